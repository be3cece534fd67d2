"""The operator's desk: between a page that may do anything at any time and a loop that never waits for it."""

import contextlib
import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from estimators.types import DampingCurve
from tuning.changes import Changes
from tuning.whatif import Curves
from twin.control.schedule import Command
from twin.plant.errors import InputError
from twin.station.frame import Frame
from twin.station.instant import instant_at
from twin.station.orders import OFF_ID_STEP, Order
from twin.station.panel import Panel, WireState
from twin.station.playback import Playback, Wish
from twin.station.proposals import REVIEW_S, Reviewed, review_of_standing, review_of_what_if
from twin.station.run import Link
from twin.station.session import Session
from twin.station.whatif_process import BRANCH_STEP, Asked, Base, WhatIfProcess, WhatIfProposal

ORDERS, REFUSALS, PROPOSALS = 16, 20, 20
ARMED_S = 15.0
STALE_S = 5.0
"""An order given by somebody who saw older data than this is not taken."""

LEFT_S = 3.0
"""A browser that is gone for no longer may be loading the page anew."""

HISTORY_FRAMES, TRACE_BLOCKS = 10, 100
CURVE_POINTS = 11


class RefusedError(Exception):
    """An order is not taken; the message says why."""

    def __init__(self, reason: str, status: int = 409) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(slots=True)
class _Armed:
    reviewed: Reviewed
    code: str
    until_s: float


