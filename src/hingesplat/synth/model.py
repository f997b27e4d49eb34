"""What an articulated object is made of: bodies of solids, hinges between them, joint values."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hingesplat.synth.shapes import Solid
from hingesplat.twin import Joint

GOLDEN = (5**0.5 - 1) / 2


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

    def value(self, state: int, number: int) -> float:
        """The value in any state; those after state 1 lie between the first two, ``number`` telling joints apart."""
        if state < 2:
            return self.states[state]
        share = (0.5 + GOLDEN * (state - 2) + GOLDEN**2 * number) % 1
        return self.states[0] + share * (self.states[1] - self.states[0])


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

    def values(self, state: int) -> dict[str, float]:
        """Joint values by body name."""
        movers = [(b.name, b.hinge) for b in self.bodies if b.hinge]
        return {name: hinge.value(state, i) for i, (name, hinge) in enumerate(movers)}

    def state(self, index: int) -> dict[str, np.ndarray]:
        """``poses`` in a state; 0 and 1 are those of the hinges, further ones lie between them."""
        return self.poses(self.values(index))


Point = tuple[float, float, float]


def turning(rng: np.random.Generator, parent: str, axis: Point, origin: Point, degrees: float) -> Hinge:
    """A revolute joint from 0 to ``degrees``, its values in the two states drawn."""
    limit = float(np.radians(degrees))
    return Hinge(parent, "revolute", axis, origin, (0.0, limit), _opening(rng, limit))


def sliding(rng: np.random.Generator, parent: str, axis: Point, origin: Point, travel: float) -> Hinge:
    """A prismatic joint from 0 to ``travel`` model units, its values in the two states drawn."""
    return Hinge(parent, "prismatic", axis, origin, (0.0, travel), _opening(rng, travel))


def _opening(rng: np.random.Generator, limit: float) -> tuple[float, float]:
    """Two values in [0, limit], a quarter to nine tenths of it apart; either may be the open one, shut or not."""
    size = limit * rng.uniform(0.25, 0.9)
    low = rng.choice([0.0, rng.uniform(0, limit - size)], p=[0.3, 0.7])
    a, b = float(low), float(low + size)
    return (b, a) if rng.random() < 0.35 else (a, b)


def ajar_and_open(rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float]) -> tuple[float, float]:
    """A nearly closed and an open value; one object in four is photographed open first."""
    a, b = rng.uniform(*low), rng.uniform(*high)
    return (b, a) if rng.random() < 0.25 else (a, b)
