"""Single-state Gaussians: the photographs of one state to G^t (method, section 1)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.ndimage import convolve
from scipy.spatial import KDTree
from torch import Tensor

from hingesplat.capture import View, visual_hull
from hingesplat.gaussians import SH_C0, Gaussians
from hingesplat.optim import GaussianAdam, LearningRates, morton_order
from hingesplat.render import place
from hingesplat.stereo import Cloud, DepthMap, fused, seen_through
from hingesplat.surface import thin
from hingesplat.training import (
    Report,
    TrainingView,
    averaged,
    grow,
    mean_psnr,
    seen_weight,
    shuffled,
    training_views,
    view_loss,
)

FLATNESS = 0.5
"""Thickness of a disc at the start, as a fraction of its width."""
FREE = 0.2
"""Fraction of the run in which nothing asks Gaussians to lie on surfaces."""


@dataclass(frozen=True)
class FitConfig:
    """One state's Gaussians."""

    steps: int = 1000
    """Optimiser steps."""
    start_gaussians: int = 4000
    """Gaussians at the start, on known depth and on the visual hull's shell."""
    max_gaussians: int = 10_000
    """Cap on the number of Gaussians."""
    densify_every: int = 100
    """Steps between densifications."""
    densify_until: float = 0.65
    """Fraction of the run after which the set only shrinks."""
    min_opacity: float = 0.02
    """Gaussians fainter than this are pruned."""
    ssim_weight: float = 0.2
    """Weight of 1 − SSIM; the rest is L1 (paper: 0.2)."""
    depth_variance_weight: float = 20.0
    """Pulls the weight along each ray to one depth, so that Gaussians lie on a surface."""
    flatten_weight: float = 0.5
    """Shrinks each Gaussian's thinnest axis, so that it is a disc on that surface."""
    max_sh_degree: int = 2
    """Largest spherical-harmonic degree that may be chosen."""
    sh_gain_db: float = 0.3
    """Held-back views must improve by this much for a degree above 0."""
    rates: LearningRates = field(default_factory=LearningRates)


def start_from_cloud(cloud: Cloud, spacing: float) -> Gaussians:
    """Half-opaque discs on the points of a cloud, each as wide as the distance to its neighbours."""
    n, points = len(cloud), cloud.points
    distance = KDTree(points).query(points, min(4, n))[0][:, 1:].mean(1) if n > 1 else np.full(n, spacing)
    log_scales = torch.from_numpy(np.log(np.maximum(distance, 1e-4) * 0.8).astype(np.float32))[:, None].repeat(1, 3)
    log_scales[:, 2] += math.log(FLATNESS)
    # Half a turn about the direction between z and the normal takes the one to the other.
    between = torch.from_numpy(np.where(cloud.normals[:, 2:] > 0, cloud.normals, -cloud.normals).astype(np.float32))
    between = between + torch.tensor([0.0, 0.0, 1.0])
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quats=torch.cat([torch.zeros((n, 1)), between], 1),
        log_scales=log_scales,
        logit_opacities=torch.zeros(n),
        sh=torch.from_numpy(((cloud.colours - 0.5) / SH_C0).astype(np.float32))[:, None],
        part=torch.zeros(n, dtype=torch.int64),
    )


def start_cloud(views: Sequence[View], maps: Sequence[DepthMap], n: int, rng: np.random.Generator) -> Cloud:
    """About n evenly spread points to start from.

    Where depth is known they lie on it; elsewhere, grey, on the shell of what is left of the visual hull when all
    that known depth sees through is carved away.
    """
    hull, voxel = visual_hull(views, 96)
    known = fused(maps, voxel)
    left = hull[seen_through(hull, maps, 2 * voxel) < 2]
    shell = left[_outer(left, voxel)]
    if len(known):
        shell = shell[KDTree(known.points).query(shell)[0] > 2 * voxel]
    shell = shell + rng.uniform(-0.5, 0.5, shell.shape) * voxel
    everything = known.joined(Cloud.of(shell))
    size = voxel
    for _ in range(5):  # The number of occupied cubes falls with the square of their size.
        chosen = thin(everything.points, size, rng)
        size *= math.sqrt(len(chosen) / n)
    return everything.rows(chosen)


def _outer(points: np.ndarray, voxel: float) -> np.ndarray:
    """(n,) bool: voxel centres (n, 3) of a grid that lack some of the neighbours in a ball around them."""
    cell = np.round((points - points.min(0)) / voxel).astype(int)
    occupied = np.zeros(cell.max(0) + 1, np.int16)
    occupied[tuple(cell.T)] = 1
    ball = (np.square(np.indices((5, 5, 5)) - 2).sum(0) <= 2.5**2).astype(np.int16)
    neighbours = convolve(occupied, ball, mode="constant")[tuple(cell.T)]
    return neighbours < 0.85 * neighbours.max()


