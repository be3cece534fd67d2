"""From a file to a fit: what each ``atmd fit`` command reads, computes and reports."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.fits.added_mass import TAU, fit_added_mass
from estimators.fits.damper import DamperRecord, fit_damper, smooth_motion
from estimators.fits.decay import fit_decay
from estimators.fits.frf import fit_frf
from estimators.fits.modal_model import ResponseKind, Window, WindowKind
from estimators.fits.step import StepPiece, fit_steps
from estimators.fits.step_finding import find_steps, squareness
from estimators.fits.transmissibility import fit_transmissibility
from estimators.fits.types import Estimate
from twin.plant.errors import InputError
from twin.plant.linear import Array
from twin.rig.units import to_si
from twin.station import fit_plots
from twin.station.fit_data import Series, TestFile
from twin.station.fit_plots import Draw

Band = tuple[float, float] | None
Result = tuple[dict[str, Any], Draw]


def run_added_mass(file: TestFile, tune_to_hz: float | None) -> Result:
    """Thesis eq. 7-1 and the maximum likelihood estimate beside it."""
    frequency = _one(file, "frequency")
    added = _one(file, "added mass", exclude=frequency)
    std = next(iter(file.pick("standard deviation", needed=False)), None)
    kg, hz = _si(file, added, "kg", "kg"), _si(file, frequency, "Hz", "Hz")
    with _naming(file):
        fit = fit_added_mass(kg, hz, None if std is None else std.real())
    k, m = fit.stiffness_n_m, fit.mass_kg
    result = {
        "file": str(file.path),
        "tests": len(hz),
        "stiffness_n_m": k.value,
        "stiffness_std_n_m": k.std,
        "moving_mass_kg": m.value,
        "moving_mass_std_kg": m.std,
        "interval_95": {
            "stiffness_n_m": [k.value - fit.quantile * k.std, k.value + fit.quantile * k.std],
            "moving_mass_kg": [m.value - fit.quantile * m.std, m.value + fit.quantile * m.std],
        },
        "correlation": fit.correlation,
        "frequency_noise_hz": float(np.mean(fit.frequency_std_hz)),
        "bare_frequency_hz": float(np.sqrt(k.value / m.value) / TAU) if m.value > 0.0 else None,
        "eq_7_1": {
            "stiffness_n_m": fit.printed_stiffness_n_m.value,
            "stiffness_std_n_m": fit.printed_stiffness_n_m.std,
            "moving_mass_kg": fit.printed_mass_kg.value,
            "moving_mass_std_kg": fit.printed_mass_kg.std,
        },
        "trusted": "maximum_likelihood",
    }
    if tune_to_hz is not None:
        result["mass_to_add_kg"] = k.value / (TAU * tune_to_hz) ** 2 - m.value
    return result, fit_plots.added_mass_plot(kg, hz, fit)


def run_transmissibility(file: TestFile, band: Band) -> Result:
    """Thesis eq. 5-4."""
    f, h, names, _ = _responses(file, band, magnitude=True)
    if h.shape[1] > 1:
        file.notes.append(f"{h.shape[1]} responses found; {names[0]} is fitted")
    ratio = h[:, 0]
    with _naming(file):
        fit = fit_transmissibility(f, ratio)
    result = {
        "file": str(file.path),
        "modes": [asdict(fit.mode)],
        "gain": fit.gain.value,
        "gain_std": fit.gain.std,
        "complex": bool(np.iscomplexobj(ratio)),
        "misfit": fit.misfit,
    }
    return result, fit_plots.response_plot(f, ratio, fit)


def run_frf(file: TestFile, band: Band, n_modes: int | None, window: str | None, kind: str | None) -> Result:
    """Modal parameters."""
    f, h, names, text = _responses(file, band, magnitude=False)
    cut = _window(file, window, float(np.median(np.diff(f))))
    known = _kind(file, kind, text)
    with _naming(file):
        fit = fit_frf(f, h, kind=known, n_modes=n_modes, window=cut)
    if fit.preferred_window is not None:
        file.notes.append(
            f"the peaks would fit much better as measured with window '{fit.preferred_window}'; "
            "if they were, say so with --window"
        )
    result = {
        "file": str(file.path),
        "modes": [asdict(m) for m in fit.modes],
        "minor_modes": [asdict(m) for m in fit.minor_modes],
        "frequency_resolution_hz": float(np.median(np.diff(f))),
        "responses": names,
        "kind": known,
        "window": cut.kind,
        "residues": [[[float(x.real), float(x.imag)] for x in row] for row in fit.residues],
        "misfit": fit.misfit,
    }
    return result, fit_plots.frf_plot(f, h, fit, names, "")


def run_decay(file: TestFile, band: Band, edges: list[float] | None, n_modes: int | None) -> Result:
    """Frequency and damping by amplitude."""
    s = _signal(file)
    values = s.real()
    rate = file.rate(len(values))
    with _naming(file, s.name):
        fit = fit_decay(values, rate, band_hz=band, edges=edges, n_modes=n_modes)
    unit = s.unit or "as recorded"
    result = {
        "file": str(file.path),
        "channel": s.name,
        "sample_rate_hz": rate,
        "modes": [asdict(m) for m in fit.modes],
        "bands": [
            {"amplitude_from": b.amplitude_from, "amplitude_to": b.amplitude_to, "unit": unit}
            | asdict(b.mode)
            | {"decays": b.decays, "periods": b.periods}
            for b in fit.bands
        ],
        "decays": [{"start_s": d.first / rate, "end_s": d.end / rate} for d in fit.decays],
        "amplitude_dependent": fit.amplitude_dependent,
        "residual_rms": fit.residual_rms,
    }
    return result, fit_plots.decay_plot(values, rate, fit, unit)


def run_step(file: TestFile) -> Result:
    """Second-order step responses."""
    outputs, inputs = _step_channels(file)
    n = len(outputs[0].values)
    rate = file.rate(n)
    by_record = {s.record: s.real() for s in inputs}
    pieces: list[StepPiece] = []
    for number, s in enumerate(outputs):
        drive = by_record.get(s.record)
        pieces += find_steps(s.real(), drive, number)
    with _naming(file, outputs[0].name):
        if not np.ptp(outputs[0].real()) > 0.0:
            raise InputError("the output is constant; choose the channel that responds")
        fit = fit_steps(pieces, rate)
    result = {
        "file": str(file.path),
        "modes": [asdict(fit.mode)],
        "steps": len(pieces),
        "method": fit.method,
        "input": inputs[0].name if inputs else None,
        "output": outputs[0].name,
        "sample_rate_hz": rate,
        "delay_s": fit.delay_s,
        "rise_s": fit.rise_s,
        "overshoot": fit.overshoot,
        "residual_rms": fit.residual_rms,
        "each": [asdict(m) for m in fit.each],
    }
    return result, fit_plots.step_plot(pieces, rate, fit, outputs[0].unit or "as recorded")


def run_damper(file: TestFile) -> Result:
    """Equivalent damping with the verdict."""
    forces, moved, speeds = (
        file.pick("force"),
        file.pick("displacement", needed=False),
        file.pick("velocity", needed=False),
    )
    if not moved and not speeds:
        raise file.error(
            "a damper needs a displacement or a velocity; say where with --channel velocity=ARRAY:UNIT"
        )
    by_x, by_v = {s.record: s for s in moved}, {s.record: s for s in speeds}
    n = len(forces[0].values)
    rate = file.rate(n)
    in_si = forces[0].si is not None
    records = []
    for s in forces:
        x, v = by_x.get(s.record), by_v.get(s.record)
        if x is None and v is None:
            continue
        lengths = {len(one.values) for one in (s, x, v) if one is not None}
        if len(lengths) > 1:
            raise file.error(f"record '{s.record or s.name}': force and motion differ in length")
        force = _scaled(s, in_si)
        name = s.record or s.name
        with _naming(file, name):
            if v is None and x is not None:
                if not np.ptp(x.real()) > 0.0:
                    raise InputError("the displacement is constant; choose the channel that moves")
                records.append(smooth_motion(force, _scaled(x, in_si), rate, name))
            elif v is not None:
                speed = _scaled(v, in_si)
                place = _scaled(x, in_si) if x is not None else _integrated(speed, rate)
                records.append(DamperRecord(name, force, place, speed))
    if not moved or not speeds:
        file.notes.append(
            "velocity is derived from displacement" if moved else "displacement is integrated from velocity"
        )
    with _naming(file):
        fit = fit_damper(records, rate)
    length = (moved or speeds)[0].unit.split("/")[0] or "-"
    force_unit = forces[0].unit or "-"
    factor = 1.0
    if in_si:
        units = ("N", "m", "m/s")
        recorded = to_si((moved or speeds)[0].unit)
        factor = (recorded[1] if recorded else 1.0) / (forces[0].si or ("", 1.0))[1]
    else:
        units = (force_unit, length, f"{length}/s")
    c_unit = "N s/m" if in_si else f"s/{length}" if force_unit == "-" else f"{force_unit} s/{length}"
    k_unit = "N/m" if in_si else f"1/{length}" if force_unit == "-" else f"{force_unit}/{length}"
    result: dict[str, Any] = {
        "file": str(file.path),
        "c_eq": fit.c_eq.value,
        "c_eq_std": fit.c_eq.std,
        "c_eq_unit": c_unit,
        "c_eq_recorded": fit.c_eq.value * factor,
        "c_eq_recorded_unit": f"{force_unit} s/{length}",
        "k": fit.k.value,
        "k_std": fit.k.std,
        "k_unit": k_unit,
        "m": None if fit.m is None else fit.m.value,
        "m_std": None if fit.m is None else fit.m.std,
        "linear_nrmse": fit.linear_nrmse,
        "systematic_nrmse": fit.systematic,
        "linear_adequate": fit.linear_adequate,
        "reason": fit.reason,
        "not_identifiable": fit.not_identifiable,
        "sample_rate_hz": rate,
        "records": [
            {
                "record": r.name, "c_eq": r.c.value, "c_eq_std": r.c.std,
                **_maybe("c_energy", r.c_energy), "k": r.k.value, "k_std": r.k.std,
                "linear_nrmse": r.nrmse, "systematic_nrmse": r.systematic, "cycles": r.cycles,
                "friction_force": r.friction.value, "friction_force_std": r.friction.std,
                "viscous": r.viscous.value, "viscous_std": r.viscous.std, "friction_nrmse": r.friction_nrmse,
            }
            for r in fit.records
        ],
    }  # fmt: skip
    return result, fit_plots.damper_plot(records, fit, units)


class _naming:  # noqa: N801 - reads as a statement
    """Put the file's name before what an estimator has to say about its data."""

    def __init__(self, file: TestFile, what: str = "") -> None:
        self._where = f"{file.path}: {what}: " if what else f"{file.path}: "

    def __enter__(self) -> None:
        return None

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if isinstance(error, InputError) and not str(error).startswith(self._where.split(": ")[0]):
            raise InputError(f"{self._where}{error}") from error


