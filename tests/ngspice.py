"""Run a SPICE deck with the real ngspice and read what it found, to the last bit."""

import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def run_deck(ngspice: Path, deck: str, folder: Path) -> dict[str, NDArray[np.complex128]]:
    """Run in batch mode; the vectors by name, ``frequency`` or ``time`` among them."""
    (folder / "deck.cir").write_text(deck, encoding="utf-8")
    done = subprocess.run(
        [ngspice, "-b", "-n", "-r", "out.raw", "deck.cir"],
        cwd=folder, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "rror" not in said, said
    assert "arning" not in said, said
    return read_raw((folder / "out.raw").read_bytes())


def read_raw(data: bytes) -> dict[str, NDArray[np.complex128]]:
    """Parse a binary raw file that holds one plot."""
    head, body = data.split(b"Binary:\n", 1)
    text = head.decode()
    facts = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    n_variables, n_points = int(facts["No. Variables"]), int(facts["No. Points"])
    names = [line.split()[1] for line in text.split("Variables:\n", 1)[1].splitlines()[:n_variables]]
    kind = np.complex128 if "complex" in facts["Flags"] else np.float64
    values = np.frombuffer(body, dtype=kind, count=n_variables * n_points).reshape(n_points, n_variables)
    return {name: values[:, column].astype(np.complex128) for column, name in enumerate(names)}
