"""Fridges, ovens and a washing machine: smooth, glossy, nearly of one colour."""

import numpy as np

from hingesplat.synth.model import Body, Model, turning
from hingesplat.synth.shapes import (
    Solid,
    Texture,
    box,
    capsule,
    cylinder,
    extrude,
    glossy,
    lathe,
    open_box,
    rod,
    round_hole,
)
from hingesplat.synth.stuff import DARK, PALE, STEEL, Stuff, bar, knob
from hingesplat.synth.textures import Colour, brushed, by_face, inlay, panes, plain, speckle, stripes

GAP = 0.005


def _enamel(stuff: Stuff) -> Texture:
    """White, steel, or a colour; never much of a texture."""
    kind = stuff.rng.random()
    if kind < 0.45:
        return plain(stuff.pale, stuff.seed(), 0.05, 0.2)
    if kind < 0.7:
        return brushed(STEEL, 2, stuff.seed(), 0.06)
    return plain(stuff.paints[0], stuff.seed(), 0.06, 0.2)


def _bottles(stuff: Stuff, x: tuple[float, float], y: float, z: float, height: float) -> list[Solid]:
    """A row of bottles, jars and cartons on a shelf."""
    rng, row, at = stuff.rng, [], x[0] + 0.03
    while at < x[1] - 0.06:
        i, j = rng.permutation(len(stuff.paints))[:2]
        body, band = plain(stuff.paints[i], stuff.seed()), plain(PALE[rng.integers(len(PALE))], stuff.seed())
        h, r = height * rng.uniform(0.55, 0.9), rng.uniform(0.02, 0.032)
        skin = stripes(body, stripes(band, plain(stuff.paints[j], 3), 2, 0.022, 0.3), 2, h, 0.4, z + 0.2 * h)
        if rng.random() < 0.35:
            row.append(box((at, y - r, z), (at + 2 * r, y + r, z + h), skin))
        else:
            neck = rng.uniform(0.3, 0.8) * r
            shape = [(0, 0), (r, 0), (r, 0.65 * h), (neck, 0.82 * h), (neck, h), (0, h)]
            row.append(lathe(shape, (at + r, y, z), (0, 0, 1), skin, 20))
        at += 2 * r + rng.uniform(0.006, 0.05)
    return row


def _cold_room(stuff: Stuff, w: float, d: float, z: tuple[float, float], enamel: Texture, shelves: int) -> list[Solid]:
    """An insulated box open towards −y, with shelves and what stands on them."""
    wall, white = 0.035, plain((0.9, 0.93, 0.95), stuff.seed(), 0.04)
    solids = list(open_box((-w, -d, z[0]), (w, d, z[1]), wall, enamel, white, face=2))
    low, high = z[0] + wall, z[1] - wall
    step = (high - low) / (shelves + 1)
    glass = plain((0.62, 0.78, 0.80), stuff.seed(), 0.06)
    for i in range(shelves + 1):
        level = low + i * step
        if i:
            solids.append(box((wall - w, 0.11 - d, level - 0.008), (w - wall, d - wall, level), glass))
            solids.append(box((wall - w, 0.105 - d, level - 0.014), (w - wall, 0.115 - d, level + 0.004), white))
        solids += _bottles(stuff, (wall - w, w - wall), stuff.rng.uniform(0.0, 0.3) * d, level, 0.8 * step)
    return solids


