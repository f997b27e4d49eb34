"""Cupboards, tables and a chair."""

from itertools import pairwise

import numpy as np

from hingesplat.synth.model import Body, Hinge, Model, ajar_and_open, turning
from hingesplat.synth.shapes import Solid, box, cylinder, glossy, moved, rod, tube
from hingesplat.synth.stuff import FRONT, GAP, Cell, Kind, Stuff, bar, compartment, finish, tint, vase
from hingesplat.synth.textures import by_face, checker, speckle, wood


def cabinet(rng: np.random.Generator) -> Model:
    """A cabinet with one hinged door and one drawer, with a real interior and a shelf."""
    W, D, H = rng.uniform(0.52, 0.62), rng.uniform(0.38, 0.46), rng.uniform(0.62, 0.74)
    wall, gap = rng.uniform(0.022, 0.028), 0.004
    split = H * rng.uniform(0.62, 0.68)  # Height of the panel between door and drawer; the drawer is on top.
    w, d = W / 2, D / 2
    front = -d - gap  # The plane of the hinge: the fronts lie before the carcass and swing clear of it.

    warm = [
        ((0.86, 0.62, 0.36), (0.42, 0.22, 0.10)),
        ((0.80, 0.72, 0.55), (0.45, 0.33, 0.20)),
        ((0.66, 0.36, 0.24), (0.28, 0.12, 0.08)),
    ]
    light, dark = warm[rng.integers(len(warm))]
    s = int(rng.integers(1 << 20))
    side, level = wood(light, dark, 2, s), wood(light, dark, 0, s + 40)
    inside = checker(tint(rng, (0.8, 0.95), 0.25), tint(rng, (0.5, 0.65), 0.35), 0.045, s + 80)
    back = by_face(speckle(tint(rng, (0.6, 0.8), 0.3), tint(rng, (0.3, 0.45), 0.4), 0.02, s + 120), f2=inside)
    carcass = (
        box((-w, -d, 0), (-w + wall, d, H), side),
        box((w - wall, -d, 0), (w, d, H), side),
        box((-w + wall, -d, 0), (w - wall, d, wall), by_face(level, f5=inside)),
        box((-w + wall, -d, H - wall), (w - wall, d, H), level),
        box((-w + wall, -d, split - wall / 2), (w - wall, d, split + wall / 2), level),
        box((-w + wall, d - wall, wall), (w - wall, d, H - wall), back),
        box((-w + wall, -d * 0.5, split * 0.48), (w - wall, d - wall, split * 0.48 + wall * 0.8), level),
    )

    metal = wood(tint(rng, (0.8, 0.95), 0.1), tint(rng, (0.45, 0.55), 0.15), 1, s + 160, 0.02)
    door_face = speckle(tint(rng, (0.7, 0.9), 0.35), tint(rng, (0.35, 0.5), 0.5), rng.uniform(0.016, 0.026), s + 200)
    door_back = checker(tint(rng, (0.8, 0.95), 0.3), tint(rng, (0.45, 0.6), 0.4), 0.055, s + 240)
    left = bool(rng.random() < 0.5)
    sign = -1.0 if left else 1.0  # The side of the hinge; the handle lies on the other.
    hx = -sign * (w - 0.05)
    y = front - wall
    door = (
        box(
            (-w, y, 0),
            (w, front, split - gap),
            by_face(wood(light, dark, 2, s + 280), f2=door_face, f3=door_back),
        ),
        *bar((hx, y, split * 0.5), (0, 0, 1), rng.uniform(0.10, 0.16), metal),
    )

    drawer_face = wood(tint(rng, (0.8, 0.95), 0.35), tint(rng, (0.4, 0.5), 0.5), 0, s + 320, 0.035)
    box_out = wood((0.85, 0.78, 0.62), (0.55, 0.43, 0.28), 1, s + 360)
    box_in = checker(tint(rng, (0.8, 0.95), 0.3), tint(rng, (0.5, 0.65), 0.45), 0.04, s + 400)
    thin, clear = wall * 0.7, 0.008
    x1, z0, z1 = w - wall - clear, split + wall / 2 + clear, H - wall - 0.03
    yb = d - wall - 0.03
    drawer = (
        box((-w, y, split + gap), (w, front, H), by_face(drawer_face, f3=box_in)),
        box((-x1, front, z0), (-x1 + thin, yb, z1), by_face(box_out, f1=box_in)),
        box((x1 - thin, front, z0), (x1, yb, z1), by_face(box_out, f0=box_in)),
        box((-x1 + thin, yb - thin, z0), (x1 - thin, yb, z1), by_face(box_out, f2=box_in)),
        box((-x1 + thin, front, z0), (x1 - thin, yb - thin, z0 + thin), by_face(box_out, f5=box_in)),
        *bar((0, y, (split + H) / 2), (1, 0, 0), rng.uniform(0.12, 0.2), metal),
    )

    swing = ajar_and_open(rng, (0.15, 0.4), (1.0, 1.45))
    pull = ajar_and_open(rng, (0.02, 0.06), (0.17, 0.24))
    return Model(
        "cabinet",
        (
            Body("base", carcass),
            Body("door", door, Hinge("base", "revolute", (0, 0, sign), (sign * w, front, 0), (0.0, 1.9), swing)),
            Body(
                "drawer",
                drawer,
                Hinge("base", "prismatic", (0, -1, 0), (0, front, split), (0.0, 0.7 * D), pull),
            ),
        ),
    )


