"""Rasterisers to measure ours against: the same Gaussians in, the same picture and gradients out.

Each module has a class ``Rasteriser(n, camera)`` whose ``forward(means, quats, scales, opacities, colors)`` gives rgb,
depth and alpha over black, (5, height, width), and whose ``backward(g_image)`` gives the gradients of its inputs; all
are float32 arrays. They live here because they are yardsticks: nothing in the package uses them.
"""

from typing import Any

import torch
from torch import Tensor


class _Through(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rasteriser, *inputs):
        ctx.rasteriser = rasteriser
        return torch.from_numpy(rasteriser.forward(*(t.detach().numpy() for t in inputs)))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_image):
        gradients = ctx.rasteriser.backward(g_image.contiguous().numpy())
        return None, *(torch.from_numpy(g) for g in gradients)


def draw(rasteriser: Any, *inputs: Tensor) -> Tensor:
    """The picture (5, height, width) of a rasteriser of this folder, for autograd: as ours is used."""
    image = _Through.apply(rasteriser, *inputs)
    assert isinstance(image, Tensor)
    return image
