"""What things are made of and often have: palettes, handles, drawers, doors."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hingesplat.synth.model import Body, sliding, turning
from hingesplat.synth.shapes import Solid, Texture, box, capsule, glossy, lathe, open_box, tube
from hingesplat.synth.textures import Colour, brushed, by_face, checker, inlay, plain, speckle, stripes, wood

WOODS: tuple[tuple[Colour, Colour], ...] = (
    ((0.87, 0.74, 0.55), (0.68, 0.50, 0.31)),  # Oak.
    ((0.70, 0.46, 0.29), (0.47, 0.27, 0.15)),  # Cherry.
    ((0.50, 0.35, 0.24), (0.29, 0.18, 0.12)),  # Walnut.
    ((0.93, 0.86, 0.72), (0.79, 0.67, 0.48)),  # Birch.
    ((0.76, 0.56, 0.33), (0.52, 0.32, 0.15)),  # Teak.
)
PAINTS: tuple[Colour, ...] = (
    (0.17, 0.42, 0.46),  # Petrol.
    (0.85, 0.62, 0.20),  # Mustard.
    (0.73, 0.33, 0.22),  # Brick.
    (0.52, 0.62, 0.48),  # Sage.
    (0.20, 0.27, 0.44),  # Navy.
    (0.83, 0.52, 0.44),  # Salmon.
    (0.44, 0.62, 0.74),  # Sky.
    (0.56, 0.24, 0.33),  # Wine.
)
PALE: tuple[Colour, ...] = ((0.93, 0.92, 0.89), (0.88, 0.85, 0.78), (0.80, 0.84, 0.86), (0.80, 0.86, 0.78))
DARK: Colour = (0.13, 0.13, 0.15)
STEEL: Colour = (0.70, 0.71, 0.73)
BRASS: Colour = (0.78, 0.62, 0.34)


def tint(rng: np.random.Generator, brightness: tuple[float, float], saturation: float = 0.5) -> Colour:
    """A colour of some hue."""
    hue = rng.random(3)
    hue = (hue - hue.min()) / (np.ptp(hue) + 1e-9)
    r, g, b = rng.uniform(*brightness) * (1 - saturation * (1 - hue))
    return float(r), float(g), float(b)


class Stuff:
    """The materials of one object, drawn from a seed: one wood, one metal, paints in order of use, one handle."""

    def __init__(self, rng: np.random.Generator, size: float = 1.0) -> None:
        """``size`` is that of the object, metres: patterns are so much finer."""
        self.rng, self.size = rng, size
        self.light, self.dark = WOODS[rng.integers(len(WOODS))]
        self.paints = [PAINTS[i] for i in rng.permutation(len(PAINTS))]
        self.pale: Colour = PALE[rng.integers(len(PALE))]
        self.metal_colour: Colour = BRASS if rng.random() < 0.35 else STEEL
        self.pull = int(rng.integers(3))

    def seed(self) -> int:
        return int(self.rng.integers(1 << 20))

    def wood(self, grain: int, scale: float = 0.07) -> Texture:
        return wood(self.light, self.dark, grain, self.seed(), scale * self.size)

    def paint(self, which: int = 0) -> Texture:
        """Nearly uniform."""
        return plain(self.paints[which], self.seed(), size=0.1 * self.size)

    def metal(self, axis: int = 0) -> Texture:
        return brushed(self.metal_colour, axis, self.seed(), size=0.004 * self.size)

    def front(self, kind: int, grain: int, which: int = 0) -> Texture:
        """What a door or drawer shows: 0 a panel in a wooden frame, 1 wood, 2 a speckled paint, 3 plain paint."""
        match kind:
            case 0:
                return inlay(self.wood(grain), self.paint(which), 0.035)
            case 1:
                return self.wood(grain)
            case 2:
                colour = np.asarray(self.paints[which])
                r, g, b = np.clip(0.45 * colour + 0.5, 0, 1)
                return speckle(self.paints[which], (r, g, b), 0.012 * self.size, self.seed(), 0.25)
        return self.paint(which)

    def lining(self) -> Texture:
        """Patterned paper inside."""
        r, g, b = 0.3 * np.asarray(self.paints[2]) + 0.6
        if self.rng.random() < 0.5:
            return checker(self.pale, (r, g, b), self.rng.uniform(0.03, 0.05), self.seed())
        return stripes(plain(self.pale, self.seed()), plain((r, g, b), self.seed()), int(self.rng.integers(2)), 0.04)


def bar(
    foot: tuple[float, float, float], along: tuple[int, int, int], length: float, texture: Texture, reach: float = 0.035
) -> tuple[Solid, ...]:
    """A bar of ``length`` on two posts, before a front that faces −y; ``foot`` is its middle on the front."""
    f, a = np.asarray(foot), np.asarray(along) * length / 2
    out = np.array([0, -reach, 0])

    def rod(p: np.ndarray, q: np.ndarray, radius: float) -> Solid:
        return capsule((p[0], p[1], p[2]), (q[0], q[1], q[2]), radius, texture)

    posts = (rod(f + 0.8 * k * a, f + 0.8 * k * a + out, 0.007) for k in (-1, 1))
    return (rod(f + out - a, f + out + a, 0.011), *posts)


def bow(
    foot: tuple[float, float, float], along: tuple[int, int, int], length: float, texture: Texture, reach: float = 0.035
) -> Solid:
    """A bent handle, its ends in the front, which faces −y."""
    turn = np.linspace(0, np.pi, 13)
    out, a = np.array([0.0, -1.0, 0.0]), np.asarray(along, float)
    bend = np.sign(np.cos(turn)) * np.abs(np.cos(turn)) ** 0.5
    path = np.asarray(foot) + np.outer(bend, a) * length / 2 + np.outer(np.sin(turn) ** 0.5 * reach, out)
    n = np.cross(a, out)
    return tube(path, (n[0], n[1], n[2]), (0.009, 0.007), texture)


def knob(foot: tuple[float, float, float], radius: float, texture: Texture) -> Solid:
    """A turned knob on a front that faces −y."""
    shape = [(0, -0.2), (0.4, -0.2), (0.35, 0.6), (0.9, 0.9), (1, 1.25), (0.85, 1.55), (0.4, 1.7), (0, 1.72)]
    return lathe([(r * radius, h * radius) for r, h in shape], foot, (0, -1, 0), texture, 24)


def pull(
    stuff: Stuff, foot: tuple[float, float, float], along: tuple[int, int, int], length: float
) -> tuple[Solid, ...]:
    """The handle that all fronts of one piece of furniture share."""
    metal = stuff.metal(1)
    match stuff.pull:
        case 0:
            return glossy(bar(foot, along, length, metal))
        case 1:
            return glossy((bow(foot, along, length, metal),))
    return glossy((knob(foot, 0.019, metal),))


def vase(stuff: Stuff, x: float, y: float, z: float, height: float) -> tuple[Solid, ...]:
    """A glazed vase on a table."""
    shape = [
        (0, 0),
        (0.22, 0),
        (0.3, 0.12),
        (0.34, 0.3),
        (0.3, 0.5),
        (0.17, 0.75),
        (0.15, 0.85),
        (0.2, 1),
        (0.12, 0.98),
    ]
    glaze = stripes(stuff.front(2, 0, 1), stuff.paint(2), 2, height, 0.2, z + 0.35 * height)
    turned = [(r * height, h * height) for r, h in (*shape, (0.1, 0.85), (0, 0.8))]
    return glossy((lathe(turned, (x, y, z), (0, 0, 1), glaze, 40),), 0.8)


def books(stuff: Stuff, x0: float, x1: float, y: float, z: float, height: float) -> tuple[Solid, ...]:
    """A row of books, spines in the plane y, looking towards −y; about a third of the board stays free."""
    row, x = [], x0
    while x < x0 + 0.68 * (x1 - x0):
        thick, tall = stuff.rng.uniform(0.016, 0.04), height * stuff.rng.uniform(0.6, 0.92)
        cover, title = (plain(stuff.paints[i], stuff.seed()) for i in stuff.rng.permutation(len(stuff.paints))[:2])
        band = stripes(cover, title, 2, tall, stuff.rng.uniform(0.08, 0.2), z + tall * stuff.rng.uniform(0.5, 0.75))
        paper = stripes(plain((0.9, 0.87, 0.8), 1), plain((0.75, 0.72, 0.65), 2), 0, 0.003)
        deep = stuff.rng.uniform(0.1, 0.15)
        row.append(box((x, y, z), (x + thick, y + deep, z + tall), by_face(band, f4=paper, f5=paper)))
        x += thick + 0.001
    return tuple(row)


Kind = Literal["drawer", "left", "right", "niche"]
"""A drawer, a door hinged at its left or right edge, or an open shelf with books."""
FRONT, GAP, SEAM = 0.02, 0.004, 0.004
"""Thickness of fronts, their distance from the carcass, and half of that from each other; metres."""
BOARD = 0.012


@dataclass(frozen=True)
class Cell:
    """A compartment: a box of boards open towards −y, and what closes it."""

    name: str
    kind: Kind
    x: tuple[float, float]
    z: tuple[float, float]


@dataclass(frozen=True)
class Finish:
    """How the cells of one piece of furniture look."""

    front: int
    """As ``Stuff.front`` counts."""
    carcass: Texture
    lining: Texture


def finish(stuff: Stuff, fronts: tuple[int, ...] = (0, 1, 2, 3)) -> Finish:
    return Finish(int(stuff.rng.choice(fronts)), stuff.wood(2), stuff.lining())


def compartment(
    stuff: Stuff, style: Finish, cell: Cell, y: tuple[float, float]
) -> tuple[tuple[Solid, ...], Body | None]:
    """The boards of a cell between the depths ``y``, and the moving front with its hinge."""
    (x0, x1), (z0, z1), (y0, y1) = cell.x, cell.z, y
    carcass = open_box((x0, y0, z0), (x1, y1, z1), BOARD, style.carcass, style.lining, face=2)
    a, b = BOARD, z1 - z0 - 2 * BOARD
    if cell.kind == "niche":
        return carcass + books(stuff, x0 + 2 * a, x1 - a, y0 + 0.05, z0 + a, b), None
    face, back = y0 - GAP - FRONT, y0 - GAP
    low, high = (x0 + SEAM, face, z0 + SEAM), (x1 - SEAM, back, z1 - SEAM)
    middle = (x0 + x1) / 2
    wide = x1 - x0
    if cell.kind == "drawer":
        c = a + 0.006
        tray = open_box(
            (x0 + c, back - 0.001, z0 + c), (x1 - c, y1 - 0.04, z0 + c + 0.65 * b), 0.01, stuff.wood(1), stuff.lining()
        )
        slab = box(low, high, by_face(stuff.front(style.front, 0), f3=stuff.wood(0)), 0.004)
        grip = pull(stuff, (middle, face, (z0 + z1) / 2), (1, 0, 0), min(0.4 * wide, 0.22))
        travel = 0.72 * (y1 - y0)
        hinge = sliding(stuff.rng, "base", (0, -1, 0), (middle, face, z0), travel)
        return carcass, Body(cell.name, (slab, *tray, *grip), hinge)
    if b > 0.3:
        shelf = z0 + stuff.rng.uniform(0.42, 0.58) * (z1 - z0)
        carcass += (box((x0 + a, y0 + 0.04, shelf), (x1 - a, y1 - a, shelf + a), style.carcass),)
    sign = 1 if cell.kind == "right" else -1
    slab = box(low, high, by_face(stuff.front(style.front, 2), f3=stuff.wood(2)), 0.004)
    edge = middle + sign * (wide / 2 - SEAM)
    grip = pull(stuff, (middle - sign * (wide / 2 - 0.045), face, (z0 + z1) / 2), (0, 0, 1), min(0.4 * (z1 - z0), 0.16))
    # Hinged at its outer edge a door stays within its own width, whatever its neighbours do.
    hinge = turning(stuff.rng, "base", (0, 0, sign), (edge, face, z0), 105)
    return carcass, Body(cell.name, (slab, *grip), hinge)
