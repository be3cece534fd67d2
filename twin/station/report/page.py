"""Web pages that stand alone: nothing is loaded from afar, they print, and every text from a file is escaped."""

import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from twin.plant.errors import InputError

STYLE = """
:root { color-scheme: light; --line: #d5dbdf; --text: #1c2529; --dim: #52626a; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 74rem; padding: 2rem 1.5rem 4rem; color: var(--text); background: #fff;
  font: 16px/1.55 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.9rem; margin: 0 0 .3rem; overflow-wrap: anywhere; } h2 { margin: 2.6rem 0 .8rem; font-size: 1.35rem; }
h3 { margin: 0; font-size: 1.05rem; } h3.sub { margin: 1.6rem 0 .5rem; }
p { max-width: 52rem; } .dim, small { color: var(--dim); }
:focus-visible { outline: 3px solid #1565c0; outline-offset: 2px; }
.counts { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.4rem 0; }
.counts div { border: 1px solid var(--line); border-radius: .5rem; padding: .6rem 1.1rem; }
.counts b { display: block; font-size: 1.6rem; line-height: 1.2; font-variant-numeric: tabular-nums; }
.badge { display: inline-block; border-radius: .7rem; padding: .02rem .55rem; font-size: .78rem; white-space: nowrap; }
.good { background: #e3f2e6; color: #1b5e20; } .bad { background: #fdeaea; color: #a31515; }
.open { background: #eef1f3; color: #3d4f58; } .warn { background: #fff3d6; color: #6b4500; }
.notice { border-left: 5px solid #a31515; background: #fdeaea; padding: .6rem 1rem; margin: 1rem 0; max-width: none; }
.notice.warn { border-color: #b26a00; background: #fff3d6; color: inherit; }
figure { margin: 0 0 2.4rem; padding: 1rem 1.2rem; border: 1px solid var(--line); border-radius: .6rem; }
figure img, figure svg { display: block; width: 100%; height: auto; margin: .6rem auto; }
figure.single img { max-width: 46rem; } figcaption { max-width: 60rem; }
.badges { margin-top: .5rem; display: flex; flex-wrap: wrap; gap: .35rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: .86rem; }
th, td { text-align: left; vertical-align: top; padding: .4rem .6rem; border-bottom: 1px solid var(--line); }
th { background: #fff; border-bottom: 2px solid #b0bec5; } th.n { text-align: right; }
td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
code { font: .82rem ui-monospace, "SF Mono", Consolas, monospace; overflow-wrap: anywhere; }
dl.facts { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.4rem; margin: 0; }
dl.facts dt { color: var(--dim); } dl.facts dd { margin: 0; overflow-wrap: anywhere; }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; } a { color: #1565c0; }
details > summary { cursor: pointer; padding: .3rem 0; }
.plot { position: relative; } .plot output { position: absolute; pointer-events: none; background: #ffffffee;
  border: 1px solid #78909c; border-radius: .3rem; padding: .25rem .5rem; font-size: .78rem; line-height: 1.35;
  white-space: pre; font-variant-numeric: tabular-nums; }
.plot output:empty { display: none; }
@media (max-width: 40rem) { dl.facts { grid-template-columns: 1fr; } dl.facts dd { margin-bottom: .4rem; } }
@page { size: A4; margin: 14mm 12mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 9.5pt; line-height: 1.4; print-color-adjust: exact;
    -webkit-print-color-adjust: exact; }
  h1 { font-size: 17pt; } h2 { font-size: 12.5pt; margin: 1.3rem 0 .5rem; break-after: avoid; }
  h3 { break-after: avoid; } nav, .plot output, .screen { display: none; }
  figure { break-inside: avoid; border: 0; padding: 0; margin: 0 0 1rem; } figure svg { max-height: 11cm; }
  table { font-size: 8pt; } tr, dl.facts > * , .notice { break-inside: avoid; } thead { display: table-header-group; }
  th, td { padding: .22rem .4rem; } .scroll { overflow: visible; } .counts div { padding: .3rem .7rem; }
  .counts b { font-size: 13pt; } code { font-size: 7.5pt; } a { color: inherit; text-decoration: none; }
}
"""

