"""Where a plant's energy comes from, where it is kept and where it goes, exactly between the samples too.

Every store, loss and source is a quadratic form in state and input. Between two samples inputs are held or joined
by straight lines, so that ``w = (x, u, rise of u)`` obeys ``w' = G w`` and the energy that an element takes over an
interval is the form ``integral of e^(G't) Q e^(Gt) dt`` in what w is at its beginning: worked out once per model, it
costs one product per sample and has no step error. Over any run, whatever law computed the inputs,

    stored at the end - stored at the start = supplied - dissipated.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from twin.plant.config import GROUND, ForceActuator, Plant, VoiceCoil
from twin.plant.discrete import Hold
from twin.plant.linear import Array, linear_model, read_only

ROWS_AT_ONCE = 4096
NODES = 10
"""Of Gauss and Legendre's rule on a stretch in which ``G t`` stays below a half: exact to rounding."""


@dataclass(frozen=True, slots=True)
class EnergyBalance:
    """Energies [J] of a run of N intervals between N + 1 samples. Arrays are read-only.

    Attributes
    ----------
    stores, losses, sources
        ``mass_<body>``, ``spring_<body>``, ``inductance_<actuator>``; ``damper_<body>``,
        ``resistance_<actuator>``; the actuators' names.
    stored_j
        (N + 1, n_stores), at the samples.
    dissipated_j
        (N, n_losses), turned to heat during each interval.
    supplied_j
        (N, n_sources), put in during each interval: electrical (v i) where the actuator's circuit is in the
        model, else mechanical.
    """

    stores: tuple[str, ...]
    losses: tuple[str, ...]
    sources: tuple[str, ...]
    stored_j: Array
    dissipated_j: Array
    supplied_j: Array

    @property
    def residual_j(self) -> Array:
        """What is missing since the start, at each sample, (N + 1,): zero but for rounding."""
        given = np.cumsum(self.supplied_j.sum(axis=1) - self.dissipated_j.sum(axis=1))
        stored = self.stored_j.sum(axis=1)
        return np.asarray(stored - stored[0] - np.concatenate([[0.0], given]))

    @property
    def flow_j(self) -> float:
        """Energy that moved: supplied and taken back without regard to sign, dissipated, and the most ever stored."""
        moved = float(np.abs(self.supplied_j).sum() + self.dissipated_j.sum())
        return moved + float(self.stored_j.sum(axis=1).max())

    @property
    def closure(self) -> float:
        """Largest residual against the energy that flowed, dimensionless."""
        flow = self.flow_j
        return float(np.abs(self.residual_j).max() / flow) if flow > 0.0 else 0.0


