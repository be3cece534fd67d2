"""Where the bodies of a plant stand in its drawing, and the lines they are drawn with.

Bodies stand beside each other from the ground on the left, those on the same body below each other; everything
moves to the left and right. Lengths are units of the drawing, y points down.
"""

from dataclasses import dataclass

import numpy as np

from twin.plant.config import GROUND, Actuator, Plant
from twin.plant.linear import Array

GAP = 44.0
ROW = 40.0
BODY_HEIGHT = 26.0
MOTION_ROOM = 10.0
"""A body may be drawn this far from where it rests."""

FILL = 1.1
"""Half the width of the lines that fill a box: a drawing in a plane has no filled ones."""

LOUPE = 15.0
"""Half the length of the magnifier's ruler."""

NAMES_Y, FIGURES_Y, RULER_Y = -13.0, 9.5, 23.0
"""Lines of text: from the top of a body, and from the bottom of the lowest one."""

SPRING_Y, COIL_Y, DAMPER_Y = -9.0, 0.0, 9.0


@dataclass(frozen=True, slots=True)
class Place:
    """A body's box at rest: middle, size, and what it is attached to (its own left end is ``x - width / 2``)."""

    name: str
    x: float
    y: float
    width: float
    height: float
    parent: str

    @property
    def left(self) -> float:
        """Left edge."""
        return self.x - 0.5 * self.width


@dataclass(frozen=True, slots=True)
class Drawing:
    """Places by body, in the plant's order, and the right end of what a body is attached to."""

    places: dict[str, Place]

    def right_of(self, name: str) -> float:
        """Right edge of a body, or of the ground."""
        if name == GROUND:
            return 0.0
        place = self.places[name]
        return place.x + 0.5 * place.width

    def link(self, name: str) -> tuple[float, float]:
        """Ends of the spring and damper that carry a body: x of the left and of the right one."""
        place = self.places[name]
        return self.right_of(place.parent), place.left

    def carried(self, actuator: Actuator) -> str:
        """Body across whose spring an actuator between two bodies acts, or the first that it pushes."""
        first, *more = (body for body, _ in actuator.pushes if body != GROUND)
        return next((body for body in more if self.places[body].parent == first), first)

    def middle(self, actuator: Actuator) -> tuple[float, float]:
        """Where an actuator between two bodies stands at rest."""
        name = self.carried(actuator)
        left, right = self.link(name)
        return 0.5 * (left + right), self.places[name].y

    @property
    def loupe(self) -> tuple[float, float]:
        """Middle of the magnifier's ruler."""
        primary = next(iter(self.places.values()))
        return primary.x, self.size[1] + RULER_Y

    @property
    def bar(self) -> tuple[float, float]:
        """Middle of the bar that tells the scale of the motion."""
        right, bottom = self.size
        return max(right - 2.0, self.loupe[0] + LOUPE + 16.0), bottom + RULER_Y

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of x and of y that holds everything."""
        right, bottom = self.size
        right = max(right, self.bar[0])
        return (-8.0, right + 11.0), (-0.5 * BODY_HEIGHT - 18.0, bottom + RULER_Y + 13.0)

    @property
    def size(self) -> tuple[float, float]:
        """Right end, from the ground, and bottom, from the middle of the first row."""
        right = max(p.x + 0.5 * p.width for p in self.places.values())
        bottom = max(p.y + 0.5 * p.height for p in self.places.values())
        return right, bottom


def draw(plant: Plant) -> Drawing:
    """Place every body of a plant."""
    children: dict[str, list[str]] = {}
    for body in plant.body:
        children.setdefault(body.attached_to, []).append(body.name)
    heaviest = max(b.mass_kg for b in plant.body)
    width = {b.name: 14.0 + 14.0 * (b.mass_kg / heaviest) ** (1.0 / 3.0) for b in plant.body}
    places: dict[str, Place] = {}

    def put(name: str, parent: str, left: float, row: float) -> float:
        """Put a body and all it carries; returns the rows they took."""
        taken = 0.0
        for child in children.get(name, ()):
            taken += put(child, name, left + width[name] + GAP, row + taken)
        rows = max(taken, 1.0)
        y, height = ROW * (row + 0.5 * (rows - 1.0)), BODY_HEIGHT + ROW * (rows - 1.0)
        places[name] = Place(name, left + 0.5 * width[name], y, width[name], height, parent)
        return rows

    row = 0.0
    for name in children[GROUND]:
        row += put(name, GROUND, GAP, row)
    return Drawing({b.name: places[b.name] for b in plant.body})


def spring(length: float, teeth: int = 7, height: float = 3.2) -> Array:
    """(n, 2) points of a spring from 0 to its length, to be stretched in x."""
    inner = np.linspace(0.14, 0.86, 2 * teeth + 1)
    y = np.where(np.arange(len(inner)) % 2 == 0, 0.0, height) * np.where(
        np.arange(len(inner)) % 4 == 1, 1, -1
    )
    x = np.concatenate([[0.0], inner, [1.0]])
    return np.column_stack([x * length, np.concatenate([[0.0], y, [0.0]])])


def dashpot(length: float, height: float = 3.0) -> tuple[list[Array], list[Array]]:
    """Strips of a dashpot from 0 to its length: the cylinder, held on the left, and the piston, held on the right."""
    back, front, plate = 0.34 * length, 0.72 * length, 0.53 * length
    cylinder = [
        np.array([[0.0, 0.0], [back, 0.0]]),
        np.array([[front, -height], [back, -height], [back, height], [front, height]]),
    ]
    piston = [
        np.array([[plate, -0.8 * height], [plate, 0.8 * height]]),
        np.array([[plate, 0.0], [length, 0.0]]),
    ]
    return cylinder, piston


def coil(length: float, height: float = 4.6) -> tuple[list[Array], list[Array]]:
    """Strips of a voice coil from 0 to its length: the magnet, held on the left, and the winding, held on the right."""
    back, front = 0.2 * length, 0.6 * length
    magnet = [
        np.array([[0.0, 0.0], [front, 0.0]]),
        np.array([[front, -height], [back, -height], [back, height], [front, height]]),
    ]
    turns = np.linspace(0.34 * length, 0.7 * length, 7)
    winding = [np.array([[x, -0.62 * height], [x, 0.62 * height]]) for x in turns]
    winding.append(np.array([[turns[-1], 0.0], [length, 0.0]]))
    return magnet, winding


def filled_box(width: float, height: float) -> list[Array]:
    """Strips of half width `FILL` that fill a box about the origin, corners a little rounded."""
    levels = np.linspace(FILL - 0.5 * height, 0.5 * height - FILL, int(np.ceil(height / (1.6 * FILL))))
    reach = 0.5 * width - FILL
    return [np.array([[-reach, y], [reach, y]]) for y in levels]


def outline(width: float, height: float) -> Array:
    """Closed strip around a box about the origin."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]])
    return np.asarray(corners * np.array([width, height]))


def ground(height: float) -> list[Array]:
    """Strips of the ground at x = 0 from -height to height, hatched."""
    marks = np.arange(-height, height, 4.0)
    return [
        np.array([[0.0, -height], [0.0, height]]),
        *(np.array([[0.0, y], [-4.0, y + 4.0]]) for y in marks),
    ]


def lowered(strip: Array, by: float) -> Array:
    """A strip moved down."""
    return np.asarray(strip + np.array([0.0, by]))