def _piece(
    name: str,
    stuff: Stuff,
    frame: tuple[Solid, ...],
    cells: list[Cell],
    y: tuple[float, float],
    fronts: tuple[int, ...],
) -> Model:
    """A piece of furniture: a frame and what its cells hold, in one finish."""
    style = finish(stuff, fronts)
    base, movers = list(frame), []
    for cell in cells:
        boards, mover = compartment(stuff, style, cell, y)
        base += boards
        movers += [mover] if mover else []
    return Model(name, (Body("base", tuple(base)), *movers))


def _corpus(stuff: Stuff, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> tuple[Solid, ...]:
    """Sides and a top around cells, on four feet."""
    t, front = 0.018, y[0] - GAP - FRONT
    sides = (box((a, y[0], z[0]), (a + t, y[1], z[1]), stuff.wood(2)) for a in (x[0] - t, x[1]))
    top = box(
        (x[0] - t - 0.01, front - 0.006, z[1] + 0.002), (x[1] + t + 0.01, y[1], z[1] + 0.026), stuff.wood(0), 0.004
    )
    plate = box((x[0], y[0], z[1] - 0.001), (x[1], y[1], z[1] + 0.003), stuff.wood(0))
    feet = (
        cylinder((a, b, 0), (0, 0, 1), 0.02, z[0] + 0.001, stuff.metal(2), 20)
        for a in (x[0] + 0.03, x[1] - 0.03)
        for b in (y[0] + 0.03, y[1] - 0.03)
    )
    return (*sides, top, plate, *feet)


def storage(rng: np.random.Generator) -> Model:
    """A bedside table: one drawer over an open shelf with books."""
    stuff = Stuff(rng)
    w, d, h, foot = rng.uniform(0.2, 0.27), rng.uniform(0.18, 0.22), rng.uniform(0.36, 0.46), 0.09
    split, y = foot + h * rng.uniform(0.48, 0.58), (-d, d)
    cells = [Cell("drawer", "drawer", (-w, w), (split, foot + h)), Cell("shelf", "niche", (-w, w), (foot, split))]
    return _piece("storage", stuff, _corpus(stuff, (-w, w), y, (foot, foot + h)), cells, y, (0, 1, 2))


def storage3(rng: np.random.Generator) -> Model:
    """A low sideboard: a drawer and an open shelf at one side, a door at the other."""
    stuff = Stuff(rng)
    w, d, h, foot = rng.uniform(0.45, 0.55), rng.uniform(0.17, 0.21), rng.uniform(0.4, 0.5), 0.1
    x, split, y = rng.uniform(-0.08, 0.08), foot + h * rng.uniform(0.5, 0.62), (-d, d)
    right = bool(rng.random() < 0.5)
    far, near = ((-w, x), (x, w)) if right else ((x, w), (-w, x))
    cells = [
        Cell("drawer", "drawer", far, (split, foot + h)),
        Cell("shelf", "niche", far, (foot, split)),
        Cell("door", "right" if right else "left", near, (foot, foot + h)),
    ]
    return _piece("storage3", stuff, _corpus(stuff, (-w, w), y, (foot, foot + h)), cells, y, (0, 1, 2))


def storage4(rng: np.random.Generator) -> Model:
    """A wardrobe of three doors: a tall one and two above each other."""
    stuff = Stuff(rng)
    w, d, h, foot = rng.uniform(0.36, 0.45), rng.uniform(0.2, 0.24), rng.uniform(0.85, 1.0), 0.06
    x, split, y = rng.uniform(-0.06, 0.02), foot + h * rng.uniform(0.42, 0.6), (-d, d)
    cells = [
        Cell("door_tall", "left", (-w, x), (foot, foot + h)),
        Cell("door_low", "right", (x, w), (foot, split)),
        Cell("door_high", "right", (x, w), (split, foot + h)),
    ]
    return _piece("storage4", stuff, _corpus(stuff, (-w, w), y, (foot, foot + h)), cells, y, (0, 1, 3))


def storage7(rng: np.random.Generator) -> Model:
    """A kitchen dresser: two doors, two drawers over them, and two doors on top."""
    stuff = Stuff(rng)
    w, d, h, foot = rng.uniform(0.42, 0.5), rng.uniform(0.19, 0.23), rng.uniform(0.9, 1.05), 0.05
    a, b, y = foot + h * rng.uniform(0.36, 0.42), foot + h * rng.uniform(0.56, 0.62), (-d, d)
    cells = []
    sides: tuple[tuple[Kind, tuple[float, float]], ...] = (("left", (-w, 0)), ("right", (0, w)))
    for side, x in sides:
        cells += [
            Cell(f"door_low_{side}", side, x, (foot, a)),
            Cell(f"drawer_{side}", "drawer", x, (a, b)),
            Cell(f"door_high_{side}", side, x, (b, foot + h)),
        ]
    return _piece("storage7", stuff, _corpus(stuff, (-w, w), y, (foot, foot + h)), cells, y, (0, 1, 2))


def _desk(stuff: Stuff, w: float, d: float, h: float, posts: list[float]) -> tuple[Solid, ...]:
    """A table top and square legs at the ``posts``."""
    top = box((-w, -d, h - 0.03), (w, d, h), stuff.wood(0, 0.09), 0.006)
    leg = stuff.wood(2)
    legs = (
        box((x - 0.022, y - 0.022, 0), (x + 0.022, y + 0.022, h - 0.02), leg, 0.004)
        for x in posts
        for y in (0.05 - d, d - 0.05)
    )
    return (top, *legs)


def table4(rng: np.random.Generator) -> Model:
    """A desk with three drawers: under each other at one side, or side by side."""
    stuff = Stuff(rng)
    w, d, h = rng.uniform(0.5, 0.62), rng.uniform(0.26, 0.31), rng.uniform(0.62, 0.72)
    y, top = (0.06 - d, d - 0.01), h - 0.029
    if rng.random() < 0.5:
        side, x, foot = rng.choice([-1.0, 1.0]), rng.uniform(0.28, 0.36), rng.uniform(0.06, 0.14)
        edges = np.linspace(foot, top, 4) + np.array([0, *rng.uniform(0, 0.04, 2), 0])
        span = (w - x, w - 0.02) if side > 0 else (0.02 - w, x - w)
        cells = [Cell(f"drawer_{i}", "drawer", span, (edges[i], edges[i + 1])) for i in range(3)]
        feet = [
            box((a, b, 0), (a + 0.03, b + 0.03, foot), stuff.wood(2))
            for a in (span[0], span[1] - 0.03)
            for b in (y[0], y[1] - 0.03)
        ]
        frame = (*_desk(stuff, w, d, h, [-side * (w - 0.05)]), *feet)
    else:
        edges = np.linspace(0.08 - w, w - 0.08, 4) + np.array([0, *rng.uniform(-0.04, 0.04, 2), 0])
        low = top - rng.uniform(0.13, 0.18)
        cells = [Cell(f"drawer_{i}", "drawer", (edges[i], edges[i + 1]), (low, top)) for i in range(3)]
        frame = _desk(stuff, w, d, h, [0.05 - w, w - 0.05])
    things = vase(stuff, 0.3 * w, 0.3 * d, h, rng.uniform(0.16, 0.24))
    return _piece("table4", stuff, (*frame, *things), cells, y, (0, 1, 2))


def table5(rng: np.random.Generator) -> Model:
    """A writing desk on two pedestals, each a drawer over a door."""
    stuff = Stuff(rng)
    w, d, h, foot = rng.uniform(0.58, 0.68), rng.uniform(0.25, 0.3), rng.uniform(0.64, 0.74), 0.05
    y, top = (0.06 - d, d - 0.01), h - 0.029
    wide, split = rng.uniform(0.3, 0.38), foot + (top - foot) * rng.uniform(0.6, 0.7)
    cells, feet = [], []
    for side, x in (("left", (0.02 - w, wide - w)), ("right", (w - wide, w - 0.02))):
        cells.append(Cell(f"drawer_{side}", "drawer", x, (split, top)))
        cells.append(Cell(f"door_{side}", "left" if side == "left" else "right", x, (foot, split)))
        feet.append(box((x[0] + 0.01, y[0] + 0.02, 0), (x[1] - 0.01, y[1] - 0.02, foot), stuff.wood(0)))
    things = vase(stuff, 0.2 * w, 0.4 * d, h, rng.uniform(0.16, 0.22))
    return _piece("table5", stuff, (*_desk(stuff, w, d, h, []), *feet, *things), cells, y, (0, 1, 2))


def latchdoor(rng: np.random.Generator) -> Model:
    """A wall cupboard whose door carries a lever that turns on the door."""
    stuff = Stuff(rng)
    w, d, h, foot = rng.uniform(0.26, 0.34), rng.uniform(0.16, 0.22), rng.uniform(0.55, 0.7), 0.05
    side: Kind = "left" if rng.random() < 0.5 else "right"
    y = (-d, d)
    frame, cell = _corpus(stuff, (-w, w), y, (foot, foot + h)), Cell("door", side, (-w, w), (foot, foot + h))
    base, door = _piece("latchdoor", stuff, frame, [cell], y, (0, 2, 3)).bodies
    inward = 1.0 if side == "left" else -1.0  # From the hinge towards the free edge.
    x, z, face = inward * (w - 0.06), foot + h * rng.uniform(0.42, 0.55), -d - GAP - FRONT
    metal = stuff.metal(0)
    plate = box((x - 0.025, face - 0.006, z - 0.07), (x + 0.025, face + 0.001, z + 0.07), stuff.metal(2), 0.003)
    length, y0 = rng.uniform(0.14, 0.19), face - 0.010
    bend = np.array([[0, 0], [0, -0.05], [0.008, -0.062], [0.02, -0.066], [length, -0.066]])
    path = np.column_stack([x - inward * bend[:, 0], y0 - 0.012 + bend[:, 1], np.full(len(bend), z)])
    lever = (
        tube(path, (0, 0, 1), 0.014, metal),
        cylinder((x, y0, z), (0, -1, 0), 0.024, 0.012, metal),
    )
    turn = turning(rng, "door", (0, inward, 0), (x, face, z), 75)
    door = Body("door", (door.solids[0], *glossy((plate,))), door.hinge)  # Without the usual handle.
    return Model("latchdoor", (base, door, Body("latch", glossy(lever), turn)))


def foldchair(rng: np.random.Generator) -> Model:
    """A folding chair of bent tubes; its seat folds up against the back."""
    stuff = Stuff(rng)
    w, h, seat = rng.uniform(0.19, 0.23), rng.uniform(0.82, 0.92), rng.uniform(0.42, 0.46)
    foot, lean, r = rng.uniform(0.2, 0.24), rng.uniform(0.42, 0.48), 0.012
    metal = stuff.metal(2) if rng.random() < 0.5 else stuff.paint(1)

    def rail(z: float) -> float:
        """Depth of the long rails at height z."""
        return lean * z / h - foot

    def across(x: float, y: float, z: float) -> Solid:
        return rod((-x, y, z), (x, y, z), 0.8 * r, metal, 16)

    arch = [(-w, rail(r), r), *((-w, rail(z), z) for z in np.linspace(0.2, h - 0.06, 5))]
    arch += [(x, rail(z), z) for x, z in ((0.03 - w, h - 0.015), (0.07 - w, h))]
    arch += [(-x, y, z) for x, y, z in reversed(arch)]
    along = np.array([0, lean, h]) / np.hypot(h, lean)
    plane = np.array([0, -along[2], along[1]])
    inner, top = w - 3.2 * r, seat - 0.04
    frame = [tube(np.array(arch), (plane[0], plane[1], plane[2]), r, metal), across(w, rail(0.13), 0.13)]
    reach = rail(seat) - rng.uniform(0.15, 0.18)  # Where the rear legs carry the front of the seat.
    rear = foot + 0.02
    for side in (-1, 1):
        x = side * inner
        frame.append(rod((x, rear, r), (x, reach, top), r, metal, 20))
        # The bolt where a leg crosses its rail.
        z = r + (rear - rail(r)) / (lean / h + (rear - reach) / (top - r))
        frame.append(rod((x, rail(z), z), (side * w, rail(z), z), 0.7 * r, metal, 16))
    frame += [across(inner, reach, top), across(inner, rear - (rear - reach) * 0.2, r + (top - r) * 0.2)]
    slats = int(rng.integers(2, 4))
    tilt = np.eye(4)
    tilt[:3, :3] = np.column_stack([[1, 0, 0], -plane, along])
    for i in range(slats):
        z = h - 0.1 - i * 0.28 / slats
        tilt[:3, 3] = 0, rail(z), z
        back = box((-w, 0.6 * r, -0.095 / slats), (w, 0.6 * r + 0.014, 0.095 / slats), stuff.wood(0), 0.005)
        frame += moved((back,), tilt)

    half, y0, y1 = inner - r - 0.006, rail(seat) - 0.34, rail(seat) + 0.045
    edges = np.linspace(y0, y1, int(rng.integers(4, 7)))
    boards = [
        box((-half, a + 0.003, seat), (half, b - 0.003, seat + 0.016), stuff.wood(0), 0.004) for a, b in pairwise(edges)
    ]
    ribs = [
        box((x - 0.012, y0 + 0.01, seat - 0.016), (x + 0.012, y1 - 0.01, seat + 0.002), metal)
        for x in (0.03 - half, half - 0.03)
    ]
    pin = rod((0.014 - w + r, rail(seat), seat - 0.004), (w - r - 0.014, rail(seat), seat - 0.004), 0.008, metal, 16)
    fold = turning(rng, "base", (-1, 0, 0), (0, rail(seat), seat - 0.004), 50)
    return Model(
        "foldchair", (Body("base", glossy(frame, 0.5)), Body("seat", glossy((*boards, *ribs, pin), 0.5), fold))
    )