def _cold_door(
    stuff: Stuff, name: str, w: float, d: float, z: tuple[float, float], right: bool, enamel: Texture, grip: Texture
) -> Body:
    """A thick door with racks inside, hinged at its front edge."""
    thick, wall, sign = 0.05, 0.035, 1 if right else -1
    face, back = -d - GAP - thick, -d - GAP
    white = plain((0.92, 0.94, 0.95), stuff.seed(), 0.04)
    slab = box((-w, face, z[0] + 0.003), (w, back, z[1] - 0.003), by_face(enamel, f3=white), 0.014)
    inside, solids = w - wall - 0.035, []
    racks = max(1, round((z[1] - z[0]) / 0.3))
    for i in range(racks):
        level = z[0] + 0.06 + i * (z[1] - z[0] - 0.08) / racks
        solids += open_box((-inside, back - 0.002, level), (inside, back + 0.075, level + 0.05), 0.006, white, white)
        solids += _bottles(stuff, (0.02 - inside, inside - 0.02), back + 0.036, level + 0.005, 0.14)
    for i in range(int(stuff.rng.choice([0, 0, 3, 6]))):  # Notes under magnets, on some doors.
        x, tall = stuff.rng.uniform(-0.6, 0.4) * w, stuff.rng.uniform(0.05, 0.08)
        level = stuff.rng.uniform(z[0] + 0.1, z[1] - 0.2)
        text = stripes(plain(stuff.pale, i), plain(stuff.paints[i], i), 2, 0.012, 0.4)
        solids.append(box((x, face - 0.0015, level), (x + 0.06, face + 0.001, level + tall), text))
        solids.append(
            cylinder((x + 0.03, face, level + tall - 0.012), (0, -1, 0), 0.008, 0.008, stuff.paint(i + 1), 16)
        )
    logo = box((-0.03, face - 0.002, z[1] - 0.07), (0.03, face + 0.001, z[1] - 0.055), stuff.paint(1))
    length = min(0.5 * (z[1] - z[0]), 0.34)
    end = z[0] + 0.12 + length / 2 if z[0] > 0.5 else z[1] - 0.12 - length / 2
    handle = bar((-sign * (w - 0.05), face, end), (0, 0, 1), length, grip)
    hinge = turning(stuff.rng, "base", (0, 0, sign), (sign * w, face, z[0]), 110)
    return Body(name, (*glossy((slab, logo, *handle)), *solids), hinge)


def _fridge(stuff: Stuff, name: str, doors: list[tuple[str, float]]) -> Model:
    """A fridge of doors from the bottom up, each with its share of the height."""
    rng = stuff.rng
    w, d, foot = rng.uniform(0.26, 0.31), rng.uniform(0.25, 0.3), 0.04
    h, right, enamel = rng.uniform(1.0, 1.25), bool(rng.random() < 0.6), _enamel(stuff)
    grip = brushed(STEEL if rng.random() < 0.6 else DARK, 2, stuff.seed())
    base: list[Solid] = [box((-w + 0.02, -d + 0.03, 0), (w - 0.02, d - 0.03, foot), plain(DARK, 1))]
    movers, z = [], foot
    for door, share in doors:
        top = z + share * h
        base += glossy(_cold_room(stuff, w, d, (z, top), enamel, max(1, round(share * 3))), 0.5)
        movers.append(_cold_door(stuff, door, w, d, (z, top), right, enamel, grip))
        z = top
    return Model(name, (Body("base", tuple(base)), *movers))


def fridge(rng: np.random.Generator) -> Model:
    """A fridge with one door."""
    return _fridge(Stuff(rng), "fridge", [("door", 1.0)])


def fridge3(rng: np.random.Generator) -> Model:
    """A fridge with a freezer under or over it."""
    share = rng.uniform(0.3, 0.42)
    doors = [("door_freezer", share), ("door_fridge", 1 - share)]
    return _fridge(Stuff(rng), "fridge3", doors if rng.random() < 0.5 else doors[::-1])


def _oven(
    stuff: Stuff, w: tuple[float, float], d: float, z: tuple[float, float], skin: Texture, racks: int
) -> list[Solid]:
    """A cavity of dark enamel with wire racks and a tray."""
    r, g, b = stuff.paints[1]
    dark: Colour = (0.25 + 0.1 * r, 0.25 + 0.1 * g, 0.27 + 0.1 * b)
    enamel = speckle(dark, (0.62, 0.62, 0.66), 0.006, stuff.seed(), 0.12)
    wall = 0.03
    solids = list(open_box((w[0], -d, z[0]), (w[1], d, z[1]), wall, skin, enamel, face=2))
    steel = brushed((0.75, 0.75, 0.77), 0, stuff.seed())
    x0, x1, y0, y1 = w[0] + wall - 0.003, w[1] - wall + 0.003, 0.03 - d, d - wall - 0.01
    for i in range(racks):
        level = z[0] + (z[1] - z[0]) * (i + 1) / (racks + 1)
        if i == 0:
            tray = plain((0.35, 0.33, 0.33), stuff.seed(), 0.2, 0.03)
            solids += open_box((x0, y0, level), (x1, y1, level + 0.03), 0.004, steel, tray)
            continue
        solids += [rod((x0, y, level), (x1, y, level), 0.004, steel) for y in (y0, y1)]
        bars = max(5, round((x1 - x0) / 0.045))
        solids += [rod((x, y0, level), (x, y1, level), 0.003, steel, 8) for x in np.linspace(x0, x1, bars + 2)[1:-1]]
    return solids


