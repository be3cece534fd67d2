"""The page on the electrical analogy says what the program says, and its deck runs."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest
from ngspice import run_deck

from twin.plant.analogue import Circuit, circuit_of
from twin.plant.files import load_plant, parse_toml

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "analogy.md").read_text(encoding="utf-8")
STEPS = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", PAGE, re.DOTALL)


def test_every_step_of_the_example_prints_what_the_page_shows():
    assert len(STEPS) == PAGE.count("```python") == 4
    names: dict[str, object] = {}
    for code, shown in STEPS:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(code, names)  # noqa: S102
        assert printed.getvalue() == shown


def test_the_deck_on_the_page_is_quietest_where_the_page_says(requires_debian, tmp_path):
    deck = next(shown for _, shown in STEPS if ".end" in shown)
    found = run_deck(requires_debian("ngspice"), deck, tmp_path)
    quiet = found["frequency"].real[np.abs(found["i(vi_primary)"]).argmin()]
    assert quiet == pytest.approx(53.0, abs=0.05)


def test_the_circuit_file_on_the_page_is_the_example():
    text = re.search(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert text is not None
    circuit = parse_toml(text[1], Circuit, "page")
    expected = circuit_of(load_plant("analogue_2dof"))
    assert circuit.source == expected.source
    for ours, theirs in zip(circuit.loop, expected.loop, strict=True):
        assert ours.elastance_1_f == pytest.approx(theirs.elastance_1_f, rel=1e-4)
        assert ours.model_copy(update={"elastance_1_f": theirs.elastance_1_f}) == theirs
    assert circuit.feedback[0].gamma_1_f == pytest.approx(4.0 * (2 * np.pi * 53.0) ** 2 - 394788.8, rel=1e-6)
