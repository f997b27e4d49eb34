"""Gaussians and a camera in, pictures out: one function, three backends.

``torch`` is the definition (brute force, float64 too), ``numba`` the CPU engine, ``gsplat`` the CUDA engine.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import Gaussians
from hingesplat.render.gsplat_backend import cuda_lacks
from hingesplat.render.place import Placed, move, place, sh_basis, sh_to_rgb

Backend = Literal["torch", "numba", "gsplat"]


@dataclass(frozen=True)
class Rendering:
    """What a camera sees."""

    rgba: Tensor
    """(4, height, width): ``rgb`` and ``alpha`` as one picture."""
    depth: Tensor
    """(height, width) Σ weight·z in scene units, not divided by alpha."""
    channels: Tensor
    """(C, height, width) Σ weight·channel; C may be 0."""

    @property
    def rgb(self) -> Tensor:
        """(3, height, width), over the background."""
        return self.rgba[:3]

    @property
    def alpha(self) -> Tensor:
        """(height, width) Σ weight: how much of the light is stopped."""
        return self.rgba[3]


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
        backend: None takes ``gsplat`` for tensors off the CPU, ``numba`` for float32 and ``torch`` for other types.
        early_stop: end a pixel once its transmittance has fallen to 1e-4.
        screen_gradient: (n, 3) float statistics that the backward pass updates for every visible Gaussian: column 0
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
    if means.device.type != "cpu":
        return "gsplat"
    return "numba" if means.dtype == torch.float32 else "torch"


def render(gaussians: Gaussians, camera: Camera, **options) -> Rendering:
    """``place`` the Gaussians before the camera, then ``rasterize`` with the same options."""
    return rasterize(*place(gaussians, camera).drawn, camera, **options)


__all__ = [
    "Backend",
    "Placed",
    "Rendering",
    "cuda_lacks",
    "move",
    "place",
    "rasterize",
    "render",
    "sh_basis",
    "sh_to_rgb",
]
