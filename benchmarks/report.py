"""What a case hands back: figures for a program and rows for people, with the target beside the figure."""

from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    unit
        ``x`` for a ratio.
    target
        None where nothing is promised.
    better
        Which side of the target is good.
    spread
        Half of the range between the quartiles, as a share; None where it says nothing.
    """

    what: str
    value: float
    unit: str = "x"
    target: float | None = None
    better: Literal["more", "less"] = "more"
    spread: float | None = None

    @property
    def verdict(self) -> str:
        """``ok``, ``short``, or nothing where nothing is promised."""
        if self.target is None:
            return ""
        good = self.value >= self.target if self.better == "more" else self.value <= self.target
        return "ok" if good else "short"

    def cells(self) -> tuple[str, str, str, str, str]:
        """Text of the columns: what, value, spread, target, verdict."""
        unit = {"x": "x", "": ""}.get(self.unit, f" {self.unit}")
        sign = ">=" if self.better == "more" else "<="
        target = "" if self.target is None else f"{sign} {self.target:.4g}{unit}"
        spread = "" if self.spread is None else f"{100.0 * self.spread:.0f} %"
        return self.what, f"{self.value:.3g}{unit}", spread, target, self.verdict


@dataclass(frozen=True, slots=True)
class Report:
    """Figures of one case, to be merged into the JSON, and its rows."""

    figures: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
