"""The definition of the rasteriser: brute force over pixels and Gaussians, in plain torch, in any float type.

Conventions are those of gsplat 1.5.3 (Apache-2.0), stated here in our own words:

* EWA projection: Σ' = J W Σ Wᵀ Jᵀ + 0.3·I (pixels²), J taken at the centre moved into 1.3 times the field of
  view;
* α = min(0.999, o·exp(-½ dᵀ Σ'⁻¹ d)), d from the projected mean to the pixel centre (+0.5);
* α below 1/255 counts as 0;
* front to back by the depth of the centres, ties by index; what lies nearer than 0.01 is not drawn;
* with ``early_stop``, a pixel takes nothing more once its transmittance is at most 1e-4. gsplat also drops
  the Gaussian that would bring it there; we keep it, since it can hold a tenth of the light of a pixel.
"""

import torch
from torch import Tensor

from hingesplat.camera import Camera

BLUR = 0.3
"""Variance (pixels²) added to every projected Gaussian, a low-pass filter."""
ALPHA_MAX = 0.999
"""Upper limit of α; it keeps every transmittance positive."""
ALPHA_MIN = 1 / 255
"""A smaller α counts as nothing."""
NEAR = 0.01
"""Depth (scene units) up to which nothing is drawn."""
FRUSTUM_MARGIN = 0.3
"""How far beyond the image, in half widths, the Jacobian still follows the centre."""
TRANSMITTANCE_MIN = 1e-4
"""Transmittance at which ``early_stop`` ends a pixel."""

_PIXELS_AT_ONCE = 2048


def rotation_matrices(quats: Tensor) -> Tensor:
    """Quaternions (n, 4) wxyz of any non-zero length to rotation matrices (n, 3, 3)."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)


def tangent_limits(camera: Camera) -> tuple[float, float, float, float]:
    """x/z and y/z are clamped to [x_min, x_max] and [y_min, y_max] where the Jacobian is taken."""
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    return (
        -camera.cx / camera.fx - margin_x,
        (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )


def _project(centres: Tensor, quats: Tensor, scales: Tensor, R: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Camera-frame centres (n, 3) and shapes to pixel means (n, 2) and pixel covariances (n, 2, 2)."""
    x, y, z = centres.unbind(1)
    x_min, x_max, y_min, y_max = tangent_limits(camera)
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            *(camera.fx / z, zero, -camera.fx * (x / z).clamp(x_min, x_max) / z),
            *(zero, camera.fy / z, -camera.fy * (y / z).clamp(y_min, y_max) / z),
        ],
        dim=1,
    ).reshape(-1, 2, 3)
    half = J @ R @ (rotation_matrices(quats) * scales[:, None, :])
    covariance = half @ half.transpose(1, 2) + BLUR * torch.eye(2, dtype=z.dtype, device=z.device)
    mean = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    return mean, covariance


def _reaches_a_pixel(mean: Tensor, extent: Tensor, camera: Camera) -> Tensor:
    """Whether the box mean ± extent holds a pixel centre of the image, (n,) bool."""
    size = torch.tensor([camera.width, camera.height]).to(mean)
    first = (mean - extent - 0.5).ceil().clamp(min=0)
    last = torch.minimum((mean + extent - 0.5).floor(), size - 1)
    return (last >= first).all(dim=1)


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
    """See ``hingesplat.render.rasterize``: rgba (4, H, W), depth (H, W), channels (C, H, W)."""
    like = {"dtype": means.dtype, "device": means.device}
    world_to_camera = torch.as_tensor(camera.T_camera_world, **like)
    R = world_to_camera[:3, :3]
    depths = means.detach() @ R[2] + world_to_camera[2, 3]
    index = torch.nonzero((depths > NEAR) & (opacities > ALPHA_MIN))[:, 0]
    index = index[torch.argsort(depths[index], stable=True)]

    centres = means[index] @ R.T + world_to_camera[:3, 3]
    mean, covariance = _project(centres, quats[index], scales[index], R, camera)
    with torch.no_grad():
        spread = 2 * torch.log(opacities[index] / ALPHA_MIN)
        extent = (spread[:, None] * covariance.diagonal(dim1=1, dim2=2)).sqrt()
        visible = _reaches_a_pixel(mean, extent, camera) & torch.isfinite(covariance).all(dim=(1, 2))
    if screen_gradient is not None and mean.requires_grad:
        radius = torch.where(visible, extent.amax(dim=1), 0).to(screen_gradient.dtype)

        def of_all(rows: Tensor) -> Tensor:
            return rows.new_zeros((len(means), *rows.shape[1:])).index_copy(0, index, rows)

        mean.register_hook(lambda g: record_screen_gradient(screen_gradient, of_all(g), of_all(radius)))

    mean, precision, o = mean[visible], torch.linalg.inv(covariance[visible]), opacities[index][visible]
    attributes = torch.cat([colors, channels], dim=1)[index][visible]
    attributes = torch.cat([attributes, centres[visible][:, 2:]], dim=1)
    v, u = torch.meshgrid(
        torch.arange(camera.height, **like) + 0.5, torch.arange(camera.width, **like) + 0.5, indexing="ij"
    )
    pieces = []
    for pixels in torch.stack([u, v], dim=-1).reshape(-1, 2).split(_PIXELS_AT_ONCE):
        d = pixels[:, None] - mean
        exponent = 0.5 * torch.einsum("pni,nij,pnj->pn", d, precision, d)
        alpha = (o * torch.exp(-exponent)).clamp(max=ALPHA_MAX)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
        before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)[:, :-1]
        if early_stop:
            alpha = torch.where(before > TRANSMITTANCE_MIN, alpha, 0)
        weight = alpha * before
        pieces.append(torch.cat([weight @ attributes, weight.sum(dim=1, keepdim=True)], dim=1))
    image = torch.cat(pieces).T.reshape(-1, camera.height, camera.width)
    rgb, others, depth, alpha = image.split([3, channels.shape[1], 1, 1])
    return torch.cat([rgb + (1 - alpha) * background[:, None, None], alpha]), depth[0], others


def record_screen_gradient(statistics: Tensor, gradient: Tensor, radius: Tensor) -> None:
    """Update the densification statistics (n, 3) of the Gaussians that are seen: their ``radius`` (n,) is not zero.

    Column 0 grows by the length of the pixel-space ``gradient`` (n, 2), column 1 by one, and column 2 is the
    largest radius so far.
    """
    seen = (radius > 0).to(statistics.dtype)
    statistics[:, 0] += gradient.norm(dim=1).to(statistics.dtype) * seen
    statistics[:, 1] += seen
    statistics[:, 2] = torch.maximum(statistics[:, 2], radius)
