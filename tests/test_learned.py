"""What was learned goes to disk and comes back, for the same model only."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimators.damping import DampingLearner, ForceBalance, LearnerSettings
from estimators.learned import learned_fingerprint, load_learned, save_learned
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.programme import rig_channels
from twin.station.session import Session, SessionSettings, settings_from


@pytest.fixture(scope="module")
def rig() -> Plant:
    return load_plant("rig")


def reading(hz: float, damping: float) -> ForceBalance:
    return ForceBalance(hz, damping, 0.05, 40700.0, 10.0, 0.0, np.array([1e3, 2e3, -3e3]), np.ones(3))


def taught(plant: Plant, basis: str = "piecewise_linear") -> DampingLearner:
    learner = DampingLearner(plant, LearnerSettings(basis=basis, rate_limit_ns_m_s=3.0))  # type: ignore[arg-type]
    for hz in np.linspace(45.0, 55.0, 40):
        learner.advance(reading(float(hz), 13.0), 0.1)
    return learner


@pytest.mark.parametrize("basis", ["piecewise_linear", "quadratic"])
def test_learner_read_back_goes_on_as_the_one_that_was_saved(rig: Plant, tmp_path: Path, basis: str) -> None:
    learner = taught(rig, basis)
    save_learned(tmp_path / "c2.json", learner, rig)
    again = load_learned(tmp_path / "c2.json", rig)
    assert again.settings == learner.settings
    assert again.curve().status == "learning"
    assert "read from a file" in again.curve().reason
    for _ in range(3):
        one, two = (each.advance(reading(50.0, 12.0), 0.1) for each in (learner, again))
        for name in ("damping_ns_m", "std_ns_m", "in_use_ns_m", "stiffness_curve_n_m", "coverage"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        assert (one.status, one.stiffness_n_m) == (two.status, two.stiffness_n_m)


def test_damping_and_limits_of_the_model_do_not_matter_and_everything_else_does(
    rig: Plant, tmp_path: Path
) -> None:
    path = tmp_path / "c2.json"
    save_learned(path, taught(rig), rig)
    load_learned(path, rig.with_damping("absorber", 20.5))
    load_learned(path, rig.model_copy(update={"limits": {}}))
    heavier = rig.body[1].model_copy(update={"mass_kg": 0.5})
    other = rig.model_copy(update={"body": (rig.body[0], heavier)})
    with pytest.raises(InputError) as refused:
        load_learned(path, other)
    text = str(refused.value)
    assert learned_fingerprint(rig) in text
    assert learned_fingerprint(other) in text
    assert "learn anew" in text
    assert str(path) in text


def damaged(content: dict[str, Any], how: str) -> str:
    if how == "no JSON":
        return "{"
    if how == "format":
        content["format"] = "something else"
    elif how == "missing":
        del content["stiffness"]
    elif how == "size":
        content["damping"]["mean"] = [1.0]
    elif how == "negative variance":
        content["damping"]["covariance"][0][0] = -1.0
    elif how == "in use":
        content["in_use_ns_m"][3] = -2.0
    elif how == "settings":
        content["settings"]["basis"] = "cubic"
    elif how == "infinite":
        content["damping"]["mean"][0] = 1e999
    return json.dumps(content)


@pytest.mark.parametrize(
    "how",
    ["no JSON", "format", "missing", "size", "negative variance", "in use", "settings", "infinite"],
)
def test_damaged_file_is_refused_by_name(rig: Plant, tmp_path: Path, how: str) -> None:
    path = tmp_path / "c2.json"
    save_learned(path, taught(rig), rig)
    path.write_text(damaged(json.loads(path.read_text(encoding="utf-8")), how), encoding="utf-8")
    with pytest.raises(InputError, match=r"c2\.json"):
        load_learned(path, rig)


def test_file_that_is_not_there_or_cannot_be_written_says_so(rig: Plant, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_learned(tmp_path / "none.json", rig)
    with pytest.raises(InputError, match="cannot be written"):
        save_learned(tmp_path / "no" / "folder" / "c2.json", taught(rig), rig)


def test_session_goes_on_from_what_was_learned_and_a_replay_of_it_does_too(rig: Plant) -> None:
    learner = taught(rig)
    fresh = Session(rig, rig_channels(rig), 50_000.0, SessionSettings())
    assert fresh.learner is not None
    knows = Session(rig, rig_channels(rig), 50_000.0, SessionSettings(learned=learner.state()))
    again = Session(
        rig, rig_channels(rig), 50_000.0, settings_from(json.loads(json.dumps(knows.configuration())))
    )
    for session in (knows, again):
        assert session.learner is not None
        np.testing.assert_array_equal(session.learner.curve().damping_ns_m, learner.curve().damping_ns_m)
    assert not np.array_equal(fresh.learner.curve().damping_ns_m, learner.curve().damping_ns_m)
    with pytest.raises(InputError, match="learned before cannot be used"):
        Session(rig, rig_channels(rig), 50_000.0, SessionSettings(learned={"settings": {}}))
