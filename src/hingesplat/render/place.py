"""Gaussians made ready for one camera: parts moved, parameters to sizes and opacities, harmonics to colours."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.gaussians import SH_C0, Gaussians
from hingesplat.render._place import place_backward, place_forward
from hingesplat.se3 import matrix_to_wxyz, quat_multiply
from hingesplat.threads import parallel

GAUSSIANS_PER_THREAD = 16_384
"""With fewer, another thread costs more than it brings."""


@dataclass(frozen=True)
class Placed:
    """What ``rasterize`` draws, all of it differentiable."""

    means: Tensor
    """(n, 3) world frame."""
    quats: Tensor
    """(n, 4) wxyz."""
    scales: Tensor
    """(n, 3) standard deviations."""
    opacities: Tensor
    """(n,) in (0, 1)."""
    colors: Tensor
    """(n, 3) rgb as the camera sees it, at least 0."""
    squared_depth: Tensor
    """(n, 1) square of each centre's depth: the channel from which the variance along a ray is made."""

    @property
    def drawn(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The first arguments of ``rasterize``."""
        return self.means, self.quats, self.scales, self.opacities, self.colors


def place(
    g: Gaussians,
    camera: Camera,
    *,
    pose: tuple[Tensor, Tensor] | None = None,
    means: Tensor | None = None,
    sh_offset: Tensor | None = None,
) -> Placed:
    """Gaussians as one camera meets them in one state.

    float32 on the CPU goes through compiled kernels, anything else through ``place_by_torch``, the definition.

    Args:
        pose: R (parts, 3, 3) and t (parts, 3) that move each part; nothing moves if None. Gradients of R are those
            along its rotations.
        means: (n, 3) centres to use instead of the moved ones (soft assignment, repulsion).
        sh_offset: (n, 3) added to the constant colour coefficient.
    """
    at = g.means if means is None else means
    if at.device.type != "cpu" or at.dtype != torch.float32:
        return place_by_torch(g, camera, pose=pose, means=means, sh_offset=sh_offset)
    lobes = None
    if g.sh.shape[1] > 1:
        moved = at if pose is None or means is not None else move(at, g.part, *pose)
        basis = sh_basis(_directions(moved, camera), g.sh.shape[1])
        lobes = torch.einsum("nb,nbc->nc", basis[:, 1:], g.sh[:, 1:])
    R, t = (None, None) if pose is None else pose
    constant = g.sh[:, 0] if g.sh.shape[1] > 1 else g.sh.reshape(-1, 3)
    return Placed(*_Place.apply(at, g.quats, g.log_scales, g.logit_opacities, constant, sh_offset, lobes, R, t,
                                g.part, means is not None, camera))  # fmt: skip


def place_by_torch(
    g: Gaussians,
    camera: Camera,
    *,
    pose: tuple[Tensor, Tensor] | None = None,
    means: Tensor | None = None,
    sh_offset: Tensor | None = None,
) -> Placed:
    """See ``place``; any type, any device."""
    quats = g.quats if pose is None else quat_multiply(matrix_to_wxyz(pose[0])[g.part], g.quats)
    if means is None:
        means = g.means if pose is None else move(g.means, g.part, *pose)
    sh = g.sh if sh_offset is None else torch.cat([g.sh[:, :1] + sh_offset[:, None], g.sh[:, 1:]], 1)
    row = torch.as_tensor(camera.T_camera_world[2]).to(means)
    squared_depth = (means @ row[:3] + row[3]).square()[:, None]
    colors = sh_to_rgb(sh, _directions(means, camera))
    return Placed(means, quats, g.scales, g.opacities, colors, squared_depth)


def move(means: Tensor, part: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """Centres (n, 3) under their own part's pose: R (parts, 3, 3), t (parts, 3)."""
    return (R[part] @ means[..., None])[..., 0] + t[part]


def _directions(means: Tensor, camera: Camera) -> Tensor:
    return torch.nn.functional.normalize(means - torch.as_tensor(camera.centre).to(means), dim=1)


def _array(tensor: Tensor | None, *empty: int) -> np.ndarray:
    """Its numbers; no rows of the shape ``empty`` where there is no tensor."""
    return np.empty((0, *empty), np.float32) if tensor is None else tensor.detach().contiguous().numpy()


class _Place(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, log_scales, logits, constant, offset, lobes, R, t, part, moved, camera):
        n, threads = len(means), min(torch.get_num_threads(), 1 + len(means) // GAUSSIANS_PER_THREAD)
        turns = np.empty((0, 4), np.float32) if R is None else matrix_to_wxyz(R.detach()).numpy()
        parts = (part.numpy(), _array(R, 3, 3), turns)
        view = camera.T_camera_world[2].astype(np.float32)
        placed, turned, colors, squares = (np.empty((n, k), np.float32) for k in (3, 4, 3, 1))
        inputs = (_array(means), _array(quats), *parts, _array(t, 3), moved)
        colour = (_array(constant), _array(offset, 3), _array(lobes, 3))
        parallel(place_forward, threads, *inputs, *colour, view, placed, turned, colors, squares)
        scales, opacities = log_scales.exp(), logits.sigmoid()
        placed, turned, colors, squares = map(torch.from_numpy, (placed, turned, colors, squares))
        ctx.known = (parts, moved, view, threads, offset is not None, lobes is not None)
        ctx.save_for_backward(means, placed, turned, scales, opacities, colors)
        ctx.set_materialize_grads(False)
        return placed, turned, scales, opacities, colors, squares

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_placed, g_turned, g_scales, g_opacities, g_colors, g_squares):
        means, placed, turned, scales, opacities, colors = ctx.saved_tensors
        parts, moved, view, threads, offset, lobes = ctx.known
        n, R = len(means), parts[1]
        g_means, g_quats, g_constant = (np.empty((n, k), np.float32) for k in (3, 4, 3))
        g_lobes, sums = np.empty((n if lobes else 0, 3), np.float32), np.zeros((threads, len(R), 15))
        coming = (_array(g_placed, 3), _array(g_turned, 4), _array(g_colors, 3), _array(g_squares, 1))
        known = (_array(means), *parts, moved, view, *map(_array, (placed, turned, colors)))
        parallel(place_backward, threads, *coming, *known, g_means, g_quats, g_constant, g_lobes, sums)
        g_means, g_quats, g_constant, g_lobes = map(torch.from_numpy, (g_means, g_quats, g_constant, g_lobes))
        g_log_scales = None if g_scales is None else g_scales * scales
        g_logits = None if g_opacities is None else g_opacities * opacities * (1 - opacities)
        g_offset, g_lobes = g_constant if offset else None, g_lobes if lobes else None
        g_pose = _pose_gradient(R, sums.sum(0)) if len(R) else (None, None)
        return g_means, g_quats, g_log_scales, g_logits, g_constant, g_offset, g_lobes, *g_pose, None, None, None


def _pose_gradient(R: np.ndarray, sums: np.ndarray) -> tuple[Tensor, Tensor]:
    """Gradients of R (parts, 3, 3) and t (parts, 3) from the sums that ``place_backward`` makes."""
    # A turn δ changes R by [δ]× R, and <[a]× R, [b]× R> = 2 a·b.
    torque = 0.5 * np.cross(sums[:, None, 12:], np.eye(3)).transpose(0, 2, 1) @ R
    g_R = sums[:, :9].reshape(-1, 3, 3) + torque
    return torch.from_numpy(g_R.astype(np.float32)), torch.from_numpy(sums[:, 9:12].astype(np.float32))


def sh_to_rgb(sh: Tensor, directions: Tensor) -> Tensor:
    """Colour (n, 3) of harmonics (n, (degree + 1)², 3) of degree 0 to 3: 0.5 + Σ basis·sh, at least 0.

    ``directions`` (n, 3) are unit vectors from the camera to the Gaussians. The harmonics are real, in the
    order and with the signs of the 3DGS file format (Kerbl et al. 2023): m = -l … l, with the Condon-Shortley
    phase.

    Raises:
        ValueError: another number of coefficients.
    """
    basis = sh_basis(directions, sh.shape[1])
    return (0.5 + torch.einsum("nb,nbc->nc", basis, sh)).clamp(min=0)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """The first ``count`` real spherical harmonics, (n, count)."""
    if count not in (1, 4, 9, 16):
        raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {count}")
    x, y, z = directions.unbind(1)
    basis = [torch.full_like(x, SH_C0)]
    if count > 1:
        c = 0.4886025119029199  # √(3/4π)
        basis += [-c * y, c * z, -c * x]
    if count > 4:
        c = 1.0925484305920792  # √(15/4π)
        basis += [
            c * x * y,
            -c * y * z,
            0.31539156525252005 * (3 * z * z - 1),  # √(5/16π)
            -c * x * z,
            0.5 * c * (x * x - y * y),
        ]
    if count > 9:
        c, d, e = 0.5900435899266435, 2.890611442640554, 0.4570457994644658  # √(35/32π), √(105/4π), √(21/32π)
        basis += [
            -c * y * (3 * x * x - y * y),
            d * x * y * z,
            -e * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),  # √(7/16π)
            -e * x * (5 * z * z - 1),
            0.5 * d * z * (x * x - y * y),
            -c * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=1)
