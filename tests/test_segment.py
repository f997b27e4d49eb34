"""Which Gaussians move, with which motion: the pieces, and the whole on a made object."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from hingesplat.register import Sheet
from hingesplat.screw import prismatic, revolute
from hingesplat.search import Motion
from hingesplat.segment import (
    Labelling,
    SegmentConfig,
    Surface,
    axis_directions,
    bounds,
    components,
    floating,
    groups_to_try,
    inverted,
    label_costs,
    moved,
    neighbour_weights,
    on_surface,
    reattach_fragments,
    registered,
    seed_costs,
    segment,
    select_motions,
    softmax,
    split_pieces,
    spread_labels,
    thin,
    track,
)
from hingesplat.visibility import FREE, HIDDEN, SURFACE, Sight, ask, look
from scenes import (
    ANGLE,
    AXIS,
    FORWARD,
    PIVOT,
    SLIDE,
    Scene,
    angle_between,
    one_thread,  # noqa: F401
    scene,
)

CONFIG = SegmentConfig(sight_size=96, cells=28, seeds_per_search=40, max_seeds=400, consensus_motions=6)
QUICK = replace(CONFIG, seeds_per_search=12, cells=16, consensus_motions=2, rounds=1)
TURN = Motion("revolute", AXIS, PIVOT, ANGLE, 1.0)
PULL = Motion("prismatic", FORWARD, np.zeros(3), SLIDE, 1.0)
NO_SIGHT = Sight(
    np.zeros((0, 3, 4), np.float32), np.zeros((0, 1, 1), np.float32), np.zeros((0, 1, 1, 3), np.float32), 0.0
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def made_scene(kind: Literal["revolute", "prismatic", "static"]) -> Scene:
    return scene(kind, 96, 0.024)


def surface_of(points: np.ndarray) -> Surface:
    """Points that no camera sees."""
    n = len(points)
    return Surface(points, np.full((n, 3), 0.5), np.arange(n), NO_SIGHT, np.tile([0.0, 0, 1], (n, 1)))


def patch(centre: tuple[float, float, float], n: int = 15, spacing: float = 0.01) -> np.ndarray:
    """A square grid of n × n points, flat in z."""
    x, y = (spacing * a.ravel() for a in np.meshgrid(np.arange(n) - n / 2, np.arange(n) - n / 2))
    return np.column_stack([x, y, np.zeros(n * n)]) + centre


def test_thin_keeps_one_point_of_every_cube(rng: np.random.Generator) -> None:
    points = np.concatenate([rng.uniform(0, 1, (500, 3)), rng.uniform(0, 0.1, (5000, 3))])
    kept = thin(points, 0.1, rng)
    cubes = np.floor(points / 0.1).astype(int)
    assert len(np.unique(cubes[kept], axis=0)) == len(kept) == len(np.unique(cubes, axis=0))
    assert len(thin(points[:0], 0.1, rng)) == 0


def test_components_are_the_connected_pieces() -> None:
    points = np.concatenate([patch((0, 0, 0)), patch((1, 0, 0))])
    label = components(points, 0.012)
    assert len(np.unique(label[:225])) == len(np.unique(label[225:])) == 1
    assert label[0] != label[-1]
    assert len(np.unique(components(points, 0.009))) == 450
    assert len(np.unique(components(points, 2.0))) == 1
    assert components(points[:0], 1.0).shape == (0,)


def test_groups_are_pieces_and_patches_of_the_large_ones() -> None:
    speck = patch((5, 5, 0), 3)
    small, large = patch((0, 0, 0), 10), patch((3, 0, 0), 20)
    groups = groups_to_try(np.concatenate([speck, small, large]), 1.0, seed=0)
    whole = [g for g in groups if len(g) in (100, 400)]
    assert {tuple(g) for g in whole} == {tuple(range(9, 109)), tuple(range(109, 509))}
    patches = [g for g in groups if len(g) not in (100, 400)]
    assert len(patches) == 6 and min(map(len, patches)) >= 12
    assert sorted(np.concatenate(patches)) == list(range(109, 509))
    assert groups_to_try(speck[:0], 1.0, seed=0) == []


def test_directions_are_the_worlds_and_the_groups_own(rng: np.random.Generator) -> None:
    tilt = revolute([1.0, 1.0, 0], [0, 0, 0], 0.6)[:3, :3]
    plates = [rng.uniform(-1, 1, (200, 3)) * [1, 0.6, 0.01] @ tilt.T + 3, rng.uniform(-1, 1, (50, 3)) * [1, 0.5, 0.1]]
    directions = axis_directions(plates)
    assert np.allclose(directions[:3], np.eye(3))
    assert 4 <= len(directions) <= 12
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert np.abs(directions @ tilt[:, 2]).max() > np.cos(np.radians(9))
    between = np.abs(directions @ directions.T)[np.triu_indices(len(directions), 1)]
    assert between.max() <= np.cos(np.radians(8)) + 1e-9


def test_bounds_hold_nearly_all_points_and_ignore_stragglers(rng: np.random.Generator) -> None:
    points = rng.uniform(0, 1, (5000, 3))
    low, high = bounds([points, np.array([[50.0, 0.5, 0.5]])])
    assert (low < 0.01).all() and (high > 0.99).all() and (high < 1.1).all()


def test_floating_needs_three_cameras_and_a_share_of_them() -> None:
    answer = np.zeros((3, 4))
    answer[:, FREE], answer[:, SURFACE], answer[:, HIDDEN] = (2, 3, 3), (0, 5, 9), (0, 4, 30)
    assert floating(answer).tolist() == [False, True, False]


def test_inverted_undoes() -> None:
    for motion in (TURN, PULL):
        np.testing.assert_allclose(inverted(motion).T @ motion.T, np.eye(4), atol=1e-12)


def test_softmax_bears_large_numbers() -> None:
    p = softmax(np.array([[1e4, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(p, [[1, 0], [0.5, 0.5]])


# Choosing motions.


def costs_of_two_parts(n: int = 100) -> np.ndarray:
    """Seeds of two parts, 0 and 1 (twice as large), and hypotheses: 0, 1, 1 again but worse, neither, hides all."""
    part = np.repeat([0, 1], [n, 2 * n])
    free, seen = 1.2, 0.1
    return np.column_stack(
        [
            np.where(part == 0, seen, free),
            np.where(part == 1, seen, free),
            np.where(part == 1, seen + 0.05, free),
            np.full(3 * n, free),
            np.full(3 * n, 0.55),
        ]
    )


def test_as_many_motions_as_pay_for_themselves() -> None:
    assert sorted(select_motions(costs_of_two_parts(), SegmentConfig(), None)) == [0, 1]
    assert select_motions(costs_of_two_parts(), SegmentConfig(part_cost=100), None) == [1]
    assert select_motions(costs_of_two_parts(), SegmentConfig(part_cost=1000), None) == []
    assert select_motions(costs_of_two_parts(), SegmentConfig(max_parts=1), None) == [1]


def test_a_given_number_of_motions_is_not_exceeded() -> None:
    assert select_motions(costs_of_two_parts(), SegmentConfig(), 1) == [1]
    assert sorted(select_motions(costs_of_two_parts(), SegmentConfig(part_cost=1000), 2)) == [0, 1]


def test_a_motion_that_only_hides_explains_nothing() -> None:
    assert select_motions(costs_of_two_parts()[:, 4:], SegmentConfig(), None) == []


def test_a_motion_that_later_ones_make_superfluous_goes() -> None:
    n = 100
    part = np.repeat([0, 1], n)
    compromise = np.full(2 * n, 0.3)
    exact = [np.where(part == k, 0.0, 1.2) for k in (0, 1)]
    chosen = select_motions(np.column_stack([compromise, *exact]), SegmentConfig(), None)
    assert sorted(chosen) == [1, 2]


# Labels.


def test_neighbours_of_another_colour_weigh_less() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    colours = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.9, 0.1, 0.5]])
    w = neighbour_weights(points, colours, 1.0).toarray()
    assert (np.diag(w) == 0).all()
    assert w[0, 1] == pytest.approx(np.exp(-1)) and 0 < w[0, 2] < 0.1 * w[0, 1]


@pytest.fixture(scope="module")
def turned() -> tuple[Scene, tuple[Surface, Surface], float]:
    made = made_scene("revolute")
    pair = made.gaussians, made.at(1)
    low, high = bounds([g.means.numpy() for g in pair])
    extent = float((high - low).max())
    sights = [look(g, v, 96, 0.012 * extent) for g, v in zip(pair, made.views, strict=True)]
    return made, (on_surface(pair[0], sights[0]), on_surface(pair[1], sights[1])), extent


def test_surface_is_what_cameras_see(turned: tuple[Scene, tuple[Surface, Surface], float]) -> None:
    made, (first, _), _ = turned
    np.testing.assert_array_equal(first.points, made.gaussians.means.numpy()[first.index])
    hidden = np.setdiff1d(np.arange(len(made.gaussians)), first.index)
    assert 0.6 < len(first.points) / len(made.gaussians) < 0.98
    front_of_box = np.abs(made.gaussians.means.numpy()[hidden] - [0, -0.34, 0]).max(1) < 0.36
    assert front_of_box.mean() > 0.8  # What is hidden lies between box and slab.


def test_true_motions_cost_their_own_points_least(turned: tuple[Scene, tuple[Surface, Surface], float]) -> None:
    made, (first, second), _ = turned
    wrong = replace(TURN, value=-ANGLE)
    forward, backward = [TURN.T, wrong.T], [inverted(TURN).T, inverted(wrong).T]
    for surface, other, transforms in ((first, second.sight, forward), (second, first.sight, backward)):
        part = made.gaussians.part.numpy()[surface.index]
        costs = label_costs(surface, other, transforms)
        assert costs.shape == (len(part), 3)
        assert (costs[part == 0].argmin(1) == 0).mean() > 0.8
        assert costs[part == 1].mean(0).argmin() == 1
        judged = seed_costs(surface, other, transforms)[part == 1].mean(0)
        assert judged[0] < 0.8 * judged[1]


def test_only_what_moved_floats(turned: tuple[Scene, tuple[Surface, Surface], float]) -> None:
    made, (first, second), _ = turned
    up = floating(ask(first.points, first.colours, second.sight))
    part = made.gaussians.part.numpy()[first.index]
    assert part[up].mean() > 0.99
    assert up[part == 1].mean() > 0.5


def test_labels_follow_the_motions_and_a_false_one_is_dropped(
    turned: tuple[Scene, tuple[Surface, Surface], float],
) -> None:
    made, surfaces, extent = turned
    problem = Labelling.of(surfaces, extent)
    false = Motion("revolute", np.eye(3)[0], np.zeros(3), 1.5, 1.0)
    kept, labels = problem.solve([false.T, TURN.T], 20.0, None)
    assert kept == [1]
    for s in (0, 1):
        part = made.gaussians.part.numpy()[surfaces[s].index]
        assert (labels[s] == part).mean() > 0.92
    assert problem.solve([false.T, TURN.T], 20.0, 2)[0] == [0, 1]
    assert problem.solve([false.T, TURN.T], 20.0, 0)[0] == []


def test_registered_keeps_the_kind_and_the_sign(turned: tuple[Scene, tuple[Surface, Surface], float]) -> None:
    made, (first, second), extent = turned
    mine = first.rows(np.flatnonzero(made.gaussians.part.numpy()[first.index] == 1)[::3])
    for sign in (1.0, -1.0):
        start = Motion("revolute", sign * AXIS, PIVOT + 0.01, sign * (ANGLE + 0.04), 0.5)
        fitted = registered(start, mine.sheet, second.sheet, extent)
        assert fitted.kind == "revolute"
        assert fitted.axis @ start.axis > 0.99
        assert fitted.value == pytest.approx(sign * ANGLE, abs=0.005)
    slid = Sheet(mine.points + SLIDE * FORWARD, mine.normals, mine.colours)
    for sign in (1.0, -1.0):
        start = Motion("prismatic", sign * FORWARD, PIVOT, sign * (SLIDE - 0.01), 0.5)
        fitted = registered(start, mine.sheet, slid, extent)
        assert fitted.kind == "prismatic"
        np.testing.assert_allclose(fitted.axis * fitted.value, SLIDE * FORWARD, atol=0.002)


def test_registering_a_slide_of_nothing_is_no_error(turned: tuple[Scene, tuple[Surface, Surface], float]) -> None:
    _, (first, _), extent = turned
    still = replace(PULL, value=0.0)
    np.testing.assert_allclose(registered(still, first.sheet, first.sheet, extent).T, np.eye(4), atol=1e-6)
    few = first.rows(np.arange(5))  # Too few to register at all.
    np.testing.assert_array_equal(registered(still, few.sheet, first.sheet, extent).T, np.eye(4))


def test_pieces_far_apart_become_parts_with_one_motion() -> None:
    shift = Motion("prismatic", np.eye(3)[2], np.zeros(3), 0.5, 1.0)
    base, first, second = patch((0, 0, -1), 20), patch((0, 0, 0)), patch((0.5, 0, 0))
    everything = np.concatenate([base, first, second])
    label = np.repeat([0, 1, 1], [400, 225, 225])
    surfaces = (surface_of(everything), surface_of(np.concatenate([base, moved(everything[400:], shift.T)])))
    motions, labels = split_pieces([shift], (label, label), surfaces, 1.0, SegmentConfig())
    assert motions == [shift, shift]
    for found in labels:
        assert (found[:400] == 0).all()
        assert {len(np.unique(found[400:625])), len(np.unique(found[625:]))} == {1}
        assert found[400] != found[-1] and 0 not in found[400:]
    np.testing.assert_array_equal(labels[0], labels[1])
    near = np.concatenate([base, first, first + np.array([0.15, 0, 0])])
    joined = (surface_of(near), surface_of(np.concatenate([base, moved(near[400:], shift.T)])))
    motions, labels = split_pieces([shift], (label, label), joined, 1.0, SegmentConfig())
    assert motions == [shift] and labels[0].max() == 1


def test_fragments_go_to_what_they_touch() -> None:
    """A speck of part 1 in the middle of the base is the base's."""
    shift = Motion("prismatic", np.eye(3)[2], np.zeros(3), 0.5, 1.0)
    base, part = patch((0, 0, -1), 20), patch((0, 0, 0))
    everything = np.concatenate([base, part])
    true = np.repeat([0, 1], [400, 225])
    wrong = true.copy()
    wrong[[190, 210, 211]] = 1
    surfaces = (surface_of(everything), surface_of(np.concatenate([base, moved(part, shift.T)])))
    for given in (true, wrong):
        for found in reattach_fragments([shift.T], (given, given), surfaces, 1.0):
            np.testing.assert_array_equal(found, true)


