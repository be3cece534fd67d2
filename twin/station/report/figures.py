"""Matplotlib figures as files, and as drawings inside a page that tell their values under the pointer.

A page carries its plots as SVG, 20 to 60 kB each, with the plotted numbers beside them for a script of two kB that
reads them out under the pointer or the arrow keys. The plotting library for the browser that the station's own page
uses would add 4.8 MB to every page that is filed, and leave nothing on paper that SVG does not.
"""

import io
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from twin.plant.errors import InputError
from twin.plant.linear import Array
from twin.station.report.page import Html, element, join

POINTS_PER_INCH = 72
WIDTH_IN = 10.0
MOST_POINTS = 1500
SUFFIXES = (".png", ".pdf", ".svg")

HOVER = Path(__file__).with_name("hover.js").read_text(encoding="utf-8")
"""Reads values out under the pointer and, with the plot in focus, under the arrow keys: left and right go from point
to point, up and down from one pair of axes to the next."""

_RC: Any = {"svg.fonttype": "none", "font.size": 9.5, "axes.titlesize": 10.5, "legend.fontsize": 8.5}


@dataclass(frozen=True, slots=True)
class Plot:
    """One plot of a page.

    Attributes
    ----------
    name
        Identifier on the page.
    caption
        What is to be seen, and from where the numbers come.
    height_in
        Of the whole drawing [inch].
    draw
        Draws into an empty figure.
    """

    name: str
    title: str
    caption: str
    height_in: float
    draw: Callable[[Figure], None]


def thinned(x: Array, y: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """A long series with no more points than a plot can show: least and largest of equal stretches stay."""
    if len(x) <= most:
        return x, y
    edges = np.linspace(0, len(x), most // 2 + 1).astype(int)
    keep: set[int] = {0, len(x) - 1}
    for a, b in pairwise(edges):
        part = y[a:b]
        if np.isfinite(part).any():
            keep |= {a + int(np.nanargmin(part)), a + int(np.nanargmax(part))}
    rows = sorted(keep)
    return x[rows], y[rows]


def as_html(plot: Plot) -> Html:
    """The plot as a figure of a page, with its numbers for the script `HOVER`."""
    figure = _drawn(plot)
    raw = io.StringIO()
    with rc_context({**_RC, "svg.hashsalt": plot.name}):
        figure.savefig(raw, format="svg", metadata={"Date": None, "Creator": None})
    # Two drawings in one page must not share identifiers: clipping paths would be the other's.
    svg = raw.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{plot.name}-', svg)
    svg = svg.replace('href="#', f'href="#{plot.name}-').replace("url(#", f"url(#{plot.name}-")
    svg = re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', svg, count=1)
    svg = svg.replace("xlink:href", "href")
    numbers = json.dumps(_numbers(figure), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    inside = element(
        "div",
        Html(svg),
        Html('<output aria-live="polite"></output>'),
        Html(f'<script type="application/json">{numbers}</script>'),
        class_="plot",
        tabindex="0",
        role="img",
        aria_label=f"{plot.title}. {plot.caption} Arrow keys read out values.",
    )
    return element(
        "figure",
        element("h3", plot.title),
        inside,
        element("figcaption", element("small", plot.caption)),
        id=plot.name,
    )


def all_as_html(plots: list[Plot], progress: Callable[[int, int], None]) -> Html:
    """Plots below each other; ``progress`` takes those drawn and all."""
    drawn = []
    for done, plot in enumerate(plots, start=1):
        drawn.append(as_html(plot))
        progress(done, len(plots))
    return join(drawn)


def no_progress(_done: int, _total: int) -> None:
    """For who does not wait."""


def save_plots(plots: list[Plot], path: Path) -> None:
    """Write plots into one file: a page each in a .pdf, below each other in a .png or .svg.

    Raises
    ------
    InputError
        If it cannot be written there, or the ending is another.
    """
    must_be_a_plot(path)
    try:
        if path.suffix.lower() == ".pdf":
            from matplotlib.backends.backend_pdf import PdfPages

            with PdfPages(path, metadata={"CreationDate": None}) as pages:
                for plot in plots:
                    pages.savefig(_drawn(plot))
            return
        with rc_context(_RC):
            whole = Figure(figsize=(WIDTH_IN, sum(p.height_in for p in plots)), dpi=110, layout="constrained")
            FigureCanvasAgg(whole)
            parts = np.atleast_1d(
                np.array(
                    whole.subfigures(len(plots), 1, height_ratios=[p.height_in for p in plots]), dtype=object
                )
            )
            for part, plot in zip(parts, plots, strict=True):
                part.suptitle(plot.title, x=0.01, ha="left", fontsize=11)
                plot.draw(part)
            whole.savefig(path, dpi=110, facecolor="white")
    except OSError as error:
        raise InputError(f"--plot {path}: cannot be written ({error.strerror or error})") from error


def must_be_a_plot(path: Path) -> None:
    """Say before the run that a plot cannot be written there; raises InputError."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"--plot {path}: give a name that ends in {', '.join(SUFFIXES)}")
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(f"--plot {path}: cannot be written; give a file in a folder that exists")


def _drawn(plot: Plot) -> Figure:
    with rc_context(_RC):
        figure = Figure(figsize=(WIDTH_IN, plot.height_in), dpi=POINTS_PER_INCH, layout="constrained")
        FigureCanvasAgg(figure)
        plot.draw(figure)
    return figure


def _numbers(figure: Figure) -> list[dict[str, object]]:
    """Where each pair of axes lies in the drawing [points from its upper left], and what is plotted there."""
    width, height = figure.get_size_inches() * POINTS_PER_INCH
    out: list[dict[str, object]] = []
    for axes in figure.axes:
        box = axes.get_position()
        series = [s for line in axes.get_lines() if (s := _series(axes, line)) is not None]
        if not series:
            continue
        place = (box.x0 * width, (1.0 - box.y1) * height, box.width * width, box.height * height)
        out.append({
            "at": [round(float(v), 2) for v in place],
            "x": [_five(v) for v in axes.get_xlim()],
            "y": [_five(v) for v in axes.get_ylim()],
            "log": [axes.get_xscale() == "log", axes.get_yscale() == "log"],
            "name": axes.get_xlabel() or next((a.get_xlabel() for a in figure.axes if a.get_xlabel()), ""),
            "series": series,
        })  # fmt: skip
    return out


def _series(axes: Axes, line: object) -> dict[str, object] | None:
    label = str(line.get_label())  # type: ignore[attr-defined]
    if label.startswith("_") or line.get_transform() != axes.transData:  # type: ignore[attr-defined]
        return None
    x = np.asarray(line.get_xdata(), dtype=np.float64)  # type: ignore[attr-defined]
    y = np.asarray(line.get_ydata(), dtype=np.float64)  # type: ignore[attr-defined]
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return None
    return {"label": label, "x": [_five(v) for v in x[known]], "y": [_five(v) for v in y[known]]}


def _five(value: float) -> float:
    return float(f"{value:.5g}")