def _one(file: TestFile, role: str, exclude: Series | None = None) -> Series:
    among = [s for s in file.series if exclude is None or s.name != exclude.name]
    return file.pick(role, among)[0]


def _si(file: TestFile, s: Series, si_unit: str, assumed: str) -> Array:
    values = s.real()
    if not s.unit:
        file.guesses.append(f"{s.name}: no unit stated, taken as {assumed}")
        return values
    known = to_si(s.unit, si_unit)
    if known is None or known[0] != si_unit:
        raise file.error(f"{s.name}: unit '{s.unit}' is none for {si_unit}; give another with --channel")
    return np.asarray(values * known[1])


def _scaled(s: Series, in_si: bool) -> Array:
    return np.asarray(s.real() * (s.si[1] if in_si and s.si is not None else 1.0))


def _integrated(speed: Array, rate_hz: float) -> Array:
    moved = np.cumsum(speed - np.mean(speed)) / rate_hz
    t = np.linspace(-1.0, 1.0, len(moved))
    return np.asarray(moved - np.polyval(np.polyfit(t, moved, 1), t))


def _maybe(name: str, e: Estimate | None) -> dict[str, float | None]:
    return {name: None if e is None else e.value, f"{name}_std": None if e is None else e.std}


def _signal(file: TestFile) -> Series:
    if "signal" in file.chosen:
        found = file.pick("signal")
        if len(found) > 1:
            raise file.error(
                f"--channel {file.chosen['signal']} is more than one series; give its column, such as a[:,0]"
            )
        return found[0]
    for role in ("displacement", "output", "acceleration", "velocity"):
        found = file.pick(role, needed=False)
        if found:
            return found[0]
    if len(file.series) == 1:
        return file.series[0]
    raise file.error("which channel decays? say so with --channel ARRAY:UNIT")


