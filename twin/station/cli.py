"""The command line: ``atmd``."""

import signal
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.table import Table

from twin.plant.errors import InputError, RunError
from twin.station.campaign.command import campaign
from twin.station.confirm import WriteSidecarOption, YesOption, accept_recording
from twin.station.fit import fit_app
from twin.station.library import recordings_app
from twin.station.report.command import report as file_report
from twin.station.report.compare_command import compare
from twin.station.terminal import (
    JsonOption,
    channel_options,
    must_be_writable,
    number,
    people,
    percent,
    progress_bar,
    report,
    say,
    with_unit,
)

EXIT_INPUT, EXIT_RUN = 2, 3

app = typer.Typer(
    name="atmd",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(recordings_app)
app.add_typer(fit_app, name="fit")
app.command(
    epilog="Examples: atmd campaign docs/examples/campaign.toml   ·   "
    "atmd campaign docs/examples/campaign.toml --replay 17"
)(campaign)
app.command(
    "report",
    epilog="Examples: atmd report runs/demo.rrd   ·   atmd report runs/demo.rrd --plot demo.pdf --json -",
)(file_report)
app.command(
    epilog="Examples: atmd compare before.rrd after.rrd --html change.html   ·   "
    "atmd compare runs/a.rrd runs/b.rrd runs/c.rrd --reference 2 --by time --json -"
)(compare)


class ControllerName(StrEnum):
    """Control laws of ``atmd analyse``."""

    PASSIVE = "passive"
    GAIN_SCHEDULING = "gain_scheduling"
    LQ = "lq"


class FeedbackName(StrEnum):
    """What moves the absorber's resonance."""

    POSITION = "position"
    ACCELERATION = "acceleration"


class MeasurementName(StrEnum):
    """What the law takes for relative motion."""

    RELATIVE = "relative"
    ABSOLUTE = "absolute"


class PatternName(StrEnum):
    """Excitations of ``atmd rig``."""

    SWEEP = "sweep"
    SHUTTLE = "shuttle"
    TONE = "tone"


class RuleName(StrEnum):
    """Rules that ``atmd export`` makes a schedule by."""

    THESIS = "thesis"


class FixedPointName(StrEnum):
    """Fixed-point formats of ``atmd export``; auto is the shortest that keeps the margins."""

    AUTO = "auto"
    Q15 = "Q15"
    Q31 = "Q31"
    NONE = "none"


class BudgetName(StrEnum):
    """Powers that a budget may bound."""

    JOULE_MEAN = "joule_mean"
    JOULE_PEAK = "joule_peak"
    ELECTRICAL = "electrical"


RotateOption = Annotated[
    str | None,
    typer.Option(metavar="SIZE|TIME", help="Go on in another file after 500MB, 10min, or 500MB,10min."),
]
DiskBudgetOption = Annotated[
    str | None,
    typer.Option("--disk-budget", metavar="SIZE", help="All files of the recording together, such as 20GB."),
]
DropOldestOption = Annotated[
    bool,
    typer.Option(
        "--drop-oldest", help="Remove the oldest files when there is no room; else recording stops."
    ),
]


class Interrupted(BaseException):
    """The person pressed Ctrl-C, or the machine asks to end. Its own kind: the library ends silently on the usual."""

    def __init__(self, signal_number: int = signal.SIGINT) -> None:
        super().__init__()
        self.exit_code = 128 + signal_number


def _interrupt(signal_number: int, _frame: object) -> NoReturn:
    raise Interrupted(signal_number)


@contextmanager
def _until_stopped() -> Iterator[None]:
    """For what runs until it is stopped: to be stopped is its proper end."""
    try:
        yield
    except Interrupted:
        say("stopped")


def main() -> None:
    """Run a command; what the person's input or the rig did wrong ends in one message, not a traceback."""
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, _interrupt)
    try:
        app(standalone_mode=True)
    except InputError as error:
        _complain(error)
        sys.exit(EXIT_INPUT)
    except RunError as error:
        _complain(error)
        sys.exit(EXIT_RUN)
    except Interrupted as stop:
        people.print("interrupted; what was recorded until here can be read", style="yellow")
        sys.exit(stop.exit_code)


def _complain(error: Exception) -> None:
    for line in str(error).splitlines():
        people.print(f"error: {line}", style="red", markup=False, highlight=False, soft_wrap=True)