class EnergyMeter:
    """Energy balance of a plant that is driven by samples.

    Parameters
    ----------
    plant, frequency_hz, damping_ns_m, current_driven
        As `twin.plant.linear.linear_model`.
    sample_rate_hz, holds
        As `twin.plant.discrete.discretise`.
    """

    def __init__(
        self,
        plant: Plant,
        sample_rate_hz: float,
        holds: Sequence[Hold],
        *,
        frequency_hz: float | None = None,
        damping_ns_m: Mapping[str, float] | None = None,
        current_driven: Collection[str] = (),
    ) -> None:
        self.model = linear_model(
            plant, frequency_hz=frequency_hz, damping_ns_m=damping_ns_m, current_driven=current_driven
        )
        size, m = self.model.B.shape
        if len(holds) != m:
            raise ValueError(f"{m} inputs need {m} holds, got {len(holds)}")
        n = len(plant.body)
        row = {name: np.eye(size)[k] for k, name in enumerate(self.model.states)}
        own = dict(damping_ns_m or {})
        stores: dict[str, Array] = {}
        losses: dict[str, Array] = {}
        sources: dict[str, Array] = {}

        def link(kind: str, body: str, other: str) -> Array:
            own_row = row[f"{kind}_{body}"]
            return own_row if other == GROUND else np.asarray(own_row - row[f"{kind}_{other}"])

        for body in plant.body:
            damping = own[body.name] if body.name in own else body.damping_at(frequency_hz)
            stores[f"mass_{body.name}"] = np.sqrt(0.5 * body.mass_kg) * row[f"v_{body.name}"]
            stores[f"spring_{body.name}"] = np.sqrt(0.5 * body.stiffness_n_m) * link(
                "x", body.name, body.attached_to
            )
            rubs = link("v", body.name, body.attached_to)
            losses[f"damper_{body.name}"] = damping * np.outer(rubs, rubs)
        mass = np.array([body.mass_kg for body in plant.body])
        for column, actuator in enumerate(plant.actuator):
            power = np.zeros((size + m, size + m))
            current = row.get(f"i_{actuator.name}")
            if current is None or isinstance(actuator, ForceActuator):
                power[n : 2 * n, size + column] = mass * self.model.B[n : 2 * n, column]
            else:
                resistance, inductance = actuator.resistance_ohm or 0.0, actuator.inductance_h or 0.0
                stores[f"inductance_{actuator.name}"] = np.sqrt(0.5 * inductance) * current
                losses[f"resistance_{actuator.name}"] = resistance * np.outer(current, current)
                # v i, where a current loop makes v = kp (i_ref - i)
                kp = actuator.current_loop_kp_v_a if isinstance(actuator, VoiceCoil) else None
                power[:size, size + column] = (kp or 1.0) * current
                power[:size, :size] = -(kp or 0.0) * np.outer(current, current)
            sources[actuator.name] = 0.5 * (power + power.T)
        self._stores, self._losses, self._sources = tuple(stores), tuple(losses), tuple(sources)
        self._store_rows = np.array(list(stores.values()))
        forms = [_padded(form, size + 2 * m) for form in (*losses.values(), *sources.values())]
        G = np.zeros((size + 2 * m, size + 2 * m))
        G[:size, :size], G[:size, size : size + m] = self.model.A, self.model.B
        G[size : size + m, size + m :] = sample_rate_hz * np.diag([float(hold == "foh") for hold in holds])
        self._forms = _integrals(G, np.array(forms), 1.0 / sample_rate_hz)

    def measure(self, states: Array, inputs: Array) -> EnergyBalance:
        """Energy balance of a run.

        Parameters
        ----------
        states
            (N + 1, n) states at the samples, as `model` names them.
        inputs
            (N + 1, m) inputs at the samples: interval k has ``inputs[k]`` held, or joined to ``inputs[k + 1]``.
        """
        if len(states) != len(inputs) or len(states) < 2:
            raise ValueError(
                f"states and inputs need as many rows, at least 2; got {len(states)} and {len(inputs)}"
            )
        begin = np.hstack([states[:-1], inputs[:-1], np.diff(inputs, axis=0)])
        n_forms, size, _ = self._forms.shape
        side_by_side = np.ascontiguousarray(self._forms.transpose(1, 0, 2).reshape(size, n_forms * size))
        energy = np.empty((len(begin), n_forms))
        for first in range(0, len(begin), ROWS_AT_ONCE):
            w = begin[first : first + ROWS_AT_ONCE]
            turned = (w @ side_by_side).reshape(len(w), n_forms, size)
            energy[first : first + len(w)] = np.einsum("kfi,ki->kf", turned, w)
        return EnergyBalance(
            stores=self._stores,
            losses=self._losses,
            sources=self._sources,
            stored_j=read_only((states @ self._store_rows.T) ** 2),
            dissipated_j=read_only(energy[:, : len(self._losses)]),
            supplied_j=read_only(energy[:, len(self._losses) :]),
        )


def _padded(form: Array, size: int) -> Array:
    out = np.zeros((size, size))
    out[: len(form), : len(form)] = form
    return out


def _integrals(G: Array, forms: Array, dt: float) -> Array:
    """``integral of e^(G't) Q e^(Gt) dt`` from 0 to dt for every form Q, (n_forms, n, n).

    A short stretch by Gauss and Legendre's rule, doubled up to dt: nothing grows that decays in the plant.
    """
    size = float(np.abs(G * dt).sum(axis=0).max())
    doublings = max(0, math.ceil(math.log2(2.0 * size))) if size > 0.0 else 0
    h = dt / 2**doublings
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    total = np.zeros_like(forms)
    for node, weight in zip(nodes, weights, strict=True):
        phi = expm(G * (0.5 * h * (1.0 + node)))
        total += 0.5 * h * weight * (phi.T @ forms @ phi)
    phi = expm(G * h)
    for _ in range(doublings):
        total += phi.T @ total @ phi
        phi = phi @ phi
    return total
