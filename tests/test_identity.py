"""Kinds of part identity."""

import numpy as np
import pytest
import torch

from hingesplat.identity import Centres, Embedding, Free, Identity, IdentityConfig, identity_of, parts_of_shifts
from hingesplat.optim import GaussianAdam, LearningRates
from scenes import angle_between, scene

MADE = scene("revolute", 48, 0.08)
G = MADE.gaussians


def made(kind, g=G, parts: int = 2) -> tuple[Identity, GaussianAdam]:
    fitted = (G, MADE.at(1))
    identity = identity_of(g, parts, fitted, IdentityConfig(kind), 1.0, 1e-3, torch.Generator().manual_seed(0))
    return identity, GaussianAdam(g, LearningRates(), 1.0, identity.extra)


def test_hard_labels_need_no_probabilities() -> None:
    identity, optimiser = made("hard")
    assert identity.probabilities(optimiser, 0.0) is None and float(identity.loss(optimiser, None, 0)) == 0


def test_an_embedding_starts_at_the_labels_that_are_known_and_nowhere_else() -> None:
    identity, optimiser = made("embedding")
    assert isinstance(identity, Embedding)
    p = identity.probabilities(optimiser, 0.0)
    assert p is not None and float(p.detach()[torch.arange(len(G)), G.part].min()) > 0.9
    blank = G.with_part(torch.zeros_like(G.part))
    identity, optimiser = made("embedding", blank, parts=4)
    p = identity.probabilities(optimiser, 0.0)
    assert p is not None and float((p.detach() - 0.25).abs().max()) < 0.05
    assert optimiser.part.unique().tolist() == [0, 1, 2, 3]


def test_soft_identities_settle() -> None:
    for kind in ("embedding", "centres"):
        identity, optimiser = made(kind)
        assert identity.probabilities(optimiser, 0.69) is not None
        assert identity.probabilities(optimiser, 0.71) is None


def test_centres_belong_to_their_clusters_and_empty_ones_to_nobody() -> None:
    identity, optimiser = made("centres", parts=3)
    assert isinstance(identity, Centres)
    p = identity.probabilities(optimiser, 0.0)
    assert p is not None
    torch.testing.assert_close(p.sum(1), torch.ones(len(G)))
    assert float(p.detach()[:, 2].max()) == 0
    assert float((p.argmax(1) == G.part).float().mean()) > 0.8
    p.square().sum().backward()
    before = identity.centres.detach().clone()
    identity.probabilities(optimiser, 0.1)
    assert not torch.equal(before[:2], identity.centres[:2])


def test_without_parts_every_gaussian_starts_on_its_match() -> None:
    identity, optimiser = made("none")
    assert isinstance(identity, Free)
    assert torch.equal(identity.moved(optimiser, 0), G.means)
    moved = identity.moved(optimiser, 1).detach()
    nearest = torch.cdist(moved, MADE.at(1).means).amin(1)
    assert float(nearest.quantile(0.9)) < 0.02


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_parts_and_motions_are_read_off_displacements(kind) -> None:
    scene_ = scene(kind, 48, 0.08)
    means = scene_.gaussians.means
    part, T = parts_of_shifts(means, (scene_.at(1).means - means)[:, None], 2, seed=0)
    assert float((part == scene_.gaussians.part).float().mean()) > 0.95
    assert angle_between(T[1, 1], scene_.T_state_0[1, 1]) < 0.5
    np.testing.assert_array_equal(T[:, 0], np.tile(np.eye(4), (2, 1, 1)))
