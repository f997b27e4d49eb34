"""Differentiable part poses, and the Gaussians of one state drawn with them."""

import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.gaussians import Gaussians
from hingesplat.render import Rendering, rasterize, sh_to_rgb
from hingesplat.se3 import matrix_to_wxyz, quat_multiply, rotvec_to_matrix


class PoseDelta:
    """A small rigid correction to each part's pose in each state, about a point of the part.

    Adam sees radians and extents, so that one step size serves both.
    """

    def __init__(self, T_state_0: Tensor, centres: Tensor, extent: float) -> None:
        """``T_state_0`` (states, parts, 4, 4) start; ``centres`` (parts, 3) in the frame of state 0."""
        self.start, self.extent = T_state_0, extent
        self.pivots = (T_state_0[..., :3, :3] @ centres[..., None])[..., 0] + T_state_0[..., :3, 3]
        free = T_state_0.new_ones(T_state_0.shape[:2])
        free[0], free[:, 0] = 0, 0  # State 0 is the frame, and the base does not move.
        self.free = free[..., None]
        self.turn = torch.zeros_like(self.pivots, requires_grad=True)
        self.shift = torch.zeros_like(self.pivots, requires_grad=True)

    @property
    def parameters(self) -> list[Tensor]:
        return [self.turn, self.shift]

    def Rt(self) -> tuple[Tensor, Tensor]:
        """Rotations (states, parts, 3, 3) and translations (states, parts, 3) of T_state_0, corrected."""
        R_delta = rotvec_to_matrix(self.turn * self.free)
        R = R_delta @ self.start[..., :3, :3]
        arm = self.start[..., :3, 3] - self.pivots
        t = (R_delta @ arm[..., None])[..., 0] + self.pivots + self.shift * self.free * self.extent
        return R, t


def draw_state(
    g: Gaussians,
    R: Tensor,
    t: Tensor,
    camera: Camera,
    *,
    sh_offset: Tensor | None = None,
    means: Tensor | None = None,
    **options: Tensor | None,
) -> Rendering:
    """Canonical Gaussians moved by their parts' poses R (parts, 3, 3), t (parts, 3), and rasterised.

    Args:
        sh_offset: (n, 3) added to the constant colour coefficient: this state's light.
        means: (n, 3) centres to use instead of the hard motion (soft assignment, repulsion).
    """
    if means is None:
        means = move(g.means, g.part, R, t)
    quats = quat_multiply(matrix_to_wxyz(R)[g.part], g.quats)
    sh = g.sh
    if sh_offset is not None:
        sh = torch.cat([sh[:, :1] + sh_offset[:, None], sh[:, 1:]], 1)
    centre = torch.as_tensor(camera.centre, dtype=means.dtype)
    directions = torch.nn.functional.normalize(means - centre, dim=1)
    return rasterize(means, quats, g.scales, g.opacities, sh_to_rgb(sh, directions), camera, **options)


def move(means: Tensor, part: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """Centres (n, 3) under their own part's pose."""
    return (R[part] @ means[..., None])[..., 0] + t[part]
