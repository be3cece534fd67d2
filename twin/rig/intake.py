"""What a rig says of itself and its samples, made sense of: which run it is, and blocks in order and in SI units.

No socket and no clock: messages come in as frames, with the time of their arrival. What cannot be believed is counted
with a reason and changes nothing: not the run that is followed, nor where it is.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from pydantic import ValidationError

from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import Plant
from twin.plant.errors import RunError
from twin.plant.linear import Array
from twin.rig.arrivals import ArrivalCounts, Arrivals
from twin.rig.complaints import Complaints, first_problem, plain
from twin.rig.drift import ClockDrift
from twin.rig.messages import Hello, SamplesHeader
from twin.rig.units import COMMON, to_si, units_for
from twin.rig.wire import MAX_SAMPLE, decode

ANNOUNCED = 16
"""Runs that were announced and have not been seen: what only says hello is no reason to leave the one that sends."""


@dataclass(slots=True)
class Run:
    """One run of the rig: its own count of samples, and where that count lies in the station's.

    Attributes
    ----------
    channels, factors
        Columns in SI units, and what takes each there.
    offset
        The station's number of the run's sample 0.
    """

    hello: Hello
    channels: tuple[Channel, ...]
    factors: Array
    offset: int = 0
    arrivals: Arrivals = field(default_factory=Arrivals)


class Intake:
    """Follows a rig from run to run.

    Parameters
    ----------
    plant
        Tells the sensors' ranges and units.
    complaints
        Where to what is left out.

    Attributes
    ----------
    run
        The one that is followed; None before the rig is known.
    restarts
        How often the rig began anew.
    notice
        What the rig says of itself, with the latest block; empty if nothing.
    drift
        `ClockDrift` of rig against station.
    events
        What has happened, in words; whoever reads them takes them out.
    """

    def __init__(self, plant: Plant, complaints: Complaints) -> None:
        self._plant, self._complaints = plant, complaints
        self._ranges_by_name = {s.name: s.range for s in plant.sensor if s.range is not None}
        self.run: Run | None = None
        self.restarts = 0
        self.notice = ""
        self.drift = ClockDrift()
        self.events: list[str] = []
        self._announced: dict[Hello, int] = {}
        self._sighted: SamplesHeader | None = None
        self._past = ArrivalCounts()
        self._last_arrival_s = 0.0

    @property
    def offset(self) -> int:
        """The station's number of the rig's sample 0."""
        return self.run.offset if self.run is not None else 0

    @property
    def counts(self) -> ArrivalCounts:
        """What the wire did to the blocks, all runs of the rig together."""
        now = self.run.arrivals.counts if self.run is not None else ArrivalCounts()
        return ArrivalCounts(
            *(getattr(self._past, name) + getattr(now, name) for name in ArrivalCounts.__slots__)
        )

    # --- which rig it is ---

    def meet(self, frames: list[bytes]) -> None:
        """Take a hello that was said twice for what the rig is.

        Raises
        ------
        RunError
            If its channels do not fit the plant.
        """
        hello = self._hello_in(frames)
        if hello is not None:
            self._announce(hello)
            if self._announced.get(hello, 0) > 1:
                self._begin(hello)

    def meet_by_samples(self, frames: list[bytes]) -> None:
        """Take the only hello there was for what the rig is, if its samples agree; raises RunError as `meet`."""
        if len(self._announced) != 1:
            return
        hello = next(iter(self._announced))
        with contextlib.suppress(ValidationError):
            header = SamplesHeader.model_validate_json(frames[0] if len(frames) == 2 else b"")
            if header.run_id == hello.run_id and len(frames[1]) == 4 * header.n_samples * len(hello.channels):
                self._begin(hello)

    def greet(self, frames: list[bytes]) -> Hello | None:
        """Note a hello and return it if it is another run's; that one counts when samples of it come."""
        hello, run = self._hello_in(frames), self.run
        if hello is None or run is None or hello.run_id == run.hello.run_id:
            return None
        self._announce(hello)
        return hello

    def _hello_in(self, frames: list[bytes]) -> Hello | None:
        try:
            return Hello.model_validate_json(frames[0] if len(frames) == 1 else b"")
        except ValidationError as error:
            self._complaints.add("a hello cannot be read", first_problem(error))
            return None

    def _announce(self, hello: Hello) -> None:
        self._announced[hello] = self._announced.get(hello, 0) + 1
        while len(self._announced) > ANNOUNCED:
            del self._announced[min(self._announced, key=lambda h: self._announced[h])]

    def _begin(self, hello: Hello) -> None:
        self.run = Run(hello, *_in_si_units(hello, self._plant))
        self._announced.clear()
        if hello.config_id and hello.config_id != self._plant.fingerprint:
            self.events.append(
                f"the rig is set up for plant '{plain(hello.plant)}' ({plain(hello.config_id)}), "
                f"this station models '{self._plant.name}' ({self._plant.fingerprint})"
            )

    def _announced_as(self, header: SamplesHeader) -> Hello | None:
        """The hello of another run, if it has begun: with its first block, or two that agree on where it is."""
        found = [h for h in self._announced if h.run_id == header.run_id]
        if not found:
            return None
        before, self._sighted = self._sighted, header
        begins = header.sequence == 0 and header.first_sample == 0
        if before is not None and before.run_id == header.run_id:
            apart = header.sequence - before.sequence
            begins |= apart == 1 and header.first_sample == before.first_sample + before.n_samples
        return max(found, key=lambda h: self._announced[h]) if begins else None

    def _begin_anew(self, run: Run, hello: Hello, now_s: float) -> Run:
        old = run.hello
        for what in ("sample_rate_hz", "channels", "config_id"):
            if getattr(hello, what) != getattr(old, what):
                raise RunError(
                    f"the rig came back with another {what} ({getattr(old, what)} before, {getattr(hello, what)} now); "
                    "start again for a new recording"
                )
        heard = self._last_arrival_s  # 0 before the first block: then nothing is missing
        away_s = max(0.0, now_s - heard) if heard else 0.0
        following = run.arrivals.next_sample or 0
        offset = following + round(away_s * hello.sample_rate_hz)
        fresh = Run(hello, run.channels, run.factors, offset, Arrivals(offset, following))
        self._past, self.run = self.counts, fresh
        self.restarts += 1
        self.drift.restart()
        self._announced.clear()
        self.events.append(f"the rig was started again; {away_s:.1f} s without samples are masked")
        return fresh

    # --- its samples ---

    def take(self, frames: list[bytes], now_s: float) -> Iterator[Block]:
        """Hand on what is due now that a message of samples has arrived.

        Parameters
        ----------
        frames
            What follows the topic.
        now_s
            This machine's monotonic clock.

        Raises
        ------
        RunError
            If the rig comes back as another rig, or after too long.
        """
        header = self._header_in(frames)
        run = self.run
        if header is None or run is None:
            return
        if header.run_id != run.hello.run_id:
            hello = self._announced_as(header)
            if hello is None:
                # Of a run that is over, or whose hello has not come yet: its place will be masked.
                self._complaints.add("a block of another run")
                return
            run = self._begin_anew(run, hello, now_s)
        block = self._block_in(run, header, frames[1])
        if block is None:
            return
        counts = run.arrivals.counts
        received, stray = counts.received, counts.stray
        for due in run.arrivals.take(block, header.sequence):
            # What is handed on says that this one is believed.
            self._last_arrival_s, self.notice = now_s, plain(header.notice, 500)
            yield due
        if counts.received == received + 1:  # in its turn: others waited for somebody
            self.drift.take((header.first_sample + header.n_samples) / run.hello.sample_rate_hz, now_s)
        for _ in range(counts.stray - stray):
            self._complaints.add(
                "a block's number and place contradict those of the others", f"number {header.sequence}"
            )

    def _header_in(self, frames: list[bytes]) -> SamplesHeader | None:
        if len(frames) != 2:
            self._complaints.add("a message of samples has not three frames")
            return None
        try:
            return SamplesHeader.model_validate_json(frames[0])
        except ValidationError as error:
            self._complaints.add("the header of a block cannot be read", first_problem(error))
            return None

    def _block_in(self, run: Run, header: SamplesHeader, samples: bytes) -> Block | None:
        wanted = 4 * header.n_samples * len(run.channels)
        if len(samples) != wanted:
            self._complaints.add(
                "a block has not the samples that it says",
                f"number {header.sequence} has {len(samples)} bytes, not {wanted}",
            )
            return None
        if header.n_samples > run.hello.block_samples:
            self._complaints.add("a block is longer than the rig's", f"{header.n_samples} samples")
            return None
        values = np.frombuffer(samples, dtype="<f4").reshape(header.n_samples, len(run.channels))
        if np.any(run.factors != 1.0):
            values = values * run.factors
        ranges = np.array([self._ranges_by_name.get(c.name, np.inf) for c in run.channels])
        return make_block(
            header.first_sample + run.offset, run.hello.sample_rate_hz, values, run.channels, ranges,
            config_id=plain(header.config_id), control_on=header.control_on, commands_applied=header.commands_applied,
        )  # fmt: skip

    def end(self, frames: list[bytes]) -> int | None:
        """Sample that the run ends before; None if what says so cannot be believed."""
        run = self.run
        try:
            message = decode(frames[0] if len(frames) == 1 else b"")
        except RunError as error:
            self._complaints.add("an end cannot be read", str(error))
            return None
        end = message.get("next_sample")
        following = run.arrivals.next_sample if run is not None else None
        if run is None or not isinstance(end, int) or isinstance(end, bool):
            self._complaints.add("an end without a whole next_sample")
        elif message.get("run_id", run.hello.run_id) != run.hello.run_id:
            self._complaints.add("an end of another run")
        elif following is not None and not following <= end + run.offset <= MAX_SAMPLE:
            self._complaints.add("an end at another sample than the blocks'", plain(end, 30))
        else:
            return end + run.offset
        return None


def _in_si_units(hello: Hello, plant: Plant) -> tuple[tuple[Channel, ...], Array]:
    """Columns as the plant knows them, in SI units, and the factor that takes each there."""
    expected = {s.name: s.unit for s in plant.sensor} | {a.name: a.input_unit for a in plant.actuator}
    channels, factors = [], np.ones(len(hello.channels))
    for k, sent in enumerate(hello.channels):
        wanted = expected.get(sent.name)
        found = to_si(sent.unit, wanted or "")
        if wanted is not None and (found is None or found[0] != wanted):
            raise RunError(
                f"the rig sends channel '{sent.name}' in '{sent.unit}'; plant '{plant.name}' has it in {wanted}: "
                f"have the rig say one of {', '.join(units_for(wanted))}"
            )
        unit, factors[k] = found if found is not None and found[0] in COMMON else (sent.unit, 1.0)
        channels.append(Channel(sent.name, unit))
    if len({c.name for c in channels}) < len(channels):
        raise RunError("the rig sends two channels of the same name")
    return tuple(channels), factors