@app.command(epilog="Example: atmd demo --headless --seconds 60 --seed 1 --json -")
def demo(
    seconds: Annotated[
        float, typer.Option(min=2.0, max=3600.0, help="Duration of the sweep from 40 to 60 Hz, in s.")
    ] = 60.0,
    seed: Annotated[
        int, typer.Option(min=0, help="Sensor noise, and the true damping that is to be learned.")
    ] = 0,
    budget_w: Annotated[
        float, typer.Option(min=1e-3, help="Mean Joule power the coil may burn, R i_rms², in W.")
    ] = 4.0,
    headless: Annotated[
        bool, typer.Option("--headless", help="Open no window; draw a picture at the end.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the operator page to a browser on this machine.")
    ] = False,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Recording; runs/demo.rrd unless given.")
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="1 keeps real time, 0 goes as fast as the twin follows (if nobody watches)."
        ),
    ] = None,
    test: Annotated[
        int, typer.Option(help="Test of the thesis: 3, or 1, whose gains are unstable above 51 Hz.")
    ] = 3,
    learned: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.json",
            help="Go on from the damping learned there, if the file exists; kept there in the end.",
        ),
    ] = None,
    rotate: RotateOption = None,
    disk_budget: DiskBudgetOption = None,
    drop_oldest: DropOldestOption = False,
    json_to: JsonOption = None,
) -> None:
    """Run a simulated rig in a process of its own with the twin beside it: thesis Test 3, retuned as it runs.

    The twin learns the coil's damping against frequency, retunes the gains under a power budget, and the rig obeys.
    Attenuation is against the same rig without control. JSON keys: attenuation_mean, attenuation_worst (1 is perfect),
    current_peak_a, joule_mean_w, joule_peak_w, electrical_mean_w (largest of any 100 ms), budget_w, budget_kind,
    damping_rmse_ns_m (learned against true, 45 to 55 Hz), blocks, dropped, realtime_factor (time of data over time
    in the loop), estimation (what learner, health monitor and tracker say in the end), audit (promised against
    achieved: points, displacement_error_rms, power_error_rms and the worst, as shares), outdated_proposals, recording,
    picture. With --test 1 the twin keeps to the thesis's gains until the rig shows that they are unstable, then
    retunes once; key instability: from_hz, growth_1_s at growth_at_hz, explained, removed_by_command, displacement
    before and after.
    """
    from twin.rig.storage import storage
    from twin.station.demo import SWEEP_HZ, DemoOptions, run_demo
    from twin.station.outputs import has_display

    _must_be_rrd(save)
    must_be_writable(json_to)
    recording = save if save is not None else Path("runs") / "demo.rrd"
    window = not headless and not web and has_display()
    if test not in (1, 3):
        raise InputError(f"--test {test}: the demo knows tests 1 and 3; the others are among the recordings")
    options = DemoOptions(
        seconds, seed, budget_w, recording, window, web, speed, 1 if test == 1 else 3, learned,
        storage(rotate, disk_budget, drop_oldest=drop_oldest),
    )  # fmt: skip
    say(
        f"Simulated rig, thesis Test {test}: {SWEEP_HZ[0]:g} to {SWEEP_HZ[1]:g} Hz in {seconds:g} s; "
        f"recording to {recording}"
    )
    with progress_bar("demo") as progress:
        result = run_demo(options, say, progress, _wait_for_browser if web else None)
    if not window and not web and result["blocks"]:
        result["picture"] = _draw(recording)
    report(result, _demo_table, json_to)
    say(f"recording: {recording}   open it with: {_viewer_command(recording)}")
    if "error" in result:
        raise RunError(result["error"] + f" What was recorded until then is whole: {recording}")


