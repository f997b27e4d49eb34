"""Things for the desk: laptop, scissors, staplers, a knife, a memory stick."""

import numpy as np

from hingesplat.synth.model import Body, Hinge, Model, ajar_and_open, sliding, turning
from hingesplat.synth.shapes import Solid, box, capsule, cylinder, extrude, glossy, open_box, tube
from hingesplat.synth.stuff import DARK, STEEL, Stuff, tint
from hingesplat.synth.textures import brushed, by_face, checker, panes, plain, speckle, stripes, wood


def laptop(rng: np.random.Generator) -> Model:
    """A laptop: a slab with keys, and a hinged lid with a screen."""
    W, D, T = rng.uniform(0.33, 0.37), rng.uniform(0.23, 0.26), rng.uniform(0.018, 0.022)
    w, lid, gap = W / 2, rng.uniform(0.010, 0.013), 0.005
    s = int(rng.integers(1 << 20))
    shell = speckle(tint(rng, (0.7, 0.85), 0.15), tint(rng, (0.35, 0.5), 0.3), rng.uniform(0.010, 0.015), s)
    deck = wood(tint(rng, (0.7, 0.9), 0.3), tint(rng, (0.35, 0.5), 0.4), 0, s + 40, 0.02)
    pad = checker(tint(rng, (0.6, 0.8), 0.3), tint(rng, (0.4, 0.5), 0.3), 0.012, s + 80)
    solids = [box((-w, -D / 2, 0), (w, D / 2, T), by_face(shell, f5=deck))]
    solids.append(box((-0.05, -D / 2 + 0.012, T), (0.05, -D / 2 + 0.07, T + 0.0012), pad))
    columns, rows, pitch = 13, 5, 0.9 * W / 13
    for r, c in np.ndindex(rows, columns):
        x, y = (c - (columns - 1) / 2) * pitch, -D / 2 + 0.09 + r * pitch
        h = pitch * 0.42
        ink = tint(rng, (0.75, 0.95), 0.3)
        key = speckle(tint(rng, (0.2, 0.45), 0.35), ink, 0.006, s + 200 + r * 31 + c)
        solids.append(box((x - h, y - h, T), (x + h, y + h, T + 0.003), key))

    back = T + gap
    screen = panes(tint(rng, (0.3, 0.5), 0.6), tint(rng, (0.7, 0.95), 0.4), (0, 1), 0.012, s + 120)
    cover = checker(tint(rng, (0.7, 0.85), 0.35), tint(rng, (0.45, 0.6), 0.45), 0.031, s + 160)
    lid_solids = (
        box((-w, -D / 2, back), (w, D / 2, back + lid), by_face(shell, f4=shell, f5=cover)),
        box(
            (-w + 0.012, -D / 2 + 0.012, back - 0.001),
            (w - 0.012, D / 2 - 0.02, back),
            by_face(shell, f4=screen),
        ),
        capsule((-w * 0.8, D / 2, back), (w * 0.8, D / 2, back), 0.005, shell),
    )
    opening = ajar_and_open(rng, (0.7, 1.0), (1.6, 2.0))
    hinge = Hinge("base", "revolute", (-1, 0, 0), (0, D / 2, back), (0.0, 2.3), opening)
    return Model("laptop", (Body("base", tuple(solids)), Body("lid", lid_solids, hinge)))


