"""The embedded demonstration: a simulated rig in its own process, the twin beside it, and what came of it."""

import json
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from estimators.learned import load_learned, save_learned
from tuning.rule import scheduling_rule
from twin.plant.blocks import Channel, make_block
from twin.plant.config import DampingTable, Plant
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.plant.linear import Array
from twin.rig.embedded import EmbeddedRig
from twin.rig.programme import Programme, Sweep
from twin.rig.storage import Storage
from twin.rig.tests_of_chapter_7 import programme as thesis_programme

if TYPE_CHECKING:
    from tuning.loop import LoopFacts
    from tuning.retune import TuningGoal
    from twin.station.retuning import RetuningSettings
    from twin.station.session import Session
    from twin.station.worker import Tuner

TABLE_HZ = tuple(float(f) for f in np.arange(45.0, 55.01, 0.5))
SWEEP_HZ = (40.0, 60.0)
DRIVE_V = 4.0


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """What the person asked for.

    Attributes
    ----------
    speed
        1 keeps real time, 0 goes as fast as the twin follows; None chooses: real time when somebody watches.
    recording
        File to write.
    learned
        File to go on from, if it is there, and to keep in the end what was learned.
    """

    seconds: float = 60.0
    seed: int = 0
    budget_w: float = 4.0
    recording: Path = Path("demo.rrd")
    window: bool = False
    web: bool = False
    speed: float | None = None
    test: Literal[1, 3] = 3
    learned: Path | None = None
    storage: Storage = field(default_factory=Storage)


GROWTH_SEEN_1_S = 0.3
"""In Test 1 the twin holds its retuning back until the coil's current grows so fast by itself."""


def true_damping(seed: int) -> DampingTable:
    """Coil damping of the simulated rig [Ns/m], which the twin is not told.

    The thesis's fit for 45 to 55 Hz, ``9.58 f - 0.103 f² - 208`` (7.9.2), moved along the frequency axis and
    scaled by amounts the seed decides, and held beyond.
    """
    rng = np.random.default_rng([seed, 0xC2])
    scale, shift = rng.uniform(0.85, 1.15), rng.uniform(-1.0, 1.0)
    f = np.arange(45.0, 55.01, 0.5)
    fit = np.polyval([-0.103, 9.58, -208.0], np.clip(f + shift, 45.0, 55.0))
    return DampingTable(frequency_hz=tuple(f.tolist()), ns_m=tuple((scale * fit).tolist()))


def demo_programme(seconds: float, seed: int) -> Programme:
    """Program of thesis Test 3: sweep 40 to 60 Hz at 4 V, control on between 45 and 55 Hz (Table 7-6).

    The gains the rig starts with know only the open coil's 7 Ns/m of Table 7-3.
    """
    plant = load_plant("rig")
    return Programme(
        plant=plant,
        true_damping=true_damping(seed),
        sweep=Sweep(from_hz=SWEEP_HZ[0], to_hz=SWEEP_HZ[1], duration_s=seconds, amplitude_v=DRIVE_V),
        schedule=scheduling_rule(plant, TABLE_HZ, high_pass_hz=2.5),
        seed=seed,
    )


def facts_of(programme: Programme) -> "LoopFacts":
    """Sampling and delay of a programme's control loop."""
    from tuning.loop import LoopFacts

    return LoopFacts(
        programme.sample_rate_hz, programme.loop_delay_samples, programme.measurement == "relative"
    )


def session_for(
    programme: Programme,
    channels: tuple[Channel, ...],
    goal: "TuningGoal",
    retuning: "RetuningSettings | None" = None,
    tuner: "Tuner | None" = None,
    learned: dict[str, Any] | None = None,
) -> "Session":
    """Return the twin of a programme: it knows everything of it but the true damping, unless it learned that before."""
    from twin.station.retuning import RetuningSettings
    from twin.station.session import Session, SessionSettings

    settings = SessionSettings(
        loop=facts_of(programme),
        schedule=programme.schedule,
        goal=goal,
        retuning=retuning or RetuningSettings(),
        learned=learned,
    )
    return Session(programme.plant, channels, programme.sample_rate_hz, settings, tuner=tuner)


