"""What the series of a view are called, in which units, and how they are drawn: all that is said once."""

import rerun as rr

from twin.plant.blocks import Channel
from twin.plant.config import Plant
from twin.station import palette
from twin.station.view.groups import Group

LANES: dict[str, dict[str, int]] = {
    "alarm": {"none": palette.GOOD, "over budget": palette.WARNING, "at a limit": palette.POOR},
    "control": {"on": palette.GOOD, "off": palette.OFF, "unknown": palette.OFF},
    "damping": {
        "none": palette.OFF,
        "unestimated": palette.OFF,
        "learning": palette.WAITING,
        "estimated": palette.GOOD,
        "invalid": palette.POOR,
    },
    "model": {
        "consistent": palette.GOOD,
        "drifting": palette.WARNING,
        "diverged": palette.POOR,
        "no data": palette.OFF,
    },
}
"""States of every lane, from good to bad in colours that people who cannot tell red from green can read as text."""

_BUDGET = {"joule_mean": "Joule mean", "joule_peak": "Joule peak", "electrical": "electrical mean"}


def log_styles(
    stream: rr.RecordingStream,
    plant: Plant,
    channels: tuple[Channel, ...],
    groups: list[Group],
    budget_kind: str,
) -> None:
    """Say once what every series is called and how it is drawn."""
    units = {c.name: c.unit for c in channels}
    for group in groups:
        measured = [channels[c].name for c in group.channels]
        names = [f"{n} measured [{units[n]}]" for n in measured]
        names += [f"{n} twin [{units[n]}]" for n in group.twin]
        pair = len(measured) == len(group.twin) == 1
        colours = [palette.MEASURED, palette.TWIN] if pair else _cycle(len(names))
        _lines(stream, group.path, names, colours, [2.0] * len(measured) + [1.2] * len(group.twin))
    _lines(
        stream,
        "vibration",
        ["measured [µm]", "model, no control [µm]", "limit of any controller [µm]"],
        [palette.MEASURED, palette.PASSIVE, palette.LIMIT],
        [2.5, 1.5, 1.5],
    )
    _lines(
        stream,
        "power",
        ["electrical mean [W]", "Joule mean [W]", "Joule peak [W]", f"budget, {_BUDGET[budget_kind]} [W]"],
        [palette.MEASURED, palette.TWIN, palette.SERIES[2], palette.LIMIT],
        [2.0, 2.0, 1.5, 2.5],
    )
    _health(stream, plant, units)
    _lines(stream, "damping/in_use", ["c2 in use [Ns/m]"], [palette.IN_USE], [2.0])
    _band(stream, "damping/learned", "c2 learned ±1σ", "Ns/m", palette.LEARNED)
    _band(stream, "excitation", "excitation ±1σ", "Hz", palette.TWIN)
    _band(stream, "estimate/primary", f"{plant.primary.name} displacement ±1σ", "µm", palette.TWIN)
    _band(stream, "estimate/stroke", "stroke ±1σ", "mm", palette.SERIES[2])
    _band(stream, "estimate/force", "force that nothing measures ±1σ", "N", palette.FORCE)
    for path, name, colour in (
        ("gains/gamma_n_m", "γ, relative position [N/m]", palette.MEASURED),
        ("gains/beta_ns_m", "β, relative velocity [Ns/m]", palette.TWIN),
        ("gains/alpha_kg", "α, relative acceleration [kg]", palette.SERIES[2]),
    ):
        _lines(stream, path, [name], [colour], [2.0])
    for lane, colours_of in LANES.items():
        style = rr.StateConfiguration(values=list(colours_of), colors=palette.array(colours_of.values()))
        stream.log(f"state/{lane}", style, static=True)


def _health(stream: rr.RecordingStream, plant: Plant, units: dict[str, str]) -> None:
    sensors = [s.name for s in plant.sensor if s.name in units]
    for path, what in (
        ("health/innovation", "rms/expected"),
        ("health/bias", "mean/std"),
        ("health/whiteness", "lag-1 autocorrelation"),
    ):
        names = [f"{s} {what} [1]" for s in sensors] + ["95 % from", "95 % to"]
        colours = [*_cycle(len(sensors)), palette.GOOD, palette.GOOD]
        _lines(stream, path, names, colours, [1.0] * len(sensors) + [2.0, 2.0])
    _lines(
        stream,
        "health/nis",
        ["NIS [1], cut at 10", "95 % from", "95 % to"],
        [palette.IN_USE, palette.GOOD, palette.GOOD],
        [2.0, 2.0, 2.0],
    )


def _cycle(n: int) -> list[int]:
    return [palette.SERIES[k % len(palette.SERIES)] for k in range(n)]


def _lines(
    stream: rr.RecordingStream, path: str, names: list[str], colours: list[int], widths: list[float]
) -> None:
    stream.log(path, rr.SeriesLines(names=names, colors=palette.array(colours), widths=widths), static=True)


def _band(stream: rr.RecordingStream, path: str, name: str, unit: str, colour: int) -> None:
    style = rr.Measurements.from_fields(
        names=[name], units=[unit], colors=palette.array([colour]), widths=[2.0]
    )
    stream.log(path, style, static=True)
