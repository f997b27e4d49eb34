"""Two drawers, or one that changed places?

Of two drawers of a kind, one open in each state, the box of one meets the box of the other if a single motion takes it
from place to place, while the right motions put both boxes out of sight. So photographs like the wrong one better, and
where there is no texture nothing speaks against it. But it leaves two fronts over, each shown by one state alone: those
of the drawers when they are shut. Two slides, one in and one out, take its own front to just these.
"""

from collections.abc import Collection, Sequence

import numpy as np

from hingesplat.labelling import Choices
from hingesplat.search import Motion

FAR = 0.03
"""Extents that each of the two slides goes at least: a sliding door that is that thin has a wall close by."""
FOLLOWS = 0.8
"""Share of what the one motion moves that each of the two could move as well, be it out of sight."""
FRONT = 5
"""Points of a front left over on which a slide must lay some of it: 6 to 30 where drawers were exchanged. On what slid
indeed two such slides laid 2 at most."""
OPPOSITE, ACROSS = 0.95, 0.7
"""Cosine between the ways in and out, and between these and the one motion's from which it goes the same way."""


def changed_places(
    choices: Choices,
    motions: Sequence[Motion],
    kept: Collection[int],
    k: int,
    like: np.ndarray,
    extent: float,
) -> bool:
    """Whether what slide ``k`` of those kept moves may as well be two things, one of which slides in, the other out.

    Args:
        choices: among the ``motions``.
        like: (motions,) bool: nearly the same as one of those kept, or one of them.
        extent: of the object, scene units.
    """
    if motions[k].kind == "revolute":  # A door in front of two drawers could follow them into the cabinet.
        return False
    known = np.isin(np.arange(len(motions)), list(kept))
    may, found = choices.stand_ins(kept, k)
    ways = np.array([m.axis * m.value if m.kind == "prismatic" else 0 * m.axis for m in motions])
    far = np.linalg.norm(ways, axis=1)
    fit = (far > FAR * extent) & (may > FOLLOWS) & (known | (~like & (found >= FRONT)))
    fit &= (np.arange(len(motions)) != k) & (np.abs(ways @ ways[k]) <= ACROSS * far * far[k])
    into, out = np.flatnonzero(fit[0]), np.flatnonzero(fit[1])
    return bool((ways[into] @ ways[out].T < -OPPOSITE * far[into, None] * far[out]).any())


__all__ = ["changed_places"]