def scissor(rng: np.random.Generator) -> Model:
    """Scissors that lie flat: two blades on a pivot, each with a loop for the fingers."""
    stuff = Stuff(rng, 0.2)
    blade, shank, t = rng.uniform(0.1, 0.13), rng.uniform(0.05, 0.065), rng.uniform(0.005, 0.0065)
    gap, wide, rod = 0.0009, rng.uniform(0.014, 0.018), rng.uniform(0.0055, 0.007)
    middle = t + gap / 2 + 0.001  # Height of the loops, which are as thick as both blades.
    plastic = stuff.front(2, 0) if rng.random() < 0.5 else stuff.paint(0)
    metal = [(blade, 0.001), (0.7 * blade, 0.75 * wide), (0, wide), (-0.012, 0.006), (-0.01, -0.006), (0.01, -0.005)]
    grip = [(0.0, 0.006), (-0.012, 0.008), (-shank, -0.006), (-shank - 0.004, -0.019), (-0.02, -0.015), (0.0, -0.006)]
    halves: list[tuple[Solid, ...]] = []
    for mirror, long in ((1, 0.030), (-1, rng.uniform(0.024, 0.032))):
        low = middle - gap / 2 - t if mirror > 0 else middle + gap / 2
        edge, handle = (np.array(line)[::mirror] * [1, mirror] for line in (metal, grip))
        turn = np.linspace(0, 2 * np.pi, 36, endpoint=False)
        wide_loop = 0.0195 * np.sin(turn) - mirror * (0.0215 + rod)
        loop = np.column_stack([long * np.cos(turn) + 0.006 - shank - long, wide_loop, np.full(36, middle)])
        steel = extrude(edge, 2, low, low + t, brushed(STEEL, 0, stuff.seed(), 0.15, 0.001))
        ring = tube(loop, (0, 0, 1), (middle, rod), plastic, closed=True)
        halves.append(glossy((steel, extrude(handle, 2, low - 0.0002 * mirror, low + t, plastic), ring), 0.8))
    screw = cylinder((0, 0, middle + gap / 2 + t - 0.0005), (0, 0, 1), 0.0055, 0.0025, stuff.metal(0))
    hinge = turning(rng, "base", (0, 0, -1), (0, 0, 0), 75)
    return Model("scissor", (Body("base", halves[0]), Body("blade", (*halves[1], *glossy((screw,))), hinge)))


def _stapler(rng: np.random.Generator, name: str, middle: bool) -> Model:
    """A stapler along x, hinged at its rear (+x): base, magazine and arm, the last two one piece or two."""
    stuff = Stuff(rng, 0.2)
    nose, w, gap = rng.uniform(0.075, 0.095), rng.uniform(0.0135, 0.0165), 0.0008
    skin = stuff.paint(0) if rng.random() < 0.6 else stuff.front(2, 0)
    steel, rubber = brushed(STEEL, 0, stuff.seed(), 0.12, 0.001), plain(DARK, 1, 0.15, 0.01)
    rear, low, top = 0.05, 0.012, rng.uniform(0.04, 0.048)
    pin, over = np.array([rear, 0.027]), np.array([rear, 0.034])  # Of the magazine, and of the arm upon it.

    def profile(points: list[tuple[float, float]]) -> np.ndarray:
        """(x, z) points, clockwise as drawn, for an extrusion along y, which wants (z, x)."""
        return np.array(points)[:, ::-1]

    def cheek(y: float, centre: np.ndarray, foot: float, radius: float, thick: float) -> Solid:
        turn = np.linspace(0, np.pi, 13)
        round_top = [(centre[0] - radius * np.cos(a), centre[1] + radius * np.sin(a)) for a in turn]
        return extrude(
            profile([*round_top, (rear + radius, foot), (rear - radius, foot)]), 1, y - thick / 2, y + thick / 2, steel
        )

    base = [
        box((-nose - 0.008, -w - 0.004, 0.0015), (rear + 0.016, w + 0.004, low), skin, 0.0035),
        box((-nose, -0.009, low - 0.001), (0.016 - nose, 0.009, low + 0.0015), steel, 0.001),
        *(box((x, -w - 0.002, 0), (x + 0.022, w + 0.002, 0.004), rubber, 0.001) for x in (-nose, rear - 0.018)),
        *(cheek(k * (w + gap + 0.001), pin, low - 0.002, 0.010, 0.002) for k in (-1, 1)),
        *(cylinder((rear, k * (w + 0.001), pin[1]), (0, k, 0), 0.004, 0.003, steel, 20) for k in (-1, 1)),
    ]
    side = w - gap
    z0, z1 = low + 0.006, low + 0.0155
    magazine = [
        *open_box((-nose, -0.0085, z0), (rear - 0.012, 0.0085, z1), 0.0012, steel, plain((0.3, 0.3, 0.32), 2)),
        box(
            (-nose + 0.002, -0.006, z0 + 0.001),
            (rear - 0.045, 0.006, z1 - 0.002),
            stripes(plain((0.82, 0.82, 0.85), 3), plain((0.5, 0.5, 0.53), 4), 0, 0.0016),
        ),
        box((rear - 0.0135, -side, z0), (rear + 0.006, side, pin[1] - 0.002), steel, 0.002),
    ]
    bottom = z1 + 0.0012
    crown = [
        (-nose - 0.003, bottom),
        (-nose - 0.004, top - 0.013),
        (-nose + 0.006, top - 0.005),
        (-0.3 * nose, top),
        (0.3 * rear, top - 0.001),
        (rear - 0.016, top - 0.006),
        (rear - 0.013, bottom),
    ]
    tongue = [
        (rear - 0.026, bottom),
        (rear - 0.026, top - 0.006),
        (rear + 0.004, over[1] + 0.006),
        (rear + 0.008, over[1]),
        (rear + 0.004, over[1] - 0.004),
        (rear - 0.013, bottom),
    ]
    wing = 0.5 * side
    arm = [
        extrude(profile(crown), 1, -w, w, skin),
        extrude(profile(tongue), 1, -wing, wing, skin),
        box((-nose + 0.012, -0.7 * w, top - 0.008), (-0.05 * nose, 0.7 * w, top + 0.0015), rubber, 0.002),
    ]

    def lifting(parent: str, at: np.ndarray, degrees: float) -> Hinge:
        return turning(rng, parent, (0, 1, 0), (float(at[0]), 0, float(at[1])), degrees)

    if not middle:
        neck = box((rear - 0.02, -wing, z0), (rear + 0.004, wing, over[1]), steel, 0.002)
        arm_body = Body("arm", glossy((*magazine, neck, *arm), 0.7), lifting("base", pin, 70))
        return Model(name, (Body("base", glossy(base, 0.7)), arm_body))
    magazine += [cheek(k * (wing + gap + 0.0008), over, z0 + 0.002, 0.007, 0.0016) for k in (-1, 1)]
    movers = (
        Body("magazine", glossy(magazine, 0.7), lifting("base", pin, 45)),
        Body("arm", glossy(arm, 0.7), lifting("magazine", over, 55)),
    )
    return Model(name, (Body("base", glossy(base, 0.7)), *movers))


