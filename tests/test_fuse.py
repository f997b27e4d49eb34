"""Two states' Gaussians to one canonical set."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from hingesplat.fuse import FuseConfig, fuse, fusion_weight, motion_richness
from hingesplat.gaussians import Gaussians
from scenes import scene

Averaging = Literal["uniform", "per_part", "global"]
STRATEGIES: list[Averaging] = ["uniform", "per_part", "global"]
MADE = scene("revolute", 48, 0.08)
FIRST, SECOND = MADE.gaussians, MADE.at(1)
LABELS = (FIRST.part.numpy(), FIRST.part.numpy())
T_1_0 = MADE.T_state_0[1]
STAY = np.tile(np.eye(4), (2, 1, 1))


def equal(a: Gaussians, b: Gaussians, atol: float = 1e-5) -> None:
    for name, value in vars(a).items():
        torch.testing.assert_close(value, getattr(b, name), rtol=0, atol=atol)


def test_richness_is_the_mean_distance_to_the_nearest() -> None:
    a, b = np.zeros((1, 3)), np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
    assert motion_richness(a, b) == 0
    assert motion_richness(b, a) == pytest.approx(7 / 3)


def test_beta_is_the_share_of_the_first_states_richness() -> None:
    a, b = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0], [4, 0, 0]])
    assert fusion_weight(a, b) == pytest.approx(0.5 / (0.5 + 1.5))
    assert fusion_weight(a, b) + fusion_weight(b, a) == pytest.approx(1)
    assert fusion_weight(7 * a, 7 * b) == pytest.approx(fusion_weight(a, b))
    assert fusion_weight(a, a) == 0.5


def test_none_is_the_first_state_with_its_parts() -> None:
    unlabelled = FIRST.with_part(torch.zeros_like(FIRST.part))
    equal(fuse((unlabelled, SECOND), LABELS, T_1_0, FuseConfig("none")), FIRST)


@pytest.mark.parametrize("strategy", ["union", *STRATEGIES])
def test_equal_states_fuse_to_themselves(strategy: Literal["union", "uniform", "per_part", "global"]) -> None:
    equal(fuse((FIRST, FIRST), LABELS, STAY, FuseConfig(strategy)), FIRST)


@pytest.mark.parametrize("strategy", ["union", *STRATEGIES])
def test_motions_of_parts_are_undone(strategy: Literal["union", "uniform", "per_part", "global"]) -> None:
    assert float((FIRST.means - SECOND.means).norm(dim=1).max()) > 0.3
    equal(fuse((FIRST, SECOND), LABELS, T_1_0, FuseConfig(strategy)), FIRST)


def test_union_adds_only_what_the_first_state_lacks() -> None:
    """The slab's back is missing in state 0: it comes over from state 1, brought back to where it was."""
    back = (FIRST.part == 1) & (FIRST.means[:, 1] > -0.381)
    assert 0 < int(back.sum()) < int((FIRST.part == 1).sum())
    kept = FIRST[~back]
    fused = fuse((kept, SECOND), (kept.part.numpy(), LABELS[1]), T_1_0, FuseConfig())
    equal(fused[torch.arange(len(kept))], kept)
    added = fused[torch.arange(len(kept), len(fused))]
    assert (added.part == 1).all()
    assert len(added) == int(back.sum())
    distance = KDTree(FIRST.means[back].numpy()).query(added.means.numpy())[0]
    assert distance.max() < 1e-5
    turn = (added.quats * FIRST.quats[back]).sum(1).abs()  # Orientations too.
    torch.testing.assert_close(turn, torch.ones_like(turn))


def test_union_takes_a_part_that_the_first_state_does_not_show_at_all() -> None:
    base = FIRST[FIRST.part == 0]
    fused = fuse((base, SECOND), (base.part.numpy(), LABELS[1]), T_1_0, FuseConfig())
    assert int((fused.part == 1).sum()) == int((FIRST.part == 1).sum())
    assert int((fused.part == 0).sum()) == len(base)


def test_union_measures_new_surface_by_part() -> None:
    """A slab that lies on the box is not the box's surface."""
    low = FIRST[FIRST.part == 0]
    twice = replace(low, part=torch.ones_like(low.part))
    labels = (np.zeros(len(low), int), np.ones(len(low), int))
    assert len(fuse((low, twice), labels, STAY, FuseConfig())) == 2 * len(low)


def test_uniform_meets_in_the_middle() -> None:
    shift = torch.tensor([0.004, -0.006, 0.002])
    there = replace(FIRST, means=FIRST.means + shift)
    fused = fuse((FIRST, there), LABELS, STAY, FuseConfig("uniform"))
    torch.testing.assert_close(fused.means, FIRST.means + shift / 2)
    assert torch.equal(fused.log_scales, FIRST.log_scales)


def test_per_part_and_global_weigh_by_beta() -> None:
    """Half of the slab is missing in state 0, so β is not ½, and it is another for the slab than for both parts."""
    first = FIRST[(FIRST.part == 0) | (FIRST.means[:, 2] < 0)]
    shift = torch.tensor([0.004, -0.006, 0.002])
    there = replace(FIRST, means=FIRST.means + shift)
    labels = (first.part.numpy(), LABELS[1])
    means = first.means.numpy(), there.means.numpy()
    slab = means[0][labels[0] == 1], means[1][labels[1] == 1]
    box = means[0][labels[0] == 0], means[1][labels[1] == 0]
    everything, of_slab, of_box = (fusion_weight(*pair) for pair in (means, slab, box))
    assert min(everything, of_slab) < 0.49 and abs(everything - of_slab) > 0.01 and abs(of_box - 0.5) < 0.01

    def moved(strategy: Averaging) -> torch.Tensor:
        fused = fuse((first, there), labels, STAY, FuseConfig(strategy))
        paired = (fused.means - first.means).norm(dim=1) < 0.02  # A few take another partner: one to one.
        assert float(paired.float().mean()) > 0.95
        share = ((fused.means - first.means) / shift)[:, 1]
        return torch.stack([share[(first.part == k) & paired].median() for k in (0, 1)])

    expected = {"global": (everything, everything), "per_part": (of_box, of_slab), "uniform": (0.5, 0.5)}
    for strategy in STRATEGIES:
        torch.testing.assert_close(moved(strategy), 1 - torch.tensor(expected[strategy]), rtol=0, atol=1e-3)


def test_pairs_across_parts_are_not_averaged() -> None:
    other = (LABELS[0], 1 - LABELS[1])
    there = replace(FIRST, means=FIRST.means + 0.003)
    equal(fuse((FIRST, there), other, STAY, FuseConfig("uniform")), FIRST)


def test_only_so_many_are_matched_the_same_ones_for_the_same_seed() -> None:
    there = replace(FIRST, means=FIRST.means + 0.002)

    def changed(seed: int) -> torch.Tensor:
        fused = fuse((FIRST, there), LABELS, STAY, FuseConfig("uniform", matched=100), seed=seed)
        return (fused.means != FIRST.means).any(1)

    assert 0 < int(changed(0).sum()) <= 100
    assert torch.equal(changed(0), changed(0)) and not torch.equal(changed(0), changed(1))


def test_harmonics_are_padded_to_the_richer_state() -> None:
    rich = replace(SECOND, sh=torch.cat([SECOND.sh, torch.ones((len(SECOND), 3, 3))], 1))
    fused = fuse((FIRST, rich), LABELS, T_1_0, FuseConfig())
    assert fused.sh_degree == 1
    assert torch.equal(fused.sh[:, :1], FIRST.sh) and float(fused.sh[:, 1:].abs().max()) == 0
