"""Coil damping against frequency, learned block by block from the absorber's force balance."""

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from estimators.curve_basis import CurveBasis, PiecewiseLinear, Quadratic
from estimators.curve_filter import CurveFilter
from estimators.force_balance import AbsorberBalance, ForceBalance
from estimators.types import DampingCurve, DampingStatus
from twin.plant.config import DampingTable, Plant
from twin.plant.linear import Array, read_only

__all__ = ["AbsorberBalance", "DampingLearner", "ForceBalance", "LearnerSettings"]

STRAYS_BELIEVED = 5
"""So many outliers in a row are no outliers: it is the curve that is wrong, where they are."""

BLOCKS_FOR_ESTIMATE = 10
STIFFNESS_PRIOR_SHARE, STIFFNESS_LENGTH_HZ = 0.1, 30.0
MISFIT_MEMORY_S, MISFIT_ALLOWED, MOST_MISFIT = 3.0, 1.5, 9.0


@dataclass(frozen=True, slots=True)
class LearnerSettings:
    """How the damping curve is learned.

    Attributes
    ----------
    basis
        Family of curves: ``piecewise_linear`` supposes no shape, ``quadratic`` is the thesis's fit.
    from_hz, to_hz, step_hz
        Knots at which the curve is told [Hz].
    prior_std_ns_m, prior_length_hz
        Before anything is measured, the curve may be off by this much, alike over about this many hertz.
    forgetting_ns_m_sqrt_s
        Random walk of the damping at the excitation [Ns/m per sqrt(s)], once readings there are further from the
        curve than their noise explains; elsewhere what is known stays known.
    floor_std_ns_m
        No single block is believed better than this: curvature between knots.
    floor_std_n_m
        The stiffness is not believed better than this, however many blocks agree [N/m].
    timing_std_s
        Delay of any of the channels against the others is known no better than this; one sample at 50 kS/s.
    rate_limit_ns_m_s
        How fast the value in use follows the learned one.
    max_block_std_ns_m, max_transient_1_s
        Gates: a block with less excitation, or faster transients, is not taken in.
    settle_s
        Nor are blocks that begin less than this after a transient, a jump or an objection.
    outlier_sigmas
        A block further from the curve than this is not taken in, unless it is one of several in a row.
    wanted_from_hz, wanted_to_hz, wanted_std_ns_m
        Progress is complete when the damping is known that well in this band.
    """

    basis: Literal["piecewise_linear", "quadratic"] = "piecewise_linear"
    from_hz: float = 35.0
    to_hz: float = 65.0
    step_hz: float = 0.5
    prior_std_ns_m: float = 8.0
    prior_length_hz: float = 10.0
    forgetting_ns_m_sqrt_s: float = 0.3
    floor_std_ns_m: float = 0.005
    floor_std_n_m: float = 5.0
    timing_std_s: float = 20e-6
    rate_limit_ns_m_s: float = 5.0
    max_block_std_ns_m: float = 1.0
    max_transient_1_s: float = 1.0
    settle_s: float = 0.1
    outlier_sigmas: float = 6.0
    wanted_from_hz: float = 45.0
    wanted_to_hz: float = 55.0
    wanted_std_ns_m: float = 0.3

    def __post_init__(self) -> None:
        """Refuse settings that no curve can be learned with."""
        if self.basis not in ("piecewise_linear", "quadratic"):
            raise ValueError(f"basis '{self.basis}' is not known; give piecewise_linear or quadratic")
        for name, value in asdict(self).items():
            if name != "basis" and not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value} must be finite and not below 0")
        if not (self.from_hz < self.to_hz and 0.0 < self.step_hz <= self.to_hz - self.from_hz):
            raise ValueError(
                "from_hz must be below to_hz [Hz], and step_hz above 0 and no more than between them"
            )
        if not (self.prior_std_ns_m > 0.0 and self.prior_length_hz > 0.0 and self.wanted_std_ns_m > 0.0):
            raise ValueError("prior_std_ns_m, prior_length_hz and wanted_std_ns_m must be above 0")

    def curve_basis(self) -> CurveBasis:
        """Return the family of curves."""
        if self.basis == "quadratic":
            return Quadratic(self.from_hz, self.to_hz, self.step_hz)
        return PiecewiseLinear(self.from_hz, self.to_hz, self.step_hz)


