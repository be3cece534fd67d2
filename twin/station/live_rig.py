"""``atmd live``: the loop on a real connection, which may fall silent and come back."""

import json
import math
import re
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tuning.loop import LoopFacts
from tuning.retune import TuningGoal
from twin.plant.blocks import Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.rig.gateway import RigGateway
from twin.rig.keys import load_pair, load_public
from twin.rig.messages import Hello
from twin.rig.storage import Storage
from twin.station.desk import Desk
from twin.station.orders import Order
from twin.station.outputs import Outputs
from twin.station.page_server import OperatorPage
from twin.station.panel import wire_state
from twin.station.retuning import RetuningSettings
from twin.station.run import Loop
from twin.station.session import Session, SessionSettings
from twin.station.worker import TunerProcess

CONNECT_S = 30.0
SILENT_S = 1.0
"""Silence worth a word."""


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What the person asked for.

    Attributes
    ----------
    address
        ``tcp://HOST:PORT`` of the rig's samples; commands go to the next port.
    bind, port
        Where the operator page is served, if ``web``; port 0 takes a free one.
    automatic
        Send verified proposals at once; else they wait for the operator.
    seconds
        End after so much data; None goes on until Ctrl-C or the rig's end.
    """

    address: str
    plant: str
    keys: Path
    rig: Path
    goal: TuningGoal
    recording: Path | None = None
    web: bool = True
    window: bool = False
    bind: str = "127.0.0.1"
    port: int = 0
    automatic: bool = False
    seconds: float | None = None
    storage: Storage = field(default_factory=Storage)


class LiveEnd(BaseException):
    """The person at the terminal has had enough."""


def run_live(options: LiveOptions, say: Callable[[str], None]) -> dict[str, Any]:
    """Run the twin beside a rig until its end, the person's, or the time asked for.

    Parameters
    ----------
    say
        Takes lines for the person.

    Returns
    -------
    dict
        Figures by name (see the command's help); ``error`` is there if the connection failed for good.

    Raises
    ------
    InputError
        If address, keys or plant cannot be used.
    RunError
        If no rig answers.
    """
    samples, commands = addresses(options.address)
    plant = load_plant(options.plant)
    gateway = RigGateway(plant, samples, commands, load_pair(options.keys), load_public(options.rig))
    with closing(gateway), ExitStack() as stack:
        say(f"waiting for the rig at {samples}")
        hello = gateway.connect(timeout_s=CONNECT_S, start=False)
        session, tuner = _session(plant, hello, gateway.channels, options)
        if tuner is not None:
            stack.enter_context(closing(tuner))
        outputs = stack.enter_context(_outputs(session, hello, options))
        if outputs.moved_aside is not None:
            say(f"{options.recording} was there already; kept as {outputs.moved_aside}")
        session.warm_up()
        desk: Desk | None = None
        if options.web:
            desk = Desk(
                session, gateway, lambda: wire_state(gateway), lambda: outputs.frames_unseen, outputs.url
            )
            page = stack.enter_context(OperatorPage(desk, options.bind, options.port))
            say(f"operator page: {page.url}")
            if page.warning:
                say(f"warning: {page.warning}")
        remarks = _Remarks(gateway, say)
        loop = Loop(session, outputs, gateway, desk, remarks)
        error, interrupted = "", False
        gateway.start()
        say(f"connected: {_in_words(hello)}")
        try:
            _go_on(loop, gateway, options, _Silence(say, remarks))
        except RunError as failure:
            error = str(failure)
        except LiveEnd:
            interrupted = True
        outputs.finish()
        counts = gateway.counts
        result = {
            **loop.log.figures(),
            "estimation": loop.log.estimation(),
            "rig": options.address,
            "plant": plant.name,
            "budget_w": options.goal.budget_w,
            "budget_kind": options.goal.budget_kind,
            "lost": counts.lost,
            "late": counts.late,
            "repeated": counts.repeated,
            "reordered": counts.reordered,
            "malformed": gateway.malformed,
            "restarts": gateway.restarts,
            "clock_drift_ppm": _finite(gateway.drift.ppm),
            "frames_unseen": outputs.frames_unseen,
            "realtime_factor": loop.realtime_factor,
            "interrupted": interrupted,
            "recording": str(options.recording) if options.recording is not None else None,
        }
        if error:
            result["error"] = error
        return result


def _go_on(
    loop: Loop, gateway: RigGateway, options: LiveOptions, on_silence: Callable[[float], None]
) -> None:
    restarts = gateway.restarts
    for block in gateway.blocks(patience_s=math.inf, on_silence=on_silence):
        order = None
        if gateway.restarts != restarts:
            restarts, schedule = gateway.restarts, gateway.hello.schedule
            order = Order(kind="found", schedules=() if schedule is None else (schedule,))
        loop.turn(block, order=order)
        if options.seconds is not None and loop.log.samples >= options.seconds * block.sample_rate_hz:
            return


def addresses(address: str) -> tuple[str, str]:
    """Both sockets' addresses from that of the samples.

    Raises
    ------
    InputError
        If it is no ``tcp://HOST:PORT``.
    """
    found = re.fullmatch(r"tcp://([^\s/:*]+|\[[0-9a-fA-F:]+\]):(\d{1,5})", address)
    port = int(found[2]) if found else 0
    if found is None or not 0 < port < 65535:
        raise InputError(f"'{address}': write tcp://HOST:PORT, such as tcp://127.0.0.1:5555")
    return address, f"tcp://{found[1]}:{port + 1}"


def _session(
    plant: Plant, hello: Hello, channels: tuple[Channel, ...], options: LiveOptions
) -> tuple[Session, TunerProcess | None]:
    tuner, loop = None, None
    if hello.schedule is not None:
        loop = LoopFacts(hello.sample_rate_hz, hello.loop_delay_samples, hello.measurement == "relative")
        tuner = TunerProcess(plant, loop, options.goal, None)
    settings = SessionSettings(
        loop=loop,
        schedule=hello.schedule,
        goal=options.goal,
        retuning=RetuningSettings(approve=not options.automatic),
    )
    return Session(plant, channels, hello.sample_rate_hz, settings, tuner=tuner), tuner


def _outputs(session: Session, hello: Hello, options: LiveOptions) -> Outputs:
    config = {"rig": hello.model_dump(mode="json"), "session": session.configuration()}
    return Outputs(
        session,
        recording=options.recording,
        storage=options.storage,
        setup=f"# Live rig\n\n{_in_words(hello)}",
        run_config_json=json.dumps(config),
        seed=None,
        window=options.window,
        web=options.web,
    )


def _in_words(hello: Hello) -> str:
    of = f" '{hello.plant}'" if hello.plant else ""
    return (
        f"rig{of}, {len(hello.channels)} channels at {hello.sample_rate_hz / 1e3:g} kS/s in blocks of "
        f"{hello.block_samples}, "
        + ("with a controller" if hello.schedule is not None else "without a controller")
    )


class _Remarks:
    """What connection and rig have to say, once each, for the log and the terminal."""

    def __init__(self, gateway: RigGateway, say: Callable[[str], None]) -> None:
        self._gateway, self._say, self._notice, self._lost = gateway, say, "", 0
        self._kept: tuple[str, ...] = ()

    def __call__(self) -> tuple[str, ...]:
        """What there is to say since the last call."""
        self.look()
        found, self._kept = self._kept, ()
        return found

    def look(self) -> None:
        """Tell the person what is new, and keep it for the log, which goes on with the next block."""
        found = list(self._gateway.events())
        notice, lost = self._gateway.notice, self._gateway.dropped
        if notice != self._notice and notice:
            found.append(f"rig: {notice}")
        if lost != self._lost:
            found.append(f"{lost - self._lost} blocks lost and masked")
        self._notice, self._lost = notice, lost
        for line in found:
            self._say(line)
        self._kept = (*self._kept, *found)


class _Silence:
    """Says once that the rig has fallen silent, and goes on waiting."""

    def __init__(self, say: Callable[[str], None], remarks: _Remarks) -> None:
        self._say, self._remarks, self.seconds = say, remarks, 0.0

    def __call__(self, seconds: float) -> None:
        self._remarks.look()
        if seconds >= SILENT_S > self.seconds:
            self._say("the rig is silent; waiting for it, Ctrl-C ends")
        self.seconds = seconds


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
