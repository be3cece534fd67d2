"""CURVE keys on disk, in ZeroMQ's certificate format: ``NAME.key`` to give away, ``NAME.key_secret`` to keep."""

import os
import stat
from pathlib import Path

from zmq.auth import create_certificates, load_certificate

from twin.plant.errors import InputError
from twin.rig.wire import KeyPair


def make_keys(folder: Path, name: str) -> Path:
    """Make a new pair and return the path of its public half.

    Raises
    ------
    InputError
        If the name is in use: a key that others know is not thrown away silently.
    """
    if not name or not all(c.isalnum() or c in "-_" for c in name):
        raise InputError(f"key name '{name}': use letters, digits, - and _")
    public, secret = folder / f"{name}.key", folder / f"{name}.key_secret"
    for path in (public, secret):
        if path.exists():
            raise InputError(
                f"{path}: there already; choose another name, or remove both halves of that key first"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Readable by nobody else from its first moment on.
        before = os.umask(0o077)
        try:
            create_certificates(folder, name)
        finally:
            os.umask(before)
        public.chmod(0o644)
    except OSError as error:
        raise InputError(f"{folder}: keys cannot be written ({error.strerror})") from error
    return public


def load_public(path: Path) -> bytes:
    """Public key of a ``.key`` file, Z85.

    Raises
    ------
    InputError
        If there is no key in it.
    """
    return _load(path)[0]


def load_pair(path: Path) -> KeyPair:
    """Both halves from a ``.key_secret`` file.

    Raises
    ------
    InputError
        If it holds no secret key, or others on this machine can read it.
    """
    public, secret = _load(path)
    if secret is None:
        raise InputError(f"{path}: holds no secret key; give the file that ends in .key_secret")
    if os.name == "posix" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise InputError(f"{path}: others on this machine can read this secret key; run: chmod 600 {path}")
    return KeyPair(public, secret)


def _load(path: Path) -> tuple[bytes, bytes | None]:
    try:
        public, secret = load_certificate(path)
    except OSError as error:
        raise InputError(f"{path}: no such key file; make one with: atmd keys NAME") from error
    except ValueError as error:
        raise InputError(f"{path}: is no key file ({error}); make one with: atmd keys NAME") from error
    if len(public) != 40 or (secret is not None and len(secret) != 40):
        raise InputError(f"{path}: a key has 40 characters (Z85); the file is damaged")
    return public, secret
