"""What a part's shape cannot tell: whether a round thing turned about its own axis."""

import numpy as np
from scipy.spatial import KDTree

from hingesplat.screw import distances_to_line, revolute
from hingesplat.se3 import moved

TURNS_DEG = (29.0, 61.0, 104.0, 163.0)
"""Turns that take no polygon of few sides onto itself."""
NEAR = 0.06
"""Distance, as a fraction of the part's radius about the line, within which a point lies on the part."""
ROUND = 0.9
"""Share of a part's points that must land on the part."""


def round_about(points: np.ndarray, axis: np.ndarray, pivot: np.ndarray) -> bool:
    """Whether a surface given by points (n, 3) turns about the line into itself: a knob, a lid, a ball.

    Only shape counts; a texture may still tell how far it turned.
    """
    if len(points) < 50:
        return False
    radius = float(np.quantile(distances_to_line(points, pivot, axis), 0.95))
    tree = KDTree(points)
    spacing = float(np.quantile(np.asarray(tree.query(points, 2)[0])[:, 1], 0.9))
    for turn in np.radians(TURNS_DEG):
        distance = np.asarray(tree.query(moved(points, revolute(axis, pivot, turn)))[0])
        if float((distance < max(NEAR * radius, 2 * spacing)).mean()) < ROUND:
            return False
    return True
