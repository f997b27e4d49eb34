"""Errors of joints: axis, position, pivot, motion. The definitions of PARIS, DTA and ArtGS."""

import numpy as np

from hingesplat.metrics.truth import TruthJoint
from hingesplat.screw import line_distance
from hingesplat.twin import Joint

MISSED_DEG = 90.0
"""What an undetected joint counts for its axis, and a revolute one for its motion."""


def axis_angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Angle in degrees between two lines of directions (3,), in [0, 90]: opposite senses are one axis."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(np.dot(a, b)))))


def point_line_distance(x: np.ndarray, p: np.ndarray, a: np.ndarray) -> float:
    """Distance of the point x from the line p + s·a (unit a)."""
    return float(np.linalg.norm(np.cross(x - p, a)))


def rotation_angle_deg(R: np.ndarray) -> float:
    """Angle in degrees of a rotation matrix 3×3; exact for small angles too."""
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    return float(np.degrees(np.arctan2(sine, (np.trace(R) - 1) / 2)))


def joint_errors(
    truth: TruthJoint, found: Joint | None, T_found: np.ndarray, centre: np.ndarray
) -> dict[str, float | None]:
    """The five errors of one joint; None where one does not apply.

    Args:
        truth: the true joint.
        found: the joint of the matched part; None, or a fixed joint, counts as not detected.
        T_found: found motion from state 0 to 1 relative to the part that matches the true parent, 4×4.
        centre: centroid (3,) of the true part in state 0, whose displacement is compared for a slide.

    Returns:
        ``axis_deg``; ``position_x10``, ``pivot`` (revolute truth found as revolute); ``motion_deg`` (revolute
        truth); ``motion_units`` (prismatic truth; undetected: all of the true slide).
    """
    revolute = truth.type == "revolute"
    T = truth.transform()
    slide = (T - T_found) @ np.append(centre, 1)
    errors: dict[str, float | None] = {
        "axis_deg": MISSED_DEG,
        "position_x10": None,
        "pivot": None,
        "motion_deg": MISSED_DEG if revolute else None,
        "motion_units": None if revolute else abs(truth.motion),
    }
    if found is None or found.type == "fixed":
        return errors
    axis, pivot = np.asarray(found.axis, float), np.asarray(found.pivot, float)
    errors["axis_deg"] = axis_angle_deg(truth.axis, axis)
    if revolute:
        errors["motion_deg"] = rotation_angle_deg(T[:3, :3].T @ T_found[:3, :3])
        if found.type == "revolute":
            errors["position_x10"] = 10 * line_distance(truth.pivot, truth.axis, pivot, axis)
            errors["pivot"] = point_line_distance(truth.pivot, pivot, axis)
    else:
        errors["motion_units"] = float(np.linalg.norm(slide[:3]))
    return errors
