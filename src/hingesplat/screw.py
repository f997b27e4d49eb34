"""Rigid motion ↔ screw: turn by an angle about an axis through a pivot, slide along the same axis.

Right-handed about the axis, radians, scene units; numpy float64. Chasles' theorem: every rigid motion is one such
screw, up to the sign of its axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

STRAIGHT = 1e-9
"""Radians. Below it a motion counts as a pure slide: the rounding of a matrix alone turns by 1e-16."""
PARALLEL = 1e-6
"""Sine of the angle between two lines below which they count as parallel (the value that the field uses)."""


@dataclass(frozen=True)
class Screw:
    """A rigid motion as rotation about, and translation along, one line."""

    axis: np.ndarray
    """(3,) unit direction of the line."""
    pivot: np.ndarray
    """(3,) a point on the line."""
    angle: float
    """Radians, right-handed about ``axis``."""
    slide: float
    """Scene units along ``axis``."""


def screw_to_matrix(screw: Screw) -> Float[np.ndarray, "4 4"]:
    """The motion ``T_b_a`` (4, 4) that a screw stands for."""
    return screws_to_matrices(screw.axis[None], screw.pivot[None], np.array([screw.angle]), np.array([screw.slide]))[0]


def screws_to_matrices(
    axes: Float[np.ndarray, "n 3"],
    pivots: Float[np.ndarray, "n 3"],
    angles: Float[np.ndarray, " n"],
    slides: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 4 4"]:
    """The motions that many screws stand for; fields as those of ``Screw``."""
    K = _cross_matrices(axes)
    # R − I, with 1 − cos θ = 2 sin²(θ/2), so that far pivots of small angles lose no digits.
    turns = np.sin(angles)[:, None, None] * K + (2 * np.sin(angles / 2) ** 2)[:, None, None] * (K @ K)
    T = np.tile(np.eye(4), (len(axes), 1, 1))
    T[:, :3, :3] += turns
    T[:, :3, 3] = slides[:, None] * axes - (turns @ pivots[:, :, None])[..., 0]
    return T


def matrix_to_screw(T_b_a: Float[np.ndarray, "4 4"], near: ArrayLike = (0.0, 0.0, 0.0)) -> Screw:
    """The screw of a rigid motion (4, 4): angle in [0, π], the pivot nearest to the point ``near`` (3,).

    A pure slide has angle 0, slide ≥ 0 and pivot ``near``; the identity has axis z. Any angle is safe: the
    axis comes from the quaternion, which is well conditioned at π as well as near 0. The pivot of a small
    angle lies far off and is known only to about (error of t) / angle.
    """
    t, near_point = np.asarray(T_b_a[:3, 3], float), np.asarray(near, float)
    rotvec = Rotation.from_matrix(np.asarray(T_b_a[:3, :3], float)).as_rotvec()
    angle = float(np.linalg.norm(rotvec))
    if angle < STRAIGHT:
        slide = float(np.linalg.norm(t))
        return Screw(t / slide if slide > 0 else np.array([0.0, 0.0, 1.0]), near_point, 0.0, slide)
    a = rotvec / angle
    slide = float(a @ t)
    across = t - slide * a
    on_axis = (across + np.cross(a, across) / np.tan(angle / 2)) / 2
    return Screw(a, on_axis + a * (a @ (near_point - on_axis)), angle, slide)


def revolute(axis: ArrayLike, pivot: ArrayLike, angle: float) -> Float[np.ndarray, "4 4"]:
    """Turn (4, 4) by ``angle`` radians about the line through ``pivot`` along ``axis``, of any length but 0.

    Raises:
        ValueError: the axis has no length.
    """
    return screw_to_matrix(Screw(_unit(axis), np.asarray(pivot, float), angle, 0.0))


def prismatic(axis: ArrayLike, slide: float) -> Float[np.ndarray, "4 4"]:
    """Move (4, 4) by ``slide`` units along ``axis`` of any non-zero length.

    Raises:
        ValueError: the axis has no length.
    """
    return screw_to_matrix(Screw(_unit(axis), np.zeros(3), 0.0, slide))


def joint_motion(kind: str, axis: ArrayLike, pivot: ArrayLike, value: float) -> Float[np.ndarray, "4 4"]:
    """Where a joint at ``value`` takes its part, (4, 4): ``revolute`` if its kind is that, else ``prismatic``."""
    return revolute(axis, pivot, value) if kind == "revolute" else prismatic(axis, value)


def line_distance(p: ArrayLike, d: ArrayLike, q: ArrayLike, e: ArrayLike) -> float:
    """Shortest distance of the lines p + s·d and q + u·e, all (3,); point to line when they are parallel.

    Raises:
        ValueError: a direction has no length.
    """
    d_unit, e_unit = _unit(d), _unit(e)
    between = np.asarray(q, float) - np.asarray(p, float)
    normal = np.cross(d_unit, e_unit)
    length = np.linalg.norm(normal)
    if length < PARALLEL:
        return float(np.linalg.norm(np.cross(between, d_unit)))
    return float(abs(between @ normal) / length)


def distances_to_line(
    points: Float[np.ndarray, "n 3"], pivot: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " n"]:
    """How far points are from the line through ``pivot`` along a unit axis."""
    return np.linalg.norm(np.cross(points - pivot, axis), axis=1)


def axes_across(axis: np.ndarray) -> Float[np.ndarray, "2 3"]:
    """Two unit vectors that make a right-handed frame with a unit axis (3,) before them."""
    u = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(axis, u)])


def slide_of(T_base_part: Sequence[np.ndarray]) -> np.ndarray | None:
    """(3,) the direction of a part that only slides, given places (4, 4) on its way."""
    turns, ways = np.array([T[:3, :3] for T in T_base_part]), np.array([T[:3, 3] for T in T_base_part])
    length = np.linalg.norm(ways, axis=-1)
    if not length.any() or np.abs(turns - np.eye(3)).max() > 1e-6:
        return None
    return ways[length.argmax()] / length.max()


def _unit(axis: ArrayLike) -> np.ndarray:
    a = np.asarray(axis, float)
    length = np.linalg.norm(a)
    if not length > 0:
        raise ValueError(f"axis {a.tolist()} has no direction")
    return a / length


def _cross_matrices(a: np.ndarray) -> np.ndarray:
    K = np.zeros((len(a), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        K[:, k, j], K[:, j, k] = a[:, i], -a[:, i]
    return K  # K v = a × v