def test_labels_spread_to_the_nearest() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0.2, 0, 0], [0.9, 0, 0]])
    surface = replace(surface_of(points[:2]), index=np.array([0, 1]))
    assert spread_labels(points, surface, np.array([3, 5])).tolist() == [3, 5, 3, 5]


# The whole.


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_the_one_moving_part_is_found(kind: Literal["revolute", "prismatic"]) -> None:
    made = made_scene(kind)
    found = segment((made.gaussians, made.at(1)), made.views, CONFIG)
    assert len(found.motions) == 1
    assert found.unexplained < 0.3 and found.seeds > 100
    T_true = made.T_state_0[1, 1]
    T = found.motions[0].T
    np.testing.assert_allclose(
        T_true, revolute(AXIS, PIVOT, ANGLE) if kind == "revolute" else prismatic(FORWARD, SLIDE)
    )
    assert angle_between(T, T_true) < 1.0
    centre = made.gaussians.means[made.gaussians.part == 1].mean(0).double().numpy()[None]
    assert np.linalg.norm(moved(centre, T) - moved(centre, T_true)) < 0.01
    for labels in found.labels:
        assert labels.shape == (len(made.gaussians),)
        assert (labels == made.gaussians.part.numpy()).mean() > 0.9


def test_identical_states_have_no_motion() -> None:
    made = made_scene("static")
    found = segment((made.gaussians, made.gaussians), made.views, CONFIG)
    assert found.motions == () and found.unexplained == 0
    assert all((labels == 0).all() for labels in found.labels)


