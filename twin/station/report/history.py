"""What happened in a run, in order: events, proposals with what became of them, masked samples, orders, commands."""

import math
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any

from estimators.signal_check import Finding
from tuning.types import Proposal
from twin.station.audit import AuditPoint
from twin.station.frame import ROUTINE, Decision, Frame
from twin.station.session import Session


@dataclass(slots=True)
class History:
    """Collects frame by frame.

    Attributes
    ----------
    events
        Dictionaries with time_s, level and text.
    proposals
        Dictionaries of all proposals and orders that a decision was made of; of proposals that changed too little, the
        number alone is kept, in ``routine``.
    commands
        By identifier: due_s, then what the rig answered.
    audit
        Predicted against achieved.
    faults
        By channel and kind: blocks, samples, from_s, to_s, the last value.
    """

    events: list[dict[str, Any]] = field(default_factory=list)
    proposals: list[dict[str, Any]] = field(default_factory=list)
    routine: Counter[str] = field(default_factory=Counter)
    commands: dict[int, dict[str, Any]] = field(default_factory=dict)
    audit: list[AuditPoint] = field(default_factory=list)
    faults: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)

    def add(self, session: Session, frame: Frame) -> None:
        """Take one frame in."""
        rate = frame.block.sample_rate_hz
        for e in frame.events:
            self.events.append({"time_s": e.sample / rate, "level": e.level, "text": e.text})
        for finding in frame.checked.findings:
            self._masked(finding, frame.block.start_s, frame.block.end_s)
        if frame.audited is not None:
            self.audit.append(frame.audited)
        if frame.decision is not None:
            self._decided(session, frame, frame.decision, frame.proposal)
        if frame.ordered is not None:
            order = frame.ordered.order
            entry = self._entry(frame, frame.ordered.decision)
            entry["what"] = "a further step of an order" if order is None else f"order: {order.kind}"
            entry["note"] = "" if order is None else order.note
            command = frame.ordered.command
            entry["command_id"] = None if command is None else command.command_id
            if order is not None and order.goal is not None:
                entry["budget_w"], entry["budget_kind"] = order.goal.budget_w, order.goal.budget_kind
            self.proposals.append(entry)
        for command in frame.commands:
            self.commands[command.command_id] = {
                "command_id": command.command_id,
                "sent_s": frame.block.end_s,
                "due_s": command.apply_at_sample / rate,
                "control_enabled": command.control_enabled,
                "new_gains": command.schedule is not None,
                "answer": None,
                "applied_s": None,
            }
        for answer in frame.acknowledgements:
            known = self.commands.get(answer.command_id)
            if known is not None:
                known["answer"] = "accepted" if answer.accepted else f"refused: {answer.reason}"
                at = answer.applied_at_sample
                known["applied_s"] = None if at is None else at / rate

    def _masked(self, f: Finding, from_s: float, to_s: float) -> None:
        entry = self.faults.setdefault(
            (f.channel, f.kind),
            {
                "channel": f.channel,
                "kind": f.kind,
                "blocks": 0,
                "samples": 0,
                "from_s": from_s,
                "unit": f.unit,
            },
        )
        entry["blocks"] += 1
        entry["samples"] += f.samples
        entry["to_s"] = to_s
        entry["value"] = f.value if math.isfinite(f.value) else entry.get("value")

    def _decided(self, session: Session, frame: Frame, d: Decision, proposal: Proposal | None) -> None:
        if d.reason in ROUTINE:
            self.routine[d.reason] += 1
            return
        entry = self._entry(frame, d)
        entry["what"] = "proposal"
        entry["command_id"] = None if frame.command is None else frame.command.command_id
        if proposal is not None:
            points = [p for _, p in proposal.points]
            here = min(
                points,
                key=lambda p: abs(p.frequency_hz - (entry["frequency_hz"] or p.frequency_hz)),
                default=None,
            )
            entry |= {
                "model_id": proposal.model_id,
                "feasible": proposal.feasible,
                "budget_w": proposal.budget_w,
                "budget_kind": proposal.budget_kind,
                "points_hz": [p.frequency_hz for p in points],
                "refused_hz": [r.frequency_hz for _, r in proposal.refusals],
                "refusals": list(dict.fromkeys(r.reason for _, r in proposal.refusals)),
            }
            if here is not None:
                entry["nearest"] = {
                    "frequency_hz": here.frequency_hz,
                    "gains": asdict(here.gains),
                    "predicted_displacement_m": here.predicted_displacement_m,
                    "passive_displacement_m": here.passive_displacement_m,
                    "limit_displacement_m": here.limit_displacement_m,
                    **asdict(here.powers),
                    "modulus_margin": here.modulus_margin,
                    "delay_margin_s": here.delay_margin_s,
                    "active_limits": [asdict(a) for a in here.active_limits],
                }
        self.proposals.append(entry)

    @staticmethod
    def _entry(frame: Frame, d: Decision) -> dict[str, Any]:
        hz = None if frame.phasors is None else frame.phasors.frequency_hz
        return {
            "time_s": d.sample / frame.block.sample_rate_hz,
            "frequency_hz": hz,
            "accepted": d.accepted,
            "by": d.by,
            "reason": d.reason,
        }

    def audit_rows(self, rate_hz: float) -> list[dict[str, Any]]:
        """Every point of the audit, with its errors as shares of what was achieved."""
        return [
            {
                "time_s": p.sample / rate_hz,
                "frequency_hz": p.frequency_hz,
                "displacement_m": list(p.displacement_m),
                "joule_mean_w": list(p.joule_mean_w),
                "electrical_mean_w": list(p.electrical_mean_w),
                "floor_m": p.floor_m,
                "displacement_error": p.displacement_error,
                "power_error": p.power_error,
            }
            for p in self.audit
        ]
