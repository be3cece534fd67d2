"""What active damping asks of a coil: thesis 8.1 to 8.4 written out, and the choice among coils."""

import math

import numpy as np
import pytest

from twin.control.analysis import analyse
from twin.control.requirements import load_catalogue, requirements, select_coils, with_coil
from twin.plant.errors import InputError
from twin.plant.files import load_plant

BAND_HZ = [float(f) for f in range(47, 54)]
ENGINE = load_plant("engine")


@pytest.mark.parametrize("feedback", ["position", "acceleration"])
@pytest.mark.parametrize("hz", BAND_HZ)
def test_force_and_current_follow_the_polynomials_of_chapter_8(feedback, hz):
    # eq. 8-3 to 8-8 with +k² in place of -k²: the back-EMF that conserves energy
    plant = load_plant("engine_vcm")
    (m1, c1, k1), (m2, c2, k2) = ((b.mass_kg, b.damping_at(None), b.stiffness_n_m) for b in plant.body)
    coil = plant.voice_coil
    R, L, k, kp = 3.0, 2.1e-3, 22.2, 200.0
    assert (coil.resistance_ohm, coil.inductance_h, coil.force_constant_n_a) == (R, L, k)
    w = math.tau * hz
    gamma = m2 * w**2 - k2 if feedback == "position" else 0.0
    alpha = k2 / w**2 - m2 if feedback == "acceleration" else 0.0
    beta = -c2
    s = 1j * w
    Z = c2 * s + k2
    law = alpha * s**2 + beta * s + gamma
    top = kp * law + k**2 * s  # force per relative motion, times the circuit's impedance
    lower = (R + kp + s * L) * ((m1 * s**2 + c1 * s + k1) * (m2 * s**2 + Z) + m2 * s**2 * Z) + top * (
        (m1 + m2) * s**2 + c1 * s + k1
    )
    force = 1000.0 * top * m2 * s**2 / lower
    (point,) = analyse(plant, "gain_scheduling", [hz], feedback=feedback, excitation_n=1000.0)
    assert point.actuator_force_n == pytest.approx(abs(force), rel=1e-8)
    assert point.current_a == pytest.approx(abs(force) / k, rel=1e-8)
    assert point.joule_peak_w == pytest.approx(R * (abs(force) / k) ** 2, rel=1e-8)


def test_coil_of_table_8_2_in_the_engine_is_the_preset():
    coil = load_catalogue().coil[1]
    built, preset = with_coil(ENGINE, coil), load_plant("engine_vcm")
    for a, b in zip(built.body, preset.body, strict=True):
        assert a.mass_kg == pytest.approx(b.mass_kg, rel=1e-12)
        assert a.stiffness_n_m == pytest.approx(b.stiffness_n_m, rel=3e-5)
    assert np.sqrt(built.body[1].stiffness_n_m / built.body[1].mass_kg) == pytest.approx(
        np.sqrt(874640.0 / 8.862)
    )


def test_larger_force_constant_is_the_cheaper_coil_and_the_small_one_cannot():
    verdicts = select_coils(
        ENGINE, load_catalogue(), BAND_HZ, excitation_n=1000.0, displacement_limit_m=20e-6, budget_w=50.2
    )
    assert [v.coil.name for v in verdicts] == ["GVCM-095-089-02S06", "thesis Table 8-2", "GVCM-051-051-01"]
    assert [v.meets for v in verdicts] == [True, True, False]
    assert any("continuous power" in s for s in verdicts[2].shortfalls)
    assert verdicts[1].worst.joule_peak_w == pytest.approx(100.23, rel=1e-4)


def test_power_grows_with_the_square_of_the_force_and_the_budget_says_which_power():
    for kind, meets in (("joule_peak", False), ("joule_mean", True)):
        verdicts = select_coils(
            ENGINE,
            load_catalogue(),
            BAND_HZ,
            excitation_n=3000.0,
            displacement_limit_m=20e-6,
            budget_w=120.0,
            budget_kind=kind,
        )
        large = next(v for v in verdicts if v.coil.name.startswith("GVCM-095"))
        assert large.meets is meets
        assert large.worst.joule_peak_w == pytest.approx(166.9, rel=1e-3)
        assert large.worst.joule_mean_w == pytest.approx(83.45, rel=1e-3)


def test_delay_rules_coils_out():
    (verdict, *_) = select_coils(
        ENGINE,
        load_catalogue(),
        [53.0],
        excitation_n=1000.0,
        displacement_limit_m=1.0,
        budget_w=1e6,
        delay_s=1e-3,
    )
    assert "the loop is unstable" in verdict.shortfalls


def test_ideal_force_has_no_power():
    worst = requirements(analyse(ENGINE, "gain_scheduling", BAND_HZ, excitation_n=1000.0))
    assert worst.current_a is worst.joule_peak_w is None
    assert worst.actuator_force_n == pytest.approx(131.7, abs=0.1)
    with pytest.raises(ValueError, match="no operating points"):
        requirements([])


def test_plants_that_cannot_take_a_coil_are_refused():
    coil = load_catalogue().coil[0]
    with pytest.raises(InputError, match="start from the plant without"):
        with_coil(load_plant("rig"), coil)
    with pytest.raises(InputError, match="no absorber"):
        with_coil(load_plant("beam"), coil)


def test_catalogue_of_ones_own(tmp_path):
    path = tmp_path / "coils.toml"
    entry = (
        '[[coil]]\nname = "mine"\nresistance_ohm = 1.0\ninductance_h = 1e-3\nforce_constant_n_a = 9.0\n'
        "coil_mass_kg = 0.1\nbody_mass_kg = 0.5\n"
    )
    path.write_text(entry)
    assert load_catalogue(path).coil[0].name == "mine"
    path.write_text(entry + entry)
    with pytest.raises(InputError, match="two coils are called 'mine'"):
        load_catalogue(path)
    path.write_text(entry.replace("1.0", "-1.0"))
    with pytest.raises(InputError, match="must be greater than 0"):
        load_catalogue(path)