@dataclass(slots=True)
class Desk:
    """Takes orders in, hands them to the loop one per block, and keeps what the page shows.

    Attributes
    ----------
    session
        Whose run it is.
    link
        To the rig, for what must not wait for the loop; None where nothing can be sent.
    wire
        Tells how the connection does.
    unseen
        Tells how many frames the viewer could not take.
    viewer_url
        Of Rerun's viewer, to be shown beside the controls.
    playback
        Plays the recording, where this is one; None for a rig.
    """

    session: Session
    link: Link | None = None
    wire: Callable[[], WireState] = WireState
    unseen: Callable[[], int] = int
    viewer_url: str = ""
    playback: Playback | None = None
    panel: Panel = field(init=False)
    what_if: WhatIfProcess | None = field(init=False, default=None)
    _orders: deque[Order] = field(default_factory=lambda: deque(maxlen=ORDERS))
    _refusals: deque[str] = field(default_factory=lambda: deque(maxlen=REFUSALS))
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _reviews: dict[int, Reviewed] = field(default_factory=dict)
    _frames: tuple[Frame, ...] = ()
    _trace: deque[tuple[int, list[float]]] = field(default_factory=lambda: deque(maxlen=TRACE_BLOCKS))
    _armed: _Armed | None = None
    _number: int = 0
    _last_off: int = 0
    _shown_s: float = 0.0
    _base: Base | None = None
    _curve: DampingCurve | None = None
    refused_in_all: int = 0
    _over: bool = False
    _watchers: int = 0
    _watched_s: float = -math.inf

    def __post_init__(self) -> None:
        self.panel = Panel(self.session)
        if self.session.settings.loop is not None and self.session.retuning is not None:
            self.what_if = WhatIfProcess()

    # --- the loop's side: never waits ---

    def order(self) -> Order | None:
        """Return the next order, if there is one."""
        try:
            return self._orders.popleft()
        except IndexError:
            return None

    def remarks(self) -> tuple[str, ...]:
        """What was refused since the last call."""
        found = []
        while self._refusals:
            found.append(self._refusals.popleft())
        return tuple(found)

    def show(self, frame: Frame, in_loop_s: float) -> None:
        """Show a frame."""
        self.panel.take(frame, in_loop_s, self.wire(), self.unseen())
        self._frames = (*self._frames[1 - HISTORY_FRAMES :], frame)
        self._curve = frame.curve or self._curve
        estimate = frame.estimate
        name = f"x_{self.session.plant.primary.name}"
        if name in estimate.states:
            column = estimate.mean[BRANCH_STEP - 1 :: BRANCH_STEP, estimate.states.index(name)]
            self._trace.append((frame.block.first_sample, [float(f"{v:.4g}") for v in column]))
        retuning, loop = self.session.retuning, self.session.settings.loop
        if retuning is not None and loop is not None and frame.phasors is not None:
            p = frame.phasors
            self._base = Base(
                self.session.identified_plant(), loop, retuning.schedule, retuning.goal,
                float(abs(p.amplitude[p.channels.index(p.reference)])),
                self.session.damping_std_at(p.frequency_hz),
            )  # fmt: skip
        self._shown_s = time.monotonic()

    def jumped(self, session: Session, time_s: float) -> None:
        """Go on with another session, whose frames do not follow those shown before."""
        self.session = self.panel.session = session
        self._frames, self._curve = (), None
        self._trace.clear()
        self.panel.jumped(time_s)

    def end(self) -> None:
        """Say that the run is over: what was is still shown, and nothing can be sent."""
        self.link, self._over = None, True

    # --- the page's side ---

    @contextlib.contextmanager
    def watcher(self) -> Iterator[None]:
        """Somebody looks at the page meanwhile."""
        with self._lock:
            self._watchers += 1
        try:
            yield
        finally:
            with self._lock:
                self._watchers -= 1
                self._watched_s = time.monotonic()

    def is_watched(self) -> bool:
        """Whether somebody looks at the page, or did so a moment ago."""
        return self._watchers > 0 or time.monotonic() - self._watched_s < LEFT_S

    def play(self, wish: Wish) -> None:
        """Have the recording played, paused, moved."""
        if self.playback is None:
            raise RefusedError("this is a rig and no recording: it cannot be played")
        self.playback.ask(wish)

    @property
    def read_only(self) -> bool:
        """Whether nothing can be sent: a recording."""
        return self.link is None

    def refuse(self, reason: str) -> None:
        """Have the log say that something was refused; a flood of refusals is counted, not kept."""
        self.refused_in_all += 1
        if self.refused_in_all <= 100 or self.refused_in_all % 1000 == 0:
            more = "" if self.refused_in_all <= 100 else f" ({self.refused_in_all} refusals in all)"
            self._refusals.append(f"page: {reason}{more}")

    def state(self) -> dict[str, Any]:
        """Return what the page shows now."""
        silent = time.monotonic() - self._shown_s if self._shown_s else None
        return {
            **self.panel.state,
            "read_only": self.read_only,
            "over": self._over,
            "silent_s": None if silent is None else round(silent, 2),
            "viewer_url": self.viewer_url,
            "refusals": self.refused_in_all,
            "player": None if self.playback is None else self.playback.state(),
            "what_if": self.what_if is not None and self._base is not None,
        }

    def log_after(self, seq: int) -> list[dict[str, Any]]:
        """Rows of the log after a number."""
        return [row for row in list(self.panel.log) if row["seq"] > seq]

    @property
    def base(self) -> Base:
        """What is known of the rig now; RefusedError while nothing is."""
        base = self._base
        if base is None or self.what_if is None:
            raise RefusedError("no rig with a controller and an excitation is being followed")
        return base

    def curves(self, changes: Changes) -> Iterator[Curves | tuple[int, Any]]:
        """What-if curves, part by part."""
        base, process = self.base, self.what_if
        table = base.schedule.frequency_hz
        n = max(2, min(CURVE_POINTS, len(table)))
        step = (table[-1] - table[0]) / (n - 1)
        frequencies = tuple(round(table[0] + k * step, 6) for k in range(n))
        if process is not None:
            yield from process.ask(Asked("curves", base, changes, frequencies))

    @property
    def damping_curve(self) -> DampingCurve | None:
        """The learned one."""
        return self._curve

    def propose(self, changes: Changes) -> Reviewed:
        """Work out a proposal for the whole table and keep it for review."""
        if (
            changes.damping_ns_m is not None
            or changes.damping_scale is not None
            or changes.excitation is not None
        ):
            raise RefusedError(
                "excitation and c2 are as the rig has them in a proposal; take their overrides off first"
            )
        asked = Asked("propose", self.base, changes)
        found = None if self.what_if is None else self.what_if.last(asked)
        if not isinstance(found, WhatIfProposal):
            raise RefusedError("nothing was worked out; ask again")
        return self._keep(review_of_what_if(found, self._sample()))

    def review(self, standing: int) -> Reviewed:
        """Keep a standing proposal of the twin's own for review."""
        retuning = self.session.retuning
        found = None if retuning is None else retuning.standing.get(standing)
        if found is None:
            raise RefusedError(f"proposal {standing} no longer stands")
        return self._keep(review_of_standing(standing, found, self._sample()))

    def _keep(self, reviewed: Reviewed) -> Reviewed:
        with self._lock:
            self._number += 1
            reviewed.number = self._number
            self._reviews[self._number] = reviewed
            while len(self._reviews) > PROPOSALS:
                del self._reviews[next(iter(self._reviews))]
        return reviewed

    def arm(self, number: int, seen_sample: int) -> str:
        """Arm a reviewed proposal; returns the code that sends it while it is armed."""
        self._may_send(seen_sample)
        with self._lock:
            reviewed = self._reviews.get(number)
            if reviewed is None:
                raise RefusedError(f"there is no proposal {number}; propose again")
            self._still_fits(reviewed)
            self._armed = _Armed(reviewed, secrets.token_hex(8), time.monotonic() + ARMED_S)
            return self._armed.code

    def send(self, number: int, code: str, seen_sample: int) -> None:
        """Send what is armed."""
        self._may_send(seen_sample)
        with self._lock:
            armed, self._armed = self._armed, None
            if armed is None or armed.reviewed.number != number:
                raise RefusedError(f"proposal {number} is not armed")
            if not secrets.compare_digest(armed.code.encode(), code.encode(errors="replace")):
                raise RefusedError("the arming code is another one")
            if time.monotonic() > armed.until_s:
                raise RefusedError(f"armed longer than {ARMED_S:.0f} s ago; arm again")
            self._still_fits(armed.reviewed)
            self._queue(armed.reviewed.order)

    def revert(self, seen_sample: int) -> None:
        """Go back to the gains before."""
        self._may_send(seen_sample)
        if self.session.retuning is None or not self.session.retuning.can_revert:
            raise RefusedError("there are no gains to go back to")
        self._queue(Order(kind="revert"))

    def on(self, seen_sample: int) -> None:
        """Switch control on."""
        self._may_send(seen_sample)
        self._queue(Order(kind="on"))

    def off(self) -> int:
        """Switch control off at once, whatever the loop is doing; returns the command's number."""
        link = self.link
        if link is None:
            raise RefusedError(self._nothing_to_send_to, 403)
        with self._lock:
            retuning = self.session.retuning
            following = 1 if retuning is None else retuning.next_command
            number = max(following, self._last_off + 1) + OFF_ID_STEP
            self._last_off, self._armed = number, None
            self._orders.clear()
            link.send(Command(command_id=number, apply_at_sample=0, control_enabled=False))
            self._orders.append(Order(kind="off", command_id=number))
        return number

    def branch(self, changes: Changes, seconds: float) -> tuple[int, Any]:
        """Run branches of the twin from now; returns the sample they start after, and the traces."""
        base, frames = self.base, self._frames
        instant = instant_at(base.plant, base.facts, frames)
        asked = Asked("branch", base, changes, instant=instant, seconds=seconds)
        found = None if self.what_if is None else self.what_if.last(asked)
        return frames[-1].block.end_sample, found

    def trace(self, from_sample: int, seconds: float) -> list[float]:
        """Measured displacement [m] after a sample, a value every `BRANCH_STEP` samples."""
        rate = self.session.observer.sample_rate_hz
        end = from_sample + seconds * rate
        out: list[float] = []
        for first, values in list(self._trace):
            if from_sample <= first < end:
                out += values
        return out[: round(seconds * rate / BRANCH_STEP)]

    def close(self) -> None:
        """End the process behind it."""
        if self.what_if is not None:
            self.what_if.close()

    def _sample(self) -> int:
        return int(self.panel.state.get("sample", 0))

    @property
    def _nothing_to_send_to(self) -> str:
        what = "the run is over" if self._over else "this is a recording"
        return f"{what}: nothing can be sent"

    def _queue(self, order: Order) -> None:
        if len(self._orders) >= ORDERS:
            raise RefusedError("too many orders are waiting: the loop is busy", 503)
        self._orders.append(order)

    def _may_send(self, seen_sample: int) -> None:
        if self.link is None:
            raise RefusedError(self._nothing_to_send_to, 403)
        if self.session.retuning is None:
            raise RefusedError("the rig runs no controller that could take orders")
        behind_s = (self._sample() - seen_sample) / self.session.observer.sample_rate_hz
        if behind_s > STALE_S:
            raise RefusedError(f"stale: the page shows the rig as it was {behind_s:.1f} s ago; reload it")
        if behind_s < -1.0:
            raise RefusedError("stale: the order names a sample that has not been measured yet")

    def _still_fits(self, reviewed: Reviewed) -> None:
        age_s = (self._sample() - reviewed.made_at_sample) / self.session.observer.sample_rate_hz
        if age_s > REVIEW_S:
            raise RefusedError(f"stale: the proposal is {age_s:.0f} s old; propose again")
        base, then = self.base, reviewed.base
        if then is None:
            return
        if base.schedule != then.schedule:
            raise RefusedError("stale: the gains in use have changed since; propose again")
        ours, theirs = base.plant.absorber, then.plant.absorber
        limit = self.session.settings.retuning.outdated_ns_m
        for f in base.schedule.frequency_hz:
            if ours is not None and theirs is not None:
                moved = abs(ours.damping_at(f) - theirs.damping_at(f))
                if moved > limit:
                    raise RefusedError(
                        f"stale: the damping at {f:g} Hz has moved by {moved:.2f} Ns/m; propose again"
                    )


def parse_changes(given: dict[str, Any]) -> Changes:
    """Read what the page asks for.

    Raises
    ------
    InputError
        If a key is unknown or a value cannot be used.
    """
    for key, value in given.items():
        if key != "budget_kind" and not (value is None or isinstance(value, float | int)):
            raise InputError(f"{str(key)[:40]}: '{str(value)[:40]}' is no number")
    try:
        return Changes(**{str(k): v for k, v in given.items() if k != "coil" and v is not None})
    except TypeError as error:
        raise InputError(f"the changes cannot be read: {error}") from error
