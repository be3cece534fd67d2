"""What all redrawn figures share: size, colours, axes, and the record of what a drawing shows."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from twin.control.analysis import OperatingPoint
from twin.plant.linear import Array

PASSIVE, CONTROLLED, LIMIT, SECOND, THIRD, THESIS = (
    "#78909c",
    "#1565c0",
    "#c62828",
    "#ef6c00",
    "#2e7d32",
    "#6a1b9a",
)
SHADES = (
    "#0d3c61",
    "#1565c0",
    "#42a5f5",
    "#26a69a",
    "#9ccc65",
    "#fbc02d",
    "#fb8c00",
    "#e53935",
    "#8e24aa",
    "#5d4037",
    "#455a64",
)
DPI = 130
WIDTHS = {1: 7.2, 2: 10.4, 3: 12.6}


@dataclass(frozen=True, slots=True)
class Drawing:
    """One redrawn figure.

    Attributes
    ----------
    name
        File name without suffix.
    source
        Figures of the thesis that it stands for.
    rows
        Identifiers of the figures whose verdicts it carries.
    panels
        Columns of axes.
    draw
        Takes the axes.
    """

    name: str
    title: str
    source: str
    caption: str
    draw: Callable[[list[Axes]], None]
    rows: tuple[str, ...] = field(default=())
    panels: int = 1


def dress(axes: Axes, x: str, y: str, title: str = "", legend: bool = True) -> None:
    """Label axes the same way everywhere."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(color="#e0e4e7", linewidth=0.6, which="both")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)
    if legend and axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, frameon=True, framealpha=0.9, edgecolor="#e0e4e7")


def values(points: Iterable[OperatingPoint], name: str, scale: float = 1.0) -> Array:
    """One attribute of operating points as an array; NaN where it is None."""
    return scale * np.array([getattr(p, name) for p in points], dtype=np.float64)


def save(drawing: Drawing, folder: Path) -> Path:
    """Draw into ``folder/NAME.png``."""
    figure = Figure(figsize=(WIDTHS[drawing.panels], 3.8), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    drawing.draw([figure.add_subplot(1, drawing.panels, k + 1) for k in range(drawing.panels)])
    path = folder / f"{drawing.name}.png"
    figure.savefig(path, format="png", dpi=DPI)
    return path
