"""Pictures of a campaign and the page that holds them: yield against budget, worst cases, sensitivities."""

import base64
import html
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from twin.plant.errors import RunError
from twin.station.campaign.spec import CampaignSpec
from twin.station.validation.canvas import CONTROLLED, LIMIT, PASSIVE, SECOND, SHADES, dress

PAGE = "report.html"
SHOWN_PARAMETERS = 14
TITLES = {
    "attenuation_mean": "mean attenuation",
    "attenuation_worst": "worst attenuation",
    "displacement_m": "displacement",
    "joule_mean_w": "mean Joule power",
    "growth_1_s": "growth of slowest pole",
    "modulus_margin": "modulus margin",
}


def write_report(
    spec: CampaignSpec, rows: Sequence[dict[str, Any]], result: dict[str, Any], folder: Path, spec_path: Path
) -> dict[str, Any]:
    """Draw the pictures and write the page; returns their paths by name.

    Raises
    ------
    RunError
        If they cannot be written.
    """
    figures = {"yield": _yield_figure(spec, result), "cases": _cases_figure(rows)}
    if result["sensitivities"]:
        figures["sensitivity"] = _sensitivity_figure(result["sensitivities"])
    drawn = {}
    try:
        for name, figure in figures.items():
            buffer = BytesIO()
            figure.savefig(buffer, dpi=130, format="png")
            drawn[name] = buffer.getvalue()
            (folder / f"{name}.png").write_bytes(drawn[name])
        page = folder / PAGE
        page.write_text(_page(spec, result, drawn, spec_path), encoding="utf-8")
    except OSError as error:
        raise RunError(f"{folder}: report cannot be written ({error.strerror or error})") from error
    return {"report": str(page), "plots": [str(folder / f"{name}.png") for name in drawn]}


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _yield_figure(spec: CampaignSpec, result: dict[str, Any]) -> Figure:
    """Share of cases that keep everything against the budget, with its 95 % interval."""
    figure = _figure(7.6, 4.4)
    axes: Axes = figure.subplots()
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for point in result["yields"]:
        groups.setdefault((point["plant"], point["excitation"]), []).append(point)
    for k, ((plant, excitation), points) in enumerate(groups.items()):
        x = np.array([p["budget_w"] for p in points])
        share, low, high = (100.0 * np.array([p[key] for p in points]) for key in ("share", "low", "high"))
        colour = (CONTROLLED, SECOND, LIMIT, *SHADES)[k % (3 + len(SHADES))]
        axes.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        axes.plot(x, share, "o-" if len(x) < 20 else "-", color=colour, label=f"{plant}: {excitation}")
    axes.set_ylim(-3.0, 103.0)
    kind = spec.budget_kind.replace("_", " ")
    dress(axes, f"budget, {kind} power [W]", "cases that keep everything [%]", "Yield against budget")
    return figure