def stapler(rng: np.random.Generator) -> Model:
    """A stapler; the arm lifts with the magazine."""
    return _stapler(rng, "stapler", False)


def stapler3(rng: np.random.Generator) -> Model:
    """A stapler whose magazine lifts from the base, and the arm from the magazine."""
    return _stapler(rng, "stapler3", True)


def usb(rng: np.random.Generator) -> Model:
    """A memory stick whose steel cover swivels round it."""
    stuff = Stuff(rng, 0.06)
    w, length, t = rng.uniform(0.0085, 0.01), rng.uniform(0.034, 0.042), rng.uniform(0.007, 0.009)
    plug, gap, sheet = 0.014, 0.0005, 0.0011
    z0 = sheet + gap
    skin = stuff.front(int(rng.choice([2, 3])), 0)
    turn = np.linspace(np.pi / 2, 1.5 * np.pi, 21)

    def rounded(end: float, swell: float) -> np.ndarray:
        """A strip from a round rear end about the pivot to x = ``end``."""
        rear = np.stack([swell * w * np.cos(turn), w * np.sin(turn)], 1)
        return np.vstack([rear, [(end, -w), (end, w)]])

    steel = brushed((0.78, 0.79, 0.8), 0, stuff.seed(), 0.1, 0.0008)
    pw, pt, start, zm = 0.0062, 0.0024, length - plug - 0.0005, z0 + t / 2
    contacts = stripes(plain((0.15, 0.15, 0.16), 3), plain((0.85, 0.68, 0.3), 4), 1, 0.0026, 0.6)
    tongue = by_face(plain((0.9, 0.9, 0.88), 3), f5=contacts)
    grey = plain((0.55, 0.55, 0.57), 2)
    base = [
        extrude(rounded(length - plug, 1), 2, z0, z0 + t, skin),
        *open_box((start, -pw, zm - pt), (length, pw, zm + pt), 0.0004, steel, grey, face=1),
        box((start, 0.0008 - pw, zm - pt + 0.0003), (length - 0.0008, pw - 0.0008, zm + 0.0002), tongue),
    ]
    far, top = length + 0.002, z0 + t + gap
    cover = [
        extrude(rounded(far + sheet, 0.95), 2, 0, sheet, steel),
        extrude(rounded(far + sheet, 0.95), 2, top, top + sheet, steel),
        box((far - 0.014, -w, top), (far - 0.007, w, top + sheet + 0.0002), stuff.paint(1)),
        box((far, -w, 0.0002), (far + sheet, w, top + sheet - 0.0002), steel),
        cylinder((0, 0, top + sheet - 0.0002), (0, 0, 1), 0.0032, 0.0012, stuff.metal(0)),
    ]
    hinge = turning(rng, "base", (0, 0, 1 if rng.random() < 0.5 else -1), (0, 0, 0), 175)
    return Model("usb", (Body("base", glossy(base, 0.7)), Body("cover", glossy(cover), hinge)))


