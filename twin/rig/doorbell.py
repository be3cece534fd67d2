"""Why nobody answers: what a ZeroMQ socket notices of the handshake, in words."""

from dataclasses import dataclass
from typing import Any

import zmq
from zmq.utils.monitor import parse_monitor_message

_EVENTS = (
    zmq.Event.CONNECT_RETRIED
    | zmq.Event.CONNECTED
    | zmq.Event.HANDSHAKE_SUCCEEDED
    | zmq.Event.HANDSHAKE_FAILED_AUTH
    | zmq.Event.HANDSHAKE_FAILED_NO_DETAIL
    | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
)
_MOST_AT_ONCE = 1000


@dataclass(frozen=True, slots=True)
class Trouble:
    """What keeps a connection from standing; an empty reason if nothing does that is known.

    Attributes
    ----------
    for_good
        Whether waiting will not help: keys do not change by themselves.
    """

    reason: str = ""
    for_good: bool = False


class Doorbell:
    """Listens to one connecting socket's handshakes.

    Parameters
    ----------
    context, socket, address
        Of the socket; before it connects.
    """

    def __init__(self, context: "zmq.Context[Any]", socket: "zmq.Socket[bytes]", address: str) -> None:
        self._address = address
        name = f"inproc://doorbell-{id(self)}"
        socket.monitor(name, int(_EVENTS))
        self._monitor = context.socket(zmq.PAIR)
        # Without a bound, since ZeroMQ's own thread would stand still at one; the events are few and small.
        self._monitor.rcvhwm = 0
        self._monitor.linger = 0
        self._monitor.connect(name)
        self._last, self._told = Trouble(), Trouble()

    def trouble(self) -> Trouble:
        """What is the matter now."""
        for _ in range(_MOST_AT_ONCE):
            if not self._monitor.poll(0):
                break
            event = zmq.Event(parse_monitor_message(self._monitor.recv_multipart())["event"])
            self._last = self._meaning(event) or self._last
        return self._last

    def news(self) -> Trouble:
        """What is the matter, once; nothing if it has been told, or is but a rig that is away."""
        now = self.trouble()
        if now == self._told:
            return Trouble()
        self._told = now
        return now if now.for_good else Trouble()

    def _meaning(self, event: zmq.Event) -> Trouble | None:
        match event:
            case zmq.Event.HANDSHAKE_FAILED_AUTH:
                return Trouble(
                    f"the rig at {self._address} does not know this station's key: name it to the rig (--station)",
                    True,
                )
            case zmq.Event.HANDSHAKE_FAILED_NO_DETAIL:
                return Trouble(
                    f"what answers at {self._address} is no rig, or has another key than the one given (--rig)",
                    True,
                )
            case zmq.Event.HANDSHAKE_FAILED_PROTOCOL:
                return Trouble(f"what answers at {self._address} is no rig: it speaks no CURVE", True)
            case zmq.Event.CONNECT_RETRIED if not self._last.for_good:
                return Trouble(f"nobody listens at {self._address}")
            case zmq.Event.HANDSHAKE_SUCCEEDED:
                return Trouble()
        return None