def _cases_figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Motion left of all cases, the mean against the worst, and what was broken first."""
    figure = _figure(11.0, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=[1.4, 1.0])
    groups = (
        ("unstable", LIMIT, [r for r in rows if not r["stable"]]),
        ("a limit broken", SECOND, [r for r in rows if r["stable"] and not r["meets"]]),
        ("keeps everything", CONTROLLED, [r for r in rows if r["meets"]]),
    )
    for label, colour, some in groups:
        known = [r for r in some if r["attenuation_worst"] is not None]
        if known:
            # What is left, not what is gone: an unstable case may move many times as far as the passive rig.
            x = [100.0 * max(1.0 - r["attenuation_mean"], 1e-6) for r in known]
            y = [100.0 * max(1.0 - r["attenuation_worst"], 1e-6) for r in known]
            left.loglog(x, y, ".", color=colour, ms=5, alpha=0.6, label=f"{label} ({len(some)})")
    for axis in (left.xaxis, left.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FormatStrFormatter("%g"))
        axis.set_minor_formatter(NullFormatter())
    dress(left, "mean motion left [% of passive]", "worst motion left [% of passive]", "Every case")
    counts: dict[str, int] = {}
    for row in rows:
        name = row["first_limit"] or "none"
        counts[name] = counts.get(name, 0) + 1
    names = sorted(counts, key=lambda key: counts[key])
    right.barh(names, [counts[n] for n in names], color=[PASSIVE if n == "none" else SECOND for n in names])
    for k, name in enumerate(names):
        right.text(counts[name], k, f" {counts[name]}", va="center", fontsize=8)
    right.margins(x=0.15)
    dress(right, "cases", "", "Limit broken first", legend=False)
    return figure


def _sensitivity_figure(sensitivities: dict[str, dict[str, dict[str, float]]]) -> Figure:
    """Rank correlation and rank regression of each result with each parameter."""
    results = list(sensitivities)
    parameters = sorted(
        {name for found in sensitivities.values() for name in found if name},
        key=lambda name: max(
            abs(found[name]["regression"]) for found in sensitivities.values() if name in found
        ),
    )[-SHOWN_PARAMETERS:]
    columns = min(3, len(results))
    lines = -(-len(results) // columns)
    figure = _figure(2.0 + 3.4 * columns, lines * (1.5 + 0.34 * len(parameters)))
    grid = figure.subplots(lines, columns, squeeze=False, sharey=True, sharex=True)
    at = np.arange(len(parameters))
    for k, axes in enumerate(grid.flat):
        if k >= len(results):
            axes.set_visible(False)
            continue
        found = sensitivities[results[k]]
        for off, key, colour in ((0.2, "regression", CONTROLLED), (-0.2, "rank_correlation", PASSIVE)):
            values = [found.get(name, {}).get(key, 0.0) for name in parameters]
            axes.barh(at + off, values, height=0.38, color=colour, label=key.replace("_", " "))
        axes.axvline(0.0, color="black", lw=0.8)
        axes.set_xlim(-1.0, 1.0)
        axes.set_yticks(at, parameters, fontsize=8)
        title = f"{TITLES.get(results[k], results[k])} (R² {found['']['explained']:.2f})"
        dress(axes, "standardised, on ranks" if k + columns >= len(results) else "", "", title, legend=k == 0)
    return figure


def _page(spec: CampaignSpec, result: dict[str, Any], drawn: dict[str, bytes], spec_path: Path) -> str:
    def text(value: object) -> str:
        if isinstance(value, bool):
            return "yes" if value else "no"
        return html.escape(
            "-" if value in (None, "") else f"{value:.4g}" if isinstance(value, float) else str(value)
        )

    worst = result["worst"]
    head = "".join(f"<th>{html.escape(key.replace('_', ' '))}</th>" for key in (worst[0] if worst else {}))
    body = "".join("<tr>" + "".join(f"<td>{text(v)}</td>" for v in row.values()) + "</tr>" for row in worst)
    pictures = "".join(
        f'<h2>{html.escape(name.capitalize())}</h2><img alt="{html.escape(name)}" '
        f'src="data:image/png;base64,{base64.b64encode(data).decode()}">'
        for name, data in drawn.items()
    )
    share = 100.0 * result["meeting"] / max(result["cases"], 1)
    command = f"atmd campaign {spec_path} --replay {worst[0]['case']}" if worst else ""
    described = html.escape(spec.model_dump_json(indent=2, exclude_defaults=True))
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(spec.name)}</title>
<style>body{{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem}}
img{{max-width:100%}}table{{border-collapse:collapse;font-size:13px}}td,th{{padding:.2rem .7rem;text-align:right;
border-bottom:1px solid #ddd}}pre{{background:#f4f6f8;padding:1rem;overflow:auto}}</style></head><body>
<h1>Campaign {html.escape(spec.name)}</h1>
<p>{result["cases"]} cases: {result["meeting"]} ({share:.1f} %) keep everything, {result["stable"]} are stable on the
whole grid. Results of every case are in <code>cases.parquet</code> beside this page.</p>
{pictures}
<p>R² is the share of a result's variance, on ranks, that the regression explains. Where it is low, the result does not
rise or fall steadily with the parameters (an absorber may be off to either side) or they act together: the bars then
say little.</p>
<h2>Worst cases</h2><table><tr>{head}</tr>{body}</table>
<p>Any of them runs again, alone: <code>{html.escape(command)}</code></p>
<h2>What was asked</h2><pre>{described}</pre></body></html>
"""