def run_demo(
    options: DemoOptions,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
    linger: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Run the demonstration to its end, or to the rig's.

    Parameters
    ----------
    say
        Takes lines for the person.
    progress
        Takes blocks done and blocks in all.
    linger
        Called when the run is over and its recording finished, while the views are still served.

    Returns
    -------
    dict
        Figures by name (see the command's help); ``error`` is there if the rig failed.
    """
    if options.test == 1:
        programme = thesis_programme("test1", seconds=options.seconds, seed=options.seed)
    else:
        programme = demo_programme(options.seconds, options.seed)
    speed = options.speed if options.speed is not None else (1.0 if options.window or options.web else 0.0)
    with EmbeddedRig(programme, speed) as rig:
        # The rig starts up on another core while this process loads its solvers and viewer: seconds saved.
        from tuning.retune import TuningGoal
        from twin.station.desk import Desk
        from twin.station.outputs import Outputs
        from twin.station.page_server import OperatorPage
        from twin.station.panel import wire_state
        from twin.station.retuning import RetuningSettings
        from twin.station.run import Loop
        from twin.station.worker import TunerProcess

        error = ""
        goal, retuning = TuningGoal(budget_w=options.budget_w), RetuningSettings()
        if options.test == 1:
            # One retune for the whole table, and only once the rig shows what the gains do.
            goal = replace(goal, reach_hz=SWEEP_HZ[1] - SWEEP_HZ[0])
            retuning = replace(retuning, only_if_unstable=True, only_if_growing_1_s=GROWTH_SEEN_1_S)
        # Where the rig does not wait for the twin, the twin does not wait for its tuner either.
        lag = None if speed else retuning.lag_blocks
        tuner = TunerProcess(programme.plant, facts_of(programme), goal, lag)
        learned = _learned_before(options.learned, programme.plant)
        session = session_for(programme, rig.channels, goal, retuning, tuner, learned)
        setup = describe_run(programme, options)
        with (
            closing(tuner),
            Outputs(
                session,
                recording=options.recording,
                storage=options.storage,
                setup=setup,
                run_config_json=json.dumps(
                    {"programme": programme.model_dump(mode="json"), "session": session.configuration()}
                ),
                seed=options.seed,
                window=options.window,
                web=options.web,
            ) as outputs,
            ExitStack() as stack,
        ):
            if outputs.moved_aside is not None:
                say(f"{options.recording} was there already; kept as {outputs.moved_aside}")
            session.warm_up()
            rig.connect()
            gateway = rig.gateway
            desk: Desk | None = None
            if options.web:
                desk = Desk(
                    session, gateway, lambda: wire_state(gateway), lambda: outputs.frames_unseen, outputs.url
                )
                page = stack.enter_context(OperatorPage(desk))
                say(f"operator page: {page.url}")
            loop = Loop(session, outputs, gateway, desk)
            log = loop.log
            try:
                for block in rig.blocks():
                    loop.turn(block)
                    progress(log.blocks, programme.n_blocks)
            except RunError as failure:
                error = str(failure)
            outputs.finish()
            if desk is not None:
                desk.end()
            gateway.close()
            if options.learned is not None and session.learner is not None and log.blocks:
                save_learned(options.learned, session.learner, programme.plant)
                say(f"what was learned: {options.learned}")
            dropped, unseen = gateway.dropped, outputs.frames_unseen
            passive = passive_displacement(programme, log.blocks)
            result = {
                **log.figures(passive, programme.true_damping),
                "estimation": log.estimation(),
                "budget_w": goal.budget_w,
                "budget_kind": goal.budget_kind,
                "dropped": dropped,
                "frames_unseen": unseen,
                "realtime_factor": loop.realtime_factor,
                "seconds": options.seconds,
                "seed": options.seed,
                "recording": str(options.recording),
                "picture": None,
            }
            if error:
                result["error"] = error
            if linger is not None:
                linger()
            return result


def _learned_before(path: Path | None, plant: Plant) -> dict[str, Any] | None:
    """What a file has of an earlier run; None if there is no file yet."""
    if path is None or not path.exists():
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--learned {path}: there is no folder {path.absolute().parent}; make it first")
        return None
    return load_learned(path, plant).state()


def passive_displacement(programme: Programme, n_blocks: int) -> Array:
    """Motion of the same rig without control [m], block by block at the excitation, from a run of its own."""
    from estimators.excitation import ExcitationTracker, choose_reference
    from twin.rig.simulated import SimulatedRig

    quiet = programme.schedule.model_copy(update={"on_from_hz": 1e-3, "on_to_hz": 1e-3})
    rig = SimulatedRig(programme.model_copy(update={"schedule": quiet}))
    names = tuple(c.name for c in rig.channels)
    reference = choose_reference(programme.plant, names)
    if reference is None:
        raise RunError("the rig records nothing that tells its excitation")
    tracker = ExcitationTracker(reference, names)
    column = next(
        i for i, s in enumerate(programme.plant.sensor)
        if s.kind == "acceleration" and s.of == programme.plant.primary.name
    )  # fmt: skip
    out = np.full(n_blocks, np.nan)
    for k in range(n_blocks):
        first = rig.next_sample
        values, _, _ = rig.next_block()
        phasors = tracker.advance(make_block(first, programme.sample_rate_hz, values, rig.channels))
        if phasors is not None:
            out[k] = abs(phasors.amplitude[column]) / (2.0 * np.pi * phasors.frequency_hz) ** 2
    return out


def describe_run(programme: Programme, options: DemoOptions) -> str:
    """Markdown about the run, for the view."""
    sweep = programme.sweep
    s = programme.schedule
    return "\n".join(
        [
            f"# Thesis Test {options.test}, simulated rig",
            "",
            f"- excitation: {sweep.amplitude:g} {sweep.unit} on the {programme.exciter.name}, {sweep.description}",
            f"- control on between {s.on_from_hz:g} and {s.on_to_hz:g} Hz",
            f"- loop delay {programme.loop_delay_samples} sample + hold at {programme.sample_rate_hz / 1e3:g} kS/s",
            f"- budget {options.budget_w:g} W mean Joule power (R i_rms²)",
            f"- seed {options.seed}: sensor noise and the true coil damping, which the twin has to learn"
            if options.test == 3
            else "- gains of the test's own, unstable from 52 Hz; retuned once, when the rig shows it",
        ]
    )