def _oven_door(
    stuff: Stuff, name: str, w: tuple[float, float], d: float, z: tuple[float, float], skin: Texture, down: bool
) -> Body:
    """A door with a dark window, hinged at its lower or its right front edge."""
    face, back, wide, tall = -d - GAP - 0.03, -d - GAP, w[1] - w[0], z[1] - z[0]
    glass = plain((0.10, 0.11, 0.13), stuff.seed(), 0.3)
    inner = plain((0.30, 0.30, 0.32), stuff.seed(), 0.1)
    rim = min(0.07, 0.24 * min(wide, tall))
    low, high = (w[0] + 0.004, face, z[0] + 0.004), (w[1] - 0.004, back, z[1] - 0.004)
    front = by_face(skin, f2=skin, f3=inlay(inner, glass, 1.2 * rim))
    frame, steel = box(low, high, front, 0.005), brushed(STEEL, 0, stuff.seed(), 0.15)
    window = box((w[0] + rim, face - 0.003, z[0] + rim), (w[1] - rim, face + 0.001, z[1] - 1.5 * rim), glass, 0.002)
    if down:
        grip = bar(((w[0] + w[1]) / 2, face, z[1] - 0.5 * rim - 0.015), (1, 0, 0), 0.8 * wide, steel, 0.03)
        hinge = turning(stuff.rng, "base", (1, 0, 0), ((w[0] + w[1]) / 2, face, low[2]), 88)
    else:
        grip = bar((w[0] + 0.5 * rim, face, (z[0] + z[1]) / 2), (0, 0, 1), 0.6 * tall, steel, 0.03)
        hinge = turning(stuff.rng, "base", (0, 0, 1), (high[0], face, z[0]), 105)
    return Body(name, glossy((frame, window, *grip)), hinge)


def _hob(stuff: Stuff, w: float, d: float, z: float, columns: int) -> list[Solid]:
    """A cooker's top: burners with their rings, and sometimes a pot."""
    top = box((-w, -d - 0.03, z), (w, d, z + 0.025), plain((0.16, 0.16, 0.18), stuff.seed(), 0.15), 0.005)
    solids = list(glossy((top,)))
    iron, pot = plain((0.28, 0.28, 0.30), stuff.seed(), 0.2, 0.02), int(stuff.rng.integers(2 * columns))
    for i, (cx, cy) in enumerate((x, y) for x in (np.arange(columns) + 0.5) / columns * 2 - 1 for y in (-0.45, 0.45)):
        x, y, r = cx * w, cy * d, stuff.rng.uniform(0.055, 0.075)
        ring = [(r, 0), (r, 0.012), (r - 0.014, 0.012), (r - 0.014, 0), (r, 0)]
        solids.append(lathe(ring, (x, y, z + 0.024), (0, 0, 1), iron, 40))
        cap = (r - 0.001, 0.0125) if i == pot else (0.5 * r, 0.008)  # No hollow under a pot.
        solids.append(cylinder((x, y, z + 0.024), (0, 0, 1), *cap, plain(STEEL, 7, 0.1, 0.02)))
        if i == pot:
            h, p = stuff.rng.uniform(0.09, 0.13), 1.15 * r
            wall = [(0, 0), (p, 0), (p, h), (p - 0.006, h), (p - 0.006, 0.01), (0, 0.01)]
            solids += glossy((lathe(wall, (x, y, z + 0.0355), (0, 0, 1), stuff.paint(0), 48),))
            for s in (-1, 1):
                ear = (x + s * (p - 0.003), y, z + 0.03 + 0.8 * h)
                solids.append(capsule(ear, (ear[0] + s * 0.03, y, ear[2]), 0.009, plain(DARK, 2)))
    return solids


