"""Plants as data: the presets against the thesis's tables, and what a wrong file is told."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from twin.plant.config import Body, DampingTable, FittedOn, ForceActuator, Plant, Shaker, VoiceCoil
from twin.plant.errors import InputError
from twin.plant.files import load_plant, parse_toml, preset_names, read_toml, unit_of
from twin.plant.linear import natural_frequencies_hz

TEXT = """
name = "p"
[[body]]
name = "case"
mass_kg = 40.0
attached_to = "ground"
stiffness_n_m = 8000.0
damping_ns_m = 200.0
[[body]]
name = "absorber"
mass_kg = 8.0
attached_to = "case"
stiffness_n_m = 800000.0
damping_ns_m = 2.7
[[actuator]]
name = "vcm"
kind = "voice_coil"
between = ["case", "absorber"]
resistance_ohm = 3.0
inductance_h = 0.002
force_constant_n_a = 22.0
[[actuator]]
name = "push"
kind = "force"
on = "case"
[[sensor]]
name = "x"
kind = "displacement"
of = "case"
noise_density = 1e-8
[limits]
stroke_m = 0.01
"""


def with_change(old: str, new: str) -> str:
    assert TEXT.count(old) >= 1, f"the text does not hold {old!r}"
    return TEXT.replace(old, new, 1)


def told(text: str) -> str:
    with pytest.raises(InputError) as error:
        parse_toml(text, Plant, "rig.toml")
    lines = str(error.value).splitlines()
    assert all(line.startswith("rig.toml: ") for line in lines)
    return "\n".join(line.removeprefix("rig.toml: ") for line in lines)


# --- presets against the thesis's tables ------------------------------------------------------------------------


# m1, m2, c1, c2, k1, k2 (thesis Tables 5-1/6-1, 8-2, 8-3, 7-1, 7-3, 4-2)
TWO_BODIES = {
    "engine": (41.38, 8.862, 200.0, 2.7, 8369.4, 874640.0),
    "engine_vcm": (41.38 + 4.15, 8.862 + 0.621, 200.0, 2.7, 8369.4, 935930.0),
    "engine_vcm_large": (41.38 + 4.10, 8.862 + 0.710, 200.0, 2.7, 8369.4, 9.572 * (2 * np.pi * 50) ** 2),
    "rig_no_vcm": (1.80, 0.4125, 5.0, 0.5, 12300.0, 40714.0),
    "rig": (2.10, 0.4125, 5.0, 7.0, 12300.0, 40714.0),
    "analogue_2dof": (40.0, 4.0, 0.1, 0.0, 1579.0, 394788.8),
}


@pytest.mark.parametrize("name", TWO_BODIES)
def test_preset_holds_its_row_of_the_table(name: str) -> None:
    plant = load_plant(name)
    first, second = plant.body
    numbers = (
        first.mass_kg, second.mass_kg, first.damping_at(None), second.damping_at(None),
        first.stiffness_n_m, second.stiffness_n_m,
    )  # fmt: skip
    np.testing.assert_allclose(numbers, TWO_BODIES[name], rtol=1e-7)
    assert (first.attached_to, second.attached_to) == ("ground", first.name)
    assert plant.primary is first
    assert plant.absorber is second


# R, L, k, kp (thesis Tables 8-2, 8-3, 7-3)
@pytest.mark.parametrize(
    ("name", "circuit"),
    [
        ("engine_vcm", (3.0, 2.1e-3, 22.2, 200.0)),
        ("engine_vcm_large", (3.0, 1.9e-3, 51.6, 200.0)),
        ("rig", (2.7, 1.3e-3, 8.0, 100.0)),
    ],
)
def test_voice_coil_of_the_preset(name: str, circuit: tuple[float, ...]) -> None:
    coil = load_plant(name).voice_coil
    assert coil is not None
    assert (
        coil.resistance_ohm, coil.inductance_h, coil.force_constant_n_a, coil.current_loop_kp_v_a
    ) == circuit  # fmt: skip
    assert coil.input_unit == "A"
    assert [sign for _, sign in coil.pushes] == [-1.0, 1.0]


@pytest.mark.parametrize("name", ["rig", "rig_no_vcm"])
def test_shaker_of_the_rig(name: str) -> None:
    shaker = load_plant(name).find_actuator("shaker")
    assert isinstance(shaker, Shaker)
    assert (shaker.resistance_ohm, shaker.inductance_h, shaker.force_constant_n_a) == (1.2, 1.8e-3, 11.1)
    assert shaker.input_unit == "V"


def test_limits_of_the_rig_are_those_of_its_amplifier_and_coil() -> None:
    assert dict(load_plant("rig").limits) == {
        "vcm_current_a": 2.0, "vcm_power_w": 33.0, "stroke_m": 0.0095, "primary_displacement_m": 20e-6
    }  # fmt: skip
    assert load_plant("engine").limits["primary_displacement_m"] == 20e-6


def test_shaker_of_its_own_is_driven_by_current() -> None:
    plant = load_plant("shaker_v721")
    (table,), shaker = plant.body, plant.find_actuator("shaker")
    assert (table.mass_kg, table.damping_ns_m, table.stiffness_n_m) == (4.41, 170.0, 31500.0)
    assert isinstance(shaker, Shaker)
    assert (shaker.force_constant_n_a, shaker.input_unit) == (159.0, "A")


# Table 6-3: variances of x1, x2 [m²], x1', x2' [(m/s)²]
@pytest.mark.parametrize("name", ["engine", "engine_vcm", "engine_vcm_large"])
def test_sensor_noise_of_the_engine_gives_back_the_thesis_variances(name: str) -> None:
    variances = [s.noise_variance(50_000.0) for s in load_plant(name).sensor[:4]]
    np.testing.assert_allclose(variances, [5e-12, 0.25e-6, 2e-6, 1e-2], rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "low_hz", "high_hz"),
    [
        ("engine", 2.054, 55.103),
        ("rig", 11.09, 54.92),
        ("rig_no_vcm", 11.80, 55.74),
        ("analogue_2dof", 0.953, 52.44),
    ],
)
def test_natural_frequencies_of_the_presets(name: str, low_hz: float, high_hz: float) -> None:
    low, high = natural_frequencies_hz(load_plant(name))
    assert float(f"{low:.{len(str(low_hz).split('.')[1])}f}") == low_hz
    assert float(f"{high:.{len(str(high_hz).split('.')[1])}f}") == high_hz


def test_analogue_is_the_circuit_of_its_table() -> None:
    # L = m, C = 1/k, R = c (thesis Table 4-1)
    first, second = load_plant("analogue_2dof").body
    np.testing.assert_allclose(
        [1 / first.stiffness_n_m, 1 / second.stiffness_n_m], [633.257e-6, 2.533e-6], rtol=1e-4
    )


def test_every_preset_loads_and_has_a_fingerprint_of_its_own() -> None:
    assert {"beam", "engine", "rig"} <= set(preset_names())
    prints = [load_plant(name).fingerprint for name in preset_names()]
    assert len(set(prints)) == len(prints)
    assert all(load_plant(name).name == name for name in preset_names())


# --- reading --------------------------------------------------------------------------------------------


def test_file_comes_before_preset_of_the_same_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rig.toml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    assert load_plant("rig.toml").name == "p"
    assert load_plant("rig").name == "rig"


def test_byte_order_mark_and_windows_line_ends_are_no_error(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_bytes(b"\xef\xbb\xbf" + TEXT.replace("\n", "\r\n").encode())
    assert load_plant(path) == parse_toml(TEXT, Plant, "p")


def test_whole_numbers_are_numbers() -> None:
    assert parse_toml(with_change("mass_kg = 8.0", "mass_kg = 8"), Plant, "p").body[1].mass_kg == 8.0


def test_fingerprint_follows_content_not_layout() -> None:
    plain = parse_toml(TEXT, Plant, "p")
    assert (
        parse_toml(TEXT.replace("mass_kg = 8.0", "mass_kg = 8.000  # steel"), Plant, "q").fingerprint
        == plain.fingerprint
    )
    assert (
        parse_toml(TEXT.replace("mass_kg = 8.0", "mass_kg = 8.001"), Plant, "p").fingerprint
        != plain.fingerprint
    )


def test_plants_cannot_be_changed_after_they_were_checked() -> None:
    with pytest.raises(ValidationError):
        load_plant("rig").body[0].mass_kg = -1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "nope",
            "nope: no such plant file, and no preset of that name; give the path of a plant TOML or one of",
        ),
        ("no/such.toml", "no/such.toml: no such plant file"),
        ("./rig", "./rig: no such plant file"),
        ("x" * 5000, "cannot be read"),
        ("\0", "no such plant file"),
    ],
)
def test_no_such_plant(name: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        load_plant(name)
    assert message in str(error.value)


def test_directory_binary_and_empty_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a directory; give the path of a plant TOML in it"):
        load_plant(tmp_path)
    with pytest.raises(InputError, match=r"cannot be read .*check the path and that it is UTF-8 text"):
        read_toml(tmp_path, Plant)
    path = tmp_path / "p.toml"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"p\.toml: cannot be read \(not UTF-8\)"):
        load_plant(path)
    path.write_bytes(b"")
    with pytest.raises(
        InputError, match=r"p\.toml: name: missing; add it\n.*body: missing; add at least one \[\[body\]\]"
    ):
        load_plant(path)


@given(st.text(max_size=80))
def test_any_text_is_read_or_refused_in_words(text: str) -> None:
    try:
        parse_toml(text, Plant, "p.toml")
    except InputError as error:
        assert str(error).startswith("p.toml: ")  # noqa: PT017 - either outcome is right


JUNK = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)
KEYS = [line.split(" = ")[0] for line in TEXT.splitlines() if " = " in line]


@given(
    st.sampled_from(["body", "actuator", "sensor", "limits", "fitted_on", "name"]),
    st.sampled_from(KEYS),
    JUNK,
)
def test_any_value_in_any_place_is_taken_or_refused_in_words(section: str, key: str, junk: object) -> None:
    import tomllib

    from twin.plant import files

    data = tomllib.loads(TEXT)
    if isinstance(data.get(section), list) and key in data[section][0]:
        data[section][0][key] = junk
    else:
        data[section] = junk
    original = files.tomllib.loads
    try:
        files.tomllib.loads = lambda text: data  # type: ignore[assignment]
        parse_toml("", Plant, "p.toml")
    except InputError as error:
        assert str(error).startswith("p.toml: ")  # noqa: PT017 - either outcome is right
    finally:
        files.tomllib.loads = original


# --- what a wrong file is told --------------------------------------------------------------------------


NUMBER = "body[1] 'absorber' mass_kg [kg]: "


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("0.0", "must be greater than 0 kg, got 0.0"),
        ("-1.0", "must be greater than 0 kg, got -1.0"),
        ("nan", "must be a finite number of kg, got nan"),
        ("inf", "must be a finite number of kg, got inf"),
        ("-inf", "must be a finite number of kg, got -inf"),
        ("1e400", "must be a finite number of kg, got inf"),
        ('"8"', "must be a number of kg, got '8'"),
        ("true", "must be a number of kg, got true"),
        ("[8.0]", "must be a number of kg"),
        ("{ a = 1 }", "must be a number of kg"),
        ("1979-01-01", "must be a number of kg"),
        ("1" + "0" * 400, "must be a number of kg, got 1" + "0" * 56 + "..."),
    ],
)
def test_mass_that_is_none(value: str, message: str) -> None:
    assert told(with_change("mass_kg = 8.0", f"mass_kg = {value}")) == NUMBER + message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "stiffness_n_m = 800000.0",
            "stiffness_n_m = 0.0",
            "body[1] 'absorber' stiffness_n_m [N/m]: must be greater than 0 N/m, got 0.0",
        ),
        (
            "damping_ns_m = 2.7",
            "damping_ns_m = -1.0",
            "body[1] 'absorber' damping_ns_m [Ns/m]: must not be below 0 Ns/m, got -1.0",
        ),
        (
            "damping_ns_m = 2.7",
            "damping_ns_m = true",
            "body[1] 'absorber' damping_ns_m [Ns/m]: must be a number of Ns/m, got true",
        ),
        (
            "damping_ns_m = 2.7",
            "damping_ns_m = 2.7\ndisturbance_density_n = -1.0",
            "body[1] 'absorber' disturbance_density_n [N/√Hz]: must not be below 0 N/√Hz, got -1.0",
        ),
        (
            "resistance_ohm = 3.0",
            "resistance_ohm = -3.0",
            "actuator[0] 'vcm' resistance_ohm [Ω]: must be greater than 0 Ω, got -3.0",
        ),
        (
            "inductance_h = 0.002",
            'inductance_h = "2 mH"',
            "actuator[0] 'vcm' inductance_h [H]: must be a number of H, got '2 mH'",
        ),
        (
            "force_constant_n_a = 22.0",
            "force_constant_n_a = nan",
            "actuator[0] 'vcm' force_constant_n_a [N/A]: must be a finite number of N/A, got nan",
        ),
        (
            "noise_density = 1e-8",
            "noise_density = 0.0",
            "sensor[0] 'x' noise_density [m/√Hz]: must be greater than 0 m/√Hz, got 0.0",
        ),
        (
            "noise_density = 1e-8",
            "noise_density = 1e-8\nrange = -1.0",
            "sensor[0] 'x' range [m]: must be greater than 0 m, got -1.0",
        ),
        ("stroke_m = 0.01", "stroke_m = 0", "limits stroke_m [m]: must be greater than 0 m, got 0"),
        ("stroke_m = 0.01", "stroke_m = inf", "limits stroke_m [m]: must be a finite number of m, got inf"),
        ("stroke_m = 0.01", 'stroke_m = "none"', "limits stroke_m [m]: must be a number of m, got 'none'"),
        (
            "stroke_m = 0.01",
            "vcm_current_a = -1",
            "limits vcm_current_a [A]: must be greater than 0 A, got -1",
        ),
    ],
)
def test_number_that_cannot_be_names_key_and_unit(old: str, new: str, message: str) -> None:
    assert told(with_change(old, new)) == message


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("mass_kg = 8.0", "body[1] 'absorber' mass_kg [kg]: missing; add it in kg"),
        ("stiffness_n_m = 800000.0", "body[1] 'absorber' stiffness_n_m [N/m]: missing; add it in N/m"),
        ("damping_ns_m = 2.7", "body[1] 'absorber' damping_ns_m [Ns/m]: missing; add it in Ns/m"),
        ('attached_to = "case"', "body[1] 'absorber' attached_to: missing; add it"),
        ("resistance_ohm = 3.0", "actuator[0] 'vcm' resistance_ohm [Ω]: missing; add it in Ω"),
        ("force_constant_n_a = 22.0", "actuator[0] 'vcm' force_constant_n_a [N/A]: missing; add it in N/A"),
        (
            'kind = "voice_coil"',
            "actuator[0] 'vcm': kind is missing; use one of 'voice_coil', 'shaker', 'force'",
        ),
        ('kind = "displacement"', "sensor[0] 'x' kind: missing; add it"),
        ("noise_density = 1e-8", "sensor[0] 'x' noise_density [m/√Hz]: missing; add it in m/√Hz"),
        ('name = "p"', "name: missing; add it"),
    ],
)
def test_missing_key_is_asked_for_in_its_unit(line: str, message: str) -> None:
    assert told(with_change(line + "\n", "")) == message


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ('name = "p"', 'name = "p"\ncolour = "red"', "colour"),
        ("[limits]", "[limit]", "limit"),
        ("mass_kg = 8.0", "mass_kg = 8.0\nmass = 8.0", "body[1] 'absorber' mass"),
        ("resistance_ohm = 3.0", "resistance_ohm = 3.0\nresistance = 3.0", "actuator[0] 'vcm' resistance"),
        ('on = "case"', 'on = "case"\nresistance_ohm = 3.0', "actuator[1] 'push' resistance_ohm"),
        ("noise_density = 1e-8", "noise_density = 1e-8\nnoise = 1e-8", "sensor[0] 'x' noise"),
        (
            "damping_ns_m = 2.7",
            "damping_ns_m = { frequency_hz = [45.0, 50.0], ns_m = [1.0, 2.0], f = 1 }",
            "body[1] 'absorber' damping_ns_m f",
        ),
        (
            "stroke_m = 0.01",
            'stroke_m = 0.01\n[[fitted_on]]\nrecording = "r"\nfirst_row = 0\nlast_row = 9\nrow = 1',
            "fitted_on[0] row",
        ),
    ],
)
def test_unknown_keys_are_refused_at_every_level(old: str, new: str, place: str) -> None:
    assert told(with_change(old, new)) == f"{place}: unknown key; check its spelling or remove it"


def test_misspelt_key_is_both_missing_and_unknown() -> None:
    assert told(with_change("mass_kg = 8.0", "mass = 8.0")).splitlines() == [
        "body[1] 'absorber' mass_kg [kg]: missing; add it in kg",
        "body[1] 'absorber' mass: unknown key; check its spelling or remove it",
    ]


LIMITS = "known: primary_displacement_m, push_force_n, stroke_m, vcm_current_a, vcm_power_w, vcm_voltage_v"
DAMPING = "body[1] 'absorber' damping_ns_m"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            "frequency_hz = [45.0, 50.0], ns_m = [1.0]",
            f"{DAMPING} [Ns/m]: frequency_hz has 2 points and ns_m 1; give one each",
        ),
        (
            "frequency_hz = [50.0, 45.0], ns_m = [1.0, 2.0]",
            f"{DAMPING} [Ns/m]: frequency_hz must rise from point to point [Hz]",
        ),
        (
            "frequency_hz = [50.0, 50.0], ns_m = [1.0, 2.0]",
            f"{DAMPING} [Ns/m]: frequency_hz must rise from point to point [Hz]",
        ),
        ("frequency_hz = [50.0], ns_m = [1.0]", f"{DAMPING} frequency_hz [Hz]: must have at least 2 entries"),
        (
            "frequency_hz = [45.0, 50.0], ns_m = [1.0, -2.0]",
            f"{DAMPING} ns_m[1] [Ns/m]: must not be below 0 Ns/m, got -2.0",
        ),
        (
            "frequency_hz = [0.0, 50.0], ns_m = [1.0, 1.0]",
            f"{DAMPING} frequency_hz[0] [Hz]: must be greater than 0 Hz, got 0.0",
        ),
        (
            "frequency_hz = 45.0, ns_m = [1.0, 1.0]",
            f"{DAMPING} frequency_hz [Hz]: must be a list in square brackets, got 45.0",
        ),
        ("ns_m = [1.0, 1.0]", f"{DAMPING} frequency_hz [Hz]: missing; add it in Hz"),
    ],
)
def test_damping_table_that_is_none(table: str, message: str) -> None:
    assert told(with_change("damping_ns_m = 2.7", f"damping_ns_m = {{ {table} }}")) == message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'attached_to = "case"',
            'attached_to = "cse"',
            'body \'absorber\': attached_to = "cse" names no body; use "ground" or one of absorber, case',
        ),
        (
            'attached_to = "case"',
            'attached_to = ""',
            'body \'absorber\': attached_to = "" names no body; use "ground" or one of absorber, case',
        ),
        (
            'attached_to = "case"',
            "attached_to = 3",
            "body[1] 'absorber' attached_to: must be text in quotes, got 3",
        ),
        (
            'attached_to = "case"',
            'attached_to = "absorber"',
            "body 'absorber': attached_to runs in a loop (absorber -> absorber); attach one of them to \"ground\"",
        ),
        (
            'attached_to = "ground"',
            'attached_to = "absorber"',
            "body 'case': attached_to runs in a loop (case -> absorber -> case); attach one of them to \"ground\"",
        ),
        (
            'name = "absorber"',
            'name = "case"',
            "two things are called 'case'; every body or actuator needs a name of its own: rename one",
        ),
        ('name = "absorber"', 'name = "ground"', "no body may be called 'ground': it is what stands still"),
        (
            'name = "push"',
            'name = "vcm"',
            "two things are called 'vcm'; every body or actuator needs a name of its own: rename one",
        ),
        (
            'name = "push"',
            'name = "case"',
            "two things are called 'case'; every body or actuator needs a name of its own: rename one",
        ),
        (
            'name = "x"',
            'name = "vcm"',
            "two things are called 'vcm'; every actuator or sensor needs a name of its own: rename one",
        ),
        (
            'name = "p"',
            'name = "1p"',
            "name: must begin with a letter and hold letters, digits and _ only, got '1p'",
        ),
        ('on = "case"', 'on = "cse"', "actuator 'push': 'cse' names no body; known: absorber, case"),
        ('on = "case"', 'on = "ground"', "actuator 'push': on = \"ground\" moves nothing; name a body"),
        (
            'on = "case"\n',
            "",
            'actuator[1] \'push\': give either on = "body" or between = ["first", "second"]',
        ),
        (
            'on = "case"',
            'on = "case"\nbetween = ["case", "absorber"]',
            'actuator[1] \'push\': give either on = "body" or between = ["first", "second"]',
        ),
        ('["case", "absorber"]', '["case"]', "actuator[0] 'vcm' between[1]: missing; the list is too short"),
        (
            '["case", "absorber"]',
            '["case", "absorber", "ground"]',
            "actuator[0] 'vcm' between: must have no more than 2 entries",
        ),
        (
            '["case", "absorber"]',
            '["case", "case"]',
            "actuator 'vcm': between must name two different places, at least one a body",
        ),
        (
            '["case", "absorber"]',
            '["ground", "ground"]',
            "actuator 'vcm': between must name two different places, at least one a body",
        ),
        (
            '["case", "absorber"]',
            '"case"',
            "actuator[0] 'vcm' between: must be a list in square brackets, got 'case'",
        ),
        (
            '["case", "absorber"]',
            '["absorber", "case"]',
            "actuator 'vcm': between ends in 'case'; "
            "a voice coil's second body is the absorber it pushes, the first what it stands on",
        ),
        (
            'kind = "voice_coil"',
            'kind = "voicecoil"',
            "actuator[0] 'vcm': kind must be one of 'voice_coil', 'shaker', 'force', got 'voicecoil'",
        ),
        (
            'kind = "displacement"',
            'kind = "displacment"',
            "sensor[0] 'x' kind: must be one of 'displacement', 'velocity', 'acceleration', "
            "'current', 'voltage', 'force', got 'displacment'",
        ),
        (
            'of = "case"\nnoise',
            'of = "cse"\nnoise',
            "sensor 'x': of = \"cse\" names no body; known: absorber, case",
        ),
        (
            'of = "case"\nnoise',
            'of = "vcm"\nnoise',
            "sensor 'x': of = \"vcm\" names no body; known: absorber, case",
        ),
        (
            'of = "case"\nnoise',
            'of = ["case", "cse"]\nnoise',
            "sensor 'x': of = \"cse\" names no body; known: absorber, case",
        ),
        (
            'of = "case"\nnoise',
            'of = ["case", "case"]\nnoise',
            "sensor 'x': of names 'case' twice; it needs two different bodies",
        ),
        ('of = "case"\nnoise', 'of = ["case"]\nnoise', "sensor[0] 'x' of[1]: missing; the list is too short"),
        ('of = "case"\nnoise', "of = 3\nnoise", "sensor[0] 'x' of: must be text in quotes, got 3"),
        (
            'kind = "displacement"\nof = "case"',
            'kind = "current"\nof = "case"',
            "sensor 'x': of = \"case\" names no actuator; known: push, vcm",
        ),
        (
            'kind = "displacement"\nof = "case"',
            'kind = "current"\nof = "push"',
            "sensor 'x': a force actuator has no current",
        ),
        (
            'kind = "displacement"\nof = "case"',
            'kind = "force"\nof = ["vcm", "push"]',
            "sensor 'x': a force is of one actuator, not of a pair",
        ),
        (
            "noise_density = 1e-8",
            'noise_density = 1e-8\nrecorded_as = "y[0"',
            'sensor[0] \'x\' recorded_as: must be "array", "array:unit" or "array[:,2]:unit", got \'y[0\'',
        ),
        ("stroke_m = 0.01", "strok_m = 0.01", "limits.strok_m is no limit of this plant; " + LIMITS),
        (
            "stroke_m = 0.01",
            "shaker_current_a = 1.0",
            "limits.shaker_current_a is no limit of this plant; " + LIMITS,
        ),
        (
            "stroke_m = 0.01",
            'stroke_m = 0.01\n[[fitted_on]]\nrecording = "r"\nfirst_row = 10\nlast_row = 5',
            "fitted_on[0]: last_row 5 must be after first_row 10",
        ),
        (
            "stroke_m = 0.01",
            'stroke_m = 0.01\n[[fitted_on]]\nrecording = "r"\nfirst_row = 1.5\nlast_row = 5',
            "fitted_on[0] first_row: must be a whole number, got 1.5",
        ),
        (
            "stroke_m = 0.01",
            'stroke_m = 0.01\n[fitted_on]\nrecording = "r"',
            "fitted_on: must be written in double brackets, [[fitted_on]]",
        ),
    ],
)
def test_plant_that_does_not_hang_together(old: str, new: str, message: str) -> None:
    assert told(with_change(old, new)) == message


def test_shaker_driven_by_voltage_needs_its_circuit() -> None:
    text = TEXT.replace("resistance_ohm = 3.0\ninductance_h = 0.002\n", "")
    assert told(text.replace('"voice_coil"', '"shaker"')) == (
        "actuator[0] 'vcm': a voltage-driven shaker needs resistance_ohm and inductance_h "
        '(or say drive = "current" for an ideal current source)'
    )
    current = text.replace('"voice_coil"', '"shaker"\ndrive = "current"')
    assert parse_toml(current, Plant, "p").find_actuator("vcm").input_unit == "A"
    probe = '[[sensor]]\nname = "v"\nkind = "voltage"\nof = "vcm"\nnoise_density = 1.0\n'
    assert told(current + probe.replace("[limits]", "")) == (
        "sensor 'v': the voltage of a current-driven shaker is not modelled"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "p"', "body: missing; add at least one [[body]]"),
        ('name = "p"\nbody = []', "body: is empty; add at least one [[body]]"),
        ('name = "p"\nbody = 3', "body: must be written in double brackets, [[body]]"),
        ('name = "p"\n[body]\nname = "c"', "body: must be written in double brackets, [[body]]"),
        ('name = "p"\nbody = [3]', "body[0]: must be a table of keys and values, got 3"),
        ("garbage", "not valid TOML: Expected '=' after a key in a key/value pair (at end of document)"),
        ("a = 1\na = 2", "not valid TOML: Cannot overwrite a value (at end of document)"),
        ("a = " + "[" * 20_000, "not valid TOML: nested too deeply"),
        (
            "a = " + "1" * 5000,
            "not valid TOML: Exceeds the limit (4300 digits) for integer string conversion",
        ),
    ],
)
def test_file_that_is_no_plant(text: str, message: str) -> None:
    assert told(text).startswith(message)


# --- what the models answer -----------------------------------------------------------------------------


def test_damping_table_is_linear_between_points_and_held_beyond() -> None:
    table = DampingTable(frequency_hz=(45.0, 50.0, 55.0), ns_m=(14.5, 13.5, 7.3))
    assert [table.at(f) for f in (40.0, 45.0, 47.5, 52.5, 60.0)] == pytest.approx(
        [14.5, 14.5, 14.0, 10.4, 7.3]
    )


def test_damping_against_frequency_is_not_read_without_one() -> None:
    table = DampingTable(frequency_hz=(45.0, 55.0), ns_m=(14.0, 7.0))
    plant = load_plant("rig").with_damping("absorber", table)
    assert plant.body[1].damping_at(50.0) == 10.5
    with pytest.raises(ValueError, match=r"'absorber' has damping against frequency: say at which"):
        plant.body[1].damping_at(None)
    assert plant.fingerprint != load_plant("rig").fingerprint
    assert Plant.model_validate(plant.model_dump()) == plant


def test_names_that_are_not_there_are_key_errors() -> None:
    plant = load_plant("rig")
    with pytest.raises(KeyError):
        plant.find_body("nobody")
    with pytest.raises(KeyError):
        plant.find_actuator("nothing")
    with pytest.raises(KeyError):
        plant.with_damping("nobody", 1.0)


def test_absorber_is_what_the_coil_pushes_or_else_what_hangs_on_the_primary() -> None:
    text = (
        TEXT
        + '\n[[body]]\nname = "b"\nmass_kg = 1.0\nattached_to = "case"\nstiffness_n_m = 1.0\ndamping_ns_m = 0.0\n'
    )
    for place, expected in (
        ('between = ["case", "b"]', "b"),
        ('between = ["ground", "b"]', "b"),
        ('between = ["ground", "case"]', "absorber"),
        ('on = "b"', "b"),
        ('on = "case"', "absorber"),
    ):
        plant = parse_toml(text.replace('between = ["case", "absorber"]', place), Plant, "p")
        assert plant.absorber is not None
        assert plant.absorber.name == expected
    assert load_plant("shaker_v721").absorber is None
    assert load_plant("shaker_v721").voice_coil is None


def test_input_units_follow_the_drive() -> None:
    coil = {
        "name": "c",
        "between": ("a", "b"),
        "kind": "voice_coil",
        "resistance_ohm": 1.0,
        "inductance_h": 1.0,
        "force_constant_n_a": 1.0,
    }
    assert VoiceCoil.model_validate(coil).input_unit == "V"
    assert VoiceCoil.model_validate(coil | {"current_loop_kp_v_a": 1.0}).input_unit == "A"
    force = {"name": "f", "on": "a", "kind": "force"}
    assert ForceActuator.model_validate(force).input_unit == "N"
    assert ForceActuator.model_validate(force | {"force_constant_n_v": 1.0}).input_unit == "V"


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("mass_kg", "kg"), ("ns_m", "Ns/m"), ("damping_ns_m", "Ns/m"), ("stiffness_n_m", "N/m"), ("stroke_m", "m"),
        ("force_constant_n_a", "N/A"), ("force_constant_n_v", "N/V"), ("current_loop_kp_v_a", "V/A"),
        ("vcm_current_a", "A"), ("vcm_voltage_v", "V"), ("vcm_power_w", "W"), ("push_force_n", "N"),
        ("inductance_h", "H"), ("sample_rate_hz", "Hz"), ("disturbance_density_n", "N/√Hz"), ("name", None),
        ("kind", None), ("of", None),
    ],
)  # fmt: skip
def test_key_states_its_unit(key: str, unit: str | None) -> None:
    assert unit_of(key) == unit


def test_every_limit_of_every_preset_ends_in_its_unit() -> None:
    for name in preset_names():
        for key, unit in load_plant(name).limit_units.items():
            assert unit_of(key) == unit


def test_models_can_be_built_in_code_as_well() -> None:
    body = Body(name="a", mass_kg=1.0, attached_to="ground", stiffness_n_m=1.0, damping_ns_m=0.0)
    rows = FittedOn(recording="r.npz", first_row=0, last_row=10)
    plant = Plant(name="p", body=(body,), fitted_on=(rows,))
    assert plant.fitted_on[0].last_row == 10
    assert natural_frequencies_hz(plant) == pytest.approx([1.0 / (2.0 * np.pi)])