def _step_channels(file: TestFile) -> tuple[list[Series], list[Series]]:
    real = [s for s in file.series if not np.iscomplexobj(s.values)]
    channels = {s.channel: [o for o in real if o.channel == s.channel] for s in real}
    outputs = file.pick("output") if "output" in file.chosen else []
    if "input" in file.chosen:
        inputs = [] if file.chosen["input"].array == "none" else file.pick("input")
    else:
        # An input is as good as two levels; the output is what moves most besides.
        scores = {
            c: squareness(group[0].real())
            for c, group in channels.items()
            if not outputs or c != outputs[0].channel
        }
        best = max(scores, key=lambda c: scores[c]) if scores else ""
        inputs = channels[best] if best and scores[best] > 0.9 and len(channels) > 1 else []
        if inputs:
            file.guesses.append(f"input <- {inputs[0].name}: a step or square wave")
    if not outputs:
        left = {c: g for c, g in channels.items() if not inputs or c != inputs[0].channel}
        if not left:
            raise file.error("no output beside the input; say where with --channel output=ARRAY:UNIT")
        named = [c for c, g in left.items() if c.lower() in ("y", "output", "out", "response")]
        best = named[0] if named else max(left, key=lambda c: _jump(left[c][0].real()))
        outputs = left[best]
        line = f"output <- {outputs[0].name}{f' [{outputs[0].unit}]' if outputs[0].unit else ''}"
        if named or len(left) == 1:
            file.notes.append(line)
        else:
            file.guesses.append(f"{line}: it jumps most")
    return outputs, inputs


