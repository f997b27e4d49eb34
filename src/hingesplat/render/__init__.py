"""Gaussians and a camera in, pictures out: one function, three backends.

``torch`` is the definition (brute force, float64 too), ``numba`` the CPU engine, ``gsplat`` the CUDA engine.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import SH_C0, Gaussians

Backend = Literal["torch", "numba", "gsplat"]


@dataclass(frozen=True)
class Rendering:
    """What a camera sees."""

    rgb: Tensor
    """(3, height, width), over the background."""
    depth: Tensor
    """(height, width) Σ weight·z in scene units, not divided by alpha."""
    alpha: Tensor
    """(height, width) Σ weight: how much of the light is stopped."""
    channels: Tensor
    """(C, height, width) Σ weight·channel; C may be 0."""


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    channels: Tensor | None = None,
    background: Tensor | None = None,
    backend: Backend | None = None,
    early_stop: bool = True,
    screen_gradient: Tensor | None = None,
) -> Rendering:
    """Draw n Gaussians, differentiably in all of their tensors (not in the camera and the background).

    Args:
        means: (n, 3) centres, world frame.
        quats: (n, 4) wxyz, any non-zero length.
        scales: (n, 3) standard deviations, scene units.
        opacities: (n,) in [0, 1].
        colors: (n, 3) rgb.
        channels: (n, C) further values to blend like colours.
        background: (3,) rgb behind everything; black if None. It shows in ``rgb`` only.
        backend: None takes ``gsplat`` for CUDA tensors, ``numba`` for float32 and ``torch`` for other types.
        early_stop: end a pixel once its transmittance has fallen to 1e-4.
        screen_gradient: (n, 3) float statistics that the backward pass updates for every visible Gaussian:
        column 0
            grows by |d loss / d (projected mean)| (per pixel), column 1 by one, and column 2 becomes the
            largest radius so far (pixels; half the longer side of the box outside which its alpha is below
            1/255).

    Raises:
        HingesplatError: the backend cannot work on these tensors.
        ValueError: a tensor has the wrong shape.
    """
    n = len(means)
    channels = means.new_zeros((n, 0)) if channels is None else channels
    background = means.new_zeros(3) if background is None else background.detach().to(means)
    shapes = {"means": (means, 3), "quats": (quats, 4), "scales": (scales, 3), "colors": (colors, 3)}
    for name, (tensor, columns) in shapes.items():
        if tensor.shape != (n, columns):
            raise ValueError(f"{name}: expected shape ({n}, {columns}), got {tuple(tensor.shape)}")
    if opacities.shape != (n,) or channels.ndim != 2 or len(channels) != n or background.shape != (3,):
        raise ValueError(f"opacities, channels or background: expected shapes ({n},), ({n}, C), (3,)")

    match backend or _default_backend(means):
        case "torch":
            from hingesplat.render import torch_backend as engine
        case "numba":
            from hingesplat.render import numba_backend as engine
        case "gsplat":
            from hingesplat.render import gsplat_backend as engine
        case other:
            raise HingesplatError(f"backend: unknown {other!r}; use torch, numba or gsplat")
    inputs = (means, quats, scales, opacities, colors, channels)
    return Rendering(*engine.rasterize(*inputs, camera, background, early_stop, screen_gradient))


def _default_backend(means: Tensor) -> Backend:
    if means.is_cuda:
        return "gsplat"
    return "numba" if means.dtype == torch.float32 else "torch"


def render(gaussians: Gaussians, camera: Camera, **options) -> Rendering:
    """Colour ``gaussians`` as the camera sees them, then ``rasterize`` with the same options."""
    centre = torch.as_tensor(camera.centre).to(gaussians.means)
    directions = torch.nn.functional.normalize(gaussians.means - centre, dim=1)
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        sh_to_rgb(gaussians.sh, directions),
        camera,
        **options,
    )


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
