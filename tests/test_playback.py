"""A recording under the page's hand: what was asked for is what is shown, and no recording is spoilt."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from twin.plant.errors import InputError
from twin.station.page_server import OperatorPage, security_policy
from twin.station.playback import HISTORY_BLOCKS, Playback, Wish

RATE, N = 1000.0, 100


@dataclass
class Tape:
    """Stands for a player: 20 s in blocks of 0.1 s."""

    position: int = 0
    length: int = 20_000
    seeks: list[float] = field(default_factory=list)

    @property
    def time_s(self) -> float:
        return self.position / RATE

    def step(self) -> Any:
        if self.position >= self.length:
            return None
        self.position += N
        return SimpleNamespace(block=SimpleNamespace(n_samples=N, start_s=(self.position - N) / RATE))

    def seek(self, time_s: float) -> None:
        self.seeks.append(time_s)
        self.position = min(int(time_s * RATE + 1e-6) // N * N, self.length)


@dataclass
class Bench:
    """A playback with a script: wishes by the number of frames seen so far, or of idle rounds."""

    tape: Tape
    playback: Playback
    shown: list[float] = field(default_factory=list)
    ends: int = 0
    jumps: list[float] = field(default_factory=list)
    when_idle: list[Wish] = field(default_factory=list)
    idle_at: list[float] = field(default_factory=list)

    def run(self, at_frame: dict[int, Wish] | None = None) -> None:
        def take(frame: Any) -> None:
            self.shown.append(round(frame.block.start_s, 3))
            wish = (at_frame or {}).get(len(self.shown))
            if wish is not None:
                self.playback.ask(wish)

        def end() -> None:
            self.ends += 1

        def stay() -> bool:
            self.idle_at.append(self.tape.time_s)
            if not self.when_idle:
                return False
            self.playback.ask(self.when_idle.pop(0))
            return True

        self.playback.run(take, end, stay)


def bench(**options: Any) -> Bench:
    tape = Tape()
    jumps: list[float] = []
    made = Playback(
        tape,
        RATE,
        tape.length,
        speed=options.pop("speed", 0.0),
        jumped=lambda: jumps.append(tape.time_s),
        **options,
    )  # type: ignore[arg-type]
    return Bench(tape, made, jumps=jumps)


def steps(first: float, n: int) -> list[float]:
    return [round(first + 0.1 * k, 3) for k in range(n)]


def test_without_wishes_it_plays_to_the_end_once() -> None:
    made = bench()
    made.run()
    assert made.shown == steps(0.0, 200)
    assert made.ends == 1
    assert made.playback.state()["ended"]


def test_from_and_to_are_kept() -> None:
    made = bench(from_s=3.0, to_s=5.05)
    made.run()
    assert made.shown == steps(3.0, 20)


def test_pause_holds_step_takes_one_play_goes_on() -> None:
    made = bench()
    made.when_idle = [Wish("step"), Wish("step"), Wish("play")]
    made.run({5: Wish("pause")})
    assert made.shown == steps(0.0, 200)
    assert made.idle_at[:4] == [0.5, 0.6, 0.7, 20.0]


@pytest.mark.parametrize("target", [12.34, 2.0, 0.0, 20.0, 0.35])
def test_jump_shows_what_a_branch_needs_and_stops_where_it_was_asked(target: float) -> None:
    made = bench()
    made.when_idle = [Wish("seek", target), Wish("pause")]
    made.run({50: Wish("pause")})
    before, after = made.shown[:50], made.shown[50:]
    assert before == steps(0.0, 50)
    reached = int(target * 10 + 1e-6) / 10
    n = min(HISTORY_BLOCKS, round(10 * reached))
    assert after[:n] == steps(reached - 0.1 * n, n)
    assert made.idle_at[1] == pytest.approx(reached)
    assert made.jumps == [pytest.approx(reached - 0.1 * n)]
    assert made.playback.jumps == 1


def test_another_wish_on_a_long_way_is_heard() -> None:
    made = bench()
    asked: list[int] = []
    seek = made.tape.seek

    def seek_and_wish(time_s: float) -> None:
        seek(time_s)
        if time_s > 3.0 and not asked:
            asked.append(1)
            made.playback.ask(Wish("seek", 1.5))

    made.tape.seek = seek_and_wish  # type: ignore[method-assign]
    made.when_idle = [Wish("seek", 19.0), Wish("pause")]
    made.run({1: Wish("pause")})
    assert max(made.tape.seeks) < 5.0
    assert made.idle_at[1] == pytest.approx(1.5)


def test_a_recording_that_begins_late_is_jumped_about_in_all_the_same() -> None:
    made = bench()
    late, seek = 8_000, made.tape.seek

    def step() -> Any:
        made.tape.position = max(made.tape.position, late)
        return Tape.step(made.tape)

    def seek_late(time_s: float) -> None:
        was = made.tape.position
        seek(time_s)
        if made.tape.position <= late:  # nothing lies before: the position stays what it was, or the start
            made.tape.position = min(was, 0)

    made.tape.step, made.tape.seek = step, seek_late  # type: ignore[method-assign]
    made.when_idle = [Wish("seek", 8.0), Wish("seek", 14.0), Wish("pause")]
    made.run({20: Wish("pause")})
    assert made.shown[:21] == [*steps(8.0, 20), 8.0]
    assert made.shown[21:31] == steps(13.0, 10)
    assert made.playback.state()["begin_s"] == 8.0


def test_after_the_end_it_plays_again_but_finishes_once() -> None:
    made = bench()
    made.when_idle = [Wish("play")]
    made.run()
    assert len(made.shown) == 400
    assert made.ends == 1


def test_a_pause_that_nobody_can_end_is_ended() -> None:
    made = bench()
    made.run({3: Wish("pause")})
    assert made.shown == steps(0.0, 200)


@pytest.mark.parametrize(
    ("wish", "words"),
    [
        (Wish("seek", 20.1), "lasts from 0 to 20.0 s"),
        (Wish("seek", -1.0), "lasts"),
        (Wish("seek", float("nan")), "lasts"),
        (Wish("speed", -1.0), "speed"),
        (Wish("speed", float("inf")), "speed"),
        (Wish("speed", 101.0), "speed"),
    ],
)
def test_wishes_that_cannot_be_are_refused(wish: Wish, words: str) -> None:
    with pytest.raises(InputError, match=words):
        bench().playback.ask(wish)


def test_a_replay_that_is_recorded_does_not_jump() -> None:
    with pytest.raises(InputError, match="without --save"):
        bench(seekable=False).playback.ask(Wish("seek", 1.0))


def test_policy_allows_no_inline_script_and_no_inline_style() -> None:
    policy = security_policy("http://127.0.0.1:9000/")
    assert "unsafe" not in policy
    assert "frame-src http://127.0.0.1:9000 http://localhost:9000;" in policy


@pytest.mark.parametrize(("bind", "warned"), [("127.0.0.1", False), ("localhost", False), ("0.0.0.0", True)])  # noqa: S104
def test_whoever_leaves_loopback_is_told_what_that_means(bind: str, warned: bool) -> None:
    class Desk:
        viewer_url = ""

        def refuse(self, reason: str) -> None: ...
        def close(self) -> None: ...

    with OperatorPage(Desk(), bind) as page:  # type: ignore[arg-type]
        assert ("can read its token" in page.warning) is warned
        assert "0.0.0.0" not in page.url  # noqa: S104
