"""Gain schedules: what lies between the points, what is refused, and orders to the rig."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from twin.control.schedule import Acknowledgement, Command, Gains, GainSchedule


def table(**changes: object) -> GainSchedule:
    entries: dict[str, object] = {
        "frequency_hz": (45.0, 50.0, 55.0),
        "alpha_kg": (0.0, 0.1, 0.2),
        "beta_ns_m": (-14.0, -13.0, -7.0),
        "gamma_n_m": (-7000.0, 0.0, 8000.0),
        "low_pass_hz": (810.0, 1000.0, 1210.0),
        "high_pass_hz": (2.5, 2.5, 2.5),
        "on_from_hz": 45.0,
        "on_to_hz": 55.0,
    }
    return GainSchedule.model_validate(entries | changes)


def test_gains_between_points_lie_on_the_line() -> None:
    assert table().at(47.5).as_tuple() == pytest.approx((0.05, -13.5, -3500.0, 905.0, 2.5))
    assert table().at(50.0) == Gains(0.1, -13.0, 0.0, 1000.0, 2.5)


def test_gains_beyond_the_table_are_those_of_its_ends() -> None:
    assert table().at(10.0) == table().at(45.0)
    assert table().at(90.0) == table().at(55.0)


@given(hz=st.floats(1.0, 200.0))
def test_gains_never_leave_the_span_of_the_table(hz: float) -> None:
    gains = table().at(hz)
    for value, column in zip(
        gains.as_tuple(), ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz"), strict=True
    ):
        points = getattr(table(), column)
        assert min(points) <= value <= max(points)


def test_controller_acts_within_its_band_ends_included() -> None:
    assert [table().acts_at(f) for f in (44.999, 45.0, 50.0, 55.0, 55.001)] == [
        False,
        True,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"beta_ns_m": (-14.0, -13.0)}, "beta_ns_m has 2 points, frequency_hz has 3"),
        ({"frequency_hz": (45.0, 45.0, 55.0)}, "must rise"),
        ({"frequency_hz": (55.0, 50.0, 45.0)}, "must rise"),
        ({"on_from_hz": 56.0}, "on_from_hz must not be above on_to_hz"),
        ({"on_from_hz": 44.0}, "act from 44 to 55 Hz but the table has gains from 45 to 55 Hz"),
        ({"on_to_hz": 56.0}, "act from 45 to 56 Hz but the table has gains from 45 to 55 Hz"),
        ({"low_pass_hz": (810.0, 0.0, 1210.0)}, "greater than 0"),
        ({"high_pass_hz": (2.5, -2.5, 2.5)}, "greater than 0"),
        ({"gamma_n_m": (0.0, float("nan"), 0.0)}, "finite"),
        ({"alpha_kg": (0.0, float("inf"), 0.0)}, "finite"),
        ({"frequency_hz": ()}, "at least 1"),
        ({"gain": (1.0,)}, "Extra inputs"),
    ],
)
def test_table_that_could_not_be_run_is_refused_with_the_reason(
    changes: dict[str, object], words: str
) -> None:
    with pytest.raises(ValidationError, match=words):
        table(**changes)


def test_new_points_replace_their_rows_and_leave_the_others() -> None:
    old = table()
    new = old.with_points({1: Gains(0.5, -20.0, 100.0, 900.0, 3.0)})
    assert new.at(50.0) == Gains(0.5, -20.0, 100.0, 900.0, 3.0)
    for hz in (45.0, 55.0):
        assert new.at(hz) == old.at(hz)
    assert (new.on_from_hz, new.on_to_hz) == (old.on_from_hz, old.on_to_hz)
    assert old.at(50.0) == table().at(50.0)
    assert old.with_points({}) == old


def test_schedule_cannot_be_changed_in_place() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        table().on_to_hz = 60.0  # type: ignore[misc]


def test_command_survives_the_wire() -> None:
    command = Command(command_id=3, apply_at_sample=10_000, schedule=table(), control_enabled=True)
    assert Command.model_validate_json(command.model_dump_json()) == command


@pytest.mark.parametrize("bad", [{"command_id": 0}, {"apply_at_sample": -1}, {"surprise": 1}])
def test_command_out_of_range_is_refused(bad: dict[str, int]) -> None:
    with pytest.raises(ValidationError):
        Command.model_validate({"command_id": 1, "apply_at_sample": 0} | bad)


def test_acknowledgement_of_a_refusal_names_no_sample() -> None:
    answer = Acknowledgement(command_id=1, accepted=False, reason="malformed")
    assert answer.applied_at_sample is None
