"""The exhaustive search for one-degree motions."""

import json
from functools import cache

import numpy as np
import pytest

from hingesplat.gaussians import SH_C0
from hingesplat.screw import prismatic, revolute
from hingesplat.search import (
    HIDDEN_SCORE,
    Motion,
    ScoreVolume,
    both_signs,
    carrier_of,
    inverted,
    novelty,
    scan,
    score_volume,
)
from hingesplat.surface import Surface, bounds, surface_of
from hingesplat.visibility import ask
from scenes import (
    ANGLE,
    AXIS,
    FORWARD,
    PIVOT,
    SLIDE,
    nearest,
    one_thread,  # noqa: F401
    scene,
)

CELLS = 40


@cache
def prepared(kind: str) -> tuple[Surface, Surface, ScoreVolume, np.ndarray]:
    """Surfaces of both states of the made scene, the volume of state 1, and which points of state 0 move."""
    made = scene("revolute" if kind == "revolute" else "prismatic", 96, 0.04)
    low, high = bounds([made.at(s).means.numpy() for s in (0, 1)])
    a, b = (surface_of(made.at(s), made.views[s], (), 96, 0.02, 0.02) for s in (0, 1))
    novel = novelty(ask(b.points, b.colours, a.sight))
    volume = score_volume(b.points, b.colours, novel, b.sight, low, high, CELLS)
    return a, b, volume, made.gaussians.part.numpy()[nearest(a.points, made.gaussians)] == 1


def displaced(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def test_motion_agrees_with_its_screw() -> None:
    axis, pivot = np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(Motion("revolute", axis, pivot, 0.7, 1.0).T, revolute(axis, pivot, 0.7))
    np.testing.assert_allclose(Motion("prismatic", axis, pivot, -0.7, 1.0).T, prismatic(axis, -0.7))


def test_a_motion_on_another_part_is_its_joint_and_then_that_of_the_part_both_ways() -> None:
    carrier = revolute((0, 0, 1), (0.5, 0, 0), 1.1)
    axis, pivot = np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 0.3])
    for kind, joint in (("revolute", revolute(axis, pivot, 0.7)), ("prismatic", prismatic(axis, 0.7))):
        motion = Motion(kind, axis, pivot, 0.7, 1.0, carrier)
        np.testing.assert_allclose(motion.T, carrier @ joint)
        np.testing.assert_allclose(inverted(motion).T @ motion.T, np.eye(4), atol=1e-12)
        np.testing.assert_allclose(inverted(inverted(motion)).axis, axis, atol=1e-12)
        again = Motion.of(json.loads(json.dumps({k: np.asarray(v).tolist() for k, v in vars(motion).items()})))
        np.testing.assert_allclose(again.T, motion.T)
        base = Motion("revolute", np.array([0.0, 0, 1]), np.array([0.5, 0, 0]), 1.1, 1.0)
        assert carrier_of(motion, [motion, base]) == 1 and carrier_of(base, [motion, base]) is None


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_scan_looks_where_another_part_takes_the_seeds_then(kind: str) -> None:
    """The world of state 0 as it was before a motion that is known: the same joint is found, in the frame of then."""
    a, _, volume, moves = prepared(kind)
    rows = np.random.default_rng(0).choice(np.flatnonzero(moves), 64, replace=False)
    after = revolute((0.0, 1.0, 0.0), (0.2, 0.0, 0.1), 0.4)
    seeds, colours = displaced(a.points[rows], np.linalg.inv(after)), a.blurred()[rows]
    T_true = (revolute(AXIS, PIVOT, ANGLE) if kind == "revolute" else prismatic(FORWARD, SLIDE)) @ after
    best = scan(kind, seeds, colours, np.eye(3) @ after[:3, :3], volume, after=after, keep=6)[0]
    error = np.linalg.norm(displaced(seeds, best.T) - displaced(seeds, T_true), axis=1).mean()
    assert best.kind == kind and error < 1.5 * volume.voxel


def test_both_signs() -> None:
    assert both_signs(np.array([1.0, 2.0])).tolist() == [-2, -1, 1, 2]


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_scan_recovers_a_motion_within_the_grid(kind: str) -> None:
    a, _, volume, moves = prepared(kind)
    rows = np.random.default_rng(0).choice(np.flatnonzero(moves), 64, replace=False)
    seeds, colours = a.points[rows], a.blurred()[rows]
    T_true = revolute(AXIS, PIVOT, ANGLE) if kind == "revolute" else prismatic(FORWARD, SLIDE)
    found = scan(kind, seeds, colours, np.eye(3), volume, keep=6)
    assert found == sorted(found, key=lambda m: -m.score)
    best = found[0]
    assert best.kind == kind
    error = np.linalg.norm(displaced(seeds, best.T) - displaced(seeds, T_true), axis=1).mean()
    assert error < 1.5 * volume.voxel
    if kind == "revolute":
        assert abs(best.axis @ AXIS) > 0.999
        assert abs(best.value * np.sign(best.axis @ AXIS) - ANGLE) < np.radians(3)
    # Distinct, as promised.
    ends = [displaced(seeds, m.T) for m in found]
    apart = [np.linalg.norm(p - q, axis=1).mean() for i, p in enumerate(ends) for q in ends[:i]]
    assert min(apart) > 3 * volume.voxel


