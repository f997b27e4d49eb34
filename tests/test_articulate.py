"""Joint optimisation of Gaussians and part motions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hingesplat.articulate import ArticulateConfig, Articulation, articulate
from hingesplat.identity import IdentityConfig
from hingesplat.physics import PhysicsConfig, RepelConfig
from scenes import (
    Scene,
    angle_between,
    distance,
    off_by,
    one_thread,  # noqa: F401
    scene,
)

CONFIG = ArticulateConfig(steps=80, pose_rate=4e-3)
FEW = replace(CONFIG, steps=16, densify_every=6)


def run(made: Scene, config: ArticulateConfig, degrees: float = 2.0, seed: int = 0) -> tuple[Articulation, list[float]]:
    losses: list[float] = []
    found = articulate(
        made.gaussians,
        off_by(made, degrees),
        made.views,
        config,
        fitted=(made.gaussians, made.at(1)),
        seed=seed,
        report=lambda **r: losses.append(r["loss"]),
    )
    return found, losses


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_motion_a_little_off_comes_closer(kind) -> None:
    made = scene(kind, 64, 0.06)
    found, losses = run(made, CONFIG)
    assert distance(found.T_state_0, made) < 0.35 * distance(off_by(made, 2.0), made)
    assert angle_between(found.T_state_0[1, 1], made.T_state_0[1, 1]) < 1.0
    assert losses[-1] < losses[0]


def test_the_base_and_state_0_stay_and_poses_are_rigid() -> None:
    found, _ = run(scene("revolute", 48, 0.08), FEW)
    T = found.T_state_0
    assert T.dtype == np.float64 and T.shape == (2, 2, 4, 4)
    for pose in (T[0, 0], T[0, 1], T[1, 0]):
        np.testing.assert_allclose(pose, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(T[1, 1, :3, :3] @ T[1, 1, :3, :3].T, np.eye(3), atol=1e-12)
    assert T[1, 1, 3].tolist() == [0, 0, 0, 1]


def test_light_is_an_offset_of_the_moved_state_only() -> None:
    made = scene("revolute", 48, 0.08)
    found, _ = run(made, FEW)
    assert found.state_sh.shape == (2, len(found.gaussians), 3)
    assert float(found.state_sh[0].abs().max()) == 0
    assert 0 < float(found.state_sh[1].abs().max()) < 1


def test_light_that_changes_between_states_is_learnt() -> None:
    """State 1 is photographed in brighter light."""
    made = scene("prismatic", 48, 0.08)
    brighter = tuple(
        replace(v, rgba=np.where([1, 1, 1, 0], np.minimum(v.rgba.astype(int) + 20, 255), v.rgba).astype(np.uint8))
        for v in made.views[1]
    )
    found = articulate(made.gaussians, made.T_state_0, (made.views[0], brighter), CONFIG)
    assert float(found.state_sh[1].mean()) > 0.05
    assert distance(found.T_state_0, made) < 0.005


PAPER = PhysicsConfig(art=1.0, contact=0.5, velocity=0.5, vector=0.5)
OPTIONS = {
    "embedding": ArticulateConfig(identity=IdentityConfig("embedding", hard_from=0.5)),
    "embedding to the end": ArticulateConfig(identity=IdentityConfig("embedding", hard_from=0.9)),
    "between the states": ArticulateConfig(frame="between"),
    "centres": ArticulateConfig(identity=IdentityConfig("centres", hard_from=0.9)),
    "repel": ArticulateConfig(repel=RepelConfig(points=200)),
    "repel, dynamic and noisy": ArticulateConfig(repel=RepelConfig(points=200, refresh=0.25, noise=0.01, nearest=0)),
    "art": ArticulateConfig(physics=PhysicsConfig(art=1.0)),
    "art, matched": ArticulateConfig(physics=PhysicsConfig(art=1.0, targets="matched")),
    "contact": ArticulateConfig(physics=PhysicsConfig(contact=0.5)),
    "velocity twist": ArticulateConfig(physics=PhysicsConfig(velocity=0.5)),
    "velocity as printed": ArticulateConfig(physics=PhysicsConfig(velocity=0.5, velocity_form="displacement")),
    "vector": ArticulateConfig(physics=PhysicsConfig(vector=0.5)),
    "vector as printed": ArticulateConfig(physics=PhysicsConfig(vector=0.5, vector_reduction="sum")),
    "everything": ArticulateConfig(identity=IdentityConfig("embedding"), repel=RepelConfig(points=2000), physics=PAPER),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_every_term_runs_and_labels_are_hard_at_the_end(name: str) -> None:
    made = scene("revolute", 48, 0.08)
    config = replace(OPTIONS[name], steps=FEW.steps, densify_every=FEW.densify_every)
    found, losses = run(made, config)
    assert np.isfinite(losses).all() and np.isfinite(found.T_state_0).all()
    g = found.gaussians
    assert g.part.dtype == torch.int64 and set(g.part.tolist()) == {0, 1}
    assert all(bool(v.isfinite().all()) for v in vars(g).values())
    known = torch.cdist(g.means, made.gaussians.means).argmin(1)
    assert float((g.part == made.gaussians.part[known]).float().mean()) > 0.95
    assert distance(found.T_state_0, made) < 1.2 * distance(off_by(made, 2.0), made)


@pytest.mark.parametrize("targets", ["nearest", "matched"])
def test_targets_follow_their_gaussians_through_densification(targets) -> None:
    """L_art and L_vector pull to the other state's Gaussians: rows that changed places must not pull elsewhere."""
    made = scene("revolute", 48, 0.08)
    config = ArticulateConfig(
        steps=40, densify_every=5, physics=PhysicsConfig(art=1.0, vector=1.0, targets=targets), pose_rate=2e-3
    )
    found, losses = run(made, config, degrees=0.0)
    assert distance(found.T_state_0, made) < 0.01
    assert losses[-1] < 0.2


