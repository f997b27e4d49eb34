"""Directions that an object has of its own: what its large faces look at.

Rails are made square to what they are mounted on. A slide that is off by a few degrees meets less of a thin thing, such
as a wire rack, than half of it: so of several near-misses none is worth its price.
"""

import numpy as np

LEVEL = np.cos(np.radians(5))
"""Cosine between normals of what looks the same way."""
LARGE = 0.05
"""Share of a surface that its large faces have at least."""
OTHER = np.cos(np.radians(30))
"""Cosine between directions that are not the same."""
TRIED = 200
"""Normals that are tried for the next direction."""


def directions_of(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(d, 3) unit directions, three at most, the one of most faces first: those of normals (n, 3), either side.

    Of two the third is across both. What is round has none.
    """
    left, found = normals, []
    while len(found) < 3 and len(left):
        tried = left[rng.permutation(len(left))[:TRIED]]
        votes = (np.abs(left @ tried.T) > LEVEL).sum(0)
        if votes.max() < LARGE * len(normals):
            break
        direction = tried[votes.argmax()]
        level = left[np.abs(left @ direction) > LEVEL]
        direction = np.linalg.svd(level, full_matrices=False)[2][0]
        found.append(direction)
        left = left[np.abs(left @ direction) < OTHER]
    if len(found) == 2:
        third = np.cross(*found)
        found.append(third / np.linalg.norm(third))
    return np.array(found).reshape(-1, 3)


def nearest(directions: np.ndarray, axis: np.ndarray, degrees: float) -> np.ndarray | None:
    """(3,) that of the directions (d, 3), either way, which is no more than so far from an axis (3,); None: none is."""
    if len(directions) == 0:
        return None
    cosines = directions @ axis
    best = int(np.abs(cosines).argmax())
    if abs(cosines[best]) < np.cos(np.radians(degrees)):
        return None
    return directions[best] * np.sign(cosines[best])


__all__ = ["directions_of", "nearest"]