def test_given_values_and_a_given_pivot_confine_the_search() -> None:
    a, _, volume, moves = prepared("revolute")
    rows = np.flatnonzero(moves)[::20]
    near = Motion("revolute", AXIS, PIVOT, ANGLE, 0.0)
    values = np.array([ANGLE - 0.05, ANGLE, ANGLE + 0.05])
    found = scan("revolute", a.points[rows], a.colours[rows], AXIS[None], volume, values=values, near=near, keep=3)
    for m in found:
        assert m.kind == "revolute" and m.value in values
        across = m.pivot - PIVOT - AXIS * ((m.pivot - PIVOT) @ AXIS)
        assert np.abs(across).max() <= 4 * volume.voxel + 1e-9


def test_volume_prefers_new_surface_to_old_and_forbids_free_space() -> None:
    *_, volume, _ = prepared("prismatic")

    def score_at(point: list[float]) -> float:
        index = np.round((np.array(point) - volume.origin) / volume.voxel).astype(int)
        return float(volume.score[tuple(index)])

    assert score_at([0.0, -0.46 - SLIDE, 0.0]) > 0.8  # The slab's front, where nothing was before.
    assert 0 < score_at([0.5, 0.0, 0.0]) < 0.4  # The box's side, there in both states.
    assert score_at([0.45, -0.6, 0.35]) == -1  # Beside the slab, in front of the box.
    assert score_at([0.0, 0.0, 0.0]) == pytest.approx(HIDDEN_SCORE)  # Inside the box.
    assert volume.score.min() == -1 and volume.score.max() <= 1


def test_volume_carries_the_surfaces_colours() -> None:
    _, b, volume, _ = prepared("prismatic")
    index = np.round((b.points - volume.origin) / volume.voxel).astype(int)
    error = np.linalg.norm(volume.colour[tuple(index.T)] - b.colours, axis=1)
    assert np.median(error) < 0.1
    assert np.median(np.linalg.norm(volume.colour[tuple(index.T)] - b.colours[::-1], axis=1)) > 0.3


def test_novelty_ranks_free_before_unseen_before_seen() -> None:
    #                  free, surface, hidden, colour
    answer = np.array([[3.0, 5, 0, 0], [0, 0, 9, 0], [2, 2, 0, 0]])
    new, unseen, seen = novelty(answer)
    assert new == 1 and new > unseen > seen > 0


def hand_made(surface_share: float) -> tuple[np.ndarray, np.ndarray, ScoreVolume]:
    """Seeds at x = 0; to the left a place where some of them meet a surface, to the right one that hides them all."""
    y, z = (x.ravel() for x in np.meshgrid(np.arange(10), np.arange(10)))
    seeds = np.column_stack([np.full(100, 10), y, z]).astype(float)
    score = np.full((21, 10, 10), -1, np.float32)
    score[16] = HIDDEN_SCORE
    score[4] = HIDDEN_SCORE
    score[4, : round(10 * surface_share)] = 1
    grey = np.full((21, 10, 10, 3), 0.5, np.float32)
    return seeds, np.full((100, 3), 0.5), ScoreVolume(np.zeros(3), 1.0, score, grey)


def test_going_where_nobody_sees_is_worth_nothing() -> None:
    seeds, colours, volume = hand_made(0.3)
    found = scan("prismatic", seeds, colours, np.eye(3)[:1], volume, values=np.array([-6.0, 6.0, 2.0]))
    assert [m.value for m in found] == [-6, 6, 2]
    seen, hidden, free = (m.score for m in found)
    assert hidden == 0 and free == pytest.approx(-1)
    # What is hidden counts as far as something is seen.
    assert seen == pytest.approx(0.3 + min(0.7 * HIDDEN_SCORE, 0.3), abs=1e-5)


def test_a_constant_change_of_light_costs_less_than_a_changed_pattern() -> None:
    seeds, colours, volume = hand_made(1.0)
    pattern = colours + 0.3 * np.sign(np.sin(7 * np.arange(100)))[:, None]

    def score(c: np.ndarray) -> float:
        return scan("prismatic", seeds, c, np.eye(3)[:1], volume, values=np.array([-6.0]))[0].score

    assert score(colours) == pytest.approx(1, abs=1e-5)
    assert 1 > score(colours + 0.3) > 1.5 * score(pattern)


def test_leaving_the_volume_is_like_free_space() -> None:
    seeds, colours, volume = hand_made(1.0)
    (out,) = scan("prismatic", seeds, colours, np.eye(3)[:1], volume, values=np.array([100.0]))
    assert out.score == pytest.approx(-1)


def test_colours_of_the_scene_are_what_was_painted() -> None:
    a, *_ = prepared("prismatic")
    made = scene("prismatic", 96, 0.04)
    painted = (made.gaussians.sh[nearest(a.points, made.gaussians), 0] * SH_C0 + 0.5).numpy()
    np.testing.assert_allclose(a.colours, painted, atol=1e-6)
