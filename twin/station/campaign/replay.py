"""One case again, alone: the whole simulated rig with the twin beside it, recorded."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tuning.loop import RigModel
from tuning.retune import TuningGoal
from twin.plant.blocks import make_block
from twin.plant.config import DampingTable, Plant
from twin.plant.discrete import DiscreteModel
from twin.plant.errors import InputError
from twin.plant.linear import LinearModel
from twin.rig.programme import Programme
from twin.rig.simulated import SimulatedRig
from twin.station.campaign.cases import Campaign, Drawn, block_samples, drawn_case, run_job
from twin.station.campaign.cases import Job as Piece

NEVER = 10**9


class CaseRig(SimulatedRig):
    """The simulated rig of a case: a delay of any length, and noise only where the campaign has it.

    Parameters
    ----------
    programme
        As `case_programme` makes it.
    drawn
        The case.
    """

    def __init__(self, programme: Programme, drawn: Drawn, *, keep_truth: bool = False) -> None:
        super().__init__(programme, keep_truth=keep_truth)
        facts = drawn.case.facts
        # With parts of a sample the converter changes between two samples, see `RigModel.stepping`.
        self._facts = facts if facts.delay_fraction > 0.0 or facts.delay_samples == 0 else None
        if self._facts is not None:
            self._delay_line = np.zeros(facts.delay_samples + 1)
        if drawn.case.noise_seed is None:
            self._noise_std = np.zeros_like(self._noise_std)

    def _stepping(self, model: LinearModel, frequency_hz: float) -> DiscreteModel:
        discrete = super()._stepping(model, frequency_hz)
        if self._facts is None:
            return discrete
        coil = self._coil_input
        stepped = RigModel(self._plant, self._facts, frequency_hz).stepping()
        B0, B1 = discrete.B0.copy(), discrete.B1.copy()
        B0[:, coil], B1[:, coil] = stepped.B0[:, coil], stepped.B1[:, coil]
        return replace(discrete, B0=B0, B1=B1)


def case_programme(campaign: Campaign, drawn: Drawn) -> Programme:
    """What the simulated rig is told to do in a case."""
    spec, case = campaign.spec, drawn.case
    excitation = spec.excitation[spec.combinations[drawn.number // spec.draws][2]]
    absorber = case.plant.absorber
    if absorber is None:
        raise InputError(f"plant '{case.plant.name}' has no absorber")
    damping = absorber.damping_ns_m
    if not isinstance(damping, DampingTable):
        damping = DampingTable(frequency_hz=(1.0, 1000.0), ns_m=(damping, damping))
    return Programme(
        plant=case.plant,
        true_damping=damping,
        sweep=excitation.model_copy(update={f"amplitude_{excitation.unit.lower()}": case.amplitude}),
        schedule=case.schedule,
        measurement=spec.measurement,
        sample_rate_hz=spec.sample_rate_hz,
        block_samples=block_samples(spec),
        loop_delay_samples=max(1, case.facts.delay_samples),
        disturbance_density_n=0.0,
        seed=case.noise_seed or 0,
    )


def _model_of(drawn: Drawn, programme: Programme) -> Plant:
    """What the twin starts from: the case's plant, with one damping, as it learns the curve itself."""
    plant, absorber = drawn.case.plant, drawn.case.plant.absorber
    if absorber is None or not isinstance(absorber.damping_ns_m, DampingTable):
        return plant
    at = programme.sweep.frequency_at(0, programme.sample_rate_hz)
    return plant.with_damping(absorber.name, absorber.damping_at(at))


def replay_case(
    campaign: Campaign,
    number: int,
    recording: Path | None,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Run one case on the simulated rig with the twin beside it.

    Parameters
    ----------
    recording
        File to write; None for none.

    Returns
    -------
    dict
        The case's ``row`` as the campaign has it, and figures of the twin's session.

    Raises
    ------
    InputError
        If there is no such case.
    """
    from twin.station.outputs import Outputs
    from twin.station.retuning import RetuningSettings
    from twin.station.session import Session, SessionSettings
    from twin.station.summary import RunLog

    spec = campaign.spec
    drawn = drawn_case(campaign, number)
    combination, draw = divmod(number, spec.draws)
    row = run_job(campaign, Piece(0, combination, draw, draw + 1))[0]
    programme = case_programme(campaign, drawn)
    rig = CaseRig(programme, drawn)
    goal = TuningGoal(budget_kind=spec.budget_kind)
    if row["budget_w"] is not None:
        goal = replace(goal, budget_w=row["budget_w"])
    # The twin watches and proposes nothing: what the case's own schedule does is what is asked.
    settings = SessionSettings(
        loop=drawn.case.facts,
        schedule=drawn.case.schedule,
        goal=goal,
        retuning=RetuningSettings(every_blocks=NEVER),
    )
    session = Session(_model_of(drawn, programme), rig.channels, spec.sample_rate_hz, settings)
    log = RunLog()
    with Outputs(
        session,
        recording=recording,
        setup=f"# Case {number} of campaign {spec.name}\n\n"
        + "\n".join(f"- {name}: {value:.6g}" for name, value in drawn.parameters.items()),
        run_config_json=json.dumps(
            {"programme": programme.model_dump(mode="json"), "session": session.configuration()}
        ),
        seed=programme.seed,
    ) as outputs:
        if outputs.moved_aside is not None:
            say(f"{recording} was there already; kept as {outputs.moved_aside}")
        session.warm_up()
        while not rig.finished:
            first = rig.next_sample
            values, on, answers = rig.next_block()
            block = make_block(first, spec.sample_rate_hz, values, rig.channels, control_on=on)
            frame = session.advance(block, tuple(answers))
            outputs.take(frame)
            log.add(frame)
            progress(log.blocks, programme.n_blocks)
        outputs.finish()
    return {
        "case": number,
        "row": row,
        "session": log.figures(truth=programme.true_damping),
        "tripped": rig.tripped,
        "recording": None if recording is None else str(recording),
    }