def test_the_number_of_parts_can_be_given() -> None:
    made = made_scene("prismatic")
    found = segment((made.gaussians, made.at(1)), made.views, QUICK, parts=1)
    assert len(found.motions) == 1
    assert set(np.unique(found.labels[0])) == {0, 1}
    nothing = segment((made.gaussians, made.at(1)), made.views, QUICK, parts=0)
    assert nothing.motions == () and nothing.unexplained == 1 and nothing.labels[0].max() == 0


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_further_state_is_tracked_along_the_known_joint(kind: Literal["revolute", "prismatic"]) -> None:
    """The joint is known from states that lie closer together than the one asked for, or is turned about."""
    made = made_scene(kind)
    known = TURN if kind == "revolute" else PULL
    labels = made.gaussians.part.numpy()
    for motion in (replace(known, value=0.4 * known.value), replace(known, axis=-known.axis)):
        (T,) = track((made.gaussians, made.at(1)), made.views, labels, [motion], CONFIG)
        assert angle_between(T, made.T_state_0[1, 1]) < 1.0
        np.testing.assert_allclose(T[:3, 3], made.T_state_0[1, 1, :3, 3], atol=0.01)


def test_tracking_a_part_that_stayed_or_has_no_points_gives_the_identity() -> None:
    made = made_scene("static")
    labels = made.gaussians.part.numpy()
    stayed, absent = track((made.gaussians, made.gaussians), made.views, labels, [PULL, PULL], CONFIG)
    np.testing.assert_allclose(stayed, np.eye(4), atol=1e-3)
    np.testing.assert_array_equal(absent, np.eye(4))
