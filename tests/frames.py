"""Plausible frames without a loop: a rig swept from 47 to 53 Hz whose coil damping is being learned."""

from collections.abc import Iterator

import numpy as np

from estimators.health import Health
from estimators.signal_check import CheckedBlock
from estimators.types import DampingCurve, Phasors, StateEstimate
from tuning.types import Powers
from twin.control.schedule import Acknowledgement, Command, GainSchedule
from twin.plant.blocks import Channel, make_block
from twin.plant.config import Plant
from twin.plant.linear import read_only
from twin.station.frame import Decision, Event, Frame, Performance

RATE = 50_000.0
BLOCK = 5_000
GRID = np.linspace(47.0, 53.0, 25)
BUDGET_W = 6.0


def schedule(scale: float = 1.0) -> GainSchedule:
    frequency = np.linspace(47.0, 53.0, 7)
    gamma = 0.4125 * ((2 * np.pi * frequency) ** 2 - (2 * np.pi * 50.0) ** 2)
    return GainSchedule(
        frequency_hz=tuple(frequency.tolist()),
        alpha_kg=(0.0,) * 7,
        beta_ns_m=tuple((scale * (3.0 + 0.3 * np.arange(7))).tolist()),
        gamma_n_m=tuple((scale * gamma).tolist()),
        low_pass_hz=(400.0,) * 7,
        high_pass_hz=(2.0,) * 7,
        on_from_hz=47.0,
        on_to_hz=53.0,
    )


def channels(plant: Plant) -> tuple[Channel, ...]:
    found = [Channel(s.name, s.unit) for s in plant.sensor]
    return (*found, Channel("vcm", "A"))


