"""The objects themselves: shapes, textures, joints and joint values, all drawn from a seed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hingesplat.synth.shapes import Solid, box, capsule
from hingesplat.synth.textures import Colour, by_face, checker, panes, speckle, wood
from hingesplat.twin import Joint


@dataclass(frozen=True)
class Hinge:
    """The joint of a movable body, in the model frame with every joint at zero."""

    parent: str
    type: Literal["revolute", "prismatic"]
    axis: tuple[float, float, float]
    """Unit vector."""
    origin: tuple[float, float, float]
    limits: tuple[float, float]
    """Radians or model units."""
    states: tuple[float, float]
    """Values in state 0 and state 1, radians or model units."""


@dataclass(frozen=True)
class Body:
    """A rigid piece. Parents come before their children; the base has no hinge."""

    name: str
    solids: tuple[Solid, ...]
    hinge: Hinge | None = None


@dataclass(frozen=True)
class Model:
    """An articulated object; z up, front towards −y, lengths in metres."""

    name: str
    bodies: tuple[Body, ...]

    def poses(self, values: dict[str, float]) -> dict[str, np.ndarray]:
        """World pose 4×4 of every body, from zero configuration, for joint values by body name."""
        poses: dict[str, np.ndarray] = {}
        for i, body in enumerate(self.bodies):
            if body.hinge is None:
                poses[body.name] = np.eye(4)
                continue
            h = body.hinge
            joint = Joint(i, 0, h.type, h.axis, h.origin, h.states, h.limits)
            poses[body.name] = poses[h.parent] @ joint.transform(values[body.name])
        return poses

    def state(self, index: int) -> dict[str, np.ndarray]:
        """``poses`` in state 0 or 1."""
        return self.poses({b.name: b.hinge.states[index] for b in self.bodies if b.hinge})


def _states(rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float]) -> tuple[float, float]:
    """A nearly closed and an open value; one object in four is photographed open first."""
    a, b = rng.uniform(*low), rng.uniform(*high)
    return (b, a) if rng.random() < 0.25 else (a, b)


def _colour(rng: np.random.Generator, brightness: tuple[float, float], saturation: float = 0.5) -> Colour:
    hue = rng.random(3)
    hue = (hue - hue.min()) / (np.ptp(hue) + 1e-9)
    r, g, b = rng.uniform(*brightness) * (1 - saturation * (1 - hue))
    return float(r), float(g), float(b)


def cabinet(seed: int) -> Model:
    """A cabinet with one hinged door and one drawer, with a real interior and a shelf."""
    rng = np.random.default_rng((1, seed))
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
    inside = checker(_colour(rng, (0.8, 0.95), 0.25), _colour(rng, (0.5, 0.65), 0.35), 0.045, s + 80)
    back = by_face(speckle(_colour(rng, (0.6, 0.8), 0.3), _colour(rng, (0.3, 0.45), 0.4), 0.02, s + 120), f2=inside)
    carcass = (
        box((-w, -d, 0), (-w + wall, d, H), side),
        box((w - wall, -d, 0), (w, d, H), side),
        box((-w + wall, -d, 0), (w - wall, d, wall), by_face(level, f5=inside)),
        box((-w + wall, -d, H - wall), (w - wall, d, H), level),
        box((-w + wall, -d, split - wall / 2), (w - wall, d, split + wall / 2), level),
        box((-w + wall, d - wall, wall), (w - wall, d, H - wall), back),
        box((-w + wall, -d * 0.5, split * 0.48), (w - wall, d - wall, split * 0.48 + wall * 0.8), level),
    )

    metal = wood(_colour(rng, (0.8, 0.95), 0.1), _colour(rng, (0.45, 0.55), 0.15), 1, s + 160, 0.02)
    door_face = speckle(
        _colour(rng, (0.7, 0.9), 0.35), _colour(rng, (0.35, 0.5), 0.5), rng.uniform(0.016, 0.026), s + 200
    )
    door_back = checker(_colour(rng, (0.8, 0.95), 0.3), _colour(rng, (0.45, 0.6), 0.4), 0.055, s + 240)
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
        *_handle((hx, y, split * 0.5), (0, 0, 1), rng.uniform(0.10, 0.16), metal),
    )

    drawer_face = wood(_colour(rng, (0.8, 0.95), 0.35), _colour(rng, (0.4, 0.5), 0.5), 0, s + 320, 0.035)
    box_out = wood((0.85, 0.78, 0.62), (0.55, 0.43, 0.28), 1, s + 360)
    box_in = checker(_colour(rng, (0.8, 0.95), 0.3), _colour(rng, (0.5, 0.65), 0.45), 0.04, s + 400)
    thin, clear = wall * 0.7, 0.008
    x1, z0, z1 = w - wall - clear, split + wall / 2 + clear, H - wall - 0.03
    yb = d - wall - 0.03
    drawer = (
        box((-w, y, split + gap), (w, front, H), by_face(drawer_face, f3=box_in)),
        box((-x1, front, z0), (-x1 + thin, yb, z1), by_face(box_out, f1=box_in)),
        box((x1 - thin, front, z0), (x1, yb, z1), by_face(box_out, f0=box_in)),
        box((-x1 + thin, yb - thin, z0), (x1 - thin, yb, z1), by_face(box_out, f2=box_in)),
        box((-x1 + thin, front, z0), (x1 - thin, yb - thin, z0 + thin), by_face(box_out, f5=box_in)),
        *_handle((0, y, (split + H) / 2), (1, 0, 0), rng.uniform(0.12, 0.2), metal),
    )

    swing = _states(rng, (0.15, 0.4), (1.0, 1.45))
    pull = _states(rng, (0.02, 0.06), (0.17, 0.24))
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


def _handle(
    foot: tuple[float, float, float], along: tuple[int, int, int], length: float, texture: Callable
) -> tuple[Solid, ...]:
    """A bar of ``length`` on two posts, before a front that faces −y; ``foot`` is its middle on the front."""
    f, a = np.asarray(foot), np.asarray(along) * length / 2
    out = np.array([0, -0.035, 0])

    def rod(p: np.ndarray, q: np.ndarray, radius: float) -> Solid:
        return capsule((p[0], p[1], p[2]), (q[0], q[1], q[2]), radius, texture)

    posts = (rod(f + 0.8 * k * a, f + 0.8 * k * a + out, 0.007) for k in (-1, 1))
    return (rod(f + out - a, f + out + a, 0.011), *posts)


def laptop(seed: int) -> Model:
    """A laptop: a slab with keys, and a hinged lid with a screen."""
    rng = np.random.default_rng((2, seed))
    W, D, T = rng.uniform(0.33, 0.37), rng.uniform(0.23, 0.26), rng.uniform(0.018, 0.022)
    w, lid, gap = W / 2, rng.uniform(0.010, 0.013), 0.005
    s = int(rng.integers(1 << 20))
    shell = speckle(_colour(rng, (0.7, 0.85), 0.15), _colour(rng, (0.35, 0.5), 0.3), rng.uniform(0.010, 0.015), s)
    deck = wood(_colour(rng, (0.7, 0.9), 0.3), _colour(rng, (0.35, 0.5), 0.4), 0, s + 40, 0.02)
    pad = checker(_colour(rng, (0.6, 0.8), 0.3), _colour(rng, (0.4, 0.5), 0.3), 0.012, s + 80)
    solids = [box((-w, -D / 2, 0), (w, D / 2, T), by_face(shell, f5=deck))]
    solids.append(box((-0.05, -D / 2 + 0.012, T), (0.05, -D / 2 + 0.07, T + 0.0012), pad))
    columns, rows, pitch = 13, 5, 0.9 * W / 13
    for r, c in np.ndindex(rows, columns):
        x, y = (c - (columns - 1) / 2) * pitch, -D / 2 + 0.09 + r * pitch
        h = pitch * 0.42
        ink = _colour(rng, (0.75, 0.95), 0.3)
        key = speckle(_colour(rng, (0.2, 0.45), 0.35), ink, 0.006, s + 200 + r * 31 + c)
        solids.append(box((x - h, y - h, T), (x + h, y + h, T + 0.003), key))

    back = T + gap
    screen = panes(_colour(rng, (0.3, 0.5), 0.6), _colour(rng, (0.7, 0.95), 0.4), (0, 1), 0.012, s + 120)
    cover = checker(_colour(rng, (0.7, 0.85), 0.35), _colour(rng, (0.45, 0.6), 0.45), 0.031, s + 160)
    lid_solids = (
        box((-w, -D / 2, back), (w, D / 2, back + lid), by_face(shell, f4=shell, f5=cover)),
        box(
            (-w + 0.012, -D / 2 + 0.012, back - 0.001),
            (w - 0.012, D / 2 - 0.02, back),
            by_face(shell, f4=screen),
        ),
        capsule((-w * 0.8, D / 2, back), (w * 0.8, D / 2, back), 0.005, shell),
    )
    opening = _states(rng, (0.7, 1.0), (1.6, 2.0))
    hinge = Hinge("base", "revolute", (-1, 0, 0), (0, D / 2, back), (0.0, 2.3), opening)
    return Model("laptop", (Body("base", tuple(solids)), Body("lid", lid_solids, hinge)))


MAKERS: dict[str, Callable[[int], Model]] = {"cabinet": cabinet, "laptop": laptop}
