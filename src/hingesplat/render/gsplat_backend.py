"""The CUDA engine: gsplat 1.5.3 (Ye et al. 2024, Apache-2.0), an optional dependency."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.errors import HingesplatError
from hingesplat.render.torch_backend import BLUR, NEAR, record_screen_gradient


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    channels: Tensor,
    camera: Camera,
    background: Tensor,
    early_stop: bool,
    screen_gradient: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See ``hingesplat.render.rasterize``: rgba (4, H, W), depth (H, W), channels (C, H, W).

    gsplat always stops early, whatever ``early_stop`` says, and rounds radii up to whole pixels.

    Raises:
        HingesplatError: no CUDA device, tensors that are not on it, or gsplat is not installed.
    """
    rasterization = _gsplat(means)
    if len(means) == 0:  # gsplat wants at least one
        blank = means.sum() + means.new_zeros((channels.shape[1] + 5, camera.height, camera.width))
        return torch.cat([blank[:3] + background[:, None, None], blank[3:4]]), blank[4], blank[5:]
    intrinsics = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    image, alpha, meta = rasterization(
        means,
        quats,
        scales,
        opacities,
        torch.cat([colors, channels], dim=1),
        torch.as_tensor(camera.T_camera_world).to(means)[None],
        torch.tensor(intrinsics, dtype=torch.float64).to(means)[None],
        camera.width,
        camera.height,
        near_plane=NEAR,
        eps2d=BLUR,
        packed=False,
        render_mode="RGB+D",
    )
    if screen_gradient is not None and meta["means2d"].requires_grad:
        radii = meta["radii"][0]
        radius = torch.where((radii > 0).all(dim=1), radii.amax(dim=1), 0).to(screen_gradient.dtype)
        meta["means2d"].register_hook(lambda g: record_screen_gradient(screen_gradient, g[0], radius))
    alpha = alpha[0, :, :, 0]
    rgb, others, depth = image[0].permute(2, 0, 1).split([3, channels.shape[1], 1])
    return torch.cat([rgb + (1 - alpha) * background[:, None, None], alpha[None]]), depth[0], others


def cuda_lacks() -> str:
    """What keeps CUDA tensors from being drawn on this machine, with its remedy; empty where nothing does."""
    if not torch.cuda.is_available():
        return "torch sees no CUDA device; use the CPU"
    if find_spec("gsplat") is None:
        return "gsplat is not installed; run pip install 'hingesplat[gsplat]'"
    return ""


def _gsplat(means: Tensor) -> Callable[..., Any]:
    """gsplat's rasteriser, where it can work on ``means``."""
    if lacking := cuda_lacks():
        raise HingesplatError(f"backend gsplat: {lacking}")
    if not means.is_cuda:
        raise HingesplatError("backend gsplat: needs CUDA tensors; move them, or use the numba or torch backend")
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    return rasterization