def test_terms_that_are_off_cost_nothing() -> None:
    made = scene("revolute", 48, 0.08)
    plain, a = run(made, FEW)
    bare = articulate(made.gaussians, off_by(made, 2.0), made.views, FEW)
    assert len(a) > 0
    np.testing.assert_array_equal(plain.T_state_0, bare.T_state_0)


def test_a_wrong_soft_label_is_corrected() -> None:
    """A tenth of the slab is called base; photographs and neighbours know better."""
    made = scene("prismatic", 64, 0.08)
    slab = torch.nonzero(made.gaussians.part == 1)[:, 0]
    part = made.gaussians.part.clone()
    part[slab[::10]] = 0
    config = ArticulateConfig(
        steps=150, identity=IdentityConfig("embedding", weight=5.0, hard_from=0.9), densify_every=1000
    )
    found = articulate(made.gaussians.with_part(part), made.T_state_0, made.views, config)
    wrong_before = int((part != made.gaussians.part).sum())
    known = torch.cdist(found.gaussians.means, made.gaussians.means).argmin(1)
    wrong_after = int((found.gaussians.part != made.gaussians.part[known]).sum())
    assert wrong_after < 0.7 * wrong_before


def test_a_part_of_hardly_any_gaussians_dies() -> None:
    made = scene("revolute", 48, 0.08)
    part = made.gaussians.part.clone()
    part[torch.nonzero(part == 0)[:2]] = 2
    T = np.concatenate([made.T_state_0, made.T_state_0[:, 1:]], 1)
    T[1, 2, :3, 3] += 0.3
    same = replace(FEW, densify_every=FEW.steps + 1)  # Two that split may be 0.6 %: on one processor they did.
    found = articulate(made.gaussians.with_part(part), T, made.views, same, fitted=(made.gaussians, made.at(1)))
    assert found.T_state_0.shape == (2, 2, 4, 4)
    assert sorted(found.gaussians.part.unique().tolist()) == [0, 1]


def test_same_seed_same_motion() -> None:
    made = scene("revolute", 48, 0.08)
    a, b, c = (run(made, FEW, seed=s)[0].T_state_0 for s in (0, 0, 1))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_what_was_given_is_left_as_it_was() -> None:
    made = scene("revolute", 48, 0.08)
    before = made.gaussians.detached()
    run(made, FEW)
    for name, value in vars(before).items():
        assert torch.equal(value, getattr(made.gaussians, name))
