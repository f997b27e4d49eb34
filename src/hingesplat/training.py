"""What every optimisation loop shares: prepared photographs, depth regularisers, growing and pruning the set."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Protocol
from weakref import finalize

import numpy as np
import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.capture import View
from hingesplat.gaussians import Gaussians
from hingesplat.losses.photometric import Target, picture_loss, psnr
from hingesplat.optim import GaussianAdam, densify, morton_order
from hingesplat.render import Placed, rasterize, render
from hingesplat.stereo import DepthMap

Report = Callable[..., None]
"""Called now and then with ``step, steps, loss, psnr, gaussians``."""

REPORT_EVERY = 50
"""Steps."""


KEPT_BYTES = 2**30
"""Of targets as floats, twelve numbers a pixel; views beyond make theirs anew whenever they are asked."""
_kept_bytes = 0


@dataclass(eq=False)
class TrainingView:
    """A photograph ready for the loop: cropped to the object, over white, with its alpha as a fourth plane."""

    camera: Camera
    rgba: np.ndarray
    """(h, w, 4) uint8, straight alpha: a window of the photograph, not a copy."""
    known: DepthMap | None = None
    """What stereo knows of it."""
    device: torch.device | str = "cpu"
    """Where its target is."""
    _target: Target | None = None

    @property
    def target(self) -> Target:
        """``image``, with what the loss needs of it."""
        if self._target is not None:
            return self._target
        rgba = torch.tensor(self.rgba).to(self.device).permute(2, 0, 1).float() / 255
        image = torch.cat([rgba[:3] * rgba[3:] + 1 - rgba[3:], rgba[3:]])
        target = Target.of(image, None if self.known is None else torch.from_numpy(self._depth()).to(self.device))
        if _kept_bytes + target.nbytes <= KEPT_BYTES:
            _count_kept(target.nbytes)
            finalize(self, _count_kept, -target.nbytes)
            self._target = target
        return target

    def _depth(self) -> np.ndarray:
        """(h, w) float32: the known depth, of the nearest of its own, coarser pixels."""
        assert self.known is not None
        coarse, fine = self.known.camera, self.camera
        x = coarse.fx * (np.arange(fine.width) + 0.5 - fine.cx) / fine.fx + coarse.cx
        y = coarse.fy * (np.arange(fine.height) + 0.5 - fine.cy) / fine.fy + coarse.cy
        height, width = self.known.depth.shape
        inside = ((x >= 0) & (x < width)) & ((y >= 0) & (y < height))[:, None]
        column, row = np.clip(x.astype(int), 0, width - 1), np.clip(y.astype(int), 0, height - 1)
        return np.where(inside, self.known.depth[row][:, column], 0).astype(np.float32)

    @property
    def image(self) -> Tensor:
        """(4, h, w): rgb over white, alpha."""
        return self.target.image


def _count_kept(nbytes: int) -> None:
    global _kept_bytes
    _kept_bytes += nbytes


def training_view(
    view: View, known: DepthMap | None = None, device: torch.device | str = "cpu", margin: int = 8
) -> TrainingView:
    """Crop to the mask's rectangle plus a margin: what lies outside is background in every render, too."""
    alpha = view.rgba[..., 3]
    height, width = alpha.shape
    rows, columns = np.flatnonzero(alpha.max(1)), np.flatnonzero(alpha.max(0))
    if len(rows) == 0:
        rows, columns = np.array([0, height - 1]), np.array([0, width - 1])
    x0, x1 = max(columns[0] - margin, 0), min(columns[-1] + margin + 1, width)
    y0, y1 = max(rows[0] - margin, 0), min(rows[-1] + margin + 1, height)
    camera = view.camera.cropped(int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    return TrainingView(camera, view.rgba[y0:y1, x0:x1], known, device)


def training_views(
    states: Sequence[Sequence[View]], maps: Sequence[Sequence[DepthMap]] = (), device: torch.device | str = "cpu"
) -> list[list[TrainingView]]:
    """The photographs of every state with what is known of their depth, if anything."""
    return [
        [training_view(view, known, device) for view, known in zip_longest(views, depths)]
        for views, depths in zip_longest(states, maps, fillvalue=())
    ]


def averaged(report: Report, steps: int) -> Callable[[Tensor, Tensor, int], None]:
    """Tell it ``loss, error, gaussians`` after each step; it reports after the first and every so many.

    Loss and PSNR are means over the steps since the last report: each saw one photograph, and some are harder.
    ``error`` are mean squared errors of r, g, b and more. Until it reports, nothing waits for a GPU.
    """
    step, losses, errors = 0, [], []

    def after_step(loss: Tensor, error: Tensor, gaussians: int) -> None:
        nonlocal step
        losses.append(loss.detach())
        errors.append(error[:3].mean())
        step += 1
        if (step - 1) % REPORT_EVERY == 0 or step == steps:
            psnr = -10 * torch.stack(errors).clamp_min(1e-12).log10().mean()
            mean_loss = torch.stack(losses).mean()
            report(step=step, steps=steps, loss=float(mean_loss), psnr=float(psnr), gaussians=gaussians)
            losses.clear()
            errors.clear()

    return after_step


class Surfaces(Protocol):
    """What pictures cost, and what keeps Gaussians on surfaces."""

    @property
    def ssim_weight(self) -> float: ...
    @property
    def depth_variance_weight(self) -> float: ...
    @property
    def flatten_weight(self) -> float: ...


def view_loss(
    placed: Placed, view: TrainingView, config: Surfaces, extent: float, *, statistics: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """What one photograph asks of Gaussians before its camera: that they look like it and lie on surfaces.

    Returns:
        The loss, and (4,) mean squared error of r, g, b and alpha.
    """
    options = {"background": placed.means.new_ones(3), "screen_gradient": statistics}
    weight = config.depth_variance_weight / extent**2
    if weight == 0:
        rgba, depths = rasterize(*placed.drawn, view.camera, **options).rgba, None
    else:
        r = rasterize(*placed.drawn, view.camera, channels=placed.squared_depth, **options)
        rgba, depths = r.rgba, (r.depth, r.channels[0])
    loss, error = picture_loss(rgba, view.target, config.ssim_weight, depths, weight)
    if config.flatten_weight:
        loss = loss + config.flatten_weight / extent * placed.scales.amin(1).mean()
    return loss, error


def evenly(number: int, most: int) -> np.ndarray:
    """Indices of at most ``most`` of so many, the first and the last among them."""
    return np.linspace(0, number - 1, min(number, most)).round().astype(int)


def thinned(states: Sequence[Sequence[TrainingView]], about: int) -> list[Sequence[TrainingView]]:
    """Evenly spread photographs of every state, ``about`` so many of each, to judge by."""
    return [state[:: max(len(state) // about, 1)] for state in states]


def shuffled(states: Sequence[Sequence[TrainingView]], rng: np.random.Generator) -> Iterator[tuple[int, TrainingView]]:
    """Every photograph of every state, with its state's index, in a new order each round, for ever."""
    everything = [(s, view) for s, state in enumerate(states) for view in state]
    while True:
        for i in rng.permutation(len(everything)):
            yield everything[i]


def grow(
    optimiser: GaussianAdam,
    statistics: Tensor,
    max_gaussians: int,
    min_opacity: float,
    extent: float,
    generator: torch.Generator,
) -> None:
    """Drop the faint, then densify where the picture pulls hardest on centres, up to ``max_gaussians``.

    ``statistics`` is the (n, 3) buffer that ``rasterize`` fills: summed screen gradient, number of views, radius.
    """
    gradient = statistics[:, 0] / statistics[:, 1].clamp_min(1)
    solid = optimiser.gaussians.opacities.detach() > min_opacity
    optimiser.select(solid)
    gradient = gradient[solid]
    room = max(max_gaussians - len(optimiser), 0)
    n_hot = min(room, int((gradient > 0).sum()), len(optimiser) // 4)
    densify(optimiser, gradient.topk(n_hot).indices, 0.02 * extent, generator)
    optimiser.select(morton_order(optimiser.gaussians.means.detach()))


@torch.no_grad()
def seen_weight(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """(n,) largest blending weight, summed over a picture's pixels, that each Gaussian has in any camera.

    The gradient of a picture's sum with respect to a per-Gaussian channel of ones is that Gaussian's weight.
    """
    best = torch.zeros_like(gaussians.logit_opacities)
    for camera in cameras:
        with torch.enable_grad():
            ones = torch.ones_like(best[:, None], requires_grad=True)
            (weight,) = torch.autograd.grad(render(gaussians, camera, channels=ones).channels.sum(), ones)
        best = torch.maximum(best, weight[:, 0])
    return best


@torch.no_grad()
def shown(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """(n,) share of each Gaussian's one-sigma footprint, from where it is largest, that the best of the cameras sees.

    About 0.4 on a surface, where Gaussians share the pixels that they cover.
    """
    centre = gaussians.means.mean(0).double().cpu().numpy()
    pixels = float(np.median([c.fx / np.linalg.norm(c.centre - centre) for c in cameras]))  # In a scene unit.
    largest = gaussians.scales.sort(1).values[:, 1:].prod(1) * (2 * math.pi * pixels**2)
    return seen_weight(gaussians, cameras) / (largest * gaussians.opacities).clamp_min(1e-9)


@torch.no_grad()
def mean_psnr(gaussians: Gaussians, views: Sequence[TrainingView]) -> float:
    """Mean PSNR over views, white background, on the cropped pictures."""
    white = torch.ones(3)
    scores = [float(psnr(render(gaussians, v.camera, background=white).rgb, v.image[:3])) for v in views]
    return float(np.mean(scores))
