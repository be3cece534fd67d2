"""A figure of the thesis, what the program makes of it, and how the two compare."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

Value = float | bool
Verdict = Literal["reproduced", "differs", "not reproducible"]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far the computed figure may be from the printed one, relative, and why that far."""

    relative: float
    why: str


EXACT = Tolerance(1e-6, "a formula")
PLOT = Tolerance(0.02, "read off a plot")
ABOUT = Tolerance(0.25, "the text says about, in one digit")


def digits(value: float, last: float, why: str = "the digits that are printed") -> Tolerance:
    """Half a unit of the last printed digit, with a margin for its rounding."""
    return Tolerance(0.501 * last / abs(value), why)


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of the thesis and how it is computed here.

    Attributes
    ----------
    thesis
        What is printed; True or False for a statement; None if nothing can be read.
    compute
        Works the figure out from presets and code; None if its inputs are missing.
    tolerance
        None for statements and for what cannot be compared.
    comparable
        False if a value is printed but does not follow from anything else that is.
    """

    id: str
    source: str
    unit: str
    thesis: Value | None
    compute: Callable[[], Value] | None
    tolerance: Tolerance | None = None
    note: str = ""
    comparable: bool = True


@dataclass(frozen=True, slots=True)
class Row:
    """A figure, computed and judged."""

    id: str
    source: str
    unit: str
    thesis: Value | None
    computed: Value | None
    relative_error: float | None
    verdict: Verdict
    note: str


def judge(figure: Figure) -> Row:
    """Compute a figure and compare it with what is printed."""
    computed = None if figure.compute is None else _plain(figure.compute())
    thesis = figure.thesis
    error: float | None = None
    verdict: Verdict = "not reproducible"
    if computed is not None and thesis is not None:
        if isinstance(thesis, bool) or isinstance(computed, bool):
            error = 0.0 if thesis == computed else 1.0
        else:
            error = abs(computed - thesis) / abs(thesis)
        if figure.comparable:
            allowed = figure.tolerance.relative if figure.tolerance is not None else 0.0
            verdict = "reproduced" if error <= allowed else "differs"
    return Row(
        figure.id, figure.source, figure.unit, thesis, computed, error, verdict, _note(figure, verdict)
    )


def _plain(value: Value) -> Value:
    """The value as Python's own number or truth, whatever library it came from."""
    return bool(value) if isinstance(value, bool | np.bool_) else float(value)


def _note(figure: Figure, verdict: Verdict) -> str:
    tolerance = figure.tolerance
    if tolerance is None or verdict == "not reproducible":
        return figure.note
    allowed = f"Tolerance {100.0 * tolerance.relative:.2g} %, {tolerance.why}."
    return f"{allowed} {figure.note}".strip()
