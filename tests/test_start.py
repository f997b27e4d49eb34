"""Starts without a search: clusters of what moved, and random motions."""

import numpy as np

from hingesplat.gaussians import concatenate, posed
from hingesplat.matching import one_to_one
from hingesplat.screw import prismatic
from hingesplat.start import StartConfig, clusters, random_motions
from scenes import box, scene, transforms_of


def test_matches_are_one_to_one_and_the_cheapest() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(50, 3))
    order = rng.permutation(50)
    i, j = one_to_one(points, points[order] + 1e-3, 100, rng)
    np.testing.assert_array_equal(order[j], i)
    i, j = one_to_one(points, points[:20], 10, rng)
    assert len(set(i)) == len(set(j)) == 10


def test_clusters_separate_what_moved_from_the_base() -> None:
    made = scene("prismatic", 48, 0.08)
    labels = clusters((made.gaussians, made.at(1)), 2, StartConfig(), seed=0)
    true = made.gaussians.part.numpy()
    for label in labels:
        assert (label == true).mean() > 0.9


def test_clusters_tell_two_slabs_apart() -> None:
    base = box((-0.5, -0.3, -0.4), (0.5, 0.3, 0.4), 0.08, seed=1)
    slabs = [box((x, -0.46, -0.2), (x + 0.3, -0.38, 0.2), 0.08, seed=2, part=k) for k, x in ((1, -0.45), (2, 0.15))]
    first = concatenate([base, *slabs])
    T = np.stack([np.eye(4), prismatic([0, -1, 0], 0.3), prismatic([0, -1, 0], 0.3)])
    labels = clusters((first, posed(first, transforms_of(T))), 3, StartConfig(), seed=0)
    for label in labels:
        (one,), (two,) = (np.unique(label[first.part.numpy() == k]) for k in (1, 2))
        assert {int(one), int(two)} == {1, 2}


def test_nothing_moved_makes_no_clusters() -> None:
    made = scene("static", 48, 0.08)
    assert not np.concatenate(clusters((made.gaussians, made.gaussians), 3, StartConfig(), seed=0)).any()


def test_random_motions_are_small_rigid_and_repeat() -> None:
    points = np.random.default_rng(0).uniform(2, 3, (100, 3))
    T = random_motions(4, points, 0.05, seed=1)
    np.testing.assert_array_equal(T[0], np.eye(4))
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12
    )
    far = np.linalg.norm(points @ T[1, :3, :3].T + T[1, :3, 3] - points, axis=1)
    assert 0 < far.mean() < 0.3
    np.testing.assert_array_equal(T, random_motions(4, points, 0.05, seed=1))
    assert not np.array_equal(T, random_motions(4, points, 0.05, seed=2))
    np.testing.assert_array_equal(random_motions(3, points, 0.0, seed=1), np.tile(np.eye(4), (3, 1, 1)))
