"""Equivalent damping from force and motion, and whether a linear damper describes the data at all.

The force balance ``F = c v + k x + m a + F0`` is fitted by least squares; beside it stands the damping that takes the
same energy out of every cycle, ``c = int F v dt / int v² dt``. Both numbers exist for any data, also for dry friction,
where they say nothing about another amplitude. The verdict therefore asks what the linear fit leaves behind: noise is
no function of the motion, friction and hysteresis are. A smooth function of displacement, velocity and its direction
is fitted to one part of the residual and has to predict the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from estimators.fits.types import Estimate
from twin.plant.errors import InputError
from twin.plant.linear import Array

TRUNCATE = 7.0
SYSTEMATIC = 0.05
"""A linear damper is adequate while what it leaves and the motion explains is below this share of the force."""


@dataclass(frozen=True, slots=True)
class DamperRecord:
    """One recording of a damper, in consistent units.

    Attributes
    ----------
    force, displacement, velocity, acceleration
        (n_samples,) each; acceleration may be None.
    name
        For messages.
    """

    name: str
    force: Array
    displacement: Array
    velocity: Array
    acceleration: Array | None = None


@dataclass(frozen=True, slots=True)
class RecordFit:
    """Force balance of one record.

    Attributes
    ----------
    c, k, m
        Damping, stiffness and mass; m is None where no acceleration was used.
    c_energy
        Damping from the energy of each cycle; None with less than two cycles.
    nrmse
        Residual of the linear fit over the standard deviation of the force.
    systematic
        Part of the residual that the motion explains, over the standard deviation of the force.
    friction, viscous
        Dry friction force and viscous damping of the model with both.
    friction_nrmse
        Residual of that model over the standard deviation of the force.
    residual
        (n_samples,) of the linear fit.
    curve_force
        (n_samples,) force of the friction model.
    cycles
        Cycles of the motion.
    """

    name: str
    c: Estimate
    k: Estimate
    m: Estimate | None
    c_energy: Estimate | None
    nrmse: float
    systematic: float
    friction: Estimate
    viscous: Estimate
    friction_nrmse: float
    residual: Array
    curve_force: Array
    cycles: int


@dataclass(frozen=True, slots=True)
class DamperFit:
    """What all records say together.

    Attributes
    ----------
    c_eq, k, m
        Damping, stiffness and mass over all records; the standard deviations contain the scatter between records.
    linear_nrmse
        Residual of each record's own linear fit over the standard deviation of the force, root mean square.
    systematic
        Part of it that the motion explains.
    linear_adequate
        The verdict.
    reason
        What decided it, in words.
    not_identifiable
        Names among ``c``, ``k``, ``m`` that the data do not determine, and why.
    records
        One by one.
    """

    c_eq: Estimate
    k: Estimate
    m: Estimate | None
    linear_nrmse: float
    systematic: float
    linear_adequate: bool
    reason: str
    not_identifiable: dict[str, str]
    records: tuple[RecordFit, ...]


def smooth_motion(force: Array, displacement: Array, sample_rate_hz: float, name: str = "") -> DamperRecord:
    """Velocity and acceleration from displacement, with one smoothing for all four series.

    Displacement is convolved with a Gaussian and its derivatives and the force with the same Gaussian, so that the
    force balance holds between the results exactly. The Gaussian passes what the displacement contains and cuts the
    noise above.

    Returns
    -------
    DamperRecord
        With the ends cut off where the Gaussian runs out of data.
    """
    x = displacement - np.mean(displacement)
    spectrum = np.abs(np.fft.rfft(x * np.hanning(len(x)))) ** 2
    hz = np.fft.rfftfreq(len(x), 1.0 / sample_rate_hz)
    power = np.maximum(spectrum - 3.0 * np.median(spectrum[len(spectrum) // 2 :]), 0.0) * hz**2
    top_hz = (
        float(hz[np.searchsorted(np.cumsum(power), 0.98 * np.sum(power))]) if np.sum(power) > 0.0 else hz[-1]
    )
    sigma = float(np.clip(sample_rate_hz / (2.0 * np.pi * 2.0 * max(top_hz, 1e-12)), 1.0, len(x) / 40.0))
    edge = int(TRUNCATE * sigma) + 1
    cut = slice(edge, len(x) - edge)
    smooth = [gaussian_filter1d(x, sigma, order=o, truncate=TRUNCATE) * sample_rate_hz**o for o in range(3)]
    return DamperRecord(
        name,
        gaussian_filter1d(force, sigma, truncate=TRUNCATE)[cut],
        smooth[0][cut],
        smooth[1][cut],
        smooth[2][cut],
    )


def fit_damper(records: Sequence[DamperRecord], sample_rate_hz: float) -> DamperFit:
    """Fit force balances and judge whether they are linear.

    Raises
    ------
    InputError
        If a record is too short or nothing moves in it.
    """
    if not records:
        raise InputError("no record with a force and a motion in it")
    fits = [_one(r, sample_rate_hz) for r in records]
    c, k = _together([f.c for f in fits]), _together([f.k for f in fits])
    masses = [f.m for f in fits if f.m is not None]
    m = _together(masses) if len(masses) == len(fits) else None
    nrmse = float(np.sqrt(np.mean([f.nrmse**2 for f in fits])))
    systematic = float(np.sqrt(np.mean([f.systematic**2 for f in fits])))
    lost = _not_identifiable(records, fits, c, k, m)
    values = np.array([f.c.value for f in fits])
    spread = float(np.ptp(values)) / max(abs(float(np.mean(values))), 1e-300)
    errors = np.array([f.c.std for f in fits])
    differs = len(fits) > 2 and spread > 0.1 and float(np.mean((values - c.value) ** 2 / errors**2)) > 9.0
    adequate = systematic <= SYSTEMATIC and not differs
    if systematic > SYSTEMATIC:
        reason = (
            f"{100 * systematic:.0f} % of the force is left by the linear fit and follows the motion: "
            "friction or hysteresis, not noise"
        )
    elif differs:
        reason = f"c differs from record to record by {100 * spread:.0f} %, far more than its errors"
    else:
        share = f"less than {100 * SYSTEMATIC:.0f} % of the force"
        reason = f"what the linear fit leaves does not follow the motion ({share})"
    return DamperFit(c, k, m, nrmse, systematic, adequate, reason, lost, tuple(fits))


def _one(r: DamperRecord, rate_hz: float) -> RecordFit:
    n, scale = len(r.force), float(np.std(r.force))
    if n < 40:
        raise InputError(f"{r.name}: {n} samples are too few for a force balance; at least 40 are needed")
    for what, series in (("force", r.force), ("velocity", r.velocity), ("displacement", r.displacement)):
        if not np.std(series) > 0.0:
            raise InputError(f"{r.name}: the {what} is constant; choose the channel that moves")
    columns = [r.velocity, r.displacement, np.ones(n)]
    if r.acceleration is not None:
        columns.append(r.acceleration)
    design = np.column_stack(columns)
    size = np.sqrt(np.mean(design**2, axis=0))
    scaled = design / size
    coefficients = np.linalg.lstsq(scaled, r.force, rcond=None)[0]
    residual = r.force - scaled @ coefficients
    cycle = _samples_per_cycle(r.velocity)
    std = np.sqrt(np.maximum(np.diag(_robust_covariance(scaled, residual, cycle)), 0.0)) / size
    value = coefficients / size
    friction, viscous, level, curve = _with_friction(r, value)
    return RecordFit(
        name=r.name,
        c=Estimate(float(value[0]), float(std[0])),
        k=Estimate(float(value[1]), float(std[1])),
        m=Estimate(float(value[3]), float(std[3])) if r.acceleration is not None else None,
        c_energy=_energy_per_cycle(r),
        nrmse=float(np.sqrt(np.mean(residual**2))) / scale,
        systematic=_explained(r, residual) / scale,
        friction=friction,
        viscous=viscous,
        friction_nrmse=level / scale,
        residual=residual,
        curve_force=curve,
        cycles=max(1, round(n / cycle)),
    )


def _robust_covariance(design: Array, residual: Array, cycle: float) -> Array:
    """Covariance of least squares with noise alike over up to half a cycle (Newey and West, 1987)."""
    n, p = design.shape
    bread = np.linalg.pinv(design.T @ design)
    lags = _correlation_length(residual, int(min(n // 4, max(2, 1.5 * cycle))))
    score = design * residual[:, None]
    meat = score.T @ score
    for lag in range(1, lags + 1):
        part = score[lag:].T @ score[:-lag]
        meat += (1.0 - lag / (lags + 1.0)) * (part + part.T)
    return np.asarray(bread @ meat @ bread * n / max(1, n - p))


def _correlation_length(residual: Array, most: int) -> int:
    n = len(residual)
    power = float(residual @ residual)
    if power == 0.0:
        return 0
    lagged = [abs(float(residual[k:] @ residual[:-k])) / power for k in range(1, most + 1)]
    above = np.flatnonzero(np.array(lagged) > 3.0 / np.sqrt(n))
    return 0 if not len(above) else int(min(most, 2 * (above[-1] + 1)))


def _samples_per_cycle(velocity: Array) -> float:
    v = velocity - np.mean(velocity)
    up = _crossings(v)
    return float(len(v) / max(1, len(up)))


def _crossings(v: Array) -> NDArray[np.int64]:
    """Upward passages through zero, counted once where noise crosses several times."""
    level = 0.2 * float(np.std(v))
    state, out = v[0] > 0.0, []
    for k, x in enumerate(v):
        if not state and x > level:
            state = True
            out.append(k)
        elif state and x < -level:
            state = False
    return np.array(out, dtype=np.int64)


def _energy_per_cycle(r: DamperRecord) -> Estimate | None:
    at = _crossings(r.velocity - np.mean(r.velocity))
    if len(at) < 3:
        return None
    force = r.force - np.mean(r.force)
    work = np.add.reduceat(force * r.velocity, at)[:-1]
    square = np.add.reduceat(r.velocity**2, at)[:-1]
    c = float(np.sum(work) / np.sum(square))
    left = work - c * square
    std = float(np.sqrt(np.sum(left**2) * len(left) / (len(left) - 1)) / np.sum(square))
    return Estimate(c, std)


def _explained(r: DamperRecord, residual: Array) -> float:
    """Root mean square of the part of the residual that the motion predicts, judged on samples not fitted."""
    x, v = (
        s / np.sqrt(np.mean((s - np.mean(s)) ** 2))
        for s in (r.displacement - np.mean(r.displacement), r.velocity)
    )
    steep = [np.tanh(v / w) for w in (0.02, 0.1, 0.3)]
    terms = [*steep, v, x, v * np.abs(v), v**3, x**2, x**3, v**2, v * x, x**2 * v, np.abs(v), np.ones_like(v)]
    terms += [x * s for s in steep] + [np.tanh((v + shift * x) / 0.15) for shift in (-0.3, 0.3)]
    features = np.column_stack(terms)
    blocks = np.arange(len(v)) * 8 // len(v)
    predicted = np.empty(len(v))
    for part in (0, 1):
        known = blocks % 2 == part
        c = np.linalg.lstsq(features[known], residual[known], rcond=1e-8)[0]
        predicted[~known] = features[~known] @ c
    # The product keeps only what both sides share: noise that was fitted by chance cancels on average, and what is
    # left of it shows in how the blocks differ.
    product = predicted * residual
    each = np.array([np.mean(product[blocks == b]) for b in range(8)])
    if np.mean(each) < 3.0 * np.std(each, ddof=1) / np.sqrt(8.0):
        return 0.0
    return float(np.sqrt(max(float(np.mean(product)), 0.0)))


def _with_friction(r: DamperRecord, linear: Array) -> tuple[Estimate, Estimate, float, Array]:
    """``F = Fc tanh((v + s x')/v0) + c v + k x + F0``: dry friction with a rounded, shifted reversal."""
    v_rms = float(np.sqrt(np.mean(r.velocity**2)))
    x0 = r.displacement - np.mean(r.displacement)
    lag = v_rms / max(float(np.std(x0)), 1e-300)

    def design(theta: Array) -> Array:
        turn = np.tanh((r.velocity + theta[1] * lag * x0) / (v_rms * np.exp(theta[0])))
        return np.column_stack([turn, r.velocity, x0, np.ones_like(x0)])

    def residual(theta: Array) -> Array:
        d = design(theta)
        return np.asarray(r.force - d @ np.linalg.lstsq(d, r.force, rcond=None)[0])

    thin = slice(None, None, max(1, len(x0) // 3000))
    whole = r
    if thin.step > 1:
        r = DamperRecord(r.name, r.force[thin], r.displacement[thin], r.velocity[thin])
        x0 = x0[thin]
    found = least_squares(residual, [-1.5, 0.0], bounds=([-4.0, -1.0], [0.5, 1.0]), ftol=1e-8, max_nfev=40)
    left, d = residual(found.x), design(found.x)
    c = np.linalg.lstsq(d, r.force, rcond=None)[0]
    std = np.sqrt(np.maximum(np.diag(_robust_covariance(d, left, _samples_per_cycle(r.velocity))), 0.0))
    r, x0 = whole, whole.displacement - np.mean(whole.displacement)
    curve = design(found.x) @ c
    return (
        Estimate(float(c[0]), float(std[0])),
        Estimate(float(c[1]), float(std[1])),
        float(np.sqrt(np.mean((whole.force - curve) ** 2))),
        curve,
    )


def _together(values: Sequence[Estimate]) -> Estimate:
    """Weighted mean; its standard deviation is widened where the values differ by more than their own."""
    x, std = np.array([v.value for v in values]), np.maximum(np.array([v.std for v in values]), 1e-300)
    if len(x) == 1:
        return values[0]
    weight = 1.0 / std**2
    mean = float(np.sum(weight * x) / np.sum(weight))
    square = float(np.sum(weight * (x - mean) ** 2)) / (len(x) - 1)
    return Estimate(mean, float(np.sqrt(max(1.0, square) / np.sum(weight))))


def _not_identifiable(
    records: Sequence[DamperRecord], fits: Sequence[RecordFit], c: Estimate, k: Estimate, m: Estimate | None
) -> dict[str, str]:
    out = {}
    named = {"c": (c, "velocity"), "k": (k, "displacement")} | (
        {"m": (m, "acceleration")} if m is not None else {}
    )
    for name, (estimate, series) in named.items():
        share = max(
            abs(estimate.value)
            * float(np.std(getattr(r, series)))
            / max(float(np.sqrt(np.mean(f.residual**2))), 1e-300)
            for r, f in zip(records, fits, strict=True)
        )
        if abs(estimate.value) < 3.0 * estimate.std:
            out[name] = "its standard deviation is more than a third of it"
        elif name == "m" and estimate.value < 0.0:
            out[name] = "it comes out negative"
        elif name == "m" and share < 1.0:
            out[name] = "its force is smaller than what the fit leaves"
    if m is None:
        out["m"] = "no acceleration was given or derived"
    return out
