"""Plants for property tests, and closed loops written out without the code under test."""

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from twin.plant.analogue import Feedback
from twin.plant.config import Body, ForceActuator, Plant, Sensor, Shaker
from twin.plant.linear import linear_model


@st.composite
def trees(draw: st.DrawFn, min_bodies: int = 1) -> Plant:
    """Bodies on bodies in any order, pushed by forces and by current-driven coils."""
    n = draw(st.integers(min_bodies, 6))
    bodies = [
        Body(
            name=f"b{i}",
            mass_kg=draw(st.floats(0.1, 50.0)),
            attached_to=draw(st.sampled_from(["ground", *(f"b{j}" for j in range(i))])),
            stiffness_n_m=draw(st.floats(1.0, 1e5)),
            damping_ns_m=draw(st.floats(0.1, 50.0)),
        )
        for i in range(n)
    ]
    actuators = [draw(actuator(f"a{i}", [b.name for b in bodies])) for i in range(draw(st.integers(1, 3)))]
    return Plant(name="tree", body=tuple(draw(st.permutations(bodies))), actuator=tuple(actuators))


@st.composite
def actuator(draw: st.DrawFn, name: str, bodies: list[str]) -> ForceActuator | Shaker:
    places = draw(st.permutations([*bodies, "ground"]))
    place = (
        {"on": draw(st.sampled_from(bodies))}
        if draw(st.booleans())
        else {"between": (places[0], places[1])}
    )  # fmt: skip
    gain = draw(st.none() | st.floats(0.01, 100.0))
    if gain is not None and draw(st.booleans()):
        return Shaker(name=name, kind="shaker", drive="current", force_constant_n_a=gain, **place)
    return ForceActuator(name=name, kind="force", force_constant_n_v=gain, **place)


def with_velocities(plant: Plant) -> Plant:
    """The plant with every body's velocity as its sensors, in the order of the bodies."""
    sensors = tuple(
        Sensor(name=f"v_{b.name}", kind="velocity", of=b.name, noise_density=1.0) for b in plant.body
    )
    return plant.model_copy(update={"sensor": sensors})


def closed_loop(
    plant: Plant, law: Feedback, **options: object
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A and B under ``f = alpha x_r'' + beta x_r' + gamma x_r``, solved for f where alpha makes it implicit."""
    push = ForceActuator(name="law_force", kind="force", between=(law.first, law.second))
    model = linear_model(plant.model_copy(update={"actuator": (*plant.actuator, push)}), **options)
    row = {name: np.array([s == name for s in model.states], dtype=float) for name in model.states}
    x_r = row[f"x_{law.first}"] - row[f"x_{law.second}"]
    v_r = row[f"v_{law.first}"] - row[f"v_{law.second}"]
    a_r, a_r_u = v_r @ model.A, v_r @ model.B
    implicit = 1.0 - law.alpha_h * a_r_u[-1]
    f_x = (law.alpha_h * a_r + law.beta_ohm * v_r + law.gamma_1_f * x_r) / implicit
    f_u = law.alpha_h * a_r_u[:-1] / implicit
    column = model.B[:, -1]
    return model.A + np.outer(column, f_x), model.B[:, :-1] + np.outer(column, f_u)