@app.command(
    epilog="Examples: atmd replay runs/demo.rrd --json -   ·   "
    "atmd replay beam.npz --plant beam.toml --channel tip_displacement=y:mm --channel piezo=u:V"
)
def replay(
    file: Annotated[
        Path,
        typer.Argument(
            help="Recording: .rrd, or .tdms, .mat, .h5, .csv, .parquet, .uff, .wav, .npz with --plant.",
            show_default=False,
        ),
    ],
    plant: Annotated[
        str | None, typer.Option(metavar="PRESET|FILE", help="Plant; an .rrd carries its own.")
    ] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=ARRAY[:UNIT]",
            help="Where a sensor or command lies: y:mm, data[:,2]:g, ch1:50 g, ai0:mV@100 mV/g, or none; "
            "may be repeated.",
        ),
    ] = None,
    sample_rate: Annotated[
        float | None,
        typer.Option(min=1e-6, metavar="HZ", help="Sample rate in Hz, if the file does not say."),
    ] = None,
    sidecar: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="TOML or JSON with rate, units and channels; else the one beside the file."
        ),
    ] = None,
    yes: YesOption = False,
    write_sidecar: WriteSidecarOption = False,
    save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Record the replay.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Open Rerun's viewer.")] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the operator page, read-only, to play, pause, step and jump.")
    ] = False,
    bind: Annotated[str, typer.Option(metavar="HOST", help="Address the page is served on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")] = 0,
    from_s: Annotated[
        float,
        typer.Option(
            "--from", min=0.0, metavar="S", help="Show from here on; what was before is played unseen."
        ),
    ] = 0.0,
    to_s: Annotated[float | None, typer.Option("--to", min=0.0, metavar="S", help="End here.")] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=100.0,
            help="1 keeps the time of the data, 0 goes as fast as it can; 1 with --web, else 0, unless given.",
        ),
    ] = None,
    recompute: Annotated[
        bool,
        typer.Option(
            "--recompute",
            help="Work the tuner's answers out again, also where question and program are the same.",
        ),
    ] = False,
    block_ms: Annotated[
        float | None,
        typer.Option(
            min=1e-3, metavar="MS", help="Read in pieces of this size; results are the same to the bit."
        ),
    ] = None,
    rotate: RotateOption = None,
    disk_budget: DiskBudgetOption = None,
    drop_oldest: DropOldestOption = False,
    json_to: JsonOption = None,
) -> None:
    """Run the same loop on a recording, as fast as it goes.

    Reports how well the observer predicts each sensor one step ahead, as rms(error)/std(signal) on rows that the
    plant's parameters were not fitted on, with the known input and without; for rigs with a voice coil also
    attenuation (against the model's passive motion), powers, and whether the decisions of the run are repeated.
    To go on from an instant with other gains or parameters: atmd whatif FILE --at S --set KEY=VALUE. With --web the
    operator's page shows the run as it was, plays, pauses, steps and jumps, and answers what-if from the instant at
    hand; it stays until Ctrl-C, or without a terminal until nobody looks at it any more.
    JSON keys: nrmse, nrmse_without_input, sensors, blocks, samples, masked_samples, realtime_factor,
    decisions_repeated, answers_recomputed (of the tuner; the others were recorded for the very same questions by the
    very same program), and those of the demo.
    """
    from twin.rig.storage import storage
    from twin.station.outputs import has_display
    from twin.station.replay import ReplayEnd, ReplayOptions, run_replay

    _must_be_rrd(save)
    must_be_writable(json_to)
    if view and not has_display():
        raise InputError(
            "--view: this machine has no display; use --web, or --save FILE.rrd and open that elsewhere"
        )
    if to_s is not None and to_s <= from_s:
        raise InputError(f"--from {from_s:g} --to {to_s:g}: there is nothing between; give a later end, in s")
    options = ReplayOptions(
        plant=plant,
        channels=channel_options(channel or []),
        sample_rate_hz=sample_rate,
        sidecar=sidecar,
        recording=save,
        window=view,
        web=web,
        storage=storage(rotate, disk_budget, drop_oldest=drop_oldest),
        recompute=recompute,
        piece_s=None if block_ms is None else 1e-3 * block_ms,
        from_s=from_s,
        to_s=to_s,
        speed=(1.0 if web else 0.0) if speed is None else speed,
        bind=bind,
        port=port,
        accept=partial(accept_recording, yes=yes, write_sidecar=write_sidecar),
    )

    def end(_signal: int, _frame: object) -> NoReturn:
        signal.signal(signal.SIGINT, _interrupt)  # a second one ends what the first did not
        raise ReplayEnd

    if web:
        signal.signal(signal.SIGINT, end)
    try:
        with progress_bar("replay") as progress:
            result = run_replay(file, options, say, progress, sys.stdin.isatty)
    except ReplayEnd:
        raise Interrupted from None
    report(result, _replay_table, json_to)