def fit(
    views: Sequence[View],
    config: FitConfig,
    *,
    seed: int = 0,
    maps: Sequence[DepthMap] = (),
    cloud: Cloud | None = None,
    device: torch.device | str = "cpu",
    report: Report = lambda **_: None,
) -> Gaussians:
    """Photographs of one state to Gaussians on its surface.

    Args:
        views: posed photographs with masks.
        maps: their depth where it is known; the start is the visual hull where it is not.
        cloud: start from these points instead of either.
        device: where to optimise.
        report: called now and then with ``step, steps, loss, psnr, gaussians``.

    Returns:
        Gaussians of the chosen spherical-harmonic degree, all of part 0, each seen from at least one view; on the CPU.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    if cloud is None:
        cloud = start_cloud(views, maps, config.start_gaussians, rng)
    extent = float((cloud.points.max(0) - cloud.points.min(0)).max())
    (training,) = training_views([views], [maps], device)
    held_back = training[:: max(len(training) // 4, 2)][:4] if len(training) >= 12 else []
    kept = [v for v in training if not any(v is h for h in held_back)]
    start = start_from_cloud(cloud, extent / 64).to(device)
    optimiser = GaussianAdam(start[morton_order(start.means)], config.rates, extent)
    _optimise(optimiser, kept, config, extent, rng, generator, report)
    cameras = [v.camera for v in training]
    optimiser.select(seen_weight(optimiser.gaussians.detached(), cameras) > 0.5)
    return _choose_sh_degree(optimiser, kept, held_back, config, extent, rng, report).to("cpu")


def _optimise(
    optimiser: GaussianAdam,
    training: Sequence[TrainingView],
    config: FitConfig,
    extent: float,
    rng: np.random.Generator,
    generator: torch.Generator,
    report: Report,
) -> None:
    cameras = [v.camera for v in training]
    statistics = optimiser.fresh_statistics()
    photographs = shuffled([training], rng)
    tell = averaged(report, config.steps)
    for step in range(config.steps):
        progress = step / config.steps
        _, view = next(photographs)
        loss, error = _view_loss(optimiser, view, config, extent, progress, statistics)
        loss.backward()
        optimiser.step(progress)
        growing = step >= 200 and progress < config.densify_until
        if growing and step % config.densify_every == 0:
            grow(optimiser, statistics, config.max_gaussians, config.min_opacity, extent, generator)
            statistics = optimiser.fresh_statistics()
        if growing and step % 500 == 0:
            optimiser.select(seen_weight(optimiser.gaussians.detached(), cameras) > 0.5)
            statistics = optimiser.fresh_statistics()
        tell(loss, error, len(optimiser))


def _view_loss(
    optimiser: GaussianAdam,
    view: TrainingView,
    config: FitConfig,
    extent: float,
    progress: float,
    statistics: Tensor | None,
) -> tuple[Tensor, Tensor]:
    if progress <= FREE:
        config = replace(config, depth_variance_weight=0, flatten_weight=0)
    return view_loss(place(optimiser.gaussians, view.camera), view, config, extent, statistics=statistics)


def _choose_sh_degree(
    optimiser: GaussianAdam,
    training: Sequence[TrainingView],
    held_back: Sequence[TrainingView],
    config: FitConfig,
    extent: float,
    rng: np.random.Generator,
    report: Report,
) -> Gaussians:
    """Refine with each degree in turn; keep the smallest that held-back views do not improve on by much."""
    steps = max(config.steps // 6, 1)
    base = optimiser.gaussians.detached()
    best, best_psnr = base, -math.inf
    for degree in range(config.max_sh_degree + 1) if held_back else [0]:
        padding = base.sh.new_zeros((len(base), (degree + 1) ** 2 - 1, 3))
        start = replace(base, sh=torch.cat([base.sh, padding], 1))
        trial = GaussianAdam(start, config.rates, extent)
        photographs = shuffled([training], rng)
        for step in range(steps):
            _, view = next(photographs)
            loss, _ = _view_loss(trial, view, config, extent, 0.6 + 0.4 * step / steps, None)
            loss.backward()
            trial.step(0.6 + 0.4 * step / steps)
        fitted = trial.gaussians.detached()
        score = mean_psnr(fitted, held_back or training)
        report(step=steps, steps=steps, loss=float(loss.detach()), psnr=score, gaussians=len(fitted))
        if score < best_psnr + (config.sh_gain_db if degree else 0):
            break
        best, best_psnr = fitted, score
    return best