def _knobs(stuff: Stuff, xs: np.ndarray, y: float, z: float, radius: float) -> list[Solid]:
    """Turned knobs on a panel that faces −y, each with a mark."""
    skin = brushed(STEEL if stuff.rng.random() < 0.5 else DARK, 2, stuff.seed())
    solids = [knob((float(x), y, z), radius, skin) for x in xs]
    mark = plain((0.85, 0.25, 0.15), 4)
    marks = [box((x - 0.003, y - 1.8 * radius, z), (x + 0.003, y - 1.6 * radius, z + 0.8 * radius), mark) for x in xs]
    return [*glossy(solids), *marks]


def _cooker(
    stuff: Stuff, name: str, w: float, h: float, doors: list[tuple[str, tuple[float, float], tuple[float, float], bool]]
) -> Model:
    """A cooker: ovens from z = 0.09 to ``h``, a panel with knobs, a hob. Doors: name, x, z, whether it drops."""
    rng = stuff.rng
    d, panel, skin = rng.uniform(0.26, 0.3), rng.uniform(0.09, 0.12), _enamel(stuff)
    base: list[Solid] = [
        box((-w, -d - 0.02, h), (w, d, h + panel), skin),
        box((-w + 0.01, -d + 0.03, 0.03), (w - 0.01, d - 0.02, 0.091), plain(DARK, 1, 0.2)),
        *_hob(stuff, w, d, h + panel - 0.001, round(w / 0.17)),
        *_knobs(stuff, np.linspace(-0.8 * w, 0.8 * w, round(w / 0.06)), -d - 0.02, h + 0.45 * panel, 0.2 * panel),
    ]
    base += [
        cylinder((x, y, 0), (0, 0, 1), 0.022, 0.04, plain(DARK, 6), 20)
        for x in (0.06 - w, w - 0.06)
        for y in (0.07 - d, d - 0.07)
    ]
    movers = []
    for door, x, z, down in doors:
        base += _oven(stuff, x, d, z, skin, 1 if z[1] - z[0] < 0.25 else 2 if down else 3)
        movers.append(_oven_door(stuff, door, x, d, z, skin, down))
    return Model(name, (Body("base", tuple(base)), *movers))


def oven(rng: np.random.Generator) -> Model:
    """A cooker with one drop-down door."""
    w, h = rng.uniform(0.27, 0.33), rng.uniform(0.52, 0.6)
    return _cooker(Stuff(rng), "oven", w, h, [("door", (-w, w), (0.09, h), True)])


def oven4(rng: np.random.Generator) -> Model:
    """A range cooker: a grill over an oven, both with drop-down doors, and a tall oven hinged at the right."""
    w, h = rng.uniform(0.44, 0.5), rng.uniform(0.56, 0.64)
    x, z = w * rng.uniform(0.1, 0.25), 0.09 + (h - 0.09) * rng.uniform(0.52, 0.6)
    doors = [
        ("door_oven", (-w, x), (0.09, z), True),
        ("door_grill", (-w, x), (z, h), True),
        ("door_tall", (x, w), (0.09, h), False),
    ]
    return _cooker(Stuff(rng), "oven4", w, h, doors)


