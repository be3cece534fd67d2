"""``atmd keys`` and ``atmd rig``: the simulated rig as a program of its own, for a station that connects to it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from tuning.rule import scheduling_rule
from twin.plant.config import DampingTable, Plant, Shaker
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.daqmx import DaqmxRig
from twin.rig.excitation import Shuttle, Sweep, Tone
from twin.rig.keys import load_pair, load_public
from twin.rig.process import warm_up
from twin.rig.programme import Programme, with_accelerometers
from twin.rig.server import RigServer
from twin.rig.simulated import SimulatedRig

TABLE_STEP_HZ = 0.5
SENSOR_NOISE = 1e-3
FOREVER_S = 365.0 * 24.0 * 3600.0

Pattern = Literal["sweep", "shuttle", "tone"]


@dataclass(frozen=True, slots=True)
class RigOptions:
    """What the person asked for.

    Attributes
    ----------
    amplitude
        Peak of the excitation in the exciter's own unit.
    from_hz, to_hz, seconds
        Of one sweep; a tone stays at ``from_hz``.
    band_hz
        Where the controller acts.
    """

    plant: str
    keys: Path
    stations: tuple[Path, ...]
    host: str = "127.0.0.1"
    port: int = 5555
    pattern: Pattern = "shuttle"
    from_hz: float = 40.0
    to_hz: float = 60.0
    seconds: float = 60.0
    amplitude: float = 4.0
    band_hz: tuple[float, float] = (45.0, 55.0)
    high_pass_hz: float = 2.5
    speed: float = 1.0
    seed: int = 0
    true_damping: DampingTable | None = field(default=None)


def rig_programme(options: RigOptions) -> Programme:
    """Program of a standing rig: it starts with the thesis's scheduling rule.

    Raises
    ------
    InputError
        If the plant cannot be run.
    """
    plant = load_plant(options.plant)
    if plant.absorber is None or plant.voice_coil is None:
        raise InputError(
            f"plant '{plant.name}' has no voice coil on an absorber: it is no rig to be controlled"
        )
    plant = with_accelerometers(plant, SENSOR_NOISE)
    low, high = options.band_hz
    table = np.arange(low, high + 0.5 * TABLE_STEP_HZ, TABLE_STEP_HZ)
    if not 0.0 < low < high or len(table) < 2:
        raise InputError(f"control band {low:g}:{high:g} Hz: give two frequencies, the lower one first")
    try:
        return Programme(
            plant=plant,
            true_damping=options.true_damping or _own_damping(plant),
            sweep=_excitation(options, plant),
            schedule=scheduling_rule(plant, [float(f) for f in table], high_pass_hz=options.high_pass_hz),
            seed=options.seed,
        )
    except ValueError as error:
        raise InputError(f"plant '{plant.name}' cannot be run: {error}") from error


def serve(
    options: RigOptions, programme: Programme, say: Callable[[str], None] = lambda _: None
) -> RigServer:
    """Bind a rig; `RigServer.run` runs it.

    Parameters
    ----------
    say
        Takes lines for the person: who has the controls, and what was refused.

    Raises
    ------
    InputError
        If keys are missing or the ports are taken.
    """
    if not options.stations:
        raise InputError(
            "no station may connect: name at least one public key with --station FILE.key "
            "(make one with: atmd keys station)"
        )
    keys = load_pair(options.keys)
    stations = [load_public(path) for path in options.stations]
    rig = SimulatedRig(programme)
    warm_up(programme)
    return RigServer(
        rig,
        keys,
        stations,
        options.speed,
        host=options.host,
        samples_port=options.port,
        commands_port=options.port + 1 if options.port else 0,
        stands_alone=True,
        say=say,
    )


def serve_device(options: RigOptions, setup: Path) -> tuple[RigServer, DaqmxRig]:
    """Bind a rig that an NI-DAQmx device measures; `RigServer.run` runs it, then close the rig. It obeys no command.

    Raises
    ------
    InputError
        If keys, package, driver or device are missing, the file does not fit the plant, or the ports are taken.
    """
    keys = load_pair(options.keys)
    stations = [load_public(path) for path in options.stations]
    rig = DaqmxRig(load_plant(options.plant), setup)
    try:
        server = RigServer(
            rig,
            keys,
            stations,
            math.inf,  # the device's clock sets the pace
            host=options.host,
            samples_port=options.port,
            commands_port=options.port + 1 if options.port else 0,
            stands_alone=True,
        )
    except InputError:
        rig.close()
        raise
    return server, rig


def _excitation(options: RigOptions, plant: Plant) -> Sweep | Shuttle | Tone:
    others = [a for a in plant.actuator if a is not plant.voice_coil]
    exciters = [a for a in others if isinstance(a, Shaker)] or others
    if not exciters:
        raise InputError(f"plant '{plant.name}' has no actuator besides its coil that could excite it")
    amplitude = {f"amplitude_{exciters[0].input_unit.lower()}": options.amplitude}
    match options.pattern:
        case "tone":
            return Tone(frequency_hz=options.from_hz, duration_s=FOREVER_S, **amplitude)  # type: ignore[arg-type]
        case "sweep":
            return Sweep(
                from_hz=options.from_hz,
                to_hz=options.to_hz,
                duration_s=options.seconds,
                **amplitude,  # type: ignore[arg-type]
            )
        case "shuttle":
            return Shuttle(
                from_hz=options.from_hz, to_hz=options.to_hz, leg_s=options.seconds, duration_s=FOREVER_S,
                **amplitude,  # type: ignore[arg-type]
            )  # fmt: skip


def _own_damping(plant: Plant) -> DampingTable:
    absorber = plant.absorber
    if absorber is None:
        raise InputError(f"plant '{plant.name}' has no absorber")
    ends = (40.0, 60.0)
    return DampingTable(frequency_hz=ends, ns_m=tuple(absorber.damping_at(f) for f in ends))
