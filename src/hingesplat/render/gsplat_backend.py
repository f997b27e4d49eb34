"""The CUDA engine: gsplat 1.5.3 (Ye et al. 2024, Apache-2.0), an optional dependency."""

from collections.abc import Callable
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
        torch.tensor(intrinsics, dtype=means.dtype, device=means.device)[None],
        camera.width,
        camera.height,
        near_plane=NEAR,
        eps2d=BLUR,
        packed=False,
        render_mode="RGB+D",
    )
    if screen_gradient is not None and meta["means2d"].requires_grad:
        radii = meta["radii"][0]
        seen = torch.nonzero((radii > 0).all(dim=1))[:, 0]
        radius = radii[seen].amax(dim=1).to(screen_gradient.dtype)
        meta["means2d"].register_hook(lambda g: record_screen_gradient(screen_gradient, seen, g[0, seen], radius))
    alpha = alpha[0, :, :, 0]
    rgb, others, depth = image[0].permute(2, 0, 1).split([3, channels.shape[1], 1])
    return torch.cat([rgb + (1 - alpha) * background[:, None, None], alpha[None]]), depth[0], others


def _gsplat(means: Tensor) -> Callable[..., Any]:
    """gsplat's rasteriser, where it can work on ``means``."""
    if not torch.cuda.is_available():
        raise HingesplatError("backend gsplat: no CUDA device; use the numba or torch backend")
    if not means.is_cuda:
        raise HingesplatError("backend gsplat: needs CUDA tensors; move them, or use the numba or torch backend")
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise HingesplatError("backend gsplat: not installed; run pip install 'hingesplat[gsplat]'") from error
    return rasterization
