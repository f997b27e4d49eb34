"""Rigid transforms as 4×4 matrices and quaternions wxyz."""

import numpy as np
import torch
from torch import Tensor


def wxyz_to_matrix(quats: Tensor) -> Tensor:
    """Quaternions (..., 4) wxyz, of any non-zero length, to rotation matrices (..., 3, 3)."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return _stacked(rows)


def matrix_to_wxyz(R: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) to unit quaternions (..., 4) wxyz, the largest component positive.

    4 q qᵀ is linear in R, and its row with the largest diagonal is the best q. Nothing branches on numbers, for which a
    GPU would have to wait for the host.
    """
    a, b, c, d, e, f, g, h, i = R.flatten(-2).unbind(-1)
    rows = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    outer = _stacked(rows)
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))
    return torch.nn.functional.normalize(row[..., 0, :], dim=-1)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a ⊗ b of wxyz quaternions (..., 4); rotates by b first, then by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def rotvec_to_matrix(rotvec: Tensor) -> Tensor:
    """Axis times angle (..., 3) in radians to rotation matrices (..., 3, 3), by Rodrigues' formula; smooth at zero."""
    squared = (rotvec * rotvec).sum(-1)
    small = squared < 1e-6  # The series is exact to rounding there, and the quotients' gradients are not finite at 0.
    angle = torch.where(small, 1.0, squared).sqrt()
    sine = torch.where(small, 1 - squared / 6, angle.sin() / angle)[..., None, None]
    half = torch.where(small, 1 - squared / 24, (angle / 2).sin() / (angle / 2))[..., None, None]
    x, y, z = rotvec.unbind(-1)
    zero = torch.zeros_like(x)
    K = _stacked(((zero, -z, y), (z, zero, -x), (-y, x, zero)))
    return torch.eye(3, dtype=rotvec.dtype, device=rotvec.device) + sine * K + half * half / 2 * (K @ K)


def from_Rt(R: Tensor, t: Tensor) -> Tensor:
    """Rotation (..., 3, 3) and translation (..., 3) to a 4×4 transform."""
    T = torch.zeros((*R.shape[:-2], 4, 4), dtype=R.dtype, device=R.device)
    T[..., 3, 3] = 1
    top = torch.cat([R, t[..., None]], -1)
    return torch.cat([top, T[..., 3:, :]], -2)


def inverse(T: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    Rt = T[..., :3, :3].transpose(-1, -2)
    return from_Rt(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def apply(T_b_a: Tensor, points_a: Tensor) -> Tensor:
    """Points (n, 3) in frame a to frame b; one transform (4, 4), or one a point (n, 4, 4)."""
    return (T_b_a[..., :3, :3] @ points_a[..., None])[..., 0] + T_b_a[..., :3, 3]


def moved(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """NumPy points (n, 3) under transforms (…, 4, 4): (…, n, 3)."""
    return points @ T[..., :3, :3].swapaxes(-1, -2) + T[..., None, :3, 3]


def apart(points: np.ndarray, T: np.ndarray, other: np.ndarray) -> float:
    """Mean distance between the places to which two transforms (4, 4) take points (n, 3)."""
    return float(np.linalg.norm(moved(points, T) - moved(points, other), axis=1).mean())


def _stacked(rows: tuple[tuple[Tensor, ...], ...]) -> Tensor:
    """Entries (...) to matrices (..., rows, columns)."""
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
