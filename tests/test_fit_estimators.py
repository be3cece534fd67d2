"""Fits from separate tests on simulated data: unbiased, as sharp as the bound allows, errors stated truly."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lsim, lti

from estimators.fits.added_mass import fit_added_mass
from estimators.fits.damper import DamperRecord, fit_damper, smooth_motion
from estimators.fits.decay import fit_decay
from estimators.fits.frf import fit_frf
from estimators.fits.modal_model import Window
from estimators.fits.step import fit_steps, second_order
from estimators.fits.step_finding import find_steps
from estimators.fits.transmissibility import fit_transmissibility
from estimators.fits.types import Mode
from twin.plant.errors import InputError

TAU = 2.0 * np.pi
RUNS = 50


def pulls(fit: Callable[[np.random.Generator], Mode], hz: float, zeta: float, runs: int = RUNS) -> np.ndarray:
    """(runs, 2) errors of frequency and damping in their stated standard deviations."""
    rng = np.random.default_rng(7)
    out = []
    for _ in range(runs):
        m = fit(rng)
        out.append([(m.frequency_hz - hz) / m.frequency_std_hz, (m.damping_ratio - zeta) / m.damping_std])
    return np.array(out)


def assert_true(pull: np.ndarray) -> None:
    """95 % intervals hold the truth in 95 % within four standard deviations of a count of so many; no bias."""
    n = len(pull)
    covered = np.mean(np.abs(pull) < 1.96, axis=0)
    allowed = 4.0 * np.sqrt(0.95 * 0.05 / n)
    assert (covered > 0.95 - allowed).all(), covered
    assert (np.std(pull, axis=0) > 0.7).all(), "errors are stated far too large"
    assert (np.abs(np.mean(pull, axis=0)) < 4.5 / np.sqrt(n)).all(), np.mean(pull, axis=0)


def ring(t: np.ndarray, hz: float, zeta: float, phase: float = 0.4) -> np.ndarray:
    return np.asarray(np.exp(-zeta * TAU * hz * t) * np.cos(TAU * hz * np.sqrt(1.0 - zeta**2) * t + phase))


def responses(f: np.ndarray, modes: list[tuple[float, float]], shapes: np.ndarray) -> np.ndarray:
    """Accelerances of real modes from their transfer functions, independent of the fitted partial fractions."""
    w = TAU * f[:, None]
    h = np.zeros((len(f), shapes.shape[1]), dtype=complex)
    for (hz, zeta), shape in zip(modes, shapes, strict=True):
        wn = TAU * hz
        h += -(w**2) * shape / (wn**2 - w**2 + 2j * zeta * wn * w)
    return h


@pytest.mark.parametrize("zeta", [1e-4, 3e-3, 0.05, 0.3])
def test_decay_states_its_errors_truly(zeta: float) -> None:
    t = np.arange(1500) / 100.0
    truth = ring(t, 5.0, zeta)

    def once(rng: np.random.Generator) -> Mode:
        return fit_decay(truth + 0.01 * rng.standard_normal(len(t)), 100.0).modes[0]

    assert_true(pulls(once, 5.0, zeta))


def test_decay_reaches_the_cramer_rao_bound() -> None:
    # Closed form for a slowly decaying sinusoid whose amplitude, phase, frequency and damping are unknown.
    hz, zeta, rate, std = 8.2, 0.004, 100.0, 0.05
    t = np.arange(3000) / rate
    w, wd = TAU * hz, TAU * hz * np.sqrt(1.0 - zeta**2)
    envelope = np.exp(-zeta * w * t)
    c, s = envelope * np.cos(wd * t + 0.4), envelope * np.sin(wd * t + 0.4)
    jacobian = np.column_stack(
        [c, s, t * c, t * s, np.ones_like(t), t]
    )  # amplitude, phase, decay, frequency, drift
    bound = std * np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[2, 2]) / w
    rng = np.random.default_rng(3)
    found = [
        fit_decay(ring(t, hz, zeta) + std * rng.standard_normal(len(t)), rate).modes[0] for _ in range(RUNS)
    ]
    error = np.sqrt(np.mean([(m.damping_ratio - zeta) ** 2 for m in found]))
    # The end of a decay, below the noise, is cut off on purpose; the rest must be used in full.
    assert error < 1.25 * bound * (1.0 + 2.0 / np.sqrt(2.0 * RUNS))


def test_decay_gives_the_damping_of_each_amplitude_and_autoregression_does_not() -> None:
    # An oscillator whose damping ratio grows with amplitude, integrated in amplitude and phase.
    rate, hz = 200.0, 8.0
    n, amplitude, phase = 6000, 10.0, 0.0
    y = np.zeros(n)
    for k in range(n):
        y[k] = amplitude * np.cos(phase)
        zeta = 0.003 + 0.0003 * amplitude
        amplitude *= np.exp(-zeta * TAU * hz / rate)
        phase += TAU * hz / rate
    y += 0.05 * np.random.default_rng(1).standard_normal(n)
    fit = fit_decay(np.concatenate([np.linspace(0.0, 12.0, 500), y]), rate)
    assert fit.amplitude_dependent
    for band in fit.bands:
        if band.amplitude_from >= 0.2:
            low, high = 0.003 + 0.0003 * band.amplitude_from, 0.003 + 0.0003 * band.amplitude_to
            slack = 4.0 * band.mode.damping_std
            assert low - slack < band.mode.damping_ratio < high + slack
    a = np.linalg.lstsq(np.column_stack([y[1:-1], y[:-2]]), y[2:], rcond=None)[0]
    pole = np.log(np.roots([1.0, -a[0], -a[1]])[0])
    assert -pole.real / abs(pole) > 2.0 * fit.modes[0].damping_ratio


@settings(max_examples=15, deadline=None)
@given(
    hz=st.floats(2.0, 30.0),
    log_zeta=st.floats(-3.5, -1.0),
    offset=st.floats(-5.0, 5.0),
    noise=st.floats(1e-3, 0.03),
)
def test_decay_anywhere(hz: float, log_zeta: float, offset: float, noise: float) -> None:
    zeta, t = 10.0**log_zeta, np.arange(4000) / 200.0
    y = offset + ring(t, hz, zeta) + noise * np.random.default_rng(0).standard_normal(len(t))
    m = fit_decay(y, 200.0).modes[0]
    assert m.frequency_hz == pytest.approx(hz, abs=6.0 * m.frequency_std_hz + 1e-9)
    assert m.damping_ratio == pytest.approx(zeta, abs=6.0 * m.damping_std + 1e-9)


@pytest.mark.parametrize("kind", ["steady", "noise", "constant", "short"])
def test_no_decay_is_said(kind: str) -> None:
    t = np.arange(3000) / 100.0
    signals = {
        "steady": np.cos(30.0 * t), "noise": np.random.default_rng(0).standard_normal(3000),
        "constant": np.full(3000, 2.0), "short": np.ones(5),
    }  # fmt: skip
    with pytest.raises(InputError):
        fit_decay(signals[kind], 100.0)


@pytest.mark.parametrize("zeta", [2e-4, 2e-3, 0.02, 0.1])
def test_frf_states_its_errors_truly_also_below_the_resolution(zeta: float) -> None:
    f = np.arange(1.0, 40.0, 0.03125 if zeta < 0.01 else 0.125)
    modes = [(8.013, zeta), (21.507, 1.3 * zeta)]
    h = responses(f, modes, np.array([[1.0, 0.7], [0.8, -1.1]]))
    scale = 0.002 * np.abs(h).max()

    def once(rng: np.random.Generator) -> Mode:
        noise = rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)
        fit = fit_frf(f, h + scale * noise)
        assert len(fit.modes) == 2
        return fit.modes[0]

    assert_true(pulls(once, 8.013, zeta, runs=12))


@pytest.mark.parametrize("kind", ["hann", "rectangular"])
def test_frf_sees_through_the_window_of_a_random_test(kind: str) -> None:
    # The H1 estimate of a very long random test, record by record, from a simulated response.
    record, rate, hz, zeta = 4.0, 128.0, 20.03, 0.002
    n = int(record * rate)
    rng = np.random.default_rng(5)
    force = rng.standard_normal(n * 800)
    w = TAU * hz
    wd, t = w * np.sqrt(1.0 - zeta**2), np.arange(int(8.0 / (zeta * w) * rate)) / rate
    impulse = np.exp(-zeta * w * t) * np.sin(wd * t)
    from scipy.signal import csd, fftconvolve, welch

    response = fftconvolve(force, impulse)[: len(force)]
    window = "hann" if kind == "hann" else "boxcar"
    f, cross = csd(force, response, rate, window=window, nperseg=n, detrend=False)
    auto = welch(force, rate, window=window, nperseg=n, detrend=False)[1]
    near = (f > 12.0) & (f < 28.0)
    h = (cross / auto)[near][:, None]
    plain = fit_frf(f[near], h, n_modes=1).modes[0]
    fit = fit_frf(f[near], h, n_modes=1, window=Window(kind, record))  # type: ignore[arg-type]
    assert fit.modes[0].damping_ratio == pytest.approx(zeta, rel=0.1)
    assert plain.damping_ratio > 1.4 * zeta


@pytest.mark.parametrize(("zeta", "with_input"), [(0.01, True), (0.06, True), (0.3, True), (0.7, False)])
def test_step_states_its_errors_truly(zeta: float, with_input: bool) -> None:
    rate, hz, over = 1000.0, 20.0, 10
    t = np.arange(1600 * over) / (rate * over)
    u = (t > 0.2004).astype(float)
    w = TAU * hz
    y = lsim(lti([w * w], [1.0, 2.0 * zeta * w, w * w]), u, t, interp=False)[1][::over]

    def once(rng: np.random.Generator) -> Mode:
        out = 1.0 + 2.0 * y + 0.02 * rng.standard_normal(len(y))
        return fit_steps(find_steps(out, u[::over] if with_input else None), rate).mode

    assert_true(pulls(once, hz, zeta, runs=24))


def test_second_order_response_is_exact_for_inputs_linear_between_samples() -> None:
    rng = np.random.default_rng(2)
    rate, hz = 400.0, 17.0
    for zeta in (0.01, 0.4, 1.0, 1.7):
        u = np.concatenate([np.zeros(3), rng.standard_normal(200)])
        w, t = TAU * hz, np.arange(203) / rate
        exact = lsim(lti([w * w], [1.0, 2.0 * zeta * w, w * w]), u, t)[1]
        np.testing.assert_allclose(second_order(u, rate, hz, zeta), exact, atol=1e-9)


@pytest.mark.parametrize("complex_data", [True, False])
@pytest.mark.parametrize("zeta", [1e-3, 0.03, 0.3])
def test_transmissibility_states_its_errors_truly(zeta: float, complex_data: bool) -> None:
    f = np.arange(20.0, 80.0, 0.25)
    s, wn = 1j * TAU * f, TAU * 50.03
    truth = (2.0 * zeta * wn * s + wn**2) / (s**2 + 2.0 * zeta * wn * s + wn**2)

    def once(rng: np.random.Generator) -> Mode:
        h = truth + 0.01 * (rng.standard_normal(len(f)) + 1j * rng.standard_normal(len(f)))
        return fit_transmissibility(f, h if complex_data else np.abs(h)).mode

    assert_true(pulls(once, 50.03, zeta, runs=24))


def test_added_mass_beats_eq_7_1_and_states_its_errors_truly() -> None:
    added = np.array([12.5, 32.5, 48.0, 63.5, 117.0, 169.0, 277.0]) * 1e-3
    hz = np.sqrt(40714.0 / (0.0946 + added)) / TAU
    rng = np.random.default_rng(1)
    fits = [fit_added_mass(added, hz + 0.2 * rng.standard_normal(7)) for _ in range(300)]
    inside = [abs(x.stiffness_n_m.value - 40714.0) < x.quantile * x.stiffness_n_m.std for x in fits]
    assert 0.91 < np.mean(inside) < 0.985
    ours = np.sqrt(np.mean([(x.stiffness_n_m.value - 40714.0) ** 2 for x in fits]))
    theirs = np.sqrt(np.mean([(x.printed_stiffness_n_m.value - 40714.0) ** 2 for x in fits]))
    assert ours < 0.9 * theirs
    slope = np.column_stack([hz / (2.0 * 40714.0), -hz / (2.0 * (0.0946 + added))])
    bound = 0.2 * np.sqrt(np.linalg.inv(slope.T @ slope)[0, 0])
    assert ours < 1.25 * bound


def test_added_mass_refuses_what_is_no_spring() -> None:
    with pytest.raises(InputError, match="does not fall"):
        fit_added_mass([0.1, 0.2, 0.3], [10.0, 11.0, 12.0])
    with pytest.raises(InputError, match="at least three"):
        fit_added_mass([0.1, 0.2], [12.0, 11.0])


def motion(n: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(n) / 100.0
    x = np.sin(TAU * t) + 0.3 * np.sin(TAU * 0.31 * t)
    return x, TAU * np.cos(TAU * t) + 0.3 * TAU * 0.31 * np.cos(TAU * 0.31 * t)


@pytest.mark.parametrize("noise", [0.01, 0.3, 2.0])
def test_linear_damper_is_adequate_however_noisy_and_its_errors_are_true(noise: float) -> None:
    x, v = motion()
    rng = np.random.default_rng(4)
    pull, verdicts = [], []
    for _ in range(20):
        force = 3.0 + 2.0 * v + 5.0 * x + noise * np.std(2.0 * v) * rng.standard_normal(len(v))
        fit = fit_damper([DamperRecord("r", force, x, v)], 100.0)
        pull.append((fit.c_eq.value - 2.0) / fit.c_eq.std)
        verdicts.append(fit.linear_adequate)
    assert np.mean(verdicts) > 0.95
    assert np.mean(np.abs(pull) < 1.96) > 0.83


@settings(max_examples=12, deadline=None)
@given(share=st.floats(0.3, 1.0), noise=st.floats(0.01, 0.3))
def test_friction_is_no_linear_damper(share: float, noise: float) -> None:
    x, v = motion()
    force = share * 10.0 * np.tanh(v / 0.1) + (1.0 - share) * v
    force = force + noise * np.random.default_rng(0).standard_normal(len(v))
    assert not fit_damper([DamperRecord("r", force, x, v)], 100.0).linear_adequate


def test_mass_is_identifiable_only_where_it_is_felt() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(8000) / 100.0
    x = sum(a * np.sin(TAU * f * t + p) for a, f, p in ((1.0, 0.2, 0.0), (0.4, 1.1, 1.0), (0.1, 2.3, 2.0)))
    v, a = np.gradient(x, 0.01), np.gradient(np.gradient(x, 0.01), 0.01)
    for mass, felt in ((0.05, True), (1e-6, False)):
        force = 2.0 * x + 0.1 * v + mass * a + 0.02 * rng.standard_normal(len(t))
        fit = fit_damper([smooth_motion(force, x, 100.0, "r")], 100.0)
        assert ("m" not in fit.not_identifiable) is felt
        assert fit.k.value == pytest.approx(2.0, abs=5.0 * fit.k.std + 0.002)
        assert fit.c_eq.value == pytest.approx(0.1, abs=5.0 * fit.c_eq.std + 0.002)
