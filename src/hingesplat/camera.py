"""A pinhole camera. OpenCV axes: x right, y down, z forward; pixel centres at +0.5."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics (pixels) and pose.

    ``T_world_camera`` is a rigid 4×4 float64 matrix that takes camera coordinates to world coordinates.
    """

    T_world_camera: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @cached_property
    def T_camera_world(self) -> np.ndarray:
        """World to camera, 4×4."""
        R, t = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ t
        return T

    @property
    def K(self) -> np.ndarray:
        """Camera coordinates to homogeneous pixels, 3×3."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def centre(self) -> np.ndarray:
        """Optical centre in world coordinates, (3,)."""
        return self.T_world_camera[:3, 3]

    def scaled(self, width: int, height: int) -> "Camera":
        """The same view at another image size; intrinsics follow."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=width,
            height=height,
        )

    def cropped(self, x0: int, y0: int, width: int, height: int) -> "Camera":
        """The sub-image whose top-left pixel is (x0, y0)."""
        return replace(self, cx=self.cx - x0, cy=self.cy - y0, width=width, height=height)

    def project(self, points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) to pixel coordinates (n, 2) and depths (n,); depth ≤ 0 lies behind the camera."""
        T = self.T_camera_world
        p = points_world @ T[:3, :3].T + T[:3, 3]
        z = p[:, 2]
        safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
        uv = np.stack([self.fx * p[:, 0] / safe + self.cx, self.fy * p[:, 1] / safe + self.cy], axis=1)
        return uv, z

    def lifted(self, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points (n, 3) at the centres of pixels (x, y) (n,) at depths (n,)."""
        p = np.stack([(x + 0.5 - self.cx) / self.fx, (y + 0.5 - self.cy) / self.fy, np.ones(len(depth))], 1)
        return (p * depth[:, None]) @ self.T_world_camera[:3, :3].T + self.centre

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origin (3,) and unit directions (height, width, 3) of the pixel-centre rays, world frame."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        d = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(u)], axis=-1)
        d = d @ self.T_world_camera[:3, :3].T
        return self.centre, d / np.linalg.norm(d, axis=-1, keepdims=True)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """T_world_camera (4, 4) of a camera at ``eye`` that looks towards ``target``; ``up`` must not point there too."""
    forward = target - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = eye
    return T


def common_up(cameras: Sequence[Camera]) -> np.ndarray:
    """The unit vector (3,) that is up for people who hold their cameras level: the normal of all right axes.

    Where these do not span a plane it is the mean of the cameras' own; an axis within 10° is taken for it.
    """
    R = np.stack([c.T_world_camera[:3, :3] for c in cameras])
    mean = -R[:, :, 1].mean(0)
    _, spread, axes = np.linalg.svd(R[:, :, 0], full_matrices=False)
    up = axes[2] if len(spread) == 3 and spread[1] > 0.2 * spread[0] else mean
    if np.linalg.norm(up) < 1e-6:
        up = np.array([0.0, 0.0, 1.0])
    up = up / np.linalg.norm(up) * (1 if up @ mean >= 0 else -1)
    axis = np.eye(3)[np.abs(up).argmax()] * np.sign(up[np.abs(up).argmax()])
    return axis if axis @ up > np.cos(np.radians(10)) else up
