"""Differentiable part poses, and the Gaussians of one state drawn with them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.gaussians import Gaussians
from hingesplat.losses.photometric import photometric
from hingesplat.optim import Adam, GaussianAdam
from hingesplat.render import Rendering, place, rasterize
from hingesplat.se3 import rotvec_to_matrix
from hingesplat.training import TrainingView, shuffled, view_loss


class PoseDelta:
    """A small rigid correction to each part's pose in each state, about a point of the part.

    Adam sees radians and extents, so that one step size serves both.
    """

    def __init__(self, T_state_0: Tensor, centres: Tensor, extent: float, *, first_is_frame: bool = True) -> None:
        """``T_state_0`` (states, parts, 4, 4) start; ``centres`` (parts, 3) in the frame of state 0.

        If not ``first_is_frame``, the Gaussians stand between the states, and parts move to state 0, too.
        """
        self.start, self.extent = T_state_0, extent
        self.pivots = (T_state_0[..., :3, :3] @ centres[..., None])[..., 0] + T_state_0[..., :3, 3]
        free = T_state_0.new_ones(T_state_0.shape[:2])
        free[:, 0] = 0  # The base does not move.
        free[0] *= not first_is_frame
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

    @torch.no_grad()
    def T_state_0(self) -> np.ndarray:
        """(states, parts, 4, 4) float64, rigid to the last digit."""
        R, t = (x.cpu().double().numpy() for x in self.Rt())
        u, _, vt = np.linalg.svd(R)
        T = np.tile(np.eye(4), (*R.shape[:2], 1, 1))
        T[..., :3, :3], T[..., :3, 3] = u @ vt, t
        return T


def draw_state(
    g: Gaussians,
    R: Tensor,
    t: Tensor,
    camera: Camera,
    *,
    sh_offset: Tensor | None = None,
    means: Tensor | None = None,
    background: Tensor | None = None,
    channels: Tensor | None = None,
    screen_gradient: Tensor | None = None,
) -> Rendering:
    """Canonical Gaussians moved by their parts' poses R (parts, 3, 3), t (parts, 3), and rasterised.

    Args:
        sh_offset: (n, 3) added to the constant colour coefficient: this state's light.
        means: (n, 3) centres to use instead of the hard motion (soft assignment, repulsion).
    """
    placed = place(g, camera, pose=(R, t), means=means, sh_offset=sh_offset)
    return rasterize(*placed.drawn, camera, channels=channels, background=background, screen_gradient=screen_gradient)


def pose_loss(
    g: Gaussians, R: Tensor, t: Tensor, view: TrainingView, ssim_weight: float, sh_offset: Tensor | None = None
) -> Tensor:
    """What one photograph says of its state's part poses alone: L_render of Gaussians that are what they are."""
    r = draw_state(g, R, t, view.camera, sh_offset=sh_offset, background=g.means.new_ones(3))
    return photometric(r.rgba, view.target, ssim_weight)


class Movable(Protocol):
    """Part poses that a few numbers decide."""

    @property
    def parameters(self) -> list[Tensor]: ...
    def Rt(self) -> tuple[Tensor, Tensor]: ...


def move_parts_alone(
    g: Gaussians,
    poses: Movable,
    training: Sequence[Sequence[TrainingView]],
    steps: int,
    rate: float,
    ssim_weight: float,
    rng: np.random.Generator,
    *,
    state_sh: Tensor | None = None,
) -> None:
    """Improve ``poses`` on the photographs of the moved states by Adam, nothing else changing.

    Args:
        training: photographs of every state; those of state 0 are not asked.
        rate: Adam step; decays to 2 %.
        state_sh: (states, n, 3) colour offsets.
    """
    adam = Adam(poses.parameters)
    photographs = shuffled(training[1:], rng)
    for step in range(steps):
        before, view = next(photographs)
        state, (R, t) = before + 1, poses.Rt()
        offset = None if state_sh is None else state_sh[state]
        pose_loss(g, R[state], t[state], view, ssim_weight, offset).backward()
        pose_step(adam, rate, step / steps)


