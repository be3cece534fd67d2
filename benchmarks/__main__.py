"""``python -m benchmarks [CASE ...] [--json FILE|-]``, or ``python -m benchmarks soak`` for the long live run."""

import argparse
import json
import os
import sys
from pathlib import Path

# Before anything imports NumPy: its library reads these once.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from benchmarks.cases import CASES, run_case  # noqa: E402


def main() -> None:
    """Run the cases that were asked for; the table goes to stdout, or to stderr where the JSON does."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Speed, side by side.")
    parser.add_argument(
        "case",
        nargs="*",
        choices=[*CASES, "soak", []],
        metavar="CASE",
        help=", ".join(CASES) + "; or soak, alone",
    )
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON; - for stdout")
    options, others = parser.parse_known_args()
    if options.case == ["soak"]:
        # Not among the cases: it takes as long as it is told, and starts programs of its own.
        from benchmarks.soak import run_soak, setting_from

        reports = [run_soak(setting_from(others))]
    else:
        if others or "soak" in options.case:
            parser.error(f"cannot be combined: {' '.join([*options.case, *others])}")
        reports = [run_case(name) for name in options.case or CASES]
    console = Console(file=sys.stderr if options.json == "-" else sys.stdout, width=130)
    figures: dict[str, object] = {}
    table = Table("figure", "value", "spread", "target", "", title="Speed", title_justify="left")
    for report in reports:
        figures |= report.figures
        for row in report.rows:
            table.add_row(*row.cells())
    console.print(table)
    if options.json == "-":
        sys.stdout.write(json.dumps(figures, indent=2) + "\n")
    elif options.json:
        Path(options.json).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
