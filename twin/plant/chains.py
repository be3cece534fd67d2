"""Plants of many bodies by rule: one absorber upon another, or all of them on the primary."""

from collections.abc import Sequence

from twin.plant.config import GROUND, Body, ForceActuator, Plant


def series_chain(
    masses_kg: Sequence[float],
    stiffnesses_n_m: Sequence[float],
    dampings_ns_m: Sequence[float],
    *,
    name: str = "series_chain",
) -> Plant:
    """Each body on the one before it, the first on the ground (thesis eq. 4-17, Figure 4-8).

    Bodies are called m1, m2 and so on, and each has a force on it, f1, f2 and so on [N]. One body is the plain
    oscillator on a spring and a damper.

    Parameters
    ----------
    masses_kg, stiffnesses_n_m, dampings_ns_m
        One of each per body; spring and damper are those towards the ground.

    Raises
    ------
    ValueError
        If the lists differ in length, are empty, or hold a number that no body can have.
    """
    places = [GROUND] + [f"m{i}" for i in range(1, len(masses_kg))]
    return _plant(name, masses_kg, stiffnesses_n_m, dampings_ns_m, places)


def parallel_chain(
    masses_kg: Sequence[float],
    stiffnesses_n_m: Sequence[float],
    dampings_ns_m: Sequence[float],
    *,
    name: str = "parallel_chain",
) -> Plant:
    """The first body on the ground, all others side by side on the first (thesis eq. 4-15, Figure 4-6).

    Names, parameters and errors as `series_chain`.
    """
    places = [GROUND] + ["m1"] * (len(masses_kg) - 1)
    return _plant(name, masses_kg, stiffnesses_n_m, dampings_ns_m, places)


def _plant(
    name: str,
    masses: Sequence[float],
    stiffnesses: Sequence[float],
    dampings: Sequence[float],
    places: Sequence[str],
) -> Plant:
    if not len(masses) == len(stiffnesses) == len(dampings):
        raise ValueError(
            f"{len(masses)} masses, {len(stiffnesses)} stiffnesses and {len(dampings)} dampings; give one of "
            "each per body"
        )
    bodies = tuple(
        Body(name=f"m{i}", mass_kg=m, stiffness_n_m=k, damping_ns_m=c, attached_to=place)
        for i, (m, k, c, place) in enumerate(zip(masses, stiffnesses, dampings, places, strict=False), 1)
    )
    forces = tuple(ForceActuator(name=f"f{i}", kind="force", on=b.name) for i, b in enumerate(bodies, 1))
    return Plant(name=name, body=bodies, actuator=forces)
