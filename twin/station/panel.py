"""What the operator page shows of a frame: plain data, finite, small, with what is wrong in words."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from tuning.retune import TuningGoal
from tuning.types import Powers
from twin.rig.gateway import RigGateway
from twin.station.alarms import AlarmState, AlarmWatch
from twin.station.audit import AuditPoint
from twin.station.frame import ROUTINE, Frame
from twin.station.session import Session

LOG_ROWS = 500
LATELY_S = 60.0
"""Trouble on the wire is worth a mark for so long; the counts stay."""

STATION_LOST = "station lost: control off"
STATION_LOST_WORDS = (
    "the rig was without a station and has switched its control off; Control on lets it act again"
)

TIGHT_SHARE = 0.7
"""A loop that needs more of a block's time than this is near its end."""


def finite(value: float | None, digits: int = 6) -> float | None:
    """Rounded to so many significant digits; None where it is no number."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


@dataclass(frozen=True, slots=True)
class WireState:
    """What the wire is doing."""

    lost: int = 0
    late: int = 0
    repeated: int = 0
    reordered: int = 0
    malformed: int = 0
    restarts: int = 0
    drift_ppm: float | None = None
    notice: str = ""


def wire_state(gateway: RigGateway) -> WireState:
    """Read it off a connection."""
    c, ppm = gateway.counts, gateway.drift.ppm
    return WireState(
        lost=c.lost,
        late=c.late,
        repeated=c.repeated,
        reordered=c.reordered,
        malformed=gateway.malformed,
        restarts=gateway.restarts,
        drift_ppm=ppm if math.isfinite(ppm) else None,
        notice=gateway.notice,
    )


@dataclass(slots=True)
class Panel:
    """Turns frames into rows of the log and a dictionary that is replaced as a whole.

    Attributes
    ----------
    state
        The latest, see `take`; never changed once it is there.
    log
        Rows with rising ``seq``.
    """

    session: Session
    state: dict[str, Any] = field(default_factory=dict)
    log: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=LOG_ROWS))
    _seq: int = 0
    _watch: AlarmWatch = field(init=False)
    _loads: deque[float] = field(default_factory=lambda: deque(maxlen=20))
    _sent: dict[str, Any] | None = None
    _refusal: dict[str, Any] | None = None
    _acknowledged: int = 0
    _audit: AuditPoint | None = None
    _troubles: tuple[int, float] = (0, -math.inf)

    def __post_init__(self) -> None:
        self._watch = AlarmWatch(self.session.plant)

    def jumped(self, time_s: float) -> None:
        """Forget what does not go on after a jump in a recording."""
        self._watch.restart()
        self._sent, self._audit = None, None
        self.add(time_s, "info", "the replay jumped here")

    def take(self, frame: Frame, in_loop_s: float, wire: WireState, unseen: int) -> None:
        """Show one frame."""
        block, session = frame.block, self.session
        retuning = session.retuning
        self._note(frame)
        if frame.audited is not None:
            self._audit = frame.audited
        goal = session.settings.goal if retuning is None else retuning.goal
        if goal.budget_kind != self._watch.kind:
            self._watch = AlarmWatch(session.plant, goal.budget_kind)
        alarm = self._watch.take(frame.performance)
        length_s = block.n_samples / block.sample_rate_hz
        self._loads.append(in_loop_s / length_s)
        load = sum(self._loads) / len(self._loads)
        learner = None
        if frame.curve is not None and frame.phasors is not None:
            learner = {
                "status": frame.curve.status,
                "progress": finite(frame.curve.progress),
                "reason": frame.curve.reason,
            }
        self.state = {
            "sample": block.end_sample,
            "time_s": finite(block.end_s, 9),
            "plant": session.plant.name,
            "config_id": block.config_id or session.plant.fingerprint,
            "model_id": session.identified_plant().fingerprint,
            "wire": self._wire(wire, block.end_s),
            "load": finite(load, 3),
            "unseen": unseen,
            "health": {
                "verdict": frame.health.verdict,
                "channel": frame.health.channel,
                "reason": frame.health.reason,
            },
            "learner": learner,
            "control_on": block.control_on,
            "excitation_hz": None if frame.phasors is None else finite(frame.phasors.frequency_hz),
            "excitation": self._excitation(frame),
            "performance": self._performance(frame),
            "goal": goal_figures(goal),
            "approve": None if retuning is None else retuning.approve,
            "standing": self._standing(),
            "can_revert": retuning is not None and retuning.can_revert,
            "sent": self._sent,
            "refusal": self._refusal,
            "acknowledged": self._acknowledged,
            "audit": None if self._audit is None else audit_figures(self._audit),
            "alarms": self._alarms(frame, load, wire, alarm),
            # At every start the rig has been without a station for a while: no alarm, but to be known.
            "notices": [STATION_LOST_WORDS] if wire.notice == STATION_LOST else [],
        }

    def _wire(self, wire: WireState, now_s: float) -> dict[str, Any]:
        """What the wire did, and whether something was amiss lately."""
        troubles = wire.lost + wire.late + wire.malformed
        if troubles > self._troubles[0]:
            self._troubles = (troubles, now_s)
        found = {name: getattr(wire, name) for name in WireState.__slots__}
        return found | {"lately": now_s - self._troubles[1] < LATELY_S}

    def _excitation(self, frame: Frame) -> dict[str, Any] | None:
        """Peak of what excites, in its own unit: what a what-if may override."""
        p = frame.phasors
        if p is None:
            return None
        unit = next((c.unit for c in self.session.channels if c.name == p.reference), "")
        return {"peak": finite(abs(p.amplitude[p.channels.index(p.reference)]), 4), "unit": unit}

    def _performance(self, frame: Frame) -> dict[str, Any] | None:
        p = frame.performance
        if p is None:
            return None
        return {
            "displacement_m": finite(p.displacement_m),
            "passive_m": finite(p.passive_m),
            "limit_m": finite(p.limit_m),
            "current_peak_a": finite(p.current_peak_a),
            "power_w": finite(self._watch.spent_w),
            **power_figures(p.powers),
        }

    def _standing(self) -> dict[str, Any] | None:
        retuning = self.session.retuning
        if retuning is None or not retuning.standing:
            return None
        number, standing = list(retuning.standing.items())[-1]
        hz = [p.frequency_hz for _, p in standing.proposal.points]
        return {"number": number, "from_hz": min(hz), "to_hz": max(hz), "points": len(standing.steps)}

    def _alarms(self, frame: Frame, load: float, wire: WireState, alarm: tuple[AlarmState, str]) -> list[str]:
        found = []
        if wire.notice and wire.notice != STATION_LOST:
            found.append(f"Rig: {wire.notice}")
        if frame.health.verdict in ("diverged", "no data"):
            found.append(f"Model {frame.health.verdict}: {frame.health.reason}")
        if load > TIGHT_SHARE:
            found.append(f"The loop needs {100 * load:.0f} % of a block's time")
        state, words = alarm
        if state != "none":
            found.append(
                f"{'Power over budget' if state == 'over budget' else 'Current at its limit'}: {words}"
            )
        return found

    def _note(self, frame: Frame) -> None:
        block = frame.block
        for event in frame.events:
            self.add(event.sample / block.sample_rate_hz, event.level, event.text)
        for d in frame.decisions:
            if d.reason not in ROUTINE:
                word = "taken" if d.accepted else "declined"
                self.add(d.sample / block.sample_rate_hz, "decision", f"{word} ({d.by}): {d.reason}")
        for command in frame.commands:
            self._sent = {"command_id": command.command_id, "state": "sent", "due": command.apply_at_sample}
            if command.schedule is not None:
                self._audit = None
        for answer in frame.acknowledgements:
            at = answer.applied_at_sample
            if answer.accepted:
                self._acknowledged = max(self._acknowledged, answer.command_id)
                words = f"command {answer.command_id} acknowledged at sample {at}"
                self.add(block.start_s, "decision", words)
            else:
                self._refusal = {"command_id": answer.command_id, "reason": answer.reason}
            if self._sent is not None and self._sent["command_id"] == answer.command_id:
                state = "acknowledged" if answer.accepted else "refused"
                self._sent = {**self._sent, "state": state, "at_sample": at, "reason": answer.reason}

    def add(self, time_s: float, level: str, text: str) -> None:
        """Append a row, stamped with model and configuration."""
        self._seq += 1
        self.log.append({
            "seq": self._seq,
            "time_s": finite(time_s, 9),
            "level": level,
            "text": text,
            "model_id": self.state.get("model_id", ""),
            "config_id": self.state.get("config_id", ""),
        })  # fmt: skip


def goal_figures(goal: TuningGoal) -> dict[str, Any]:
    """Return the goal, for the page."""
    return {
        "budget_w": goal.budget_w,
        "budget_kind": goal.budget_kind,
        "modulus_margin": goal.modulus_margin,
        "displacement_m": goal.displacement_m,
    }


def power_figures(powers: Powers) -> dict[str, Any]:
    """All three powers [W]."""
    return {
        "joule_mean_w": finite(powers.joule_mean_w),
        "joule_peak_w": finite(powers.joule_peak_w),
        "electrical_mean_w": finite(powers.electrical_mean_w),
    }


def audit_figures(point: AuditPoint) -> dict[str, Any]:
    """Predicted beside achieved."""
    return {
        "sample": point.sample,
        "frequency_hz": finite(point.frequency_hz),
        "displacement_m": [finite(v) for v in point.displacement_m],
        "joule_mean_w": [finite(v) for v in point.joule_mean_w],
        "floor_m": finite(point.floor_m),
    }