def washer(rng: np.random.Generator) -> Model:
    """A washing machine with a round door, nearly all white."""
    stuff = Stuff(rng)
    w, d, foot, wall = rng.uniform(0.29, 0.32), rng.uniform(0.25, 0.3), 0.03, 0.015
    h, panel, hole = rng.uniform(0.78, 0.88), 0.12, rng.uniform(0.145, 0.165)
    skin = plain(PALE[rng.integers(len(PALE))], stuff.seed(), 0.04, 0.2)
    top, z = h - panel, (foot + h - panel) / 2
    grey, steel = plain((0.5, 0.52, 0.55), stuff.seed(), 0.15, 0.05), brushed((0.72, 0.73, 0.75), 1, stuff.seed())
    outline, ring = round_hole((foot, -w), (top, w), hole)
    holes = stripes(steel, stripes(steel, plain((0.2, 0.2, 0.22), 5), 1, 0.03, 0.35), 2, 0.03, 0.35)
    deep = d + 0.10
    drum = [(0, 0), (hole + 0.004, 0), (hole + 0.004, deep), (hole - 0.012, deep), (hole - 0.012, 0.01), (0, 0.01)]
    base = [
        *open_box((-w, -d + wall, foot), (w, d, h), wall, skin, grey, face=2),
        extrude(outline, 1, -d, -d + wall + 0.001, skin, ring),
        lathe(drum, (0, -d + wall + deep, z), (0, -1, 0), holes, 96),
        box((-w, -d - 0.012, top), (w, -d + wall + 0.001, h), skin, 0.005),
        box((-w, -d, h - 0.001), (w, d, h + 0.02), skin, 0.006),
    ]
    mid, face = top + 0.5 * panel, -d - 0.012
    display = panes((0.05, 0.08, 0.12), (0.1, 0.2, 0.25), (0, 2), 0.006, stuff.seed())
    base += [
        box((0.02 - w, face - 0.006, top + 0.02), (0.19 - w, face + 0.001, h - 0.02), skin, 0.003),
        box((0.10 - w, face - 0.009, top + 0.035), (0.17 - w, face - 0.005, top + 0.05), grey, 0.001),
        box((0.1, face - 0.003, mid - 0.03), (0.2, face + 0.001, mid + 0.03), display, 0.001),
        *_knobs(stuff, np.array([-0.02]), face, mid, 0.03),
        *(
            cylinder((0.225, face + 0.001, mid + k * 0.028), (0, -1, 0), 0.008, 0.006, stuff.paint(k + 1), 20)
            for k in (-1, 0, 1)
        ),
    ]
    base += [
        cylinder((x, y, 0), (0, 0, 1), 0.025, foot + 0.001, plain(DARK, 6), 20)
        for x in (0.06 - w, w - 0.06)
        for y in (0.06 - d, d - 0.06)
    ]

    return Model("washer", (Body("base", glossy(base, 0.6)), _washer_door(stuff, hole, -d - GAP, z)))


def _washer_door(stuff: Stuff, hole: float, back: float, z: float) -> Body:
    """A round door whose glass bowl reaches through a hole of that radius into the drum; its rear at y = ``back``."""
    rng, thick, rim, bowl = stuff.rng, 0.035, hole + 0.045, hole - 0.03
    side, y = 1.0 if rng.random() < 0.3 else -1.0, back - thick
    frame = brushed((0.78, 0.79, 0.81), 1, stuff.seed(), 0.1) if rng.random() < 0.6 else plain(stuff.paints[0], 3)
    glass = plain((0.16, 0.19, 0.22), stuff.seed(), 0.2)

    def skin(x: np.ndarray, face: int) -> np.ndarray:
        outside = np.hypot(x[:, 0], x[:, 2] - z) > bowl + 0.004
        return np.where(outside[:, None], frame(x, face), glass(x, face))

    # One profile from the front's centre round the rim and back over the bowl.
    front = [(0, -0.004), (0.5 * bowl, 0), (bowl, 0.012), (bowl + 0.008, 0), (rim - 0.008, 0), (rim, 0.008)]
    deep = [(1, 0), (0.95, 0.03), (0.8, 0.055), (0.5, 0.065), (0, 0.068)]
    behind = [(rim, thick), *((r * bowl, thick + h) for r, h in deep)]
    free = -side * (rim - 0.01)
    solids = (
        lathe([*front, *behind], (0, y, z), (0, 1, 0), skin, 96),
        box((free - 0.014, y - 0.016, z - 0.05), (free + 0.014, y + 0.012, z + 0.05), plain(DARK, 9), 0.005),
        box((side * (rim - 0.02), y + 0.004, z - 0.04), (side * (rim + 0.012), back - 0.002, z + 0.04), frame, 0.003),
    )
    return Body("door", glossy(solids), turning(rng, "base", (0, 0, side), (side * (rim + 0.012), y, z), 120))
