"""What this machine has of the things the program needs, and what to do about the rest."""

import importlib.metadata
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zmq
from packaging.requirements import InvalidRequirement, Requirement
from rich.table import Table
from rich.text import Text

import twin

DISTRIBUTION = "atmd-twin"
OLDEST_PYTHON = (3, 11)
LEAST_FREE_BYTES = 2 * 10**9  # ten minutes of six channels at 50 kS/s, with room to work
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
REINSTALL = "run 'make clean demo' to install everything again"


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at.

    Attributes
    ----------
    required
        Without it the program does not run; the others only widen what it can do.
    remedy
        What to do about it; empty where there is nothing to do.
    """

    name: str
    ok: bool
    required: bool
    detail: str
    remedy: str = ""


def _installed_version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _declared_requirements() -> tuple[str, ...]:
    try:
        return tuple(importlib.metadata.requires(DISTRIBUTION) or ())
    except importlib.metadata.PackageNotFoundError:
        return ()


def curve_loopback() -> None:
    """Send one encrypted message to ourselves over loopback.

    Raises
    ------
    zmq.ZMQError
        If the library has no CURVE, loopback cannot be bound, or the message does not arrive in two seconds.
    """
    if not zmq.has("curve"):
        raise zmq.ZMQError(msg="this ZeroMQ was built without CURVE encryption")
    server_key, server_secret = zmq.curve_keypair()
    client_key, client_secret = zmq.curve_keypair()
    with zmq.Context() as context, context.socket(zmq.PULL) as server, context.socket(zmq.PUSH) as client:
        server.linger = client.linger = 0
        server.rcvtimeo = client.sndtimeo = 2000
        server.curve_server, server.curve_secretkey = True, server_secret
        client.curve_serverkey, client.curve_publickey = server_key, client_key
        client.curve_secretkey = client_secret
        server.bind("tcp://127.0.0.1:*")
        client.connect(server.getsockopt_string(zmq.LAST_ENDPOINT))
        client.send(b"ping")
        server.recv()


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the checks look; the defaults are this machine."""

    python: tuple[int, int, int] = sys.version_info[:3]
    platform: str = sys.platform
    environ: Mapping[str, str] = field(default_factory=lambda: os.environ)
    root: Path = Path("/")
    home: Path = field(default_factory=lambda: Path("~").expanduser())
    scripts: Path = Path(sys.executable).parent
    package: Path = Path(twin.__file__).parent
    here: Path = Path()
    requirements: Callable[[], tuple[str, ...]] = _declared_requirements
    version_of: Callable[[str], str | None] = _installed_version
    which: Callable[[str], str | None] = shutil.which
    free_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free
    loopback: Callable[[], None] = curve_loopback


def run_checks(machine: Machine | None = None) -> tuple[Check, ...]:
    """Look at everything; takes a fraction of a second and changes nothing."""
    m = machine or Machine()
    return (
        _python(m), *_packages(m), _viewer(m), _messages(m), _compiled_cache(m), _disk(m),
        _display(m), _vulkan(m), _browser(m), _threads(m), _analytics(m),
    )  # fmt: skip


def exit_code(checks: tuple[Check, ...]) -> int:
    """0 if everything that is required is there, 1 if not."""
    return 0 if all(check.ok for check in checks if check.required) else 1


def as_json(checks: tuple[Check, ...]) -> dict[str, Any]:
    """Return the checks as plain data, with the verdict on all of them under ``ok``."""
    return {"ok": exit_code(checks) == 0, "checks": [asdict(check) for check in checks]}


def as_table(checks: tuple[Check, ...]) -> Table:
    """Return the checks as a table for the terminal: what is missing comes with what to do about it."""
    table = Table(title="atmd doctor", title_justify="left")
    for heading in ("", "what", "found", "what to do"):
        table.add_column(heading, overflow="fold")
    for check in checks:
        state = (
            ("ok", "green") if check.ok else ("missing", "bold red") if check.required else ("note", "yellow")
        )
        table.add_row(Text(*state), Text(check.name), Text(check.detail), Text(check.remedy))
    return table


def find_software_vulkan(machine: Machine | None = None) -> Path | None:
    """Path of the description of Mesa's software Vulkan driver (lavapipe), if there is one."""
    return next((path for path in _vulkan_drivers(machine or Machine()) if path.name.startswith("lvp")), None)


def find_browser(machine: Machine | None = None) -> Path | None:
    """Path of a Chromium-like browser on the search path, if there is one."""
    m = machine or Machine()
    return next((Path(path) for name in BROWSERS if (path := m.which(name)) is not None), None)


def _python(m: Machine) -> Check:
    ok = m.python[:2] >= OLDEST_PYTHON
    remedy = "" if ok else "install Python 3.11 or later, then 'make clean demo PYTHON=python3.12'"
    return Check("Python", ok, True, ".".join(map(str, m.python)), remedy)


def _packages(m: Machine) -> Iterator[Check]:
    stated = m.requirements()
    if not stated:
        yield Check(DISTRIBUTION, False, True, "not installed in this environment", REINSTALL)
    for text in stated:
        try:
            requirement = Requirement(text)
        except InvalidRequirement:
            yield Check(text, False, True, "not a requirement anyone can read", REINSTALL)
            continue
        if requirement.marker is not None and not requirement.marker.evaluate():
            continue
        version = m.version_of(requirement.name)
        if version is None:
            yield Check(requirement.name, False, True, "not installed", REINSTALL)
        elif not requirement.specifier.contains(version, prereleases=True):
            yield Check(
                requirement.name, False, True, f"{version}, but {requirement.specifier} is needed", REINSTALL
            )
        else:
            yield Check(requirement.name, True, True, version)


