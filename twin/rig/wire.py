"""The wire between rig and station: ZeroMQ with CURVE, samples on PUB/SUB, commands on DEALER/ROUTER.

Samples are multipart ``[topic, JSON header, raw little-endian float32]``; every other message is one JSON object
with a ``type``. The rig binds both sockets and knows its station's public key; the station knows the rig's.
"""

import json
from dataclasses import dataclass
from typing import Any

import zmq

from twin.plant.errors import RunError

TOPIC_HELLO = b"hello"
TOPIC_SAMPLES = b"samples"
TOPIC_END = b"end"
MAX_MESSAGE_BYTES = 64 * 1024 * 1024
MAX_SAMPLE = 2**62
ANOTHER_STATION = "another station has the controls"


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE key pair, Z85-encoded."""

    public: bytes
    secret: bytes

    @classmethod
    def fresh(cls) -> "KeyPair":
        """Make a new pair."""
        return cls(*zmq.curve_keypair())

    def __repr__(self) -> str:
        return f"KeyPair(public={self.public!r})"  # a secret has no business in a log


def guard_server(socket: zmq.Socket[bytes], keys: KeyPair) -> None:
    """Make a bound socket speak CURVE as the server; who may connect is the authenticator's to say."""
    socket.curve_server = True
    socket.curve_secretkey = keys.secret
    socket.curve_publickey = keys.public
    socket.zap_domain = b"rig"
    _bound(socket)


def guard_client(socket: zmq.Socket[bytes], keys: KeyPair, server_public: bytes) -> None:
    """Make a connecting socket speak CURVE to one known server."""
    socket.curve_secretkey = keys.secret
    socket.curve_publickey = keys.public
    socket.curve_serverkey = server_public
    _bound(socket)


def _bound(socket: zmq.Socket[bytes]) -> None:
    socket.linger = 0
    socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)


def encode(message: dict[str, Any]) -> bytes:
    """One JSON message."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode()


def decode(frame: bytes) -> dict[str, Any]:
    """Read one JSON message.

    Raises
    ------
    RunError
        If the bytes are no JSON object.
    """
    try:
        message = json.loads(frame)
    except (ValueError, RecursionError) as error:  # ValueError also for a number of thousands of digits
        raise RunError(f"a message of {len(frame)} bytes is not JSON: {error}") from error
    if not isinstance(message, dict):
        raise RunError("a message is not a JSON object")
    return message