@app.command(epilog="Example: atmd plants rig   ·   atmd plants my_rig.toml --json -")
def plants(
    plant: Annotated[
        str | None, typer.Argument(metavar="[PRESET|FILE]", help="A plant to check and show.")
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """List the plants that ship with the program, or check one and show its natural frequencies."""
    from twin.plant.files import load_plant, preset_names
    from twin.plant.linear import natural_frequencies_hz

    found = [load_plant(name) for name in ([plant] if plant is not None else preset_names())]
    modes = [[float(f) for f in natural_frequencies_hz(p)] for p in found]
    rows = [
        {
            "name": p.name,
            "fingerprint": p.fingerprint,
            "bodies": [b.name for b in p.body],
            "actuators": [a.name for a in p.actuator],
            "sensors": [s.name for s in p.sensor],
            "natural_frequencies_hz": hz,
            "limits": dict(p.limits),
        }
        for p, hz in zip(found, modes, strict=True)
    ]

    def table(_: dict[str, Any]) -> Table:
        out = Table("plant", "bodies", "actuators", "sensors", "natural frequencies [Hz]", title="Plants")
        for p, hz in zip(found, modes, strict=True):
            parts = (", ".join(thing.name for thing in things) for things in (p.body, p.actuator, p.sensor))
            out.add_row(p.name, *parts, ", ".join(f"{f:.2f}" for f in hz))
        return out

    report({"plants": rows}, table, json_to)


@app.command(
    epilog="Example: atmd analyse --plant engine_vcm --controller gain_scheduling --at 47:53:1 --excitation-n 1000"
)
def analyse(
    plant: Annotated[
        str, typer.Option(metavar="PRESET|FILE", help="Plant with an absorber.", show_default=False)
    ],
    controller: Annotated[
        ControllerName,
        typer.Option(help="Passive is the coil open; lq has the weights of thesis Table 6-2."),
    ] = ControllerName.PASSIVE,
    feedback: Annotated[
        FeedbackName, typer.Option(help="Gain scheduling by relative position or acceleration.")
    ] = FeedbackName.POSITION,
    measurement: Annotated[
        MeasurementName, typer.Option(help="Absolute measures the absorber alone.")
    ] = MeasurementName.RELATIVE,
    at: Annotated[
        str, typer.Option(metavar="FROM:TO:STEP|LIST", help="Excitation frequencies in Hz, or 47,50,53.")
    ] = "45:55:1",
    excitation_n: Annotated[
        float, typer.Option(metavar="N", help="Peak of the sine force on the first body, in N.")
    ] = 1000.0,
    delay_us: Annotated[
        float, typer.Option(metavar="US", help="Pure delay from measurement to force, in µs.")
    ] = 0.0,
    filters: Annotated[
        str | None,
        typer.Option(metavar="LP,HP", help="Cutoffs in Hz of the chain of thesis 7.9; none unless given."),
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """Steady state, coil power and stability of a plant under a control law, frequency by frequency.

    Continuous time, the delay exact. Amplitudes are peaks; other actuators than the absorber's coil are unpowered.
    A coil with a current loop is commanded through it, one without is an ideal current source, and without a coil the
    force is ideal and has no current. JSON keys:
    natural_frequencies_hz, and for each of points: frequency_hz, primary_displacement_m, stroke_m,
    actuator_force_n, current_a, voltage_v, joule_peak_w (R i_peak²), joule_mean_w (R i_rms²), electrical_mean_w,
    stable, delay_margin_s (from no delay; null if none below 8 ms destabilises), modulus_margin.
    """
    from twin.station.analyse import AnalyseOptions, analysis_table, run_analysis

    must_be_writable(json_to)
    options = AnalyseOptions(
        plant, controller.value, feedback.value, measurement.value, at, excitation_n, delay_us, filters
    )
    report(run_analysis(options), lambda r: analysis_table(r, options), json_to)


@app.command(epilog="Example: atmd keys station --dir keys   ·   atmd keys rig --dir keys")
def keys(
    name: Annotated[str, typer.Argument(help="Whose key it is, such as rig or station.", show_default=False)],
    folder: Annotated[Path, typer.Option("--dir", metavar="DIR", help="Where to put both halves.")] = Path(
        "keys"
    ),
) -> None:
    """Make a key pair for the wire between rig and station.

    NAME.key is the public half: give it to the other side. NAME.key_secret stays where it is used and is readable
    by you alone. Both are ZeroMQ certificates (CURVE, Z85).
    """
    from twin.rig.keys import make_keys

    public = make_keys(folder, name)
    say(f"public, for the other side: {public}")
    say(f"secret, stays here:         {public.with_suffix('.key_secret')}")


@app.command(
    epilog="Example: atmd rig --keys keys/rig.key_secret --station keys/station.key   ·   "
    "then: atmd live tcp://127.0.0.1:5555 --plant rig --keys keys/station.key_secret --rig keys/rig.key"
)
def rig(
    keys: Annotated[
        Path, typer.Option(metavar="FILE.key_secret", help="The rig's own key.", show_default=False)
    ],
    station: Annotated[
        list[Path],
        typer.Option(metavar="FILE.key", help="Public key of a station that may connect; may be repeated."),
    ],
    plant: Annotated[
        str, typer.Option(metavar="PRESET|FILE", help="Plant with a coil on an absorber.")
    ] = "rig",
    bind: Annotated[str, typer.Option(metavar="HOST", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65534, help="Port of the samples; commands have the next one.")
    ] = 5555,
    pattern: Annotated[
        PatternName, typer.Option(help="Excitation: one sweep, to and fro without end, or one frequency.")
    ] = PatternName.SHUTTLE,
    band: Annotated[
        str, typer.Option(metavar="FROM:TO", help="Excitation frequencies in Hz; a tone stays at FROM.")
    ] = "40:60",
    seconds: Annotated[float, typer.Option(min=1.0, help="Time from one end to the other, in s.")] = 60.0,
    amplitude: Annotated[
        float,
        typer.Option(
            min=1e-9, help="Peak of the excitation in the exciter's unit: V of a shaker, N of a force."
        ),
    ] = 4.0,
    control: Annotated[
        str, typer.Option(metavar="FROM:TO", help="Frequencies in Hz between which the controller acts.")
    ] = "45:55",
    high_pass_hz: Annotated[
        float,
        typer.Option(min=0.01, help="High-pass the rig starts with, in Hz; the low-pass is paired with it."),
    ] = 2.5,
    speed: Annotated[
        float,
        typer.Option(min=0.0, max=100.0, help="1 keeps real time, 0 goes as fast as the station follows."),
    ] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the sensor noise.")] = 0,
    daqmx: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="Measure a real rig by an NI-DAQmx device instead; the file says which channel is where.",
        ),
    ] = None,
) -> None:
    """Run the simulated rig as a program of its own, until Ctrl-C or the end of its sweep.

    It speaks the protocol of a real rig, obeys commands at block boundaries, enforces its plant's limits whatever it
    is told, and switches its controller off 0.5 s after it last heard of its station.

    With --daqmx the samples are those of a real rig, measured by an NI-DAQmx device; commands are refused, since its
    controller is not here. See docs/daqmx.md.
    """
    from twin.station.rig import RigOptions, rig_programme, serve, serve_device

    options = RigOptions(
        plant, keys, tuple(station), bind, port, pattern.value, *_two_hz("--band", band), seconds, amplitude,
        _two_hz("--control", control), high_pass_hz, speed, seed,
    )  # fmt: skip
    if daqmx is not None:
        device, measured = serve_device(options, daqmx)
        say(f"rig of plant '{plant}', measured as {daqmx} says; its controller takes no orders from here")
        say(f"samples on tcp://{bind}:{device.samples_port}, commands on tcp://{bind}:{device.commands_port}")
        with closing(measured), _until_stopped():
            device.run()
        return
    programme = rig_programme(options)
    server = serve(options, programme, say)
    say(f"rig '{programme.plant.name}' ({programme.plant.fingerprint}): {programme.sweep.description}")
    say(f"samples on tcp://{bind}:{server.samples_port}, commands on tcp://{bind}:{server.commands_port}")
    with _until_stopped():
        server.run()


@app.command(
    epilog="Example: atmd live tcp://127.0.0.1:5555 --plant rig --keys keys/station.key_secret --rig keys/rig.key"
)
def live(
    address: Annotated[
        str, typer.Argument(metavar="tcp://HOST:PORT", help="The rig's samples.", show_default=False)
    ],
    plant: Annotated[str, typer.Option(metavar="PRESET|FILE", help="Model of the rig.", show_default=False)],
    keys: Annotated[
        Path, typer.Option(metavar="FILE.key_secret", help="The station's own key.", show_default=False)
    ],
    rig: Annotated[Path, typer.Option(metavar="FILE.key", help="The rig's public key.", show_default=False)],
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Recording; runs/live.rrd unless given.")
    ] = None,
    web: Annotated[bool, typer.Option(help="Serve the operator page, with Rerun's viewer in it.")] = True,
    view: Annotated[bool, typer.Option("--view", help="Open Rerun's own viewer.")] = False,
    bind: Annotated[
        str, typer.Option(metavar="HOST", help="Address the operator page is served on.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")] = 0,
    automatic: Annotated[
        bool,
        typer.Option("--automatic", help="Send verified proposals at once; else the operator decides."),
    ] = False,
    budget_w: Annotated[float, typer.Option(min=1e-3, help="Power the coil may burn, in W.")] = 4.0,
    budget: Annotated[BudgetName, typer.Option(help="Which power that is.")] = BudgetName.JOULE_MEAN,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="End after so much data, in s; else at Ctrl-C.")
    ] = None,
    rotate: RotateOption = "10min",  # what Rerun keeps of a file in memory grows until the file ends
    disk_budget: DiskBudgetOption = None,
    drop_oldest: DropOldestOption = False,
    json_to: JsonOption = None,
) -> None:
    """Run the twin beside a rig: watch, learn, propose, and send what the operator accepts, until Ctrl-C.

    Channels, rate and gains come from the rig's own hello. Silence is waited out, a rig that starts again goes on in
    the same recording. At the end control is off at the rig, since nobody watches it. JSON keys: those of the demo, and
    lost, late, repeated, reordered, malformed, restarts, clock_drift_ppm, interrupted.
    """
    from tuning.retune import TuningGoal
    from twin.rig.storage import storage
    from twin.station.live_rig import LiveEnd, LiveOptions, run_live

    _must_be_rrd(save)
    must_be_writable(json_to)

    def end(_signal: int, _frame: object) -> NoReturn:
        for ending in (signal.SIGINT, signal.SIGTERM):
            signal.signal(ending, _interrupt)  # a second one ends what the first did not
        raise LiveEnd

    options = LiveOptions(
        address, plant, keys, rig, TuningGoal(budget_w=budget_w, budget_kind=budget.value),
        save if save is not None else Path("runs") / "live.rrd", web, view, bind, port, automatic, seconds,
        storage(rotate, disk_budget, drop_oldest=drop_oldest),
    )  # fmt: skip
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, end)
    try:
        result = run_live(options, say)
    except LiveEnd:
        raise Interrupted from None
    report(result, _live_table, json_to)
    say(f"recording: {options.recording}   replay it with: atmd replay {options.recording}")
    if "error" in result:
        raise RunError(f"{result['error']} What was recorded until then is whole: {options.recording}")


