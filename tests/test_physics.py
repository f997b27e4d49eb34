"""Switches of the paper's terms: each changes what it should."""

from dataclasses import replace

import pytest
import torch

from hingesplat.optim import GaussianAdam, LearningRates
from hingesplat.physics import PhysicsConfig, RepelConfig, Repulsion, Targets, draw_repel_points, physics_loss
from scenes import scene

MADE = scene("revolute", 48, 0.08)
G = MADE.gaussians
R, t = (torch.from_numpy(MADE.T_state_0[..., :3, k]).float() for k in (slice(3), 3))
REPEL = RepelConfig(points=100, threshold=0.1)


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def loss(config: PhysicsConfig, shift: float = 0.0) -> float:
    targets = Targets(G, (G, MADE.at(1)), config, 1.0, 0)
    aim = targets.at(GaussianAdam(G, LearningRates(), 1.0, targets.extra), None, R, t + shift, 1, 0)
    return float(physics_loss(G, None, R[1], t[1] + shift, aim, config, 1.0, seeded()))


def test_no_points_no_repulsion() -> None:
    assert draw_repel_points(G, RepelConfig(), seeded()) is None
    assert draw_repel_points(G.with_part(torch.zeros_like(G.part)), REPEL, seeded()) is None
    drawn = draw_repel_points(G, REPEL, seeded())
    assert drawn is not None and drawn.shape == (100, 3)


def test_noise_moves_the_points_by_its_share_of_the_extent() -> None:
    clean, noisy = (draw_repel_points(G, replace(REPEL, noise=s), seeded()) for s in (0.0, 0.05))
    assert clean is not None and noisy is not None
    extent = float((G.means.amax(0) - G.means.amin(0)).norm())
    assert float((noisy - clean).std()) == pytest.approx(0.05 * extent, rel=0.2)


def test_points_are_drawn_once_or_anew_every_so_often_and_not_too_early() -> None:
    def drawn(config: RepelConfig) -> list[int]:
        repulsion, at = Repulsion(config, 1.0, seeded()), []
        for step in range(20):
            before = repulsion.points
            repulsion.update(G, step, 20)
            at += [step] if repulsion.points is not before else []
        return at

    assert drawn(REPEL) == [0]
    assert drawn(replace(REPEL, since=0.5)) == [10]
    assert drawn(replace(REPEL, refresh=0.25)) == [0, 5, 10, 15]
    assert drawn(RepelConfig()) == []


def test_only_the_movable_are_pushed_and_by_tau_max_at_most() -> None:
    repulsion = Repulsion(replace(REPEL, tau_max=0.02), 2.0, seeded())
    repulsion.update(G, 0, 1)
    movable = (G.part > 0).float()
    way = (repulsion.pushed(G.means, movable) - G.means).norm(dim=1)
    assert float(way[G.part == 0].max()) == 0
    assert 0 < float(way.max()) <= 0.04 + 1e-6


def test_terms_are_off_by_default() -> None:
    assert loss(PhysicsConfig(), shift=0.3) == 0


@pytest.mark.parametrize("term", ["art", "vector"])
def test_alignment_is_least_at_the_true_motion(term: str) -> None:
    config = PhysicsConfig(**{term: 1.0})
    assert loss(config, shift=0.01) > loss(config) >= 0


def test_matched_targets_follow_their_rows() -> None:
    targets = Targets(G, (G, MADE.at(1)), PhysicsConfig(vector=1.0, targets="matched"), 1.0, 0)
    optimiser = GaussianAdam(G, LearningRates(), 1.0, targets.extra)
    before = targets.at(optimiser, None, R, t, 1, 0)
    assert before is not None and len(before.rows) > 0.9 * len(G)
    optimiser.select(torch.arange(len(G)).flip(0))
    after = targets.at(optimiser, None, R, t, 1, 1)
    assert after is not None
    torch.testing.assert_close(after.points, before.points.flip(0))


def test_velocity_as_printed_punishes_the_turn() -> None:
    assert loss(PhysicsConfig(velocity=1.0)) < 1e-6
    assert loss(PhysicsConfig(velocity=1.0, velocity_form="displacement")) > 1e-4


def test_the_printed_sum_grows_with_the_number_of_gaussians() -> None:
    mean, total = (loss(PhysicsConfig(vector=1.0, vector_reduction=r), shift=0.01) for r in ("mean", "sum"))
    assert total > 0.5 * len(G) * mean
