"""All figures of the thesis, in its order."""

from collections import Counter
from collections.abc import Callable

from twin.station.validation import chapter_6, chapter_7, chapter_7_tests, chapter_8, chapters_3_to_5
from twin.station.validation.rows import Figure, Row, judge

FIGURES: tuple[Figure, ...] = (
    *chapters_3_to_5.FIGURES,
    *chapter_6.FIGURES,
    *chapter_7.FIGURES,
    *chapter_7_tests.FIGURES,
    *chapter_8.FIGURES,
)


def all_rows(progress: Callable[[int, int], None] = lambda _done, _of: None) -> list[Row]:
    """Compute and judge every figure."""
    rows = []
    for figure in FIGURES:
        rows.append(judge(figure))
        progress(len(rows), len(FIGURES))
    return rows


def counts(rows: list[Row]) -> dict[str, int]:
    """How many rows have each verdict, and how many there are."""
    found = Counter(row.verdict for row in rows)
    verdicts = ("reproduced", "differs", "not reproducible")
    return {**{v: found[v] for v in verdicts}, "rows": len(rows)}  # type: ignore[index]