@app.command(
    epilog="Examples: atmd export runs/demo.rrd --out firmware   ·   "
    "atmd export tuning.json --plant rig --out firmware   ·   atmd export --plant rig --rule thesis --out firmware"
)
def export(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for PLANT_schedule.json and .h.", show_default=False)
    ],
    file: Annotated[
        Path | None,
        typer.Argument(help="Recording (.rrd), or .json of atmd tune or of an earlier export."),
    ] = None,
    plant: Annotated[
        str | None, typer.Option(metavar="PRESET|FILE", help="Plant; a recording carries its own.")
    ] = None,
    rule: Annotated[
        RuleName | None, typer.Option(help="Make the schedule by a rule, in place of a FILE.")
    ] = None,
    band: Annotated[
        str, typer.Option(metavar="FROM:TO:STEP", help="Rows of the rule's table in Hz.")
    ] = "45:55:0.5",
    fixed_point: Annotated[
        FixedPointName,
        typer.Option(help="Words of the rounded tables; auto takes the shortest that will do."),
    ] = FixedPointName.AUTO,
    margin_loss: Annotated[
        float, typer.Option(metavar="PERCENT", help="Share of a margin that rounding may cost.")
    ] = 5.0,
    budget_w: Annotated[
        float | None, typer.Option(metavar="W", help="Power budget, unless the source states one.")
    ] = None,
    budget: Annotated[
        BudgetName | None, typer.Option(help="Which power the budget bounds; joule_mean unless given.")
    ] = None,
    excitation: Annotated[
        float | None,
        typer.Option(metavar="PEAK", help="Excitation in its actuator's unit, unless the source says."),
    ] = None,
    delay_us: Annotated[
        float | None,
        typer.Option(
            metavar="US", help="Delay from measuring to the converter in µs, unless the source says."
        ),
    ] = None,
    made: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Written into both files, such as a date.")
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """Write the accepted schedule for the rig's firmware: JSON, and a C header in double and fixed point.

    Everything is verified again on the full model first, filters and delay included: a schedule that is not stable, or
    whose rounding costs more of a margin than may be lost, is not written. From a recording comes the last schedule
    the rig took, with the damping learned. JSON keys: plant, fingerprint, damping_ns_m, source, made, budget,
    excitation, loop, coil, points (per row: displacements passive, limit and reached, stroke, current, three powers,
    modulus and delay margin, slowest pole), transition (fastest sweep shown to be stable, null is any), fixed_point,
    rounding (margins before and after), files.
    """
    from twin.station.export import export_table, run_export
    from twin.station.export_source import ExportOptions

    must_be_writable(json_to)
    options = ExportOptions(
        out=out,
        file=file,
        plant=plant,
        rule=None if rule is None else rule.value,
        band=band,
        fixed_point=fixed_point.value,
        most_lost_percent=margin_loss,
        budget_w=budget_w,
        budget_kind=None if budget is None else budget.value,
        excitation=excitation,
        delay_us=delay_us,
        made=made,
    )
    report(run_export(options, say), export_table, json_to)


