"""What does not move by itself in the drawing of a plant: bodies, springs and all that hangs on them, scales, names."""

from collections.abc import Iterable

import numpy as np
import rerun as rr

from twin.plant.config import GROUND, Body, Plant, VoiceCoil
from twin.plant.linear import Array
from twin.station import palette
from twin.station.view.drawing import (
    BODY_HEIGHT,
    COIL_Y,
    DAMPER_Y,
    FILL,
    LOUPE,
    MOTION_ROOM,
    NAMES_Y,
    Drawing,
    coil,
    dashpot,
    filled_box,
    ground,
    lowered,
    outline,
    spring,
)
from twin.station.view.forces import pushes
from twin.station.view.scales import in_words

ROOT = "schematic"
TEXT, FAINT = 0xCFD8DCFF, 0x78909CFF


class StillParts:
    """Logs them once; bodies and springs about the points by which `Schematic` moves them.

    Parameters
    ----------
    stream
        Where to.
    drawing, plant
        What is drawn.
    """

    def __init__(self, stream: rr.RecordingStream, drawing: Drawing, plant: Plant) -> None:
        self._stream, self._drawing, self._plant = stream, drawing, plant

    def draw(self) -> None:
        """Draw all of it."""
        drawing, plant = self._drawing, self._plant
        rows = {drawing.places[b.name].y for b in plant.body if b.attached_to == GROUND}
        self._strips("ground", (lowered(s, row) for row in rows for s in ground(0.5 * BODY_HEIGHT)), FAINT)
        for body in plant.body:
            self._draw_body(body)
            self._draw_link(body)
        self._draw_names()
        self._draw_scales()
        self._draw_roots_of_arrows()

    def _draw_body(self, body: Body) -> None:
        place = self._drawing.places[body.name]
        colour = palette.BODY if body is not self._plant.primary else palette.PRIMARY
        box = filled_box(place.width, place.height)
        self._strips(f"body/{body.name}/mass", box, colour, FILL, order=-5.0)
        self._strips(f"body/{body.name}/edge", [outline(place.width, place.height)], colour, ui=1.8)

    def _draw_link(self, body: Body) -> None:
        """Spring, dashpot and what else acts between a body and the one that carries it."""
        drawing = self._drawing
        place = drawing.places[body.name]
        left, right = drawing.link(body.name)
        length = right - left
        moves = f"body/{body.name}"
        holds = "ground" if place.parent == GROUND else f"body/{place.parent}"
        begin = np.array([left, place.y])
        if place.parent != GROUND:
            parent = drawing.places[place.parent]
            begin = begin - [parent.x, parent.y]
        end = np.array([-0.5 * place.width - length, 0.0])
        self._strips(f"spring/{body.name}/wire", [spring(length)], palette.SPRING, ui=1.6)
        cylinder, piston = ([lowered(s, DAMPER_Y) for s in part] for part in dashpot(length))
        self._strips(f"{holds}/cylinder_{body.name}", (s + begin for s in cylinder), palette.SPRING)
        self._strips(f"{moves}/piston", (s + end for s in piston), palette.SPRING)
        for actuator in self._plant.actuator:
            if actuator.between is not None and drawing.carried(actuator) == body.name:
                magnet, winding = ([lowered(s, COIL_Y) for s in part] for part in coil(length))
                self._strips(
                    f"{holds}/magnet_{actuator.name}", (s + begin for s in magnet), palette.MAGNET, ui=1.6
                )
                self._strips(f"{moves}/{actuator.name}", (s + end for s in winding), palette.COPPER, ui=1.6)

    def _draw_names(self) -> None:
        """Bodies with their masses, springs with their stiffness."""
        places, labels = [], []
        for body in self._plant.body:
            place = self._drawing.places[body.name]
            left, right = self._drawing.link(body.name)
            places.append([place.x, place.y - 0.5 * place.height + NAMES_Y])
            labels.append(f"{body.name} {in_words(1e3 * body.mass_kg, 'g')}")
            places.append([0.5 * (left + right), place.y - 0.5 * BODY_HEIGHT + NAMES_Y])
            labels.append(in_words(body.stiffness_n_m, "N/m"))
        text = rr.Points2D(places, labels=labels, colors=FAINT, radii=0.0, show_labels=True)
        self._stream.log(f"{ROOT}/names", text, static=True)

    def _draw_scales(self) -> None:
        x, y = self._drawing.loupe
        marks = [np.array([[x + d, y], [x + d, y + 2.0]]) for d in np.linspace(-LOUPE, LOUPE, 11)]
        self._strips("loupe/ruler", [np.array([[x - LOUPE, y], [x + LOUPE, y]]), *marks], FAINT)
        point = rr.Points2D([[0.0, -1.6]], colors=palette.TWIN, radii=1.5)
        self._stream.log(f"{ROOT}/loupe/pointer", point, static=True)
        x, y = self._drawing.bar
        bar = np.array([[x - 0.5 * MOTION_ROOM, y], [x + 0.5 * MOTION_ROOM, y]])
        self._strips("bar", [bar], TEXT, ui=2.5)

    def _draw_roots_of_arrows(self) -> None:
        origins, colours = [], []
        for actuator, body, _ in pushes(self._plant):
            place = self._drawing.places[body]
            of_coil = isinstance(actuator, VoiceCoil)
            side = 0.5 * place.height + 3.5
            origins.append([place.x, place.y + (side if of_coil else -side)])
            colours.append(palette.COPPER if of_coil else palette.FORCE)
        if origins:
            self._arrows("force", origins, colours)
        voice_coil = self._plant.voice_coil
        if voice_coil is not None:
            self._arrows("current", [list(self._drawing.middle(voice_coil))], [palette.MEASURED])

    def _arrows(self, path: str, origins: list[list[float]], colours: list[int]) -> None:
        arrows = rr.Arrows2D.from_fields(
            origins=origins, colors=palette.array(colours), radii=[0.8] * len(origins), draw_order=20.0
        )
        self._stream.log(f"{ROOT}/{path}", arrows, static=True)

    def _strips(
        self, path: str, strips: Iterable[Array], colour: int, radius: float | None = None, *,
        ui: float = 1.4, order: float = 0.0,
    ) -> None:  # fmt: skip
        size = rr.Radius.ui_points(ui) if radius is None else radius
        lines = rr.LineStrips2D(list(strips), colors=palette.array([colour]), radii=size, draw_order=order)
        self._stream.log(f"{ROOT}/{path}", lines, static=True)