@torch.no_grad()
def drawn_parts(
    g: Gaussians, R: Tensor, t: Tensor, training: Sequence[Sequence[TrainingView]], state_sh: Tensor | None = None
) -> Iterator[tuple[TrainingView, Rendering]]:
    """Every photograph, and what its camera sees over white; its channels are the shares of the moving parts.

    Args:
        R, t: (states, parts, 3, 3) and (states, parts, 3) poses.
        training: photographs of every state.
        state_sh: (states, n, 3) colour offsets.
    """
    membership, white = torch.nn.functional.one_hot(g.part, R.shape[1]).float()[:, 1:], g.means.new_ones(3)
    for s, views in enumerate(training):
        offset = None if state_sh is None else state_sh[s]
        for view in views:
            yield (
                view,
                draw_state(g, R[s], t[s], view.camera, sh_offset=offset, background=white, channels=membership),
            )


def errors_by_part(
    g: Gaussians,
    trials: Sequence[tuple[Tensor, Tensor]],
    training: Sequence[Sequence[TrainingView]],
    state_sh: Tensor | None = None,
) -> np.ndarray:
    """How well photographs agree with each part's poses, where any of the trials draws the part.

    A part that hides behind others would else be judged by the few pixels that it still has. Photographs of state 0 are
    not asked.

    Args:
        trials: poses R (states, parts, 3, 3), t (states, parts, 3) to compare.
        training, state_sh: as for ``drawn_parts``.

    Returns:
        (trials, views, parts − 1) mean absolute error over the pixels near each moving part; NaN where it is hardly
        seen.
    """
    sh = None if state_sh is None else state_sh[1:]
    rows = []
    for drawn in zip(*(drawn_parts(g, R[1:], t[1:], training[1:], sh) for R, t in trials), strict=True):
        error = torch.stack([(r.rgba - view.image).abs().mean(0) for view, r in drawn])[:, None]
        share = torch.stack([r.channels for _, r in drawn]).amax(0)[None]
        tall = torch.nn.functional.max_pool2d(share, (15, 1), 1, (7, 0))
        region = torch.nn.functional.max_pool2d(tall, (1, 15), 1, (0, 7)) > 0.3
        area = region.flatten(2).sum(2)
        mean = (error * region).flatten(2).sum(2) / area.clamp_min(1)
        rows.append(torch.where(area > 30, mean, torch.nan).cpu().numpy())
    return np.stack(rows, 1)


def pose_step(adam: Adam, rate: float, progress: float, end: float = 0.02) -> None:
    """One step of poses or joints; their rate decays to ``end`` of ``rate`` as ``progress`` goes from 0 to 1."""
    adam.step(*[rate * end**progress] * len(adam.values))


def part_centres(g: Gaussians, parts: int) -> Tensor:
    """(parts, 3) mean centre of each part's Gaussians; the origin for a part without any."""
    total = g.means.new_zeros((parts, 3)).index_add_(0, g.part, g.means)
    return total / torch.bincount(g.part, minlength=parts).clamp_min(1)[:, None]


@dataclass(frozen=True)
class StateLossConfig:
    """What one photograph of one state asks of the canonical Gaussians."""

    ssim_weight: float = 0.2
    """Weight of 1 − SSIM; the rest is L1 (paper: 0.2)."""
    depth_variance_weight: float = 5.0
    """Pulls the weight along each ray to one depth."""
    flatten_weight: float = 0.5
    """Shrinks each Gaussian's thinnest axis."""
    state_colour_weight: float = 0.02
    """Price of a colour that differs between states (light and shadow move with the parts)."""


def state_loss(
    optimiser: GaussianAdam,
    R: Tensor,
    t: Tensor,
    view: TrainingView,
    state: int,
    config: StateLossConfig,
    extent: float,
    *,
    means: Tensor | None = None,
    statistics: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """L_render and its regularisers for one photograph, and (4,) mean squared error of r, g, b and alpha.

    Args:
        optimiser: holds the Gaussians, and ``state_sh`` (n, states − 1, 3).
        R, t: this state's part poses.
    """
    g = optimiser.gaussians
    offset = optimiser.values["state_sh"][:, state - 1] if state else None
    placed = place(g, view.camera, pose=(R, t), means=means, sh_offset=offset)
    loss, error = view_loss(placed, view, config, extent, statistics=statistics)
    if offset is not None:
        loss = loss + config.state_colour_weight * offset.abs().mean()
    return loss, error