@app.command(
    epilog="Examples: atmd whatif --plant rig --set budget_w=1 --set low_pass_hz=800   ·   "
    "atmd whatif runs/demo.rrd --at 35 --set gamma_n_m=-3000@48 --plot whatif.png"
)
def whatif(
    file: Annotated[
        Path | None,
        typer.Argument(help="Recording of this program (.rrd): what was known at its end or --at."),
    ] = None,
    plant: Annotated[
        str | None,
        typer.Option(metavar="PRESET|FILE", help="A plant as its file has it, with the thesis's gains."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="What is different; may be repeated."),
    ] = None,
    band: Annotated[
        str, typer.Option(metavar="FROM:TO:STEP|LIST", help="Excitation frequencies in Hz.")
    ] = "45:55:1",
    at: Annotated[
        float | None,
        typer.Option(metavar="S", help="Instant of the recording in s; the twin is run on from there."),
    ] = None,
    branch_s: Annotated[
        float, typer.Option(min=0.1, max=60.0, metavar="S", help="How far it is run on, in s.")
    ] = 1.0,
    delay_us: Annotated[
        float, typer.Option(min=0.0, metavar="US", help="Loop delay in µs, with --plant.")
    ] = 50.0,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw the curves and branches.")
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """Predict motion, power and margins over the band for other settings, beside the physical limit.

    Keys of --set: budget_w, budget_kind, power_price_um_w (spend a watt only where it buys so many µm),
    modulus_margin, low_pass_hz, high_pass_hz, excitation (peak), damping_ns_m or damping_scale (of the absorber),
    absorber_mass_kg, absorber_stiffness_n_m, resistance_ohm, inductance_h, force_constant_n_a, coil (a preset's or
    plant file's), on_from_hz, on_to_hz; and gains of your own beside those proposed: alpha_kg, beta_ns_m, gamma_n_m,
    for all frequencies or, as KEY=VALUE@HZ, for one operating point. With --at the whole twin is run on from that
    instant under each candidate: control off, gains in use, gains proposed, gains given; its standard deviation covers
    the estimate, unknown forces and the damping. JSON keys: points (frequency_hz, damping_ns_m,
    passive_displacement_m, limit_displacement_m, in_use, proposed and given with displacement_m, powers, margins,
    gains), branches (name, displacement_m, displacement_std_m, current_a, off_measured_rms_m), budget_w, budget_kind,
    excitation.
    """
    from twin.station.whatif import WhatIfOptions, run_whatif, whatif_table

    must_be_writable(json_to)
    options = WhatIfOptions(file, plant, tuple(settings or ()), band, at, branch_s, delay_us, plot)
    report(run_whatif(options, say), whatif_table, json_to)


@app.command(
    epilog="Examples: atmd tune --plant engine_vcm --budget-w 25   ·   "
    "atmd tune --plant rig --band 45:55:1 --modulus-margin 0.15 --plot tune.png"
)
def tune(
    plant: Annotated[
        str, typer.Option(metavar="PRESET|FILE", help="Plant with a voice coil.", show_default=False)
    ],
    band: Annotated[
        str, typer.Option(metavar="FROM:TO:STEP|LIST", help="Excitation frequencies in Hz.")
    ] = "47:53:0.5",
    budget_w: Annotated[float, typer.Option(metavar="W", help="Power the coil may take, in W.")] = 25.0,
    budget: Annotated[
        BudgetName, typer.Option(help="Which: R i_rms², R i_peak², or the mean of v i.")
    ] = BudgetName.JOULE_MEAN,
    excitation_n: Annotated[
        float | None, typer.Option(metavar="N", help="Peak of an exciting force, in N; 1000 unless given.")
    ] = None,
    excitation_v: Annotated[
        float | None, typer.Option(metavar="V", help="Peak at an exciting shaker, in V; 4 unless given.")
    ] = None,
    delay_us: Annotated[
        float,
        typer.Option(
            metavar="US", help="Delay from measuring to the converter, in µs; its hold comes on top."
        ),
    ] = 50.0,
    modulus_margin: Annotated[float, typer.Option(metavar="M", help="Least |1 + L|.")] = 0.3,
    delay_margin_us: Annotated[
        float, typer.Option(metavar="US", help="Further delay the loop must stand, in µs.")
    ] = 200.0,
    sample_rate: Annotated[float, typer.Option(metavar="HZ", help="Of the controller, in Hz.")] = 50_000.0,
    displacement_um: Annotated[
        float | None,
        typer.Option(metavar="UM", help="Motion that is enough, in µm: reached with the least power."),
    ] = None,
    damping_std: Annotated[
        float, typer.Option(metavar="NS_M", help="Standard deviation of the absorber's damping, in Ns/m.")
    ] = 0.1,
    drift: Annotated[
        float, typer.Option(metavar="HZ", help="How far the excitation may be off within the budget, in Hz.")
    ] = 0.25,
    cutoffs: Annotated[
        str | None,
        typer.Option(metavar="LP,HP", help="Filter cutoffs in Hz; those of Test 3 or better unless given."),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw motion, power and margins.")
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """Work out gains for each frequency: as quiet as the power allows, verified, beside what physics allows.

    Every point holds its budget and limits with the excitation off by --drift and the damping by two standard
    deviations. Frequencies without gains say which limit binds and the least budget that would do. JSON keys of each of
    points: frequency_hz, limit_displacement_m (least of any linear controller), achieved_displacement_m,
    passive_displacement_m, displacement_range_m and power_range_w (damping two deviations off), joule_mean_w,
    joule_peak_w, electrical_mean_w, stroke_m, current_peak_a, voltage_peak_v, lq (states, Q, R, K of the power-budgeted
    LQ), duality_gap, gains, cutoffs, modulus_margin, delay_margin_s (8 ms where none below destabilises),
    decay_rate_1_s, active_limits (name, price, unit), solve_ms; or reason, binding, least_budget_w.
    """
    from twin.station.tune import TuneOptions, run_tune, troubles, tune_table

    must_be_writable(json_to)
    options = TuneOptions(
        plant, band, budget_w, budget.value, excitation_n, excitation_v, delay_us, modulus_margin, delay_margin_us,
        sample_rate, displacement_um, damping_std, drift, cutoffs, plot,
    )  # fmt: skip
    with progress_bar("tune") as progress:
        result = run_tune(options, say, progress)
    report(result, tune_table, json_to)
    for line in troubles(result):
        say(line)


@app.command(epilog="Example: atmd validate --report runs/validation --json validation.json")
def validate(
    report_to: Annotated[
        Path | None,
        typer.Option("--report", metavar="DIR", help="Write a web page with the thesis's plots redrawn."),
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """Compute every figure that the thesis prints and say which come out, which do not, and why.

    JSON keys: rows, each with id, source, unit, thesis, computed, relative_error (absolute), verdict (reproduced,
    differs, not reproducible) and note with the tolerance; counts by verdict. Ends with 0 once all are computed,
    whatever the verdicts.
    """
    from twin.station.validate import run_validation, validation_table

    must_be_writable(json_to)
    with progress_bar("validate") as progress:
        result = run_validation(report_to, say, progress)
    report(result, validation_table, json_to)


@app.command(epilog="Example: atmd doctor --json -")
def doctor(json_to: JsonOption = None) -> None:
    """Say what is installed, what is missing, and what to do about it. Ends with 1 if something needed is missing."""
    from twin.station.doctor import as_json, as_table, exit_code, run_checks

    checks = run_checks()
    report(as_json(checks), lambda _: as_table(checks), json_to)
    raise typer.Exit(exit_code(checks))


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        sys.stdout.write(f"atmd-twin {version('atmd-twin')}\n")
        raise typer.Exit


@app.callback()
def _top(
    _version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    """Digital twin of an active vibration rig: it runs beside the rig, learns its damping and retunes it."""


def _wait_for_browser() -> None:
    """Keep serving until the person at the terminal has seen enough; without one, end with the run."""
    if sys.stdin.isatty() and people.is_terminal:
        people.print("The run is over; the page stays. Press Enter to end.", style="yellow")
        with suppress(EOFError):
            input()


def _draw(recording: Path) -> str | None:
    from twin.station.picture import save_picture

    drawn = save_picture(recording, recording.with_suffix(".png"), time_s=None)
    if drawn.note:
        say(drawn.note)
    say(f"picture: {drawn.path} ({drawn.how})")
    return str(drawn.path)


def _demo_table(r: dict[str, Any]) -> Table:
    table = Table(
        "figure", "value", "", title="Demo: simulated rig, retuned while it runs", title_justify="left"
    )
    table.add_row(
        "mean attenuation, 45 to 55 Hz", percent(r["attenuation_mean"]), "against the same rig, passive"
    )
    table.add_row("worst attenuation", percent(r["attenuation_worst"]), "0.5 s after control came on")
    table.add_row("peak current", with_unit(r["current_peak_a"], "A"), "limit 2 A")
    budget = f"budget {r['budget_w']:g} W ({r['budget_kind'].replace('_', ' ')})"
    table.add_row("mean Joule power R i_rms²", with_unit(r["joule_mean_w"], "W"), budget)
    table.add_row("peak Joule power R i_peak²", with_unit(r["joule_peak_w"], "W"), "")
    table.add_row("mean electrical power v i", with_unit(r["electrical_mean_w"], "W"), "")
    table.add_row(
        "damping c2(f), learned - true", with_unit(r["damping_rmse_ns_m"], "Ns/m"), "rms, 45 to 55 Hz"
    )
    _add_estimation(table, r["estimation"])
    table.add_row("blocks, dropped", f"{r['blocks']}, {r['dropped']}", f"{r['commands']} commands obeyed")
    table.add_row("real-time factor", number(r["realtime_factor"]), "time of data / time in the loop")
    audit, instability = r["audit"], r["instability"]
    if audit is not None:
        errors = (audit["displacement_error_rms"], audit["power_error_rms"])
        table.add_row(
            "promised - achieved, rms",
            f"{percent(errors[0])}, {percent(errors[1])}",
            f"motion at {audit['displacement_points']}, power at {audit['power_points']} points",
        )
    if instability is not None:
        table.add_row("gains unstable from", f"{instability['from_hz']:.1f} Hz", instability["explained"])
        ended = instability["removed_by_command"]
        what = (
            "not removed" if ended is None else f"by command {ended} at {instability['removed_at_hz']:.1f} Hz"
        )
        table.add_row("removed", what, "")
    return table


def _live_table(r: dict[str, Any]) -> Table:
    table = Table("figure", "value", "", title=f"Live: {r['rig']}", title_justify="left")
    table.add_row("blocks", f"{r['blocks']}", f"{r['masked_samples']} values masked")
    wire = ", ".join(f"{r[k]} {k}" for k in ("late", "repeated", "reordered", "malformed"))
    table.add_row("blocks lost", f"{r['lost']}", wire)
    table.add_row("rig began anew", f"{r['restarts']} times", "")
    table.add_row("rig's clock against this one", with_unit(r["clock_drift_ppm"], "ppm"), "")
    if r["attenuation_mean"] is not None:
        table.add_row("mean attenuation", percent(r["attenuation_mean"]), "against the model without control")
    budget = f"budget {r['budget_w']:g} W ({r['budget_kind'].replace('_', ' ')})"
    table.add_row("mean Joule power", with_unit(r["joule_mean_w"], "W"), f"largest of any block; {budget}")
    table.add_row("commands", f"{r['commands']}", "")
    table.add_row("real-time factor", number(r["realtime_factor"]), "time of data / time in the loop")
    return table


def _add_estimation(table: Table, e: dict[str, Any]) -> None:
    """What the estimators say of themselves."""
    if e["learner_status"] is not None:
        table.add_row("damping learned", percent(e["learner_progress"]), e["learner_status"])
    if e["stiffness_n_m"] is not None and e["stiffness_std_n_m"] is not None:
        stiffness = f"{e['stiffness_n_m']:.0f} ± {e['stiffness_std_n_m']:.0f} N/m"
        table.add_row("absorber stiffness", stiffness, "from the same force balance")
    if e["force_n"] is not None:
        table.add_row(
            "exciting force", f"{e['force_n']:.4g} ± {e['force_std_n']:.2g} N", "not measured: estimated"
        )
    table.add_row("model and rig consistent", percent(e["consistent_share"]), "of the run")


def _replay_table(r: dict[str, Any]) -> Table:
    table = Table("figure", "value", "", title=f"Replay of {r['file']}", title_justify="left")
    table.add_row("plant", r["plant"], f"{r['sample_rate_hz']:g} samples/s")
    table.add_row("blocks, samples", f"{r['blocks']}, {r['samples']}", f"{r['masked_samples']} values masked")
    for s in r["sensors"]:
        without = s["nrmse_without_input"]
        remark = f"without the known input {without:.4f}" if without is not None else ""
        table.add_row(f"NRMSE {s['sensor']}", f"{s['nrmse']:.4f}", f"{remark} ({s['rows']} rows)")
    _add_estimation(table, r["estimation"])
    if r["attenuation_mean"] is not None:
        table.add_row("mean attenuation", percent(r["attenuation_mean"]), "against the model without control")
    if r["joule_mean_w"] is not None:
        table.add_row("mean Joule power", with_unit(r["joule_mean_w"], "W"), "largest of any block")
    if r["decisions_repeated"] is not None:
        table.add_row(
            "decisions repeated", "yes" if r["decisions_repeated"] else "no", f"{r['commands']} commands"
        )
    table.add_row("real-time factor", number(r["realtime_factor"]), "time of data / time in the loop")
    return table


def _two_hz(option: str, text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise InputError(f"{option} {text}: write FROM:TO in Hz, such as 45:55") from None
    return low, high


def _must_be_rrd(path: Path | None) -> None:
    if path is not None and path.suffix.lower() != ".rrd":
        raise InputError(f"--save {path}: a recording's name ends in .rrd")


def _viewer_command(recording: Path) -> str:
    return f"{Path(sys.executable).with_name('rerun')} {recording}"


if __name__ == "__main__":
    main()
