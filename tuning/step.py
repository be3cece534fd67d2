"""From the gains in use to better ones: no further at once than a stated step, and nowhere unverified."""

import math

from tuning.loop import LoopFacts, Margins, RigModel, margin_grid, margins
from tuning.retune import predict
from tuning.types import OperatingPoint
from twin.control.schedule import Gains
from twin.plant.config import Plant
from twin.plant.linear import Array, natural_frequencies_hz

LEAST_SHARE_OF_MARGIN = 0.95
"""On the way to better gains the modulus margin may be this share of the worse end's."""


def stiffness_terms(gains: Gains, frequency_hz: float) -> tuple[float, float, float]:
    """Size of the law's three terms at a frequency as stiffness [N/m]: alpha w², beta w, gamma."""
    w = math.tau * frequency_hz
    return gains.alpha_kg * w * w, gains.beta_ns_m * w, gains.gamma_n_m


def step_n_m(old: Gains, new: Gains, frequency_hz: float) -> float:
    """Largest change of any of the law's terms at a frequency [N/m]."""
    pairs = zip(stiffness_terms(old, frequency_hz), stiffness_terms(new, frequency_hz), strict=True)
    return max(abs(b - a) for a, b in pairs)


def between(old: Gains, new: Gains, share: float) -> Gains:
    """Gains part of the way from old to new: linear in the gains, geometric in the cutoffs."""
    return Gains(
        alpha_kg=old.alpha_kg + share * (new.alpha_kg - old.alpha_kg),
        beta_ns_m=old.beta_ns_m + share * (new.beta_ns_m - old.beta_ns_m),
        gamma_n_m=old.gamma_n_m + share * (new.gamma_n_m - old.gamma_n_m),
        low_pass_hz=old.low_pass_hz * (new.low_pass_hz / old.low_pass_hz) ** share,
        high_pass_hz=old.high_pass_hz * (new.high_pass_hz / old.high_pass_hz) ** share,
    )


class Stepper:
    """Limits how far gains move at once; what it puts in between is verified as proposals are.

    Parameters
    ----------
    plant
        As identified.
    damping_std_ns_m
        Standard deviation of its damping [Ns/m]; steps hold two of them off, too.
    amplitude
        Peak of the excitation, in the exciting actuator's unit.
    """

    def __init__(self, plant: Plant, facts: LoopFacts, damping_std_ns_m: float, amplitude: float) -> None:
        self._plant, self._facts = plant, facts
        self._std, self._amplitude = damping_std_ns_m, amplitude

    def limited(self, old: Gains, point: OperatingPoint, longest_n_m: float) -> Gains:
        """Return gains towards a verified point, at most one step away, or the point's own.

        The straight way between two stable designs need not be stable, and a step must not be worse than where it
        began: gains in between are taken only if they are stable with a margin near that of the worse end, burn
        no more than the worse end and move the primary no more than the gains in use. Otherwise, and where the
        gains in use are not stable themselves, it goes all the way at once.

        Parameters
        ----------
        old
            Gains in use at the point's frequency.
        longest_n_m
            Longest step of any of the law's terms at the point's frequency [N/m].
        """
        length = step_n_m(old, point.gains, point.frequency_hz)
        if length <= longest_n_m:
            return point.gains
        step = between(old, point.gains, longest_n_m / length)
        return step if self._is_fit(old, step, point) else point.gains

    def _is_fit(self, old: Gains, step: Gains, point: OperatingPoint) -> bool:
        f, plant = point.frequency_hz, self._plant
        absorber = plant.absorber
        nominal = absorber.damping_at(f) if absorber is not None else 0.0
        grid = margin_grid(self._facts.sample_rate_hz, natural_frequencies_hz(plant), 200)
        for damping in (nominal, max(0.0, nominal - 2.0 * self._std), nominal + 2.0 * self._std):
            model = RigModel(plant, self._facts, f, damping)
            if not (model.decay_rate_1_s(old) < 0.0 and model.decay_rate_1_s(step) < 0.0):
                return False
            worse = min(self._margins(model, g, grid).modulus for g in (old, point.gains))
            if self._margins(model, step, grid).modulus < LEAST_SHARE_OF_MARGIN * worse:
                return False
        model = RigModel(plant, self._facts, f)
        before, now, after = (predict(model, g, f, self._amplitude) for g in (old, step, point.gains))
        power = max(before.powers.joule_mean_w, after.powers.joule_mean_w)
        return now.powers.joule_mean_w <= power and now.displacement_m <= before.displacement_m

    @staticmethod
    def _margins(model: RigModel, gains: Gains, grid: Array) -> Margins:
        return margins(model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz), grid, gains)
