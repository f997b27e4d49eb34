"""Trimmed point-to-plane registration: a motion that is roughly right made right to a fraction of a degree."""

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from hingesplat.gaussians import Gaussians
from hingesplat.se3 import moved, wxyz_to_matrix
from hingesplat.stereo import Cloud

COLOUR_LENGTH = 0.08
"""A difference of 1 in colour counts as this fraction of the extent."""
NORMAL_LENGTH = 0.03
"""The same for a difference of 1 between normals: the two sides of a panel are two sheets."""


def features(cloud: Cloud, T: np.ndarray, extent: float) -> np.ndarray:
    """(n, 9) what has to be alike for two points to be one, after T: place, colour, side of the sheet."""
    return np.concatenate(
        [
            moved(cloud.points, T),
            cloud.colours * (COLOUR_LENGTH * extent),
            cloud.normals @ T[:3, :3].T * (NORMAL_LENGTH * extent),
        ],
        1,
    )


def normals_of(gaussians: Gaussians) -> np.ndarray:
    """(n, 3) thinnest axis of each Gaussian: on a surface, its normal."""
    R = wxyz_to_matrix(gaussians.quats.double()).numpy()
    thin = gaussians.log_scales.numpy().argmin(1)
    return R[np.arange(len(thin)), :, thin]


def register(
    source: Cloud,
    target: Cloud,
    T: np.ndarray,
    extent: float,
    *,
    turn: bool = True,
    iterations: int = 15,
    start_radius: float = 0.04,
    end_radius: float = 0.012,
) -> np.ndarray:
    """Refine T (4×4, source to target) by point-to-plane distance over pairs alike in place, colour and side.

    A light pull along the tangent keeps texture in place where planes slide on themselves. Pairs farther apart than the
    shrinking radius (fractions of the extent) are left out; directions that no pair constrains stay as they are.
    Without ``turn`` the rotation stays as it is.
    """
    tree = KDTree(features(target, np.eye(4), extent))
    for i in range(iterations):
        radius = extent * start_radius * (end_radius / start_radius) ** (i / max(iterations - 1, 1))
        ours = features(source, T, extent)
        distance, index = map(np.asarray, tree.query(ours))
        near = distance < radius
        if near.sum() < 12:
            return T
        p, q, n = ours[near, :3], target.points[index[near]], target.normals[index[near]]
        centre = p.mean(0)
        arm = p - centre
        rows, residuals = [], []
        for direction, weight in ((n, 1.0), *((np.broadcast_to(e, p.shape), 0.1) for e in np.eye(3))):
            rows.append(weight * np.concatenate([np.cross(arm, direction), direction], 1))
            residuals.append(weight * ((q - p) * direction).sum(1))
        A, b = np.concatenate(rows), np.concatenate(residuals)
        robust = 1 / (1 + (np.abs(b) / (0.3 * radius)) ** 2)
        if not turn:
            A[:, :3] = 0
        H = A.T @ (A * robust[:, None])
        damping = 1e-4 * np.diag(H).max() * np.eye(6)
        step = np.linalg.solve(H + damping, A.T @ (robust * b))
        delta = np.eye(4)
        delta[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
        delta[:3, 3] = centre + step[3:] - delta[:3, :3] @ centre
        T = delta @ T
    return T
