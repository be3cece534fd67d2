"""What is guessed about somebody's file is used only after a person has said that it is right."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from twin.plant.errors import InputError
from twin.station.cli import app

N = 400


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Tip and voltage of the beam under names that the plant does not know, with their units beside them."""
    path = tmp_path / "hand.npz"
    t = np.arange(N) / 100.0
    np.savez(path, t=t, laser=3.0 * np.cos(51.7 * t), amplifier=np.zeros(N))
    path.with_suffix(".json").write_text(json.dumps({"channels": {"laser": "mm", "amplifier": "V"}}))
    return path


def replay(path: Path, *options: str, answer: str | None = None) -> Result:
    return CliRunner().invoke(
        app, ["replay", str(path), "--plant", "beam", "--json", "-", *options], input=answer
    )


@pytest.fixture
def somebody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin.station.confirm.somebody_is_there", lambda: True)


def test_where_nobody_can_be_asked_a_guess_is_refused_with_what_to_write(recorded: Path) -> None:
    done = replay(recorded)
    assert isinstance(done.exception, InputError)
    said = str(done.exception)
    assert "tip_displacement <- laser [mm -> m, x 0.001]: guessed: the only array left in mm" in said
    assert "--yes" in said
    assert "--channel tip_displacement=laser:mm --channel piezo=amplifier:V" in said
    text = said[said.index("write hand.toml:") :].splitlines()[1:]
    recorded.with_suffix(".toml").write_text("\n".join(line.strip() for line in text))
    assert replay(recorded).exit_code == 0  # the very text that was proposed
    assert not recorded.with_suffix(".toml").read_text().startswith(" ")


def test_what_a_person_says_beforehand_is_taken_and_written_down(recorded: Path) -> None:
    done = replay(recorded, "--yes", "--write-sidecar")
    assert done.exit_code == 0, done.output
    assert recorded.with_suffix(".toml").is_file()
    again = replay(recorded)
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)["sensors"] == json.loads(done.stdout)["sensors"]
    assert any("from hand.toml" in remark for remark in json.loads(again.stdout)["remarks"])
    assert "is there already" in str(replay(recorded, "--write-sidecar").exception)


@pytest.mark.usefixtures("somebody")
@pytest.mark.parametrize(("answer", "taken"), [("y\n", True), ("n\n", False), ("\n", False)])
def test_a_person_at_a_terminal_is_shown_everything_and_asked(
    recorded: Path, answer: str, taken: bool
) -> None:
    done = replay(recorded, answer=answer)
    assert "? tip_displacement <- laser" in done.stderr
    assert "sample rate 100 Hz from time array 't'" in done.stderr
    assert (done.exit_code == 0) is taken
    if not taken:
        assert "not confirmed; say what is right, such as --channel" in str(done.exception)
    assert not recorded.with_suffix(".toml").exists()  # nothing is written that was not asked for


def test_what_the_person_gave_needs_no_confirmation(recorded: Path) -> None:
    done = replay(recorded, "--channel", "tip_displacement=laser:mm", "--channel", "piezo=amplifier:V")
    assert done.exit_code == 0, done.output


@pytest.mark.usefixtures("somebody")
def test_a_fit_asks_too_and_says_what_it_guessed(tmp_path: Path) -> None:
    path = tmp_path / "steps.npz"
    t = np.arange(4000) / 1000.0
    edge = (t > 0.5).astype(float)
    ring = edge * (1.0 - np.exp(-5.0 * (t - 0.5)) * np.cos(80.0 * (t - 0.5)))
    np.savez(path, time=t, one=edge, other=ring, third=0.01 * ring)
    said_no = CliRunner().invoke(app, ["fit", "step", str(path), "--json", "-"], input="n\n")
    assert "not confirmed" in str(said_no.exception)
    done = CliRunner().invoke(app, ["fit", "step", str(path), "--yes", "--json", "-"])
    assert done.exit_code == 0, done.output
    guesses = json.loads(done.stdout)["guesses"]
    assert guesses == ["input <- one: a step or square wave", "output <- other: it jumps most"]
    stated = CliRunner().invoke(
        app, ["fit", "step", str(path), "--channel", "input=one", "--channel", "output=other", "--json", "-"]
    )
    assert json.loads(stated.stdout)["guesses"] == []