def _jump(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0


_WINDOWS: Mapping[str, WindowKind] = {
    "none": "none", "uniform": "rectangular", "rectangular": "rectangular", "boxcar": "rectangular",
    "hann": "hann", "hanning": "hann", "exponential": "exponential",
}  # fmt: skip
_KINDS: Mapping[ResponseKind, tuple[str, ...]] = {
    "receptance": ("receptance", "compliance", "m/n"),
    "mobility": ("mobility",),
    "accelerance": ("accelerance", "inertance"),
}


def _window(file: TestFile, option: str | None, spacing_hz: float) -> Window:
    said = option if option is not None else str(file.facts.get("window", "")) or None
    if said is None:
        file.notes.append(
            "nothing says how the records were cut: taken as whole (no leakage); --window hann or rectangular if the "
            "excitation was continuous random"
        )
        return Window()
    name, _, length = said.strip().lower().partition(":")
    names = _WINDOWS
    if name not in names or (name == "exponential" and not length):
        raise InputError(f"--window {said}: known are none, rectangular, hann and exponential:SECONDS")
    try:
        seconds = float(length) if length else 1.0 / spacing_hz
    except ValueError as error:
        raise InputError(f"--window {said}: '{length}' is no time in s") from error
    if not seconds > 0.0:
        raise InputError(f"--window {said}: the time must be above 0 s")
    return Window(names[name], seconds)


def _kind(file: TestFile, option: str | None, text: str) -> ResponseKind:
    if option is not None and option not in ("receptance", "mobility", "accelerance"):
        raise InputError(f"--kind {option}: known are receptance, mobility and accelerance")
    said = (option or f"{text} {file.facts.get('units', '')}").lower()
    for kind, words in _KINDS.items():
        if any(w in said for w in words):
            return kind
    file.guesses.append("responses taken as accelerance; --kind receptance or mobility if they are not")
    return "accelerance"


def _responses(file: TestFile, band: Band, *, magnitude: bool) -> tuple[Array, Any, list[str], str]:
    f, axis = _frequencies(file)
    rest = [s for s in file.series if s.name != axis and len(s.values) == len(f)]
    if "response" in file.chosen:
        rest = file.pick("response", rest)
    complex_ones = [s for s in rest if np.iscomplexobj(s.values)]
    columns: list[tuple[str, NDArray[Any]]] = [(s.name, s.values) for s in complex_ones]
    columns = columns or _paired(rest)
    if not columns and magnitude:
        columns = [(s.name, _linear(s)) for s in rest if "phase" not in s.words and "std" not in s.words][:1]
    if not columns:
        raise file.error(
            "no complex response: expected a complex array, or columns with real and imaginary part, "
            "or magnitude and phase"
        )
    h = np.column_stack([c for _, c in columns])
    ok = np.isfinite(f) & np.all(np.isfinite(h), axis=1) & (f > 0.0)
    if band is not None:
        ok &= (f >= band[0]) & (f <= band[1])
    if ok.sum() < 8:
        raise file.error(f"only {int(ok.sum())} usable frequencies" + (" in the band" if band else ""))
    if not np.all(np.isfinite(h)):
        file.notes.append(
            f"{int(np.sum(~np.all(np.isfinite(h), axis=1)))} rows with missing values are left out"
        )
    order = np.argsort(f[ok], kind="stable")
    sorted_f = f[ok][order]
    if not np.all(np.diff(sorted_f) > 0.0):
        raise file.error("the same frequency stands twice")
    return sorted_f, h[ok][order], [n for n, _ in columns], " ".join(s.text for s in rest)


def _frequencies(file: TestFile) -> tuple[Array, str]:
    real = [s for s in file.series if not np.iscomplexobj(s.values)]
    found = file.pick("frequency", real, needed=False)
    turned = [] if found else file.pick("angular frequency", real, needed=False)
    if found or turned:
        s = (found or turned)[0]
        known = to_si(s.unit) if s.unit else None
        factor = known[1] if known else 1.0
        if turned or (known is not None and known[0] == "rad/s"):
            factor = factor / TAU
        return np.asarray(np.asarray(s.values, dtype=np.float64) * factor), s.name
    step = file.facts.get("df_hz")
    if isinstance(step, int | float) and step > 0:
        n = max(len(s.values) for s in file.series)
        file.notes.append(f"frequencies from df_hz {step:g} Hz, beginning there")
        return step * np.arange(1.0, n + 1.0), ""
    raise file.error("no frequencies; say where they are with --channel frequency=ARRAY:Hz")


_REAL, _IMAG = ("real", "re"), ("imag", "imaginary", "im")
_SIZE, _TURN = ("mag", "magnitude", "abs", "amplitude", "gain", "db"), ("phase", "angle", "arg", "deg", "rad")


def _paired(rest: list[Series]) -> list[tuple[str, NDArray[Any]]]:
    """Complex responses from columns in pairs."""
    kinds = {"re": _REAL, "im": _IMAG, "size": _SIZE, "turn": _TURN}
    first = {role: [s for s in rest if any(w in names for w in s.words)] for role, names in kinds.items()}
    if first["re"] and len(first["re"]) == len(first["im"]):
        pairs = zip(first["re"], first["im"], strict=True)
        return [(a.name, a.values + 1j * np.asarray(b.values)) for a, b in pairs]
    sizes = [s for s in first["size"] if s not in first["turn"] or "db" in s.words]
    turns = [s for s in first["turn"] if s not in sizes]
    if sizes and len(sizes) == len(turns):
        out = []
        for a, b in zip(sizes, turns, strict=True):
            angle = np.asarray(b.values, dtype=np.float64)
            in_degrees = (
                "deg" in b.words
                or b.unit.lower() in ("deg", "°")
                or (b.unit.lower() != "rad" and np.nanmax(np.abs(angle)) > 7.0)
            )
            out.append((a.name, _linear(a) * np.exp(1j * (np.radians(angle) if in_degrees else angle))))
        return out
    return []


def _linear(s: Series) -> Array:
    values = np.asarray(s.values, dtype=np.float64)
    return np.asarray(10.0 ** (values / 20.0)) if "db" in s.words or s.unit.lower() == "db" else values