def blade(rng: np.random.Generator) -> Model:
    """A cutter that lies flat: a hollow handle with a slot, in which a thumb piece slides the blade."""
    stuff = Stuff(rng, 0.2)
    half, w, t = rng.uniform(0.07, 0.085), rng.uniform(0.010, 0.0125), rng.uniform(0.013, 0.016)
    wall, gap, slot = 0.0018, 0.0008, 0.0034
    skin = stuff.paint(0) if rng.random() < 0.5 else stuff.front(2, 0)
    dark = plain((0.28, 0.28, 0.3), stuff.seed(), 0.2, 0.02)
    rubber = stripes(plain(DARK, 1, 0.1, 0.01), plain((0.3, 0.3, 0.32), 2, 0.1, 0.01), 0, 0.005, 0.4)
    stop = rng.uniform(-0.6, -0.45) * half  # The rear end of the slot.
    steel = brushed((0.62, 0.63, 0.66), 0, stuff.seed(), 0.15, 0.002)
    case = [
        box((-half, -w, 0), (half, w, wall), by_face(skin, f5=dark)),
        box((-half, wall - w, wall), (wall - half, w - wall, t - wall), skin),
        box((-half, -w, t - wall), (stop, w, t), skin),
        box((-half - 0.004, -0.8 * w, 0.001), (-half + 0.004, 0.8 * w, t - 0.001), rubber, 0.002),
        box((-half + 0.006, -0.8 * w, t - 0.0005), (stop - 0.004, 0.8 * w, t + 0.0012), rubber, 0.0008),
    ]
    for k in (-1, 1):
        case += [
            box((-half, k * w, wall), (half, k * (w - wall), t - wall), skin),
            box((stop, k * w, t - wall), (half, k * slot, t), skin),
            box((stop, k * (w - 0.0008), 0.002), (half - 0.02, k * (w + 0.0012), t - 0.002), rubber, 0.0008),
            box((half - 0.012, k * w, 0), (half, k * (w - 0.001), t), steel),
        ]
    travel = (half - stop) * rng.uniform(0.55, 0.7)
    x0, tip, b, z = stop + 0.006, half - 0.003, w - wall - gap, 0.5 * t
    scored = stripes(steel, plain((0.35, 0.36, 0.38), 3), 0, 0.008, 0.12)
    line = np.array([(x0, -b), (tip - 0.012, -b), (tip, b), (x0, b)])
    thumb = stripes(stuff.paint(1), plain(DARK, 2), 0, 0.004, 0.3)
    slider = [
        *glossy((extrude(line, 2, z - 0.0006, z + 0.0006, scored),)),
        box((x0 - 0.002, -b, z - 0.002), (x0 + 0.02, b, t - wall - gap), dark),
        box((x0, gap - slot, z), (x0 + 0.017, slot - gap, t + 0.002), dark),
        box((x0 - 0.002, -0.62 * w, t + gap), (x0 + 0.019, 0.62 * w, t + 0.0045), thumb, 0.0012),
    ]
    hinge = sliding(rng, "base", (1, 0, 0), (x0, 0, z), travel)
    return Model("blade", (Body("base", glossy(case, 0.6)), Body("blade", tuple(slider), hinge)))
