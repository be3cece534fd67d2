"""The validation as a web page: every figure of the thesis as a row, its plots drawn anew, nothing loaded from afar."""

import html
from collections.abc import Callable
from pathlib import Path

from twin.plant.errors import InputError
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

_STYLE = """
:root { color-scheme: light; --line: #e0e4e7; --text: #1c2529; --dim: #5b6b73; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 74rem; padding: 2rem 1.5rem 4rem; color: var(--text); background: #fff;
  font: 16px/1.55 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.9rem; margin: 0 0 .3rem; } h2 { margin: 2.6rem 0 .8rem; font-size: 1.35rem; }
p { max-width: 52rem; } .dim, small { color: var(--dim); }
.counts { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.4rem 0; }
.counts div { border: 1px solid var(--line); border-radius: .5rem; padding: .6rem 1.1rem; }
.counts b { display: block; font-size: 1.6rem; line-height: 1.2; }
.badge { display: inline-block; border-radius: .7rem; padding: .02rem .55rem; font-size: .78rem; white-space: nowrap; }
.good { background: #e3f2e6; color: #1b5e20; } .bad { background: #fdeaea; color: #a31515; }
.open { background: #eef1f3; color: #455a64; }
figure { margin: 0 0 2.4rem; padding: 1rem 1.2rem; border: 1px solid var(--line); border-radius: .6rem; }
figure img { display: block; width: 100%; height: auto; margin: .6rem auto; }
figure.single img { max-width: 46rem; } figcaption { max-width: 60rem; }
h3 { margin: 0; font-size: 1.05rem; } .badges { margin-top: .5rem; display: flex; flex-wrap: wrap; gap: .35rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: .86rem; }
th, td { text-align: left; vertical-align: top; padding: .4rem .6rem; border-bottom: 1px solid var(--line); }
th { background: #fff; border-bottom: 2px solid #b0bec5; }
td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
code { font: .82rem ui-monospace, "SF Mono", Consolas, monospace; } td:first-child { min-width: 11.5rem; }
nav a { margin-right: 1.1rem; } a { color: #1565c0; }
"""


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


def _page(rows: list[Row], figures: list[str]) -> str:
    found = counts(rows)
    tiles = "".join(
        f'<div><b>{found[name]}</b><span class="badge {_MARK[name]}">{name}</span></div>' for name in _MARK
    )
    left_out = "".join(f"<li>{html.escape(which)}: {html.escape(why)}.</li>" for which, why in NOT_DRAWN)
    columns = ("figure", "source", "thesis", "computed", "unit", "error", "verdict", "note")
    heads = "".join(f"<th>{name}</th>" for name in columns)
    return f"""<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>The thesis, recomputed</title><style>{_STYLE}</style></head>
<body>
<h1>The thesis, recomputed</h1>
<p class="dim">Every figure that the thesis prints or states, beside what this program computes from the thesis's
own parameters. Nothing here was measured: the rig is the simulated one.</p>
<div class="counts">{tiles}<div><b>{found["rows"]}</b>figures in all</div></div>
<p><b>Reproduced</b>: the two agree within the row's tolerance, which follows from the digits that are printed or
from how the figure was read. <b>Differs</b>: they do not; the note says why and which one is right.
<b>Not reproducible</b>: the thesis shows it in a plot that the scan lacks, or it was measured and its data are not
printed; a computed value stands for itself.</p>
<nav><a href="#plots">Plots</a><a href="#figures">All figures</a><a href="#left-out">Not drawn</a></nav>
<h2 id="plots">Plots</h2>
{"".join(figures)}
<h2 id="figures">All figures</h2>
<div class="scroll"><table>
<thead><tr>{heads}</tr></thead>
<tbody>
{"".join(_row(row) for row in rows)}
</tbody></table></div>
<h2 id="left-out">Not drawn</h2>
<ul>{left_out}</ul>
</body></html>
"""


def _figure(drawing: Drawing, picture: str, verdicts: dict[str, Row]) -> str:
    badges = "".join(
        f'<span class="badge {_MARK[verdicts[name].verdict]}" title="{html.escape(verdicts[name].note)}">'
        f"{html.escape(name)}: {verdicts[name].verdict}</span>"
        for name in drawing.rows
    )
    if not badges:
        badges = '<span class="badge open">drawn from the model; the scan has no numbers to compare</span>'
    kind = "single" if drawing.panels == 1 else "wide"
    title = html.escape(drawing.title)
    return f"""<figure class="{kind}" id="{drawing.name}"><h3>{title}</h3>
<small>thesis {html.escape(drawing.source)}</small>
<img src="{picture}" alt="{title}" loading="lazy">
<figcaption>{html.escape(drawing.caption)}<div class="badges">{badges}</div></figcaption></figure>
"""


def _row(row: Row) -> str:
    name = row.id.replace(".", ".<wbr>").replace("_", "_<wbr>")
    return (
        f'<tr id="{row.id}"><td><code>{name}</code></td><td>{html.escape(row.source)}</td>'
        f'<td class="n">{number(row.thesis)}</td><td class="n">{number(row.computed)}</td>'
        f'<td>{html.escape(row.unit)}</td><td class="n">{percent(row)}</td>'
        f'<td><span class="badge {_MARK[row.verdict]}">{row.verdict}</span></td>'
        f"<td>{html.escape(row.note)}</td></tr>\n"
    )