_NOTHING_FROM_AFAR = (
    "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; img-src data:\">"
)


class Html(str):
    """Text that is HTML already; everything else is escaped on its way into a page."""

    __slots__ = ()


def text(value: object) -> Html:
    """A value as HTML: escaped unless it is `Html`; a dash for None."""
    if isinstance(value, Html):
        return value
    return Html("–" if value is None else html.escape(str(value)))


def join(parts: Iterable[object]) -> Html:
    """Parts behind each other, each escaped unless it is `Html`."""
    return Html("".join(text(p) for p in parts))


def element(name: str, *content: object, **attributes: str) -> Html:
    """An element with its content escaped unless it is `Html`; ``class_`` is ``class``, ``aria_label`` aria-label."""
    names = ((k.rstrip("_").replace("_", "-"), v) for k, v in attributes.items())
    with_values = "".join(f' {k}="{html.escape(v)}"' for k, v in names)
    return Html(f"<{name}{with_values}>{join(content)}</{name}>")


def badge(word: str, kind: str) -> Html:
    """A word on a coloured ground: ``good``, ``bad``, ``warn`` or ``open``."""
    return element("span", word, class_=f"badge {kind}")


def tiles(figures: Iterable[tuple[object, object]]) -> Html:
    """Large figures (value, what it is) side by side."""
    boxes = join(element("div", element("b", value), what) for value, what in figures)
    return element("div", boxes, class_="counts")


def facts(pairs: Iterable[tuple[str, object]]) -> Html:
    """Names and values below each other."""
    rows = join(join((element("dt", name), element("dd", value))) for name, value in pairs)
    return element("dl", rows, class_="facts")


def table(
    heads: Sequence[str],
    rows: Iterable[Sequence[object]],
    numbers: Iterable[int] = (),
    identifiers: Sequence[str] = (),
) -> Html:
    """A table that scrolls by itself where it is too wide.

    Parameters
    ----------
    numbers
        Columns set to the right.
    identifiers
        Of the rows, to be jumped to.
    """
    right = set(numbers)

    def cells(name: str, row: Sequence[object]) -> Html:
        scope = {"scope": "col"} if name == "th" else {}
        return join(
            element(name, cell, **({"class_": "n"} if k in right else {}), **scope)
            for k, cell in enumerate(row)
        )

    def line(k: int, row: Sequence[object]) -> Html:
        return element("tr", cells("td", row), **({"id": identifiers[k]} if identifiers else {}))

    body = join(join((line(k, row), Html("\n"))) for k, row in enumerate(rows))
    head = element("thead", element("tr", cells("th", heads)))
    return element("div", element("table", head, element("tbody", body)), class_="scroll", tabindex="0")


def section(title: str, identifier: str, *content: object) -> Html:
    """A section with a heading that can be jumped to."""
    return join((element("h2", title, id=identifier), *content, Html("\n")))


def page(title: str, body: Html, script: str = "", *, self_contained: bool = True) -> str:
    """A whole page.

    Parameters
    ----------
    script
        JavaScript for the end of the page.
    self_contained
        Forbid the browser to load anything at all, files beside the page included.
    """
    policy = _NOTHING_FROM_AFAR if self_contained else ""
    tail = f"<script>{script}</script>\n" if script else ""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head><meta charset="utf-8">{policy}'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">\n'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head>\n<body>\n{body}\n{tail}</body></html>\n"
    )


def write_page(path: Path, content: str, option: str = "--html") -> None:
    """Write a page.

    Raises
    ------
    InputError
        If it cannot be written there.
    """
    try:
        path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"{option} {path}: cannot be written ({error.strerror or error}); give a file in a folder that exists"
        ) from error
