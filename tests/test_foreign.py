"""Foreign NumPy recordings: what is found in them, in which unit, at which rate, and what is refused."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.files import load_plant, parse_toml
from twin.rig.arrayref import ArrayRef, parse_array_ref
from twin.rig.foreign import ForeignRecording, open_foreign
from twin.rig.units import is_common, sensitivity_to_si, to_si, units_for

RATE_HZ = 100.0


def plant(sensor: str = "tip", actuator: str = "piezo", *, recorded_as: str = "", extra: str = "") -> Plant:
    text = f"""
name = "beam"
[[body]]
name = "body"
mass_kg = 0.05
attached_to = "ground"
stiffness_n_m = 100.0
damping_ns_m = 0.02
[[actuator]]
name = "{actuator}"
kind = "force"
on = "body"
force_constant_n_v = 1e-4
[[sensor]]
name = "{sensor}"
kind = "displacement"
of = "body"
noise_density = 1e-5
range = 0.015
{f'recorded_as = "{recorded_as}"' if recorded_as else ""}
{extra}
"""
    return parse_toml(text, Plant, "test plant")


Save = Callable[..., Path]


@pytest.fixture
def save(tmp_path: Path) -> Save:
    def write(name: str = "run.npz", **arrays: object) -> Path:
        path = tmp_path / name
        np.savez(path, **arrays)  # type: ignore[arg-type]
        return path

    return write


def t(n: int = 50, rate_hz: float = RATE_HZ) -> np.ndarray:
    return np.arange(n) / rate_hz


def said(error: pytest.ExceptionInfo[InputError]) -> str:
    return str(error.value)


# --- finding channels -----------------------------------------------------------------------------------


def test_option_comes_before_every_other_way(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), tip=np.ones(50), y=np.full(50, 3.0), z=np.full(50, 5.0), piezo=np.zeros(50))
    (tmp_path / "run.toml").write_text('[channels]\ntip = "z:mm"\n')
    recording = open_foreign(path, plant(), channels={"tip": "y:mm"})
    assert recording.values[0, 0] == pytest.approx(3e-3)
    assert [m.decided for m in recording.mapping] == ["as given", "equal names; no unit stated, taken as SI"]


def test_sidecar_comes_before_recorded_as_and_that_before_equal_names(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), tip=np.ones(50), y=np.full(50, 3.0), z=np.full(50, 5.0), piezo=np.zeros(50))
    of_plant = plant(recorded_as="y:mm")
    assert open_foreign(path, of_plant).values[0, 0] == pytest.approx(3e-3)
    (tmp_path / "run.toml").write_text('[channels]\ntip = { array = "z", unit = "mm" }\n')
    assert open_foreign(path, of_plant).values[0, 0] == pytest.approx(5e-3)
    assert open_foreign(path, of_plant).mapping[0].decided == "from run.toml"


def test_recorded_as_gives_way_to_equal_names_where_its_array_is_missing(save: Save) -> None:
    recording = open_foreign(save(t=t(), tip=np.ones(50), piezo=np.zeros(50)), plant(recorded_as="y:mm"))
    assert recording.mapping[0].array == "tip"


def test_unit_beside_the_recording_outranks_the_plants_own(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), y=np.ones(50), piezo=np.zeros(50))
    (tmp_path / "run.json").write_text(json.dumps({"channels": {"y": "um laser"}}))
    mapping = open_foreign(path, plant(recorded_as="y:mm")).mapping[0]
    assert (mapping.unit, mapping.factor) == ("um", 1e-6)
    assert mapping.decided == "the plant's recorded_as; unit from run.json"


def test_option_that_contradicts_the_sidecar_wins_and_says_so(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), y=np.ones(50), piezo=np.zeros(50))
    (tmp_path / "run.json").write_text(json.dumps({"channels": {"y": "um laser"}}))
    assert (
        open_foreign(path, plant(), channels={"tip": "y:mm"}).mapping[0].decided
        == "as given; run.json says um"
    )
    assert open_foreign(path, plant(), channels={"tip": "y"}).mapping[0].factor == 1e-6


def test_single_channel_left_over_is_guessed_by_its_unit_and_called_a_guess(
    save: Save, tmp_path: Path
) -> None:
    path = save(t=t(), laser=np.ones(50), noise=np.ones(50), force=np.ones(50), piezo=np.zeros(50))
    (tmp_path / "run.json").write_text(
        json.dumps({"channels": {"laser": "mm tip", "noise": "unknown", "force": "N"}})
    )
    mapping = open_foreign(path, plant()).mapping[0]
    assert str(mapping) == (
        "tip <- laser [mm -> m, x 0.001]: guessed: the only array left in mm; unit from run.json"
    )


def test_two_candidates_are_named_and_none_is_taken(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), tip=np.ones(50), u=np.ones(50), v=np.zeros(50))
    (tmp_path / "run.json").write_text(json.dumps({"channels": {"u": "V", "v": "mV, amplifier"}}))
    with pytest.raises(InputError) as error:
        open_foreign(path, plant())
    assert said(error) == (
        f"{path}: no array for channel 'piezo' [V] (could be u or v); give --channel piezo=ARRAY:UNIT, "
        f"or --channel piezo=none if it was not recorded\n{path}: arrays in the file: t, tip, u, v"
    )


def test_two_channels_of_unlike_dimension_are_guessed_each_by_its_own(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), y=np.ones(50), u=np.ones(50))
    (tmp_path / "run.json").write_text(json.dumps({"channels": {"u": "V", "y": "mm"}}))
    recording = open_foreign(path, plant())
    assert [(m.channel, m.array) for m in recording.mapping] == [("tip", "y"), ("piezo", "u")]
    assert len(recording.guesses) == 2
    assert recording.guesses[0].startswith("tip <- y [mm -> m, x 0.001]: guessed")


SECOND = '[[sensor]]\nname = "root"\nkind = "displacement"\nof = "body"\nnoise_density = 1e-5\n'


def test_arrays_of_like_dimension_are_told_apart_by_words_of_the_names_or_not_at_all(
    save: Save, tmp_path: Path
) -> None:
    beside = tmp_path / "run.json"
    path = save(t=t(), laser_root=np.ones(50), TipLaser=np.ones(50), piezo=np.ones(50))
    beside.write_text(json.dumps({"channels": {"laser_root": "mm", "TipLaser": "um", "piezo": "V"}}))
    recording = open_foreign(path, plant(extra=SECOND))
    assert {m.channel: m.array for m in recording.mapping} == {
        "tip": "TipLaser", "root": "laser_root", "piezo": "piezo",
    }  # fmt: skip
    assert all("is called" in guess for guess in recording.guesses)
    path = save(t=t(), one=np.ones(50), other=np.ones(50), piezo=np.ones(50))
    beside.write_text(json.dumps({"channels": {"one": "mm", "other": "mm", "piezo": "V"}}))
    with pytest.raises(InputError, match=r"'tip' \[m\] \(could be one or other\)[^$]*'root' \[m\]"):
        open_foreign(path, plant(extra=SECOND))


def test_a_unit_that_nobody_stated_is_a_guess_unless_a_person_named_the_array(save: Save) -> None:
    path = save(t=t(), tip=np.ones(50), y=np.ones(50), piezo=np.zeros(50))
    assert [m.guess != "" for m in open_foreign(path, plant()).mapping] == [True, True]
    given = open_foreign(path, plant(), channels={"tip": "y", "piezo": "piezo:V"})
    assert given.guesses == ()


def test_sidecar_written_of_a_recording_leaves_nothing_to_guess(save: Save, tmp_path: Path) -> None:
    keep = np.r_[0:20, 25:50]
    path = save(t=t()[keep], laser=np.arange(45.0), piezo=np.zeros(45))
    (tmp_path / "run.json").write_text(json.dumps({"channels": {"laser": "mm tip"}}))
    first = open_foreign(path, plant())
    assert len(first.guesses) == 2
    (tmp_path / "run.toml").write_text(first.sidecar)
    again = open_foreign(path, plant())
    assert again.guesses == ()
    assert again.n_samples == first.n_samples == 50
    np.testing.assert_array_equal(again.values, first.values)
    assert again.sample_rate_hz == first.sample_rate_hz


@pytest.mark.parametrize(
    ("place", "factor"),
    [
        ('{ array = "y", unit = "g", scale = 50.0 }', None), ('{ array = "y", unit = "mm", scale = 50 }', 0.05),
        ('{ array = "y", scale = 2.5 }', 2.5), ('{ array = "y", unit = "mV", sensitivity = "10 mV/mm" }', 1e-4),
        ('{ array = "y", unit = "V", scale = 2.0, sensitivity = "10 mV/mm" }', 0.2), ('"y:mV@10 mV/mm"', 1e-4),
        ('"y:50 mm"', 0.05), ('{ array = "y", unit = "mV", sensitivity = "10 pC/mm" }', None),
        ('{ array = "y", scale = 0.0 }', None), ('{ array = "y", sensitivity = "10 mV/mm" }', None),
    ],
)  # fmt: skip
def test_sidecar_says_what_a_sample_of_one_stands_for(
    save: Save, tmp_path: Path, place: str, factor: float | None
) -> None:
    path = save(t=t(), y=np.full(50, 3.0), piezo=t())
    (tmp_path / "run.toml").write_text(f"[channels]\ntip = {place}\n")
    if factor is None:
        with pytest.raises(InputError, match=r"unit '.*'|a scale of 0|sensitivity needs the unit"):
            open_foreign(path, plant())
        return
    recording = open_foreign(path, plant())
    np.testing.assert_allclose(recording.values[:, 0], 3.0 * factor, rtol=1e-12)
    (tmp_path / "run.toml").write_text(recording.sidecar)
    np.testing.assert_array_equal(open_foreign(path, plant()).values, recording.values)


def test_command_that_was_not_recorded_is_left_out_when_a_person_says_so(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), tip=np.ones(50))
    by_option = open_foreign(path, plant(), channels={"piezo": "none"})
    (tmp_path / "run.toml").write_text('[channels]\npiezo = "none"\n')
    by_sidecar = open_foreign(path, plant())
    assert [c.name for c in by_option.channels] == [c.name for c in by_sidecar.channels] == ["tip"]
    assert "piezo: not recorded (as given)" in by_option.notes
    assert "piezo: not recorded (from run.toml)" in by_sidecar.notes


def test_recording_without_any_sensor_is_refused(save: Save) -> None:
    with pytest.raises(InputError, match="no sensor of plant 'beam' is in it"):
        open_foreign(save(t=t(), piezo=np.ones(50)), plant(), channels={"tip": "none"})


def test_channels_keep_the_plants_order_and_units(save: Save) -> None:
    path = save(piezo=np.zeros(5), tip=np.ones(5))
    recording = open_foreign(path, plant(), sample_rate_hz=10.0)
    assert [(c.name, c.unit) for c in recording.channels] == [("tip", "m"), ("piezo", "V")]


def test_misspelt_channel_in_an_option_is_refused_with_the_plants_channels(save: Save) -> None:
    with pytest.raises(InputError, match=r"--channel tpi=y: plant 'beam' has no channel 'tpi'.*tip, piezo"):
        open_foreign(save(t=t(), y=np.ones(50)), plant(), channels={"tpi": "y"})


def test_sidecar_may_name_channels_of_a_larger_plant(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), tip=np.ones(50), piezo=np.zeros(50))
    (tmp_path / "run.toml").write_text('[channels]\nother = "t"\n')
    assert (
        "run.toml names channel 'other', which plant 'beam' has not: not used"
        in open_foreign(path, plant()).notes
    )


def test_array_named_but_not_there_lists_what_is(save: Save) -> None:
    with pytest.raises(
        InputError, match="'tip': no array 'yy' in the file \\(as given\\); arrays: t, y, piezo"
    ):
        open_foreign(save(t=t(), y=t(), piezo=t()), plant(), channels={"tip": "yy:mm"})


def test_plant_beside_a_recording_is_not_taken_for_its_sidecar(save: Save, tmp_path: Path) -> None:
    path = save(t=t(), tip=np.ones(50), piezo=np.zeros(50))
    (tmp_path / "run.toml").write_text('name = "x"\n[[body]]\nname = "b"\n')
    assert (
        "run.toml beside the recording is a plant, not a sidecar: not used"
        in open_foreign(path, plant()).notes
    )


def test_plant_without_channels_has_nothing_to_read(save: Save) -> None:
    bare = Plant.model_validate(plant().model_dump() | {"sensor": (), "actuator": ()})
    with pytest.raises(InputError, match="has no sensors or actuators"):
        open_foreign(save(t=t(), tip=t()), bare)


# --- units ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("mm", "m", 1e-3), ("µm", "m", 1e-6), ("μm", "m", 1e-6), ("um", "m", 1e-6), ("m", "m", 1.0),
        ("mm/s", "m/s", 1e-3), ("g", "m/s²", 9.80665), ("m/s²", "m/s²", 1.0), ("m/s^2", "m/s²", 1.0),
        ("m/s2", "m/s²", 1.0), (" m/s**2 ", "m/s²", 1.0), ("mV", "V", 1e-3), ("V", "V", 1.0), ("mA", "A", 1e-3),
        ("A", "A", 1.0), ("N", "N", 1.0), ("kN", "N", 1e3), ("ms", "s", 1e-3),
    ],
)  # fmt: skip
def test_units_become_si(unit: str, si: str, factor: float) -> None:
    assert to_si(unit) == (si, factor)
    assert units_for(si)[0] == si


@pytest.mark.parametrize(
    ("unit", "expected", "si", "factor"),
    [
        ("g", "kg", "kg", 1e-3), ("mg", "kg", "kg", 1e-6), ("g", "m/s²", "m/s²", 9.80665), ("g_n", "", "m/s²", 9.80665),
        ("in", "m", "m", 0.0254), ("inches/s", "", "m/s", 0.0254), ("mm/s/s", "", "m/s²", 1e-3),
        ("lbf", "", "N", 4.4482216152605), ("rpm", "", "rad/s", np.pi / 30.0), ("rpm", "Hz", "Hz", 1.0 / 60.0),
        ("50 g", "m/s²", "m/s²", 490.3325), ("furlong", "m", "m", 201.168), ("kg", "", "kg", 1.0),
        ("kg*m/s^2", "", "N", 1.0), ("kHz", "Hz", "Hz", 1e3), ("deg", "", "rad", np.pi / 180.0),
    ],
)  # fmt: skip
def test_other_units_and_what_g_is_go_by_the_dimension_expected(
    unit: str, expected: str, si: str, factor: float
) -> None:
    assert to_si(unit, expected) == (si, pytest.approx(factor, rel=1e-5))


@pytest.mark.parametrize(
    "unit",
    [
        "MM",
        "",
        "m/s3",
        "G",
        "tip",
        "dB",
        "degC",
        "m**9**9",
        "9**9**9",
        "a" * 99,
        "0 g",
        "1e999 g",
        "g pk",
        "1",
    ],
)
def test_what_is_no_unit_of_a_channel_is_not_made_into_one(unit: str) -> None:
    known = to_si(unit)
    assert known is None or not units_for(known[0])[1:]


@pytest.mark.parametrize(
    ("unit", "sensitivity", "expected", "factor"),
    [
        ("mV", "100 mV/g", "m/s²", 0.0980665), ("V", "50 mV/(mm/s)", "m/s", 0.02), ("V", "22.5 mV/N", "N", 1e3 / 22.5),
        ("V", "10 pC/g", "m/s²", None), ("V", "100 mV/g", "N", None), ("V", "100", "N", None),
    ],
)  # fmt: skip
def test_volts_become_what_the_sensor_measures_by_its_sensitivity(
    unit: str, sensitivity: str, expected: str, factor: float | None
) -> None:
    found = sensitivity_to_si(unit, sensitivity, expected)
    assert found == (None if factor is None else pytest.approx(factor))


@pytest.mark.parametrize("word", ["in", "a", "d", "u", "t", "min", "bar", "hand", "pin", "point", "x"])
def test_words_of_a_description_are_not_taken_for_units(word: str) -> None:
    assert not is_common(word)
    assert is_common("m/s^2")
    assert is_common("µm")


@pytest.mark.parametrize(
    ("unit", "why"),
    [
        ("smoot2x", "unit 'smoot2x' is not known"),
        ("kg", "unit 'kg' is kg, the channel is m"),
        ("mV", "unit 'mV' is V, the channel is m"),
        ("dB", "unit 'dB' is logarithmic or has an offset: there is no factor to SI"),
        ("degC", "unit 'degC' is logarithmic or has an offset: there is no factor to SI"),
    ],
)
def test_unit_that_does_not_fit_is_refused_with_those_that_do(save: Save, unit: str, why: str) -> None:
    path = save(t=t(), y=t(), piezo=t())
    with pytest.raises(InputError) as error:
        open_foreign(path, plant(), channels={"tip": f"y:{unit}"})
    assert said(error) == (
        f"{path}: channel 'tip' <- y: {why}; give --channel tip=y:UNIT with one of m, nm, um, mm, cm"
    )


# --- series inside larger arrays ------------------------------------------------------------------------


def test_column_of_a_matrix_and_record_of_a_stack_can_be_named(save: Save) -> None:
    rng = np.random.default_rng(1)
    table, stack = rng.normal(size=(50, 3)), rng.normal(size=(10, 3, 50)).astype(np.float32)
    path = save(t=t(), table=table, stack=stack)
    recording = open_foreign(path, plant(), channels={"tip": "table[:,2]:mm", "piezo": "stack[3, -1, :]"})
    np.testing.assert_allclose(recording.values[:, 0], table[:, 2] * 1e-3)
    np.testing.assert_allclose(recording.values[:, 1], stack[3, -1])
    assert [m.array for m in recording.mapping] == ["table[:,2]", "stack[3,-1,:]"]


def test_column_vectors_need_no_index(save: Save) -> None:
    recording = open_foreign(save(t=t()[:, None], tip=np.ones((50, 1)), piezo=np.ones((1, 50))), plant())
    assert recording.values.shape == (50, 2)


@pytest.mark.parametrize(
    ("text", "ref"),
    [
        ("y", ArrayRef("y")),
        ("y:mm", ArrayRef("y", None, "mm")),
        ("y[:,2]:m/s^2", ArrayRef("y", (None, 2), "m/s^2")),
        ("a.b c[3,1,:]", ArrayRef("a.b c", (3, 1, None))),
        (" y [ : ] : g ", ArrayRef("y", (None,), "g")),
    ],
)
def test_short_form_is_read(text: str, ref: ArrayRef) -> None:
    assert parse_array_ref(text, "here") == ref


@pytest.mark.parametrize(
    "text",
    [
        "", ":mm", "[:,0]", "y[0,1]", "y[:,:]", "y[1:2,:]", "y[:,x]", "y[]", "y[:", "y]", "y[:][0]", "y:m:m",
        "y[:,__import__('os')]", "y[:,1e3]", "y[:,99999999999]",
    ],
)  # fmt: skip
def test_other_forms_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(InputError, match=r"^here: cannot read .*\[:,2\]"):
        parse_array_ref(text, "here")


@pytest.mark.parametrize(
    ("ref", "why"),
    [
        ("table", r"array 'table' is 50x3, not one series of samples; say which .* such as table\[:,0\]"),
        ("table[:]", r"table\[:\] has 1 indices, but array 'table' is 50x3; give one per dimension"),
        ("table[:,3]", r"table\[:,3\] is outside array 'table', which is 50x3; positions count from 0"),
        ("number", "array 'number' is single number, not one series"),
    ],
)
def test_index_that_does_not_fit_says_what_the_array_is(save: Save, ref: str, why: str) -> None:
    path = save(t=t(), table=np.ones((50, 3)), number=np.float64(3.0), piezo=t())
    with pytest.raises(InputError, match=why):
        open_foreign(path, plant(), channels={"tip": ref})


# --- sample rate ----------------------------------------------------------------------------------------


def rate_of(recording: ForeignRecording) -> tuple[float, str]:
    return recording.sample_rate_hz, recording.notes[0]


@pytest.mark.parametrize("name", ["t", "time"])
def test_rate_is_read_off_even_time_stamps(save: Save, name: str) -> None:
    path = save(tip=t(), piezo=t(), **{name: 7.0 + t(50, 50_000.0)})
    assert rate_of(open_foreign(path, plant())) == (
        50_000.0,
        f"sample rate 50000 Hz from time array '{name}'",
    )


def test_rounded_but_even_stamps_give_the_mean_rate(save: Save) -> None:
    path = save(tip=np.ones(2000), piezo=np.ones(2000), t=np.round(t(2000, 300.0), 5))
    assert open_foreign(path, plant()).sample_rate_hz == pytest.approx(300.0, rel=1e-5)


def test_time_array_and_its_unit_can_be_named(save: Save, tmp_path: Path) -> None:
    path = save(tip=t(), piezo=t(), clock=t() * 1e3)
    (tmp_path / "run.toml").write_text('time = "clock:ms"\n')
    assert open_foreign(path, plant()).sample_rate_hz == 100.0


def test_time_array_named_but_not_there_is_refused(save: Save, tmp_path: Path) -> None:
    path = save(tip=t(), piezo=t())
    (tmp_path / "run.toml").write_text('time = "clock"\n')
    with pytest.raises(InputError, match=r"run\.toml names time array 'clock', which is not in the file"):
        open_foreign(path, plant())


def test_time_in_a_unit_of_length_is_refused(save: Save, tmp_path: Path) -> None:
    path = save(tip=t(), piezo=t(), clock=t())
    (tmp_path / "run.toml").write_text('time = "clock:mm"\n')
    with pytest.raises(InputError, match="time array 'clock' is in 'mm', which is no unit of time"):
        open_foreign(path, plant())


def test_uneven_stamps_alone_are_refused_with_their_steps(save: Save) -> None:
    path = save(tip=np.ones(5), piezo=np.ones(5), t=np.array([0.0, 0.01, 0.01, 0.02, 0.04]))
    with pytest.raises(InputError) as error:
        open_foreign(path, plant())
    assert said(error) == (
        f"{path}: time array 't' is not evenly spaced (steps of 0 to 20 ms, median 10 ms); give the rate it was "
        "sampled at with --sample-rate HZ, or sample_rate_hz in a sidecar"
    )


def test_uneven_stamps_are_set_aside_for_a_nominal_rate_and_that_is_said(save: Save, tmp_path: Path) -> None:
    path = save(tip=np.ones(5), piezo=np.ones(5), t=np.array([0.0, 0.01, 0.01, 0.02, 0.04]))
    (tmp_path / "run.json").write_text('{"fs_hz": 128}')
    rate, note = rate_of(open_foreign(path, plant()))
    assert rate == 128.0
    assert note.endswith("(steps of 0 to 20 ms, median 10 ms), so it is not used")


@pytest.mark.parametrize(
    ("stamps", "why"),
    [
        (np.array([0.0, 1.0, np.nan, 3.0, 4.0]), "stamps that are not finite"),
        (np.zeros(5), "not evenly spaced"),
        (-t(5), "not evenly spaced"),
        (t(4), "has 4 stamps for 5 samples"),
        (t(5).astype(str), "not one series of numbers"),
    ],
)
def test_stamps_that_carry_no_rate_are_refused(save: Save, stamps: np.ndarray, why: str) -> None:
    with pytest.raises(InputError, match=rf"time array 't' .*{why}.*--sample-rate HZ"):
        open_foreign(save(tip=np.ones(5), piezo=np.ones(5), t=stamps), plant())


def test_single_sample_has_no_rate_of_its_own(save: Save) -> None:
    path = save(tip=np.ones(1), piezo=np.ones(1), t=np.zeros(1))
    with pytest.raises(InputError, match="has a single stamp"):
        open_foreign(path, plant())
    assert len(list(open_foreign(path, plant(), sample_rate_hz=10.0).blocks())) == 1


def test_even_stamps_that_contradict_the_sidecar_are_not_settled_silently(save: Save, tmp_path: Path) -> None:
    path = save(tip=t(), piezo=t(), t=t())
    (tmp_path / "run.json").write_text('{"fs_hz": 1000}')
    with pytest.raises(InputError, match=r"'t' says 100 Hz but run\.json says 1000 Hz; correct the sidecar"):
        open_foreign(path, plant())
    assert rate_of(open_foreign(path, plant(), sample_rate_hz=50.0)) == (50.0, "sample rate 50 Hz as given")


def test_no_rate_at_all_is_refused_with_the_remedy(save: Save) -> None:
    with pytest.raises(InputError, match="no sample rate: it has no time array 't' or 'time'; give the rate"):
        open_foreign(save(tip=t(), piezo=t()), plant())


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_rate_given_must_be_positive(save: Save, rate: float) -> None:
    with pytest.raises(InputError, match=r"sample rate \[Hz\]: must be a positive number"):
        open_foreign(save(tip=t(), piezo=t()), plant(), sample_rate_hz=rate)


# --- blocks ---------------------------------------------------------------------------------------------


def test_blocks_follow_each_other_and_the_last_is_shorter(save: Save) -> None:
    tip = np.linspace(0.0, 1e-3, 25)
    recording = open_foreign(save(t=t(25), tip=tip, piezo=tip), plant(), block_s=0.1)
    blocks = list(recording.blocks())
    assert [(b.first_sample, b.n_samples) for b in blocks] == [(0, 10), (10, 10), (20, 5)]
    np.testing.assert_array_equal(np.concatenate([b.values[:, 0] for b in blocks]), tip)
    assert len(list(recording.blocks())) == 3, "a second reading begins again"


def test_missing_and_saturated_samples_are_masked_not_passed_on(save: Save) -> None:
    tip = np.array([1e-3, np.nan, np.inf, 0.015, -0.015, 0.0149])
    (block,) = open_foreign(
        save(tip=tip, piezo=np.full(6, 200.0)), plant(), sample_rate_hz=10.0, block_s=1
    ).blocks()
    np.testing.assert_array_equal(block.valid[:, 0], [True, False, False, False, False, True])
    assert block.valid[:, 1].all()
    assert np.isfinite(block.values).all()
    assert not block.values.flags.writeable


@pytest.mark.parametrize("block_s", [0.0, -0.1, float("nan"), float("inf")])
def test_block_length_must_be_positive(save: Save, block_s: float) -> None:
    with pytest.raises(InputError, match=r"block length \[s\]"):
        open_foreign(save(t=t(), tip=t(), piezo=t()), plant(), block_s=block_s)


def test_integers_and_foreign_byte_orders_are_numbers_too(save: Save) -> None:
    tip = np.arange(50)
    recording = open_foreign(save(t=t(), tip=tip.astype("i2"), piezo=tip.astype(">f4")), plant())
    np.testing.assert_array_equal(recording.values, np.column_stack([tip, tip]))


def test_numbers_too_large_for_their_unit_are_masked(save: Save) -> None:
    path = save(t=t(), tip=np.zeros(50), piezo=np.full(50, 1e308))
    assert not next(open_foreign(path, plant(), channels={"piezo": "piezo:kV"}).blocks()).valid[:, 1].any()


# --- what is refused ------------------------------------------------------------------------------------


def test_missing_file_and_directory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.npz: no such file; check the path"):
        open_foreign(tmp_path / "none.npz", plant())
    with pytest.raises(InputError, match=r"is a directory; give a file in it"):
        open_foreign(tmp_path, plant())


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is empty; copy or export"),
        (b"\x7fELF\0\0\0", r"is of no known format; recordings are read from \.npz, \.tdms"),
        (b"Dear reader,\nhere is no number.\n", "no row of numbers in its first 2 lines"),
        (b"\x93NUMPY\x01\x00", r"is a single \.npy array, not an \.npz"),
        (b"PK\x03\x04 and no more", "is cut short or damaged"),
    ],
)
def test_files_of_another_kind(tmp_path: Path, content: bytes, why: str) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=why):
        open_foreign(path, plant())


def test_archive_without_arrays(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(InputError, match="holds no arrays"):
        open_foreign(path, plant())


def test_pickled_objects_are_never_loaded(save: Save) -> None:
    path = save(t=t(), tip=np.array([{"a": 1}] * 50, dtype=object), piezo=t())
    with pytest.raises(InputError, match="array 'tip' holds Python objects, which are never loaded"):
        open_foreign(path, plant())


@pytest.mark.parametrize("kind", [complex, bool, str, "M8[s]"])
def test_what_is_not_a_real_number_is_refused(save: Save, kind: str) -> None:
    with pytest.raises(InputError, match=r"array 'tip' holds .*, not real numbers; channel 'tip' \[m\]"):
        open_foreign(save(t=t(), tip=np.zeros(50).astype(int).astype(kind), piezo=t()), plant())


def test_empty_arrays(save: Save) -> None:
    with pytest.raises(InputError, match="array 'tip' is empty; there is nothing to replay"):
        open_foreign(save(tip=np.zeros(0), piezo=np.zeros(0)), plant(), sample_rate_hz=10.0)


def test_arrays_of_unequal_length_are_listed(save: Save) -> None:
    with pytest.raises(InputError, match=r"arrays differ in length \(tip 50, piezo 49 samples\)"):
        open_foreign(save(t=t(), tip=t(), piezo=t(49)), plant())


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("run.json", "{", r"run\.json: not valid JSON"),
        ("run.json", "[1]", r"run\.json: expected an object"),
        (
            "run.json",
            '{"fs_hz": "100"}',
            r"run\.json: fs_hz \[Hz\]: must be a positive number of Hz, got '100'",
        ),
        ("run.json", '{"fs_hz": 0}', r"fs_hz \[Hz\]: must be a positive number"),
        ("run.json", '{"fs_hz": NaN}', r"fs_hz \[Hz\]: must be a positive number"),
        ("run.json", '{"fs_hz": true}', r"fs_hz \[Hz\]: must be a positive number"),
        ("run.json", '{"channels": ["mm"]}', r"run\.json: channels: expected one text for each array"),
        ("run.toml", "sample_rate_hz = -1.0", r"run\.toml: sample_rate_hz \[Hz\]: must be greater than 0 Hz"),
        ("run.toml", "sample_rate = 100.0", r"run\.toml: sample_rate: unknown key"),
        ("run.toml", "[channels]\ntip = 3", r"run\.toml: channels tip"),
        ("run.toml", '[channels]\ntip = { unit = "mm" }', r"run\.toml: channels tip array: missing"),
        ("run.toml", '[channels]\ntip = { array = "y[", unit = "mm" }', r"channels tip: cannot read 'y\['"),
        (
            "run.toml",
            '[channels]\ntip = { array = "y:m", unit = "mm" }',
            "says 'm' and unit says 'mm'; keep one",
        ),
    ],
)
def test_sidecars_that_cannot_be_used(save: Save, tmp_path: Path, name: str, content: str, why: str) -> None:
    path = save(t=t(), tip=t(), piezo=t())
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=why):
        open_foreign(path, plant())


def test_sidecar_given_must_exist_and_is_the_only_one_read(save: Save, tmp_path: Path) -> None:
    path = save(tip=t(), piezo=t())
    (tmp_path / "run.json").write_text("not JSON")
    other = tmp_path / "other.JSON"
    with pytest.raises(InputError, match=r"other\.JSON: cannot be read"):
        open_foreign(path, plant(), sidecar=other)
    other.write_text('{"fs_hz": 25.0}')
    assert open_foreign(path, plant(), sidecar=other).sample_rate_hz == 25.0
    with pytest.raises(InputError, match=r"other\.toml: cannot be read"):
        open_foreign(path, plant(), sidecar=tmp_path / "other.toml")


def _archive() -> tuple[bytes, np.ndarray]:
    rng = np.random.default_rng(7)
    tip, file = rng.normal(size=40), io.BytesIO()
    np.savez_compressed(file, t=t(40), tip=tip, piezo=np.ones(40))
    return file.getvalue(), tip


ARCHIVE, TIP = _archive()


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_or_read_right(tmp_path: Path, data: st.DataObject) -> None:
    damaged = bytearray(ARCHIVE)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    cut = data.draw(st.one_of(st.none(), st.integers(0, len(damaged))))
    path = tmp_path / "damaged.npz"
    path.write_bytes(bytes(damaged[:cut]))
    try:
        read = open_foreign(path, plant()).values[:, 0]
    except InputError:
        return
    np.testing.assert_array_equal(read, TIP)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.lists(st.tuples(st.integers(0, 127), st.integers(1, 255)), min_size=1, max_size=4))
def test_nonsense_in_an_arrays_header_is_refused_even_with_a_right_checksum(
    tmp_path: Path, changes: list[tuple[int, int]]
) -> None:
    file = io.BytesIO()
    np.save(file, TIP)
    member = bytearray(file.getvalue())
    for place, change in changes:
        member[place] ^= change
    path = tmp_path / "nonsense.npz"
    np.savez(path, t=t(40), piezo=np.ones(40))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("tip.npy", bytes(member))
    try:
        blocks = list(open_foreign(path, plant()).blocks())
    except InputError:
        return
    assert all(np.isfinite(b.values).all() for b in blocks)


# --- measured recordings of other people's rigs ---------------------------------------------------------


def test_beam_recording_needs_nothing_but_the_plant(realdata: Path) -> None:
    path = realdata / "beam_closed_lq.npz"
    recording = open_foreign(path, load_plant("beam"))
    assert [str(m) for m in recording.mapping] == [
        "tip_displacement <- y [mm -> m, x 0.001]: the plant's recorded_as",
        "piezo <- u [V -> V, x 1]: the plant's recorded_as",
    ]
    assert rate_of(recording) == (100.0, "sample rate 100 Hz from beam_closed_lq.json")
    with np.load(path) as arrays:
        np.testing.assert_array_equal(recording.values[:, 1], arrays["u"])
        np.testing.assert_allclose(recording.values[:, 0], arrays["y"] * 1e-3, rtol=1e-15)
    assert sum(b.n_samples for b in recording.blocks()) == 2400


def test_beam_recording_by_equal_names_takes_units_from_beside_it(realdata: Path) -> None:
    recording = open_foreign(realdata / "beam_closed_lq.npz", plant("y", "u"))
    assert [(m.array, m.unit, m.decided) for m in recording.mapping] == [
        ("y", "mm", "equal names; unit from beam_closed_lq.json"),
        ("u", "V", "equal names; unit from beam_closed_lq.json"),
    ]


def test_beam_recording_by_guess(realdata: Path) -> None:
    path = realdata / "beam_closed_lq.npz"
    assert (
        open_foreign(path, plant("tip", "u"))
        .mapping[0]
        .decided.startswith("guessed: the only array left in mm")
    )
    with pytest.raises(InputError, match=r"'piezo' \[V\] \(could be u or V1 or V2\)"):
        open_foreign(path, plant("y", "piezo"))


def test_uncontrolled_beam_has_no_voltage_and_says_how_to_go_on(realdata: Path) -> None:
    path = realdata / "beam_open.npz"
    with pytest.raises(InputError, match="--channel piezo=none if it was not recorded"):
        open_foreign(path, load_plant("beam"))
    assert open_foreign(path, load_plant("beam"), channels={"piezo": "none"}).n_samples == 11200


def test_rounded_repeating_stamps_of_the_fatigue_rig(realdata: Path) -> None:
    recording = open_foreign(realdata / "faster.npz", plant("d", "u"))
    rate, note = rate_of(recording)
    assert rate == 128.0
    assert "time array 't' is not evenly spaced (steps of 0 to 11 ms, median 8 ms), so it is not used" in note


def test_damper_columns_are_reached_by_index(realdata: Path) -> None:
    options = {"tip": "e1_1[:,0]:mm", "piezo": "none"}
    recording = open_foreign(realdata / "mr_0V.npz", plant(), channels=options)
    assert (recording.n_samples, recording.sample_rate_hz) == (3001, 100.0)


def test_circuit_records_are_reached_by_index(realdata: Path) -> None:
    options = {"tip": "none", "piezo": "data[3,0,:]:V", "capacitor": "data[3,1,:]:V"}
    coil = plant(
        extra=(
            '[[actuator]]\nname = "coil"\nkind = "shaker"\non = "body"\nresistance_ohm = 14.0\n'
            "inductance_h = 1.54e-3\nforce_constant_n_a = 1.0\n"
            '[[sensor]]\nname = "capacitor"\nkind = "voltage"\nof = "coil"\nnoise_density = 1e-6\n'
        )
    )
    recording = open_foreign(realdata / "rlc_20221130_0001.npz", coil, channels=options | {"coil": "none"})
    assert recording.values.shape == (4464, 2)
    assert recording.sample_rate_hz == pytest.approx(892857.18, rel=1e-6)


def test_response_functions_are_no_recording(realdata: Path) -> None:
    with pytest.raises(InputError, match="holds complex128, not real numbers"):
        open_foreign(
            realdata / "soton_frf_in1.npz",
            plant(),
            channels={"tip": "H[:,0]", "piezo": "none"},
            sample_rate_hz=1.0,
        )