def frames(plant: Plant, duration_s: float, *, block: int = BLOCK, seed: int = 1) -> Iterator[Frame]:
    """Frames of a plant like ``rig``: control comes on after a sixth of the time, better gains at two thirds."""
    rng = np.random.default_rng(seed)
    n_blocks = round(duration_s * RATE / block)
    on_from, tuned_from = n_blocks // 6, 2 * n_blocks // 3
    names = tuple(s.name for s in plant.sensor)
    truth = 7.0 + 0.9 * (GRID - 50.0) + 0.25 * (GRID - 50.0) ** 2
    variance = np.full(len(GRID), 9.0)
    learned, in_use = np.full(len(GRID), 7.0), np.full(len(GRID), 7.0)
    phase = 0.0
    for k in range(n_blocks):
        share = k / max(1, n_blocks - 1)
        hz = 50.0 + 3.0 * np.sin(2 * np.pi * 1.25 * share)
        step = 2 * np.pi * hz / RATE
        angle = phase + step * np.arange(block)
        phase = (phase + step * block) % (2 * np.pi)
        passive = 4e-6 + 55e-6 * abs(hz - 50.0) / 3.0
        limit = 1.5e-6 + 3e-6 * abs(hz - 50.0) / 3.0
        on, tuned = k >= on_from, k >= tuned_from
        table = (limit * (1.15 if tuned else 2.2) if on else passive) * (1 + 0.02 * rng.standard_normal())
        stroke = 1.2e-3 + 5e-4 * abs(hz - 50.0)
        current = (0.25 + 0.33 * abs(hz - 50.0)) * (0.8 if tuned else 1.0) if on else 0.0
        w = 2 * np.pi * hz
        shapes = np.column_stack(
            [
                -(w**2) * table * np.cos(angle),
                -(w**2) * stroke * np.cos(angle + 0.4),
                current * np.cos(angle + 1.0),
                (2.7 * current) * np.cos(angle + 1.0) + 8.0 * w * stroke * np.sin(angle + 0.4),
                0.6 * np.cos(angle + 2.0),
                1.4 * np.cos(angle + 2.4),
            ]
        )
        noise = np.array([4e-3, 4e-3, 2e-3, 1e-2, 1e-3, 2e-3])
        measured = shapes + noise * rng.standard_normal(shapes.shape)
        values = np.column_stack([measured, current * np.cos(angle + 1.0)])
        if k == n_blocks // 2:
            values[block // 3 : block // 2, 1] = np.nan
        data = make_block(
            k * block,
            RATE,
            values.astype(np.float32),
            channels(plant),
            config_id=plant.fingerprint,
            control_on=bool(on),
            commands_applied=(1,) if k == tuned_from else (),
        )

        at = np.exp(-0.5 * ((GRID - hz) / 0.35) ** 2)
        variance = 1.0 / (1.0 / variance + 0.6 * at)
        learned = learned + (truth - learned) * np.minimum(1.0, 0.5 * at)
        noisy = learned + np.sqrt(variance) * 0.1 * rng.standard_normal(len(GRID))
        in_use = in_use + np.clip(learned - in_use, -0.05, 0.05)
        nis = 1.0 + 0.08 * rng.standard_normal() + (3.5 if abs(k - n_blocks // 2) < n_blocks // 30 else 0.0)
        ratio = np.sqrt(nis) * (1 + 0.05 * rng.standard_normal(len(names)))
        sigma = np.array([2e-7, 4e-6, 1e-4, 1e-3, 1e-3, 1e-3])
        mean = np.column_stack(
            [
                table * np.cos(angle),
                table * np.cos(angle) + stroke * np.cos(angle + 0.4),
                -w * table * np.sin(angle),
                -w * stroke * np.sin(angle + 0.4),
                shapes[:, 2],
                shapes[:, 4],
            ]
        )
        estimate = StateEstimate(
            states=("x_table", "x_absorber", "v_table", "v_absorber", "i_vcm", "i_shaker"),
            mean=read_only(mean),
            covariance=read_only(np.diag(sigma**2)),
            innovation_rms=read_only(ratio * noise),
            innovation_std=read_only(noise),
            nis=float(nis),
            sensors=names,
            innovation_count=read_only(np.full(len(names), float(block))),
            innovation_mean=read_only(0.0 * noise),
            innovation_lag1=read_only(0.0 * noise),
            nis_per_sensor=read_only(ratio**2),
            prediction_rms=read_only(ratio * noise),
        )
        command = None
        acknowledgements: tuple[Acknowledgement, ...] = ()
        decision, events = None, []
        if k == 0:
            events.append(Event(0, "info", "rig connected, 7 channels at 50 kS/s"))
        if k == on_from:
            events.append(Event(data.first_sample, "info", "control on"))
        if k == tuned_from - 1:
            command = Command(command_id=1, apply_at_sample=tuned_from * block, schedule=schedule(1.3))
            decision = Decision(
                data.first_sample, True, "operator", "displacement falls by 48 % within the budget"
            )
        if k == tuned_from:
            acknowledgements = (Acknowledgement(command_id=1, accepted=True, applied_at_sample=k * block),)
        if k == n_blocks // 2:
            events.append(Event(data.first_sample, "warning", "absorber_acceleration: samples missing"))
        powers = Powers(2.7 * current**2 / 2, 2.7 * current**2, 2.9 * current**2 / 2)
        yield Frame(
            block=data,
            checked=CheckedBlock(data, ()),
            twin=read_only(shapes),
            estimate=estimate,
            health=Health(
                verdict="consistent" if nis < 2.0 else "diverged",
                channel="" if nis < 2.0 else names[1],
                test="" if nis < 2.0 else "nis",
                reason="" if nis < 2.0 else f"the model disagrees with the rig, most in {names[1]}",
                nis=float(nis),
                nis_band=(0.97, 1.03),
                bias=0.0,
                whiteness=0.0,
                since_sample=data.first_sample,
            ),
            phasors=Phasors(
                frequency_hz=float(hz + 2e-3 * rng.standard_normal()),
                frequency_std_hz=4e-3,
                sweep_rate_hz_s=0.0,
                steady=True,
                reference="shaker_current",
                channels=names,
                amplitude=np.zeros(len(names), dtype=np.complex128),
                slope=np.zeros(len(names), dtype=np.complex128),
                variance=read_only(np.ones(len(names))),
                slope_variance=read_only(np.ones(len(names))),
                harmonic_orders=(),
                harmonics=np.zeros((0, len(names)), dtype=np.complex128),
                harmonic_variance=np.zeros((0, len(names))),
                samples=np.zeros((0, len(names))),
                sample_variance=read_only(np.ones(len(names))),
                duration_s=0.1,
            ),
            curve=DampingCurve(
                frequency_hz=read_only(GRID),
                damping_ns_m=read_only(noisy),
                std_ns_m=read_only(np.sqrt(variance)),
                noise_std_ns_m=read_only(np.sqrt(variance)),
                in_use_ns_m=read_only(in_use),
                coverage=read_only(1.0 - variance / 9.0),
                status="unestimated" if k < 3 else "learning" if share < 0.35 else "estimated",
                progress=share,
                reason="" if k % 7 else "excitation moves",
                stiffness_n_m=40_714.0,
                stiffness_std_n_m=30.0,
                stiffness_curve_n_m=read_only(np.full(len(GRID), 40_714.0)),
                stiffness_curve_std_n_m=read_only(np.full(len(GRID), 30.0)),
            ),
            performance=Performance(
                displacement_m=float(table),
                passive_m=passive,
                limit_m=limit,
                current_peak_a=float(current),
                powers=powers,
                budget_w=BUDGET_W,
            ),
            proposal=None,
            decision=decision,
            command=command,
            acknowledgements=acknowledgements,
            events=tuple(events),
        )
