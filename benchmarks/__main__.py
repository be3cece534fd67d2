"""``python -m benchmarks [CASE ...] [--json FILE|-]``."""

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
    parser.add_argument("case", nargs="*", choices=[*CASES, []], metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON; - for stdout")
    options = parser.parse_args()
    console = Console(file=sys.stderr if options.json == "-" else sys.stdout, width=130)
    figures: dict[str, object] = {}
    table = Table("figure", "value", "spread", "target", "", title="Speed", title_justify="left")
    for name in options.case or CASES:
        report = run_case(name)
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
