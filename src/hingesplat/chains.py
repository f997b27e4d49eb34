"""What a part hangs on: its parent is what it moves against with one degree of freedom."""

from collections.abc import Sequence

import numpy as np

from hingesplat.screw import joint_motion, matrix_to_screw
from hingesplat.se3 import moved

STRAY = 0.004
"""Mean error of the best joint on the base, as a fraction of the extent, from which another parent is sought."""
BETTER = 1 / 3
"""A joint on another parent must leave at most this share of that error."""


def closest_joint(kind: str, T: np.ndarray, centroid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axis (3,), pivot (3,) and values (states − 1,) of the joint of one type nearest to motions T (states − 1, 4, 4).

    The state that moved most sets the axis; the others get their best value on it.
    """
    ends = T[:, :3, :3] @ centroid + T[:, :3, 3]
    if kind == "prismatic":
        shifts = ends - centroid
        axis = shifts[np.linalg.norm(shifts, axis=1).argmax()]
        axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
        return axis, centroid, shifts @ axis
    screws = [matrix_to_screw(M, centroid) for M in T]
    most = screws[int(np.argmax([s.angle for s in screws]))]
    return most.axis, most.pivot, np.array([s.angle * np.sign(s.axis @ most.axis or 1) for s in screws])


def misfit(T: np.ndarray, points: np.ndarray) -> float:
    """Mean distance between where motions T (states − 1, 4, 4) and the closest joint of either type take points."""
    if len(points) == 0:
        return 0.0
    centroid = points.mean(0)
    errors = []
    for kind in ("prismatic", "revolute"):
        axis, pivot, values = closest_joint(kind, T, centroid)
        joints = [joint_motion(kind, axis, pivot, v) for v in values]
        gaps = [moved(points, M) - moved(points, J) for M, J in zip(T, joints, strict=True)]
        errors.append(float(np.linalg.norm(gaps, axis=2).mean()))
    return min(errors)


def parents_of(T_state_0: np.ndarray, points: Sequence[np.ndarray], extent: float) -> list[int]:
    """The parent of every movable part: the base (0), unless only relative to another part its motion is one joint.

    Args:
        T_state_0: (states, parts, 4, 4) free rigid motions; part 0 is the base.
        points: (n, 3) of each part, base included, frame of state 0.
    """
    movers = range(1, T_state_0.shape[1])
    on_base = {k: misfit(T_state_0[1:, k], points[k]) for k in movers}
    parents = dict.fromkeys(movers, 0)
    placed: list[int] = []
    for k in sorted(movers, key=on_base.__getitem__):  # Whoever sits well on the base may carry others.
        if on_base[k] > STRAY * extent and placed:
            on_others = [misfit(np.linalg.inv(T_state_0[1:, p]) @ T_state_0[1:, k], points[k]) for p in placed]
            if min(on_others) < BETTER * on_base[k]:
                parents[k] = placed[int(np.argmin(on_others))]
        placed.append(k)
    return [parents[k] for k in movers]