def _viewer(m: Machine) -> Check:
    program = m.scripts / ("rerun.exe" if m.platform == "win32" else "rerun")
    if program.is_file() and os.access(program, os.X_OK):
        return Check("Rerun viewer", True, True, str(program))
    return Check("Rerun viewer", False, True, f"{program} is missing", REINSTALL)


def _messages(m: Machine) -> Check:
    name = "encrypted messages"
    try:
        m.loopback()
    except (zmq.ZMQError, OSError) as error:
        remedy = "let programs on this machine talk over 127.0.0.1 (firewall, container), or " + REINSTALL
        return Check(name, False, True, f"ZeroMQ with CURVE over loopback: {error}", remedy)
    return Check(name, True, True, "ZeroMQ with CURVE over loopback")


def _compiled_cache(m: Machine) -> Check:
    """Look where numba looks; where none of these can be written, its compiled functions fail to load."""
    places = [m.package / "__pycache__"]
    if m.environ.get("NUMBA_CACHE_DIR"):
        places.insert(0, Path(m.environ["NUMBA_CACHE_DIR"]))
    if m.platform == "darwin":
        places.append(m.home / "Library/Caches/numba")
    else:
        places.append(Path(m.environ.get("XDG_CACHE_HOME") or m.home / ".cache") / "numba")
    for place in places:
        if _writable(place):
            return Check("compiled code", True, True, f"kept under {place}")
    detail = f"none of these can be written: {', '.join(map(str, places))}"
    return Check("compiled code", False, True, detail, "set NUMBA_CACHE_DIR to a folder that you may write")


def _writable(path: Path) -> bool:
    existing = next((p for p in (path, *path.parents) if p.exists()), None)
    return existing is not None and existing.is_dir() and os.access(existing, os.W_OK)


def _disk(m: Machine) -> Check:
    free, where = m.free_bytes(m.here), m.here.resolve()
    ok = free >= LEAST_FREE_BYTES
    remedy = (
        "" if ok else f"make room: {LEAST_FREE_BYTES / 1e9:.0f} GB at least, and more for long recordings"
    )
    return Check("free disk", ok, True, f"{free / 1e9:.1f} GB in {where}", remedy)


def _display(m: Machine) -> Check:
    if m.platform in ("darwin", "win32"):
        return Check("display", True, False, "the desktop's")
    for variable in ("WAYLAND_DISPLAY", "DISPLAY"):
        if m.environ.get(variable):
            return Check("display", True, False, f"{variable}={m.environ[variable]}")
    remedy = "none needed: 'atmd demo' then runs headless and the web page still works"
    return Check("display", False, False, "neither DISPLAY nor WAYLAND_DISPLAY is set", remedy)


def _vulkan_drivers(m: Machine) -> Iterator[Path]:
    for variable in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        for name in filter(None, m.environ.get(variable, "").split(os.pathsep)):
            if Path(name).is_file():
                yield Path(name)
    for folder in ("usr/share/vulkan/icd.d", "usr/local/share/vulkan/icd.d", "etc/vulkan/icd.d"):
        yield from sorted((m.root / folder).glob("*.json"))


def _vulkan(m: Machine) -> Check:
    name = "pictures without a screen"
    if m.platform in ("darwin", "win32"):
        return Check(name, True, False, "drawn by the system's own graphics")
    software = find_software_vulkan(m)
    if software is not None:
        return Check(name, True, False, f"software Vulkan, {software}")
    others = ", ".join(path.name for path in _vulkan_drivers(m))
    detail = f"no software Vulkan; other drivers: {others}" if others else "no Vulkan driver"
    return Check(name, False, False, detail, "Debian and Ubuntu: apt install mesa-vulkan-drivers")


def _browser(m: Machine) -> Check:
    found = find_browser(m)
    if found is not None:
        return Check("browser for tests", True, False, str(found))
    return Check("browser for tests", False, False, "no Chromium", "Debian and Ubuntu: apt install chromium")


def _threads(m: Machine) -> Check:
    loose = [name for name in THREAD_VARIABLES if m.environ.get(name) != "1"]
    if not loose:
        return Check("threads", True, False, ", ".join(f"{name}=1" for name in THREAD_VARIABLES))
    detail = ", ".join(f"{name}={m.environ.get(name, 'unset')}" for name in loose)
    remedy = f"export {' '.join(f'{name}=1' for name in loose)} (small matrices run faster; make does it)"
    return Check("threads", False, False, detail, remedy)


def _analytics(m: Machine) -> Check:
    """Rerun's viewer reports its use to its makers unless told not to; it keeps the answer in a file."""
    name, remedy = "Rerun's usage reports", f"to switch them off: {m.scripts / 'rerun'} analytics disable"
    if m.platform == "darwin":
        folder = m.home / "Library/Application Support/rerun"
    elif m.platform == "win32":
        folder = Path(m.environ.get("APPDATA") or m.home / "AppData/Roaming") / "rerun/config"
    else:
        folder = Path(m.environ.get("XDG_CONFIG_HOME") or m.home / ".config") / "rerun"
    try:
        text = (folder / "analytics.json").read_text(encoding="utf-8")
        enabled = json.loads(text).get("analytics_enabled", True)
    except FileNotFoundError:
        return Check(name, False, False, "on from the viewer's second start: nobody has said no", remedy)
    except (OSError, ValueError, AttributeError):
        return Check(name, False, False, f"{folder / 'analytics.json'} cannot be read", remedy)
    if enabled is False:
        return Check(name, True, False, "off")
    return Check(name, False, False, "on", remedy)