class DampingLearner:
    """What is known of the coil's damping and the absorber's stiffness against frequency.

    Parameters
    ----------
    plant
        Gives the curves to start from.
    """

    def __init__(self, plant: Plant, settings: LearnerSettings | None = None) -> None:
        absorber = plant.absorber
        if absorber is None:
            raise ValueError("the plant has no absorber")
        self.settings = settings = settings or LearnerSettings()
        basis = settings.curve_basis()
        self._knots = basis.knots_hz
        self._damping = CurveFilter(
            basis,
            np.array([absorber.damping_at(float(f)) for f in self._knots]),
            settings.prior_std_ns_m,
            settings.prior_length_hz,
        )
        self._stiffness = CurveFilter(
            basis,
            np.full(len(self._knots), absorber.stiffness_n_m),
            STIFFNESS_PRIOR_SHARE * absorber.stiffness_n_m,
            STIFFNESS_LENGTH_HZ,
        )
        self._in_use = np.maximum(self._damping.values, 0.0)
        wanted = (self._knots >= settings.wanted_from_hz) & (self._knots <= settings.wanted_to_hz)
        self._wanted = np.flatnonzero(wanted)
        self._knots_hz = tuple(self._knots.tolist())
        self._table: DampingTable | None = None
        self._accepted = self._strays = 0
        self._last_hz = math.nan
        self._misfit = 1.0
        self._settling_s = 0.0
        self._reason = "nothing measured yet"

    def advance(self, balance: ForceBalance | None, elapsed_s: float, objection: str = "") -> DampingCurve:
        """Take one block in, unless a gate objects, and move the value in use.

        Parameters
        ----------
        balance
            The block's; None if it had no phasors.
        elapsed_s
            Duration of the block [s].
        objection
            Reason of the caller's not to learn from this block.
        """
        unsettled = objection or self._unsettled(balance)
        if unsettled:
            self._settling_s = self.settings.settle_s
            self._reason = unsettled
        else:
            self._reason = self._gate(balance)
            self._settling_s -= elapsed_s
        if balance is not None and not self._reason:
            self._take(balance, elapsed_s)
        step = self.settings.rate_limit_ns_m_s * elapsed_s
        wanted = np.maximum(self._damping.values, 0.0)
        before = self._in_use
        self._in_use = before + np.minimum(np.maximum(wanted - before, -step), step)
        if not np.array_equal(before, self._in_use):
            self._table = None
        return self.curve()

    def warm_up(self) -> None:
        """Compile what a block needs, on copies."""
        self._damping.warm_up()

    def curve(self) -> DampingCurve:
        """Copy of what is known at present."""
        timing = self.settings.timing_std_s
        std = self._damping.std(timing)
        stiffness, stiffness_std = self._stiffness.values, self._stiffness_std()
        here = self._last_hz if self._accepted else 0.0
        return DampingCurve(
            frequency_hz=self._knots,
            damping_ns_m=read_only(self._damping.values),
            std_ns_m=read_only(std),
            noise_std_ns_m=read_only(self._damping.noise_std),
            in_use_ns_m=read_only(self._in_use),
            coverage=read_only(self._damping.coverage),
            status=self._status(),
            progress=self._progress(std),
            reason=self._reason,
            stiffness_n_m=self._stiffness.at(here) if self._accepted else math.nan,
            stiffness_std_n_m=float(np.interp(here, self._knots, stiffness_std))
            if self._accepted
            else math.nan,
            stiffness_curve_n_m=read_only(stiffness),
            stiffness_curve_std_n_m=read_only(stiffness_std),
        )

    def table(self) -> DampingTable:
        """Return the curve in use, as a plant takes it; the same object until it moves."""
        if self._table is None:
            self._table = DampingTable(frequency_hz=self._knots_hz, ns_m=tuple(self._in_use.tolist()))
        return self._table

    def in_use_at(self, frequency_hz: float) -> float:
        """Damping in use at a frequency [Ns/m], as `table` has it."""
        return float(np.interp(frequency_hz, self._knots, self._in_use))

    def std_at(self, frequency_hz: float) -> float:
        """Standard deviation of the learned value at a frequency [Ns/m]."""
        return self._damping.std_at(frequency_hz, self.settings.timing_std_s)

    def noise_std_at(self, frequency_hz: float) -> float:
        """Return the part of it that is noise, without the doubt about the channels' delays [Ns/m]."""
        return self._damping.std_at(frequency_hz, 0.0)

    def state(self) -> dict[str, Any]:
        """What has been learned, as plain data that `restored` reads back."""
        return {
            "settings": asdict(self.settings),
            "damping": self._damping.state(),
            "stiffness": self._stiffness.state(),
            "in_use_ns_m": self._in_use.tolist(),
            "blocks": self._accepted,
            "last_hz": self._last_hz if self._accepted else 0.0,
        }

    @classmethod
    def restored(cls, state: dict[str, Any], plant: Plant) -> "DampingLearner":
        """Learner that goes on from what `state` gave.

        Raises
        ------
        ValueError, KeyError, TypeError
            If it is not that.
        """
        learner = cls(plant, LearnerSettings(**state["settings"]))
        learner._damping.restore(state["damping"])
        learner._stiffness.restore(state["stiffness"])
        in_use = np.array(state["in_use_ns_m"], dtype=np.float64)
        if in_use.shape != learner._knots.shape or not np.all(in_use >= 0.0) or not np.isfinite(in_use).all():
            raise ValueError("in_use_ns_m must hold one finite damping of at least 0 Ns/m per knot")
        learner._in_use, learner._table = in_use, None
        learner._accepted, learner._last_hz = int(state["blocks"]), float(state["last_hz"])
        if learner._accepted < 0 or not math.isfinite(learner._last_hz):
            raise ValueError("blocks and last_hz must be finite and not below 0")
        learner._reason = "read from a file; nothing measured since"
        return learner

    def _stiffness_std(self) -> Array:
        return np.hypot(self._stiffness.std(self.settings.timing_std_s), self.settings.floor_std_n_m)

    def _progress(self, std: Array) -> float:
        """0 where the prior stands to 1 where the wanted band is known as well as wanted, in decades of std."""
        s = self.settings
        if not len(self._wanted) or s.wanted_std_ns_m >= s.prior_std_ns_m:
            return 1.0
        share = np.log(s.prior_std_ns_m / np.maximum(std[self._wanted], s.wanted_std_ns_m))
        progress = float(share.mean()) / math.log(s.prior_std_ns_m / s.wanted_std_ns_m)
        return min(max(progress, 0.0), 1.0)

    def _status(self) -> DampingStatus:
        if not np.all(np.isfinite(self._damping.values)):
            return "invalid"
        if self._accepted == 0:
            return "unestimated"
        return "estimated" if self._accepted >= BLOCKS_FOR_ESTIMATE and not self._reason else "learning"

    def _unsettled(self, balance: ForceBalance | None) -> str:
        """Why a block and those soon after it are no steady state."""
        if balance is None:
            return "no excitation"
        if not balance.steady:
            return "excitation has jumped"
        if math.isfinite(balance.transient_1_s) and balance.transient_1_s > self.settings.max_transient_1_s:
            return "transient"
        return ""

    def _gate(self, balance: ForceBalance | None) -> str:
        settings = self.settings
        if balance is None:
            return "no excitation"
        if not settings.from_hz <= balance.frequency_hz <= settings.to_hz:
            return f"excitation outside {settings.from_hz:g} to {settings.to_hz:g} Hz"
        if not balance.damping_std_ns_m <= settings.max_block_std_ns_m:
            return "too little excitation"
        if self._settling_s > 1e-9:
            return "settling"
        if abs(self._surprise(balance)) > settings.outlier_sigmas:
            self._strays += 1
            if self._strays < STRAYS_BELIEVED:
                return "outlier"
            self._damping.forget(balance.frequency_hz, settings.prior_std_ns_m**2)
        self._strays = 0
        return ""

    def _take(self, balance: ForceBalance, elapsed_s: float) -> None:
        settings, f = self.settings, balance.frequency_hz
        keep = math.exp(-elapsed_s / MISFIT_MEMORY_S)
        self._misfit = keep * self._misfit + (1.0 - keep) * min(self._surprise(balance) ** 2, MOST_MISFIT)
        # Forgetting has a price in certainty; it is paid where readings ask for it.
        excess = max(self._misfit - MISFIT_ALLOWED, 0.0)
        if excess > 0.0:
            self._damping.forget(f, excess * settings.forgetting_ns_m_sqrt_s**2 * elapsed_s)
        self._damping.take(f, balance.damping_ns_m, self._variance(balance), balance.damping_per_delay_ns_m_s)
        self._stiffness.take(
            f, balance.stiffness_n_m, balance.stiffness_std_n_m**2 + 1.0, balance.stiffness_per_delay_n_m_s
        )
        self._accepted += 1
        self._last_hz = f

    def _surprise(self, balance: ForceBalance) -> float:
        return self._damping.surprise(
            balance.frequency_hz,
            balance.damping_ns_m,
            self._variance(balance),
            balance.damping_per_delay_ns_m_s,
            self.settings.timing_std_s,
        )

    def _variance(self, balance: ForceBalance) -> float:
        """Variance of a block's damping [(Ns/m)²]."""
        return balance.damping_std_ns_m**2 + self.settings.floor_std_ns_m**2
