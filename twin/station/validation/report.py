"""The validation as a web page: every figure of the thesis as a row, its plots drawn anew, nothing loaded from afar."""

from collections.abc import Callable
from pathlib import Path

from twin.plant.errors import InputError
from twin.station.report.page import Html, badge, element, join, page, section, table, text, tiles
from twin.station.validation import drawings_absorbers, drawings_control, drawings_rig
from twin.station.validation.canvas import Drawing, save
from twin.station.validation.catalogue import counts
from twin.station.validation.rows import Row, Value

DRAWINGS: tuple[Drawing, ...] = (
    *drawings_absorbers.DRAWINGS,
    *drawings_control.DRAWINGS,
    *drawings_rig.DRAWINGS,
)

NOT_DRAWN = (
    (
        "Figures 3-1 to 3-4, 3-6 to 3-11, 4-1, 4-3 to 4-9, 5-1, 5-3 to 5-5, 5-9, 5-11, 6-1, 6-2, 6-7 to 6-9, "
        "7-1, 7-2, 7-6, 7-18, 14-4",
        "sketches, photographs and circuit diagrams",
    ),
    (
        "Figures 6-4, 6-14, 6-23, 6-26, 6-28, 7-12, 7-19, 7-30, 7-34, 8-1, 11-3, 11-9, 11-12, 11-15, "
        "14-1 to 14-3",
        "block diagrams of models",
    ),
    ("Figure 5-10", "measured at the maker's; no data in the thesis"),
    ("Figures 6-15 to 6-19", "noise: the thesis gives variances without the sample time of its noise blocks"),
    (
        "Figures 6-24, 6-27, 6-29, 6-31, 12-1",
        "time histories whose instability the poles above show; amplitudes depend on the solver's start",
    ),
    ("Figure 7-3", "measured resonances; the scan keeps the added masses alone"),
    ("Figure 7-5", "measured lateral vibration; no data in the thesis"),
    ("Figures 7-15, 7-17", "as 7-14 and 7-16 with acceleration feedback, which differs little"),
)  # fmt: skip

_MARK = {"reproduced": "good", "differs": "bad", "not reproducible": "open"}


def write_report(
    rows: list[Row], folder: Path, progress: Callable[[int, int], None] = lambda _done, _of: None
) -> Path:
    """Write ``index.html`` and its pictures into a folder, made if there is none.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If the folder cannot be written to.
    """
    verdicts = {row.id: row for row in rows}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        figures = []
        for done, drawing in enumerate(DRAWINGS, start=1):
            picture = save(drawing, folder)
            figures.append(_figure(drawing, picture.name, verdicts))
            progress(done, len(DRAWINGS))
        page = folder / "index.html"
        page.write_text(_page(rows, figures), encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"--report {folder}: cannot be written ({error.strerror}); give another folder"
        ) from error
    return page


def number(value: Value | None, significant: int = 5) -> str:
    """A value as people read it: to some significant digits, yes or no for a statement."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{significant}g}"


def percent(row: Row) -> str:
    """Relative error as people read it."""
    if row.relative_error is None or isinstance(row.thesis, bool):
        return ""
    return f"{100.0 * row.relative_error:.2g} %"


def _page(rows: list[Row], figures: list[Html]) -> str:
    found = counts(rows)
    numbers: list[tuple[object, object]] = [(found[name], badge(name, kind)) for name, kind in _MARK.items()]
    links = (("#plots", "Plots"), ("#figures", "All figures"), ("#left-out", "Not drawn"))
    heads = ("figure", "source", "thesis", "computed", "unit", "error", "verdict", "note")
    body = join((
        element("h1", "The thesis, recomputed"),
        element(
            "p",
            "Every figure that the thesis prints or states, beside what this program computes from the thesis's own "
            "parameters. Nothing here was measured: the rig is the simulated one.",
            class_="dim",
        ),
        tiles([*numbers, (found["rows"], "figures in all")]),
        Html(
            "<p><b>Reproduced</b>: the two agree within the row's tolerance, which follows from the digits that are "
            "printed or from how the figure was read. <b>Differs</b>: they do not; the note says why and which one is "
            "right. <b>Not reproducible</b>: the thesis shows it in a plot that the scan lacks, or it was measured and "
            "its data are not printed; a computed value stands for itself.</p>"
        ),
        element("nav", join(element("a", name, href=target) for target, name in links)),
        section("Plots", "plots", *figures),
        section("All figures", "figures", table(heads, map(_row, rows), (2, 3, 5), [row.id for row in rows])),
        section(
            "Not drawn",
            "left-out",
            element("ul", join(element("li", f"{which}: {why}.") for which, why in NOT_DRAWN)),
        ),
    ))  # fmt: skip
    return page("The thesis, recomputed", body, self_contained=False)


def _figure(drawing: Drawing, picture: str, verdicts: dict[str, Row]) -> Html:
    badges = join(
        element(
            "span",
            f"{name}: {verdicts[name].verdict}",
            class_=f"badge {_MARK[verdicts[name].verdict]}",
            title=verdicts[name].note,
        )
        for name in drawing.rows
    )
    if not badges:
        badges = badge("drawn from the model; the scan has no numbers to compare", "open")
    return element(
        "figure",
        element("h3", drawing.title),
        element("small", f"thesis {drawing.source}"),
        Html(f'<img src="{text(picture)}" alt="{text(drawing.title)}" loading="lazy">'),
        element("figcaption", drawing.caption, element("div", badges, class_="badges")),
        class_="single" if drawing.panels == 1 else "wide",
        id=drawing.name,
    )


def _row(row: Row) -> list[object]:
    name = Html(text(row.id).replace(".", ".<wbr>").replace("_", "_<wbr>"))
    return [
        element("code", name),
        row.source,
        number(row.thesis),
        number(row.computed),
        row.unit,
        percent(row),
        badge(row.verdict, _MARK[row.verdict]),
        row.note,
    ]
