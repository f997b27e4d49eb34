"""How odd a joint it would take: hinges are at what they turn, and not by much; slides go along or across a plate.

Of two doors or drawers that look alike, one open in each state, photographs allow that the one went to where the other
is. But no hinge would turn it so, and no rail lead there. And a round lever might have turned about itself on its way.
"""

import numpy as np
from jaxtyping import Float

from hingesplat.screw import distances_to_line
from hingesplat.search import Motion

AWAY = 0.15
"""Extents between a hinge line and the nearest of what it turns that make a motion as odd again: right ones, as seeds
show them, had 0.13 at most, those of doors taken for each other 0.46."""
NEAREST = 0.05
"""Share of the points that may be nearer to a hinge line than what counts."""
AROUND = 2.6
"""Radians of a turn that make it as odd again: a lever's own was 1.2, and 2.2 with half a turn about itself."""
SLANTED = 0.08
"""Extents that a slide goes slantwise to the largest plate that do: right ones had 0.05 at most, as seeds show plates,
a drawer taken for another 0.12."""
STEEP = 4
"""Power with which that grows: hardly anything up to there, and soon too much."""


def oddity(motion: Motion, points: Float[np.ndarray, "n 3"], plate: Float[np.ndarray, "m 3"], extent: float) -> float:
    """From 0 how odd a joint it would take: a motion is worth a price less for every 1.

    Args:
        motion: from the state in which the points are.
        points: that it moves.
        plate: those of them that lie in their largest plane; may be none.
        extent: of the object, scene units.
    """
    if motion.kind == "revolute":
        away = off_hinge(motion, points) / (AWAY * extent) if len(points) else 0.0
        return away**STEEP + (abs(motion.value) / AROUND) ** STEEP
    return (slantwise(motion, plate) / (SLANTED * extent)) ** STEEP if len(plate) else 0.0


def off_hinge(motion: Motion, points: Float[np.ndarray, "n 3"]) -> float:
    """How far from its line a hinge leaves the nearest of some points."""
    return float(np.quantile(distances_to_line(points, motion.pivot, motion.axis), NEAREST))


def slantwise(motion: Motion, plate: Float[np.ndarray, "n 3"]) -> float:
    """How far a slide goes both along and across a plate: the less of the two."""
    normal = np.linalg.svd(plate - plate.mean(0), full_matrices=False)[2][2]
    across = min(abs(float(normal @ motion.axis)), 1.0)
    return abs(motion.value) * min(across, float(np.sqrt(1 - across**2)))
