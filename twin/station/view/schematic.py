"""The plant as a drawing that moves: bodies, springs, dampers, coil, and arrows for current and forces.

What is drawn is the observer's estimate at the flashes of a stroboscope, its motion enlarged to be seen. All bodies
share one scale, which is drawn as a bar; the primary body, which may move a thousand times less than its absorber, has
a pointer of its own under a magnifier.
"""

import numpy as np
import rerun as rr

from twin.plant.config import GROUND, Plant, VoiceCoil
from twin.plant.linear import Array
from twin.station import palette
from twin.station.columns import TIMELINE, Columns, nanoseconds
from twin.station.frame import Frame
from twin.station.view.drawing import BODY_HEIGHT, FIGURES_Y, GAP, LOUPE, MOTION_ROOM, SPRING_Y, Drawing, draw
from twin.station.view.forces import drive_of, force_of, pushes
from twin.station.view.scales import FollowingScale, in_words
from twin.station.view.still import ROOT, TEXT, StillParts
from twin.station.view.stroboscope import Stroboscope, slower_by

ARROW = 16.0
"""Length of an arrow at full scale."""

PEAK_SAMPLES = 500
"""So many of a block's samples tell the largest value well enough for a scale."""


class Schematic:
    """Draws one plant.

    Parameters
    ----------
    stream, columns
        Where to; what moves goes through the columns.
    plant
        What is drawn.
    text_s
        Time between changes of what is written [s].
    """

    def __init__(self, stream: rr.RecordingStream, columns: Columns, plant: Plant, text_s: float) -> None:
        self._stream, self._columns, self._plant = stream, columns, plant
        self._drawing: Drawing = draw(plant)
        self._strobe = Stroboscope()
        self._motion = FollowingScale(1e-9)
        self._loupe = FollowingScale(1e-9)
        self._force = {a.name: FollowingScale(1e-6) for a in plant.actuator}
        self._current = FollowingScale(1e-3)
        self._text_s, self._text_at_s = text_s, -np.inf
        self._marks_at: tuple[float, ...] = ()
        StillParts(stream, self._drawing, plant).draw()

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of x and of y that holds everything."""
        return self._drawing.bounds

    def add(self, frame: Frame) -> None:
        """Take one block."""
        block, estimate = frame.block, frame.estimate
        rate = block.sample_rate_hz
        hz = None if frame.phasors is None else frame.phasors.frequency_hz
        flashes = self._strobe.flashes(block.start_s, block.end_s, hz)
        rows = np.clip(np.round(flashes * rate).astype(int) - block.first_sample, 0, block.n_samples - 1)
        at = {name: k for k, name in enumerate(estimate.states)}
        columns = {b.name: at[f"x_{b.name}"] for b in self._plant.body if f"x_{b.name}" in at}
        few = slice(None, None, max(1, block.n_samples // PEAK_SAMPLES))
        peaks = {name: _peak(estimate.mean[few, k]) for name, k in columns.items()}
        self._motion.follow(max(peaks.values(), default=0.0))
        self._move(flashes, {name: estimate.mean[rows, k] for name, k in columns.items()})
        primary = self._plant.primary.name
        if primary in columns:
            self._loupe.follow(peaks[primary])
            shown = LOUPE / self._loupe.full * estimate.mean[rows, columns[primary]]
            shift = np.array(self._drawing.loupe) + np.column_stack([shown, np.zeros(len(rows))])
            self._columns.add_motion(f"{ROOT}/loupe/pointer", flashes, shift)
        drives = {a.name: drive_of(a, frame) for a in self._plant.actuator}
        self._point(flashes, rows, drives)
        if block.end_s >= self._text_at_s - 1e-9:
            self._text_at_s = block.end_s + self._text_s
            self._stream.set_time(TIMELINE, duration=nanoseconds(block.end_s)[0])
            self._write(frame, peaks, drives, hz)

    def repeat(self) -> None:
        """Write everything again when next it can be, for a viewer that has come since."""
        self._text_at_s, self._marks_at = -np.inf, ()

    def _move(self, time_s: Array, moved_m: dict[str, Array]) -> None:
        scale = MOTION_ROOM / self._motion.full
        still = np.zeros(len(time_s))
        shown = {name: scale * x for name, x in moved_m.items()} | {GROUND: still}
        for name, place in self._drawing.places.items():
            x = shown.get(name, still)
            self._columns.add_motion(
                f"{ROOT}/body/{name}", time_s, np.column_stack([place.x + x, place.y + still])
            )
            left, right = self._drawing.link(name)
            parent = shown.get(place.parent, still)
            shift = np.column_stack([left + parent, place.y + SPRING_Y + still])
            self._columns.add_motion(
                f"{ROOT}/spring/{name}", time_s, shift, 1.0 + (x - parent) / (right - left)
            )

    def _point(self, time_s: Array, rows: Array, drives: dict[str, Array | None]) -> None:
        """Arrows of the forces on the bodies, every actuator's on its own scale, and of the current in the coil."""
        lengths = {}
        for actuator in self._plant.actuator:
            force, scale = force_of(actuator, drives[actuator.name]), self._force[actuator.name]
            if force is None:
                lengths[actuator.name] = np.zeros(len(rows))
                continue
            scale.follow(_peak(force[:: max(1, len(force) // PEAK_SAMPLES)]))
            lengths[actuator.name] = ARROW / scale.full * force[rows]
        vectors = []
        for actuator, _, sign in pushes(self._plant):
            shown = sign * lengths[actuator.name]
            vectors.append(np.column_stack([shown, np.zeros(len(rows))]))
        if vectors:
            self._columns.add_arrows(f"{ROOT}/force", time_s, np.nan_to_num(np.stack(vectors, axis=1)))
        voice_coil = self._plant.voice_coil
        current = None if voice_coil is None else drives[voice_coil.name]
        if current is not None:
            self._current.follow(_peak(current[:: max(1, len(current) // PEAK_SAMPLES)]))
            up = -0.6 * ARROW / self._current.full * np.nan_to_num(current[rows])
            self._columns.add_arrows(f"{ROOT}/current", time_s, np.column_stack([0.0 * up, up])[:, None, :])

    def _write(
        self, frame: Frame, peaks: dict[str, float], drives: dict[str, Array | None], hz: float | None
    ) -> None:
        places, texts, colours = [], [], []

        def say(x: float, y: float, text: str, colour: int = TEXT) -> None:
            places.append([x, y])
            texts.append(text)
            colours.append(colour)

        row = self._drawing.size[1] + FIGURES_Y
        for name, peak in peaks.items():
            place = self._drawing.places[name]
            say(place.x, place.y + 0.5 * place.height + FIGURES_Y, f"±{in_words(peak, 'm')}", palette.TWIN)
        for name, drive in drives.items():
            actuator = self._plant.find_actuator(name)
            force = force_of(actuator, drive)
            if drive is None or force is None or not np.isfinite(force).any():
                continue
            newton = in_words(_peak(force), "N")
            if isinstance(actuator, VoiceCoil):
                x, y = self._drawing.middle(actuator)
                ampere = in_words(_peak(drive), "A")
                say(x, y + 0.5 * BODY_HEIGHT + FIGURES_Y, f"{ampere}, {newton}", palette.COPPER)
            else:
                say(0.5 * GAP, row, f"{name} {newton}", palette.FORCE)
        x, y = self._drawing.loupe
        if hz is not None:
            slower = slower_by(hz)
            say(
                0.5 * GAP - 7.0, y + 3.0, f"{hz:.2f} Hz" + (f", {slower:.0f}× slower" if slower > 1.0 else "")
            )
        say(x, y + 3.0, f"ruler ±{in_words(self._loupe.full, 'm')}")
        say(self._drawing.bar[0], y + 3.0, f"bar {in_words(self._motion.full, 'm')}")
        text = rr.Points2D(places, labels=texts, colors=palette.array(colours), radii=0.0, show_labels=True)
        self._stream.log(f"{ROOT}/figures", text)
        p = frame.performance
        if p is not None:
            marks = tuple(round(v / self._loupe.full, 2) for v in (p.limit_m, p.passive_m))
            if marks != self._marks_at:
                self._marks_at = marks
                self._mark(marks)

    def _mark(self, marks: tuple[float, ...]) -> None:
        """Under the magnifier: the least motion any controller could leave, and that without control."""
        strips, colours = [], []
        for share, colour in zip(marks, (palette.LIMIT, palette.PASSIVE), strict=True):
            for side in (-1.0, 1.0):
                if share <= 1.0:
                    x, y = self._drawing.loupe
                    x += side * share * LOUPE
                    strips.append(np.array([[x, y - 4.0], [x, y + 1.0]]))
                    colours.append(colour)
        self._stream.log(
            f"{ROOT}/loupe/marks",
            rr.LineStrips2D(strips, colors=palette.array(colours), radii=rr.Radius.ui_points(1.5)),
        )


def _peak(values: Array) -> float:
    """Largest size of any; 0 where there is none."""
    return float(np.nanmax(np.abs(values), initial=0.0))
