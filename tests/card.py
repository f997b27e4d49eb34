"""A card with a smooth texture before nothing, drawn by rays: its photographs and its joint are known exactly."""

from collections.abc import Callable
from functools import cache

import numpy as np
import torch

from hingesplat.patches import Photograph
from hingesplat.render import Rendering
from hingesplat.screw import joint_motion
from scenes import ANGLE, AXIS, FORWARD, PIVOT, SLIDE, cameras_around, look_at

CARD = np.array([0.0, -0.46, 0.0])
HALF = 0.4
"""The card is a square in the plane y = −0.46, facing −y."""


def grain(u: np.ndarray, v: np.ndarray, phase: float) -> np.ndarray:
    """Each phase is another texture of the same kind."""
    waves = np.sin(u + 2 * phase) + np.sin(0.7 * v + 1 - 3 * phase)
    return waves + np.sin(0.6 * (u + v) + phase) * np.cos(0.8 * (u - v) + 2 + 5 * phase)


def photograph(eye: np.ndarray, T: np.ndarray, *, part: int = 1, contrast: float = 0.1, phase: float = 0) -> Photograph:
    """The card, moved by T, as part 1 or as the base."""
    camera = look_at(eye, 140)
    y, x = np.mgrid[: camera.height, : camera.width]
    away = (camera.lifted(x.ravel(), y.ravel(), np.ones(x.size)) - camera.centre).reshape(*x.shape, 3)
    R, t = T[:3, :3], T[:3, 3]
    depth = ((CARD @ R.T + t - camera.centre) @ (R @ FORWARD)) / (away @ (R @ FORWARD))
    at = (camera.centre + depth[..., None] * away - t) @ R - CARD
    on = (np.abs(at[..., [0, 2]]) < HALF).all(-1) & (depth > 0)
    texture = 0.5 + contrast * grain(40 * at[..., 0], 40 * at[..., 2], phase)
    grey, alpha, depth = (torch.from_numpy(np.where(on, value, 0)).float() for value in (texture, 1.0, depth))
    image = torch.stack([grey, grey, grey, alpha])
    return Photograph.of(camera, image, Rendering(image, depth, alpha[None][:part]))


def place(kind: str) -> Callable[[np.ndarray], np.ndarray]:
    """A tilt of the axis, a shift of the pivot and a change of the value, to both states' places: zero is the truth."""
    tilt, aside = np.array([1.0, 0, 0]), np.array([1.0, 0, 0])
    axis, value = (AXIS, ANGLE) if kind == "revolute" else (FORWARD, SLIDE)

    def poses(theta: np.ndarray) -> np.ndarray:
        turned = axis + theta[0] * tilt
        turned = turned / np.linalg.norm(turned)
        return np.stack([np.eye(4), joint_motion(kind, turned, PIVOT + theta[1] * aside, value + theta[2])])

    return poses


@cache
def photographs(
    kind: str, *, part: int = 1, contrast: float = 0.1, phases: tuple[float, float] = (0, 0)
) -> tuple[list[Photograph], list[Photograph]]:
    """The card in both states, by cameras in front."""
    eyes = [c.centre for c in cameras_around(60, 8) if c.centre[1] < -1.0]
    first, second = (
        [photograph(eye, T, part=part, contrast=contrast, phase=phase) for eye in eyes]
        for T, phase in zip(place(kind)(np.zeros(3)), phases, strict=True)
    )
    return first, second
