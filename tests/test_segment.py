"""Which Gaussians move, with which motion: the pieces, and the whole on a made object."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, Literal, cast

import numpy as np
import pytest

from hingesplat.capture import View
from hingesplat.exchange import changed_places
from hingesplat.gaussians import Gaussians, concatenate, posed
from hingesplat.hypotheses import (
    PATCH,
    HypothesesConfig,
    axis_directions,
    climbed,
    distinct,
    edges,
    groups_to_try,
    registered,
    squared,
)
from hingesplat.labelling import (
    WORTH,
    Choices,
    Labelling,
    gone,
    label_costs,
    meeting,
    neighbour_weights,
    seed_costs,
    seed_gains,
    shortest,
)
from hingesplat.pieces import (
    follow_fronts,
    give_way,
    lying_on,
    passed_on,
    reattach_fragments,
    riding,
    seen_to_move,
    split_pieces,
)
from hingesplat.render import render
from hingesplat.screw import prismatic, revolute
from hingesplat.se3 import apart, moved
from hingesplat.search import Motion, carrier_of, inverted, there_and_back
from hingesplat.segment import (
    SegmentConfig,
    _Case,
    floating,
    gather,
    one_for_two,
    segment,
    spread_labels,
    survey,
)
from hingesplat.simd import LANES
from hingesplat.states import segment_states, track
from hingesplat.stereo import Cloud, DepthMap, StereoConfig, depth_map, stereo
from hingesplat.surface import Labels, Surface, bounds, components, free_share, surface_of, thin
from hingesplat.texture import told_apart, vouched_for
from hingesplat.visibility import FREE, HIDDEN, SURFACE, Sight, ask
from scenes import (
    ANGLE,
    AXIS,
    FORWARD,
    PIVOT,
    SLIDE,
    Scene,
    angle_between,
    box,
    cameras_around,
    nearest,
    one_thread,  # noqa: F401
    photograph,
    scene,
)

CONFIG = SegmentConfig(
    sight_size=96, cells=28, max_seeds=400, hypotheses=HypothesesConfig(seeds_per_search=40, starts=6)
)
FEW = HypothesesConfig(seeds_per_search=12, starts=2)
QUICK = replace(CONFIG, cells=16, hypotheses=FEW, rounds=1)
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


@cache
def made_maps(kind: Literal["revolute", "prismatic"]) -> tuple[list[DepthMap], list[DepthMap]]:
    """Depth of both states' photographs by stereo. Cached: treat it as read-only."""
    config = StereoConfig(image_size=96, planes=48)
    first, second = (stereo(views, config) for views in made_scene(kind).views)
    return first, second


def plain(points: np.ndarray, sight: Sight = NO_SIGHT) -> Surface:
    """Grey points, flat in z, that no camera sees but those of ``sight``."""
    grey = np.full(points.shape, 0.5)
    return Surface(points, grey, np.tile([0.0, 0, 1], (len(points), 1)), free_share(ask(points, grey, sight)), sight)


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


def test_a_few_points_between_two_pieces_are_no_bridge() -> None:
    left, right = patch((0, 0, 0)), patch((0.3, 0, 0))
    between = np.array([[x, 0.07, 0.0] for x in np.arange(left[:, 0].max() + 0.01, right[:, 0].min(), 0.01)])
    points = np.concatenate([left, right, between])
    assert len(np.unique(components(points, 0.025))) == 1
    label = components(points, 0.025, bridges=False)
    assert len(np.unique(label[:225])) == len(np.unique(label[225:450])) == 1
    assert label[0] != label[225]
    assert label[450] == label[0] and label[-1] == label[225]


def test_groups_are_pieces_and_patches_of_the_large_ones() -> None:
    speck = patch((5, 5, 0), 3)
    small, large = patch((0, 0, 0), 10), patch((3, 0, 0), 30)
    points = np.concatenate([speck, small, large])
    groups = groups_to_try(points, np.tile([0.0, 0, 1], (len(points), 1)), 1.0, seed=0)
    assert {tuple(g) for g, whole in groups if whole} == {tuple(range(9, 109)), tuple(range(109, 1009))}
    patches = [g for g, whole in groups if not whole]
    assert len(patches) == min(900 // PATCH, 10) and min(map(len, patches)) >= 12
    assert sorted(np.concatenate(patches)) == list(range(109, 1009))
    assert groups_to_try(speck[:0], speck[:0], 1.0, seed=0) == []


def test_two_doors_side_by_side_are_two_plates(rng: np.random.Generator) -> None:
    """One piece of seeds, but each door may be a part, hinge and all; noise of stereo is in no plane's way."""
    ajar = revolute([0, 1, 0], [0.15, 0, 0], 0.7)
    doors = [patch((0, 0, 0), 30), moved(patch((0.3, 0, 0), 30), ajar)]
    points = np.concatenate(doors) + rng.normal(0, 0.002, (1800, 3))
    normals = np.repeat([[0.0, 0, 1], ajar[:3, 2]], 900, 0)
    groups = groups_to_try(points, normals, 1.0, seed=0)
    whole = [g for g, may_be in groups if may_be]
    assert len(whole[0]) == 1800 and len(whole) == 3
    for door in (0, 1):
        share = max((g // 900 == door).sum() * ((g // 900 == door).mean() > 0.95) for g in whole[1:])
        assert share > 800
    assert all(edges(points[g]) for g in whole[1:])
    assert len(groups_to_try(doors[0], normals[:900], 1.0, seed=0)) == 1 + 10  # A plate by itself is its own piece.


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


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_hypothesis_that_is_off_climbs_to_the_motion(kind: Literal["revolute", "prismatic"]) -> None:
    made, true = made_scene(kind), TURN if kind == "revolute" else PULL
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    evidence, (first, second) = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    part = surfaces[0].points[first]

    def off(motion: Motion) -> float:
        return float(np.linalg.norm(moved(part, motion.T) - moved(part, true.T), axis=1).mean()) / evidence.extent

    tilted = true.axis + np.array([0.06, 0, 0] if kind == "revolute" else [0.06, 0, 0.06])
    wrong = replace(true, axis=tilted / np.linalg.norm(tilted), pivot=true.pivot + 0.04, value=1.12 * true.value)
    for start, gained in ((wrong, 0.5), (true, 2.0)):
        assert off(climbed(evidence, start, (first, second))) < max(gained * off(start), 1.5 * CONFIG.tolerance)
    assert off(wrong) > 2 * CONFIG.tolerance
    nowhere = replace(PULL, value=3.0)  # Nothing comes to lie on anything.
    assert climbed(evidence, nowhere, (first, second)) is nowhere


def test_a_slide_that_is_nearly_square_is_square_if_photographs_hardly_mind() -> None:
    made = made_scene("prismatic")
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    evidence, _ = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    first, second = (np.flatnonzero(parts_of(made, surface, s) == 1) for s, surface in enumerate(surfaces))

    def tilted(degrees: float) -> Motion:
        axis = np.cos(np.radians(degrees)) * FORWARD + np.sin(np.radians(degrees)) * np.array([0, 0, 1])
        return Motion("prismatic", axis, np.zeros(3), SLIDE, 1.0)

    found = squared(evidence, tilted(6), (first, second))
    assert found.axis @ FORWARD > np.cos(np.radians(1))
    assert abs(found.value - SLIDE) < 0.01 * evidence.extent
    far, turns, hanging = tilted(20), TURN, replace(tilted(6), after=TURN.T)
    for motion in (far, turns, hanging):
        assert squared(evidence, motion, (first, second)) is motion
    assert squared(evidence, tilted(6), (first[:0], second[:0])).axis[2] > 0
    # A little aslant of what it really does, and photographs mind.
    went = replace(PULL, axis=tilted(14).axis)
    aslant = posed(made.gaussians, {1: went.T})
    views = made.views[0], tuple(photograph(aslant, v.camera) for v in made.views[1])
    low, high, surfaces = survey((made.gaussians, aslant), views, ((), ()), CONFIG)
    evidence, _ = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    rows = [
        np.flatnonzero(made.gaussians.part.numpy()[nearest(s.points, g)] == 1)
        for s, g in zip(surfaces, (made.gaussians, aslant), strict=True)
    ]
    assert squared(evidence, went, (rows[0], rows[1])) is went


def test_a_square_slide_is_cheaper_than_one_aslant() -> None:
    made = made_scene("prismatic")
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    evidence, (first, second) = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    case = _Case.of(evidence, (first, second), CONFIG, None)
    aslant = replace(PULL, axis=np.array([0.6, 0.8, 0]))
    square, other, turn = case._prices([PULL, aslant, TURN])
    assert square < 0.8 * CONFIG.part_cost < 0.9 * CONFIG.part_cost < min(other, turn)


def test_a_seed_that_hides_says_nothing_of_a_motion() -> None:
    """Though it costs less than to be seen where there is nothing."""
    made = made_scene("revolute")
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    evidence, (first, _) = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    seeds, away = surfaces[0].rows(first), prismatic([0, 0, 1], 1e3)
    gain = seed_gains(seeds, surfaces[1].sight, [TURN.T, away], evidence.extent)
    cost = seed_costs(seeds, surfaces[1].sight, [TURN.T, away], evidence.extent)
    assert np.median(gain[:, 0]) > 0.3 and (gain <= np.maximum(WORTH - cost, 0) + 1e-9).all()
    assert (gain[:, 1] == 0).all() and (cost[:, 1] < WORTH).all()


def test_many_ways_there_and_back_are_those_of_each_motion() -> None:
    hanging = replace(SHIFT, after=TURN.T)
    there, back = there_and_back([TURN, SHIFT, hanging])
    for k, motion in enumerate((TURN, SHIFT, hanging)):
        np.testing.assert_allclose(there[k], motion.T, atol=1e-12)
        np.testing.assert_allclose(back[k], inverted(motion).T, atol=1e-12)


def test_inverted_undoes() -> None:
    for motion in (TURN, PULL):
        np.testing.assert_allclose(inverted(motion).T @ motion.T, np.eye(4), atol=1e-12)


# Choosing motions.

PRICE = 50.0


def slides(*values: float) -> list[Motion]:
    return [replace(PULL, value=v) for v in values]


def test_small_parts_get_hypotheses_too() -> None:
    """Ten hypotheses for a large part, and one for a part a tenth as large, which alone they would crowd out."""
    large = np.repeat([True, False], [300, 30])
    costs = np.where(large[:, None], np.linspace(0.1, 0.2, 11), 1.2)
    costs[:, 10] = np.where(large, 1.2, 0.1)
    kept = distinct(slides(*np.arange(1.0, 12.0)), np.maximum(WORTH - costs, 0), np.zeros((1, 3)), 0.1, 9)
    assert len(kept) == 9 and kept[0] == 0
    assert 10 in kept
    assert (np.argsort(-np.maximum(0.6 - costs, 0).sum(0)) == 10).argmax() == 10  # By its worth it came last.


def test_hypotheses_are_apart(rng: np.random.Generator) -> None:
    points, motions = rng.uniform(-1, 1, (20, 3)), slides(*rng.uniform(0, 1, 60))
    costs = rng.uniform(0, 1.2, (50, 60))
    gain = np.maximum(WORTH - costs, 0)
    kept = distinct(motions, gain, points, 0.05, 60)
    value = np.array([motions[k].value for k in kept])
    between = np.abs(value[:, None] - value)[np.triu_indices(len(kept), 1)]
    assert 5 < len(kept) < 21 and between.min() > 0.05
    assert kept[0] == np.maximum(0.6 - costs, 0).sum(0).argmax()
    for m in motions:  # Every one is left out for one that stays.
        assert np.abs(m.value - value).min() <= 0.05
    assert distinct(motions, gain, points, 0.05, 3) == kept[:3]
    twice = [TURN, replace(TURN, axis=-AXIS, value=-ANGLE), PULL]
    assert len(distinct(twice, gain[:, :3], points, 0.05, 60)) == 2


def costs_of(*sizes: int) -> np.ndarray:
    """Points of a base and of parts, of these sizes, and labels: to stay, then the true motion of each part."""
    part = np.repeat(np.arange(len(sizes)), sizes)
    costs = np.where(part[:, None] == np.arange(len(sizes)), 0.1, 1.1)
    costs[part == 0, 0] = 0
    return costs


def with_compromise(costs: np.ndarray) -> np.ndarray:
    """One motion more, the first, that is nearly right for every part."""
    moves = costs[:, 0] > 0.5
    return np.insert(costs, 1, np.where(moves, 0.35, 1.1), axis=1)


def lengths_by(length: Callable[[frozenset[int]], float]) -> Callable[[Sequence[frozenset[int]]], list[float]]:
    return lambda sets: [length(kept) for kept in sets]


def chosen(costs: np.ndarray, price: float, parts: int | None = None) -> list[int]:
    """The columns that ``shortest`` takes, the first aside, each point taking the cheapest."""

    def length(kept: frozenset[int]) -> float:
        own = costs[:, [0, *sorted(kept)]].min(1).sum()
        return own + (price * len(kept) if parts is None else 1e6 * abs(len(kept) - parts))

    def promising(kept: frozenset[int]) -> list[int]:
        gain = np.maximum(costs[:, [0, *sorted(kept)]].min(1)[:, None] - costs, 0).sum(0)
        return [int(k) for k in np.argsort(-gain) if k > 0]

    return sorted(shortest(lengths_by(length), promising))


def greedy(costs: np.ndarray, price: float) -> list[int]:
    """The motion that helps most, then the next, as long as it pays."""
    best, chosen = costs[:, 0], []
    while (gain := np.maximum(best[:, None] - costs, 0).sum(0)).max() > price:
        chosen.append(int(gain.argmax()))
        best = np.minimum(best, costs[:, chosen[-1]])
    return chosen


def test_two_right_motions_beat_one_that_is_nearly_right_for_both() -> None:
    costs = with_compromise(costs_of(300, 150, 150))
    assert greedy(costs, PRICE) == [1]
    assert chosen(costs, PRICE) == [2, 3]


def test_generating_motions_are_found_among_many(rng: np.random.Generator) -> None:
    true = costs_of(400, 250, 150, 100)
    worse = true[:, [1, 2, 3, 1, 2]] + 0.15
    lucky = np.where(rng.random((len(true), 20)) < 0.2, 0.2, 1.1)
    costs = np.concatenate([with_compromise(true), worse, lucky], 1) + rng.uniform(0, 0.05, (len(true), 30))
    assert chosen(costs, PRICE) == [2, 3, 4]


def test_a_motion_must_be_worth_its_price() -> None:
    costs = costs_of(100, 200, 80)
    for price, worth in ((10, [1, 2]), (78, [1, 2]), (82, [1]), (198, [1]), (202, [])):
        assert chosen(costs, price) == worth, price


@pytest.mark.parametrize("parts", [0, 1, 2, 3])
def test_as_many_motions_as_were_asked_for(parts: int) -> None:
    costs = costs_of(100, 400, 200, 100)
    assert chosen(costs, 0, parts) == list(range(1, parts + 1))


def test_to_stay_is_free() -> None:
    """It costs no part, so it is there at any price and even if it is missed least."""
    assert chosen(costs_of(300, 30), PRICE) == []
    assert chosen(costs_of(0, 90, 90), PRICE, 2) == [1, 2]
    assert chosen(costs_of(1, 90, 80), PRICE, 1) == [1]
    base_only = np.column_stack([np.zeros(100), np.zeros(100), np.full(100, 0.2)])
    assert chosen(base_only, 1.0) == []


def test_a_better_one_takes_the_place_of_another() -> None:
    """With one motion only the compromise is best, though an exact one is the more promising."""
    costs = with_compromise(costs_of(300, 150, 150))
    exact_first = lambda kept: [2, 3, 1]  # noqa: E731
    length = lambda kept: costs[:, [0, *sorted(kept)]].min(1).sum() + 1e6 * abs(len(kept) - 1)  # noqa: E731
    assert shortest(lengths_by(length), exact_first) == {1}


def test_two_look_alikes_taken_for_each_other_are_exchanged_together() -> None:
    """Two doors, each thought to go where the other went: with one of them right, both want the same surface."""
    crossed, true = frozenset({1, 2}), frozenset({3, 4})

    def length(kept: frozenset[int]) -> float:
        if len(kept) < 2:
            return 100 - 40 * len(kept) + 20 * len(kept & true)
        return {crossed: 20, true: 10}.get(kept, 30 + 10 * (len(kept) - 2))

    assert shortest(lengths_by(length), lambda kept: [1, 2, 3, 4]) == true


# Labels.


@pytest.mark.parametrize("number", [4, LANES + 3])
def test_labels_settle_as_mean_field_says(number: int, rng: np.random.Generator) -> None:
    """Compiled, they are those of the definition, energy and all; more of them than a vector holds, too."""
    surfaces = plain(rng.uniform(0, 0.1, (60, 3))), plain(rng.uniform(0, 0.1, (50, 3)))
    problem = Labelling.of(surfaces, 1.0)
    costs = [rng.uniform(0, 1, (n, number)) for n in (60, 50)]
    partners = [rng.integers(-1, other, (n, number), np.int32) for n, other in ((60, 50), (50, 60))]

    def softmax(x: np.ndarray) -> np.ndarray:
        e = np.exp(x - x.max(1, keepdims=True))
        return e / e.sum(1, keepdims=True)

    q, energy = [softmax(-c / 0.1) for c in costs], 0.0
    for iteration in range(20):
        updated, energy = [], 0.0
        for s in (0, 1):
            partner = np.where(partners[s] >= 0, q[1 - s][np.maximum(partners[s], 0), np.arange(number)], 0.3)
            heard = problem.smoothness * (problem.weights[s] @ q[s]) + problem.consistency * partner
            updated.append(softmax(-(costs[s] - heard) / (0.15 - 0.1 * iteration / 20)))
            energy += float((updated[s] * (costs[s] - 0.5 * heard)).sum())
        q = updated
    labels, found = problem.mean_field(costs, partners)
    assert found == pytest.approx(energy, abs=2e-3)
    for s in (0, 1):
        np.testing.assert_array_equal(labels[s], q[s].argmax(1))


def test_neighbours_of_another_colour_weigh_less() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    colours = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.9, 0.1, 0.5]])
    w = neighbour_weights(points, colours, 1.0).toarray()
    assert (np.diag(w) == 0).all()
    assert w[0, 1] == pytest.approx(np.exp(-1)) and 0 < w[0, 2] < 0.1 * w[0, 1]


Turned = tuple[Scene, tuple[Surface, Surface], float]


@pytest.fixture(scope="module")
def turned() -> Turned:
    """Each state's surface as the Gaussians have it, and the extent of the object."""
    made = made_scene("revolute")
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    return made, surfaces, float((high - low).max())


def parts_of(made: Scene, surface: Surface, state: int = 0) -> np.ndarray:
    return made.gaussians.part.numpy()[nearest(surface.points, made.at(state))]


def test_surface_is_what_cameras_see(turned: Turned) -> None:
    made, (first, _), _ = turned
    means = made.gaussians.means.numpy()
    shown = nearest(first.points, made.gaussians)
    np.testing.assert_array_equal(first.points, means[shown])
    hidden = np.setdiff1d(np.arange(len(means)), shown)
    assert 0.6 < len(first.points) / len(means) < 0.98
    front_of_box = np.abs(means[hidden] - [0, -0.34, 0]).max(1) < 0.36
    assert front_of_box.mean() > 0.8  # What is hidden lies between box and slab.


def test_maps_lift_the_lid_that_a_fit_has_put_on() -> None:
    """No mask contradicts a lid on a hollow, but depth does."""
    rim, floor = 0.15, -0.25
    walls = [(-0.4, -0.4, -0.35, 0.4), (0.35, -0.4, 0.4, 0.4), (-0.35, -0.4, 0.35, -0.35), (-0.35, 0.35, 0.35, 0.4)]
    boxes = [box((*w[:2], floor), (*w[2:], rim), 0.03, seed=3) for w in walls]
    tray = concatenate([*boxes, box((-0.35, -0.35, floor), (0.35, 0.35, floor + 0.05), 0.03, seed=4)])
    lid = box((-0.35, -0.35, rim - 0.02), (0.35, 0.35, rim), 0.03, seed=3)
    cameras = cameras_around(12, 96)
    views = [photograph(tray, c) for c in cameras]
    drawn = [render(tray, c) for c in cameras]
    depth = [np.where(r.alpha > 0.5, r.depth / r.alpha.clamp_min(0.1), 0).astype(np.float32) for r in drawn]
    maps = [depth_map(view, d) for view, d in zip(views, depth, strict=True)]

    def share_on_lid(maps: Sequence[DepthMap]) -> float:
        p = surface_of(concatenate([tray, lid]), views, maps, 96, 0.02, 0.015).points
        return float(((np.abs(p[:, :2]).max(1) < 0.3) & (p[:, 2] > 0)).mean())

    assert share_on_lid(()) > 0.1
    assert share_on_lid(maps) < 0.005


def wall(depth: float, views: int = 4) -> Sight:
    """Cameras at z = -3, all of which see nothing but a grey wall, ``depth`` away."""
    P = np.array([[20, 0, 20, 60], [0, 20, 20, 60], [0, 0, 1, 3]], np.float32)
    return Sight(
        np.tile(P, (views, 1, 1)),
        np.full((views, 40, 40), depth, np.float32),
        np.full((views, 40, 40, 3), 0.5, np.float32),
        0.05,
    )


def up(z: float) -> np.ndarray:
    return prismatic(np.eye(3)[2], z)


def test_seen_costs_less_than_hidden_and_hidden_less_than_in_the_air() -> None:
    """The wall is at z = 0 in one state and at z = 0.5 in the other."""
    mine, other = plain(patch((0, 0, 0), 5), wall(3)), plain(patch((0, 0, 0.5), 9), wall(3.5))
    stay, air, seen, hidden = label_costs(mine, other.sight, [up(0.2), up(0.5), up(1)], extent=1).T
    assert (seen < hidden).all() and (hidden < 0.5 * air).all() and (seen < 0.5 * stay).all()
    # To be recognised far away is a bolder claim, to be recognised in another colour a weaker one.
    assert (seen < label_costs(mine, other.sight, [up(0.5)], extent=0.4)[:, 1]).all()
    red = replace(mine, colours=np.tile([1.0, 0, 0], (25, 1)))
    assert (seen < label_costs(red, other.sight, [up(0.5)], extent=1)[:, 1]).all()


def test_to_stay_costs_the_static_nothing() -> None:
    mine = plain(patch((0, 0, 0), 5), wall(3))
    costs = label_costs(mine, mine.sight, [np.eye(4), up(0.3)], extent=1)
    assert (costs[:, 0] == 0).all()
    assert (costs[:, 1:] > 0).all()  # To move is a claim, even to nowhere.


def test_what_floats_at_home_may_float_there() -> None:
    """A fit's points lie a little in front of their surface: its own photographs see them in free space, too."""
    sound, loose = plain(patch((0, 0, 0), 5), wall(3)), plain(patch((0, 0, 0), 5), wall(3.5))
    other = plain(patch((0, 0, 0.5), 9), wall(3.5))
    assert (label_costs(sound, other.sight, [], extent=1) > 1).all()
    assert (label_costs(loose, other.sight, [], extent=1) < 0.5).all()


def test_a_seed_must_go_somewhere() -> None:
    mine, other = plain(patch((0, 0, 0), 5), wall(3)), plain(patch((0, 0, 0.5), 9), wall(3.5))
    motions = [up(0.2), up(0.5), up(1)]
    costs, judged = label_costs(mine, other.sight, motions, extent=1), seed_costs(mine, other.sight, motions, 1)
    assert judged.shape == (25, 3)
    np.testing.assert_allclose(judged[:, 1], costs[:, 2])
    assert (judged[:, 2] > costs[:, 3]).all()


def test_true_motions_cost_their_own_points_least(turned: Turned) -> None:
    made, (first, second), extent = turned
    wrong = replace(TURN, value=-ANGLE)
    forward, backward = [TURN.T, wrong.T], [inverted(TURN).T, inverted(wrong).T]
    for surface, other, transforms, state in ((first, second, forward, 0), (second, first, backward, 1)):
        part = parts_of(made, surface, state)
        costs = label_costs(surface, other.sight, transforms, extent=extent)
        assert costs.shape == (len(part), 3)
        assert (costs[part == 0].argmin(1) == 0).mean() > 0.8
        assert costs[part == 1].mean(0).argmin() == 1
        judged = seed_costs(surface, other.sight, transforms, extent)[part == 1].mean(0)
        assert judged[0] < 0.8 * judged[1]


def test_only_what_moved_floats(turned: Turned) -> None:
    made, (first, second), _ = turned
    floats = floating(ask(first.points, first.colours, second.sight))
    part = parts_of(made, first)
    assert part[floats].mean() > 0.99
    assert floats[part == 1].mean() > 0.5


def test_labels_follow_the_motions_and_a_false_one_is_dropped(
    turned: Turned,
) -> None:
    made, surfaces, extent = turned
    problem = Labelling.of(surfaces, extent)
    false = Motion("revolute", np.eye(3)[0], np.zeros(3), 1.5, 1.0)
    choices, prices = Choices(problem, [false.T, TURN.T]), np.full(2, 20.0)
    assert choices.best(prices, None) == {1}
    labels = choices.labels([1])
    for s in (0, 1):
        part = parts_of(made, surfaces[s], s)
        assert (labels[s] == part).mean() > 0.92
        assert (problem.labels([TURN.T])[s] == labels[s]).all()
    assert choices.best(prices, 2) == {1}  # A number that is given is an upper bound.
    assert choices.best(prices, 0) == set()
    assert choices.best(np.array([1e5, 1e5]), None) == set()


def test_no_price_is_paid_for_a_motion_that_only_hides(turned: Turned) -> None:
    _, surfaces, extent = turned
    into_the_box = prismatic(FORWARD, -0.5 * extent)
    choices = Choices(Labelling.of(surfaces, extent), [into_the_box, TURN.T])
    assert choices.best(np.full(2, float(PRICE)), None) == {1}


def test_what_others_explain_nearly_as_well_is_not_explained_at_first_hand(turned: Turned) -> None:
    """Of two motions that are the same neither sees what the other does not; one alone explains more than its price."""
    _, surfaces, extent = turned
    choices = Choices(Labelling.of(surfaces, extent), [TURN.T, TURN.T])
    assert choices.firsthand(frozenset({0}))[0] > 2 * PRICE
    assert max(choices.firsthand(frozenset({0, 1})).values()) < 0.1 * PRICE


def test_more_motions_to_choose_from_are_as_if_they_had_been_there_from_the_first(turned: Turned) -> None:
    """What was worked out before stays true, and the motions that come later are chosen as well."""
    _, surfaces, extent = turned
    problem, into_the_box = Labelling.of(surfaces, extent), prismatic(FORWARD, -0.5 * extent)
    few = Choices(problem, [into_the_box])
    assert few.gains(frozenset()).keys() == {0}
    grown, whole = few.with_more([TURN.T]), Choices(problem, [into_the_box, TURN.T])
    assert grown.best(np.full(2, float(PRICE)), None) == {1}
    for kept in ([], [0], [1], [0, 1]):
        assert grown.gains(frozenset(kept)) == pytest.approx(whole.gains(frozenset(kept)))
        np.testing.assert_array_equal(grown.labels(kept)[0], whole.labels(kept)[0])
    assert few.with_more([]) is few


def test_an_odd_joint_costs_more(turned: Turned) -> None:
    """Of two motions that explain the same, the one that no hinge would make is not chosen."""
    _, surfaces, extent = turned
    choices = Choices(Labelling.of(surfaces, extent), [TURN.T, TURN.T])
    for odd in (0, 1):
        price = np.where(np.arange(2) == odd, 30.0, 20.0)
        assert told_apart(choices, lambda *_: 0.0, price, None) == {1 - odd: 20}


def test_texture_is_asked_about_what_is_chosen_and_may_have_it_replaced(turned: Turned) -> None:
    """Of two motions that explain the same, one is chosen; that texture speaks against it brings in the other."""
    _, surfaces, extent = turned
    choices = Choices(Labelling.of(surfaces, extent), [TURN.T, TURN.T])
    (usual,) = choices.best(np.full(2, 20.0), None)
    asked = []

    def against(says: dict[int, float]) -> Callable[[int, Labels], float]:
        def say(k: int, owned: Labels) -> float:
            asked.append(k)
            assert min(owned[0].sum(), owned[1].sum()) > 50
            return says[k]

        return say

    assert told_apart(choices, against({usual: -3}), 20, None) == {usual: 20}
    assert told_apart(choices, against({usual: 30, 1 - usual: -100}), 20, None) == {1 - usual: 10}
    assert told_apart(choices, against({usual: 30, 1 - usual: 35}), 20, None) == {usual: 50}
    assert told_apart(choices, against({usual: 9}), 20, None) == {usual: 20}
    assert asked == [usual, usual, 1 - usual, usual, 1 - usual, usual]
    # However loud texture is, what nothing else explains stays: a door that shows its other side.
    assert told_apart(Choices(Labelling.of(surfaces, extent), [TURN.T]), against({0: 1e6}), 20, None) == {0: 60}


def test_an_odd_joint_is_in_doubt_before_texture_says_anything(turned: Turned) -> None:
    """Of two odd ones that explain the same the other is heard, too, where a joint could be had that is not odd."""
    _, surfaces, extent = turned
    nonsense = replace(TURN, value=-TURN.value)
    choices = Choices(Labelling.of(surfaces, extent), [TURN.T, TURN.T, nonsense.T])
    (usual,) = choices.best(np.full(3, 28.0), None)
    says = {usual: 5.0, 1 - usual: -3.0}
    assert told_apart(choices, lambda k, _: says[k], [28, 28, 28], None) == {usual: 28}
    assert told_apart(choices, lambda k, _: says[k], [28, 28, 20], None) == {1 - usual: 25}
    # A slide that costs less than a hinge does not make hinges odd.
    assert told_apart(choices, lambda k, _: says[k], [28, 28, 20], None, [28, 28, 20]) == {usual: 28}


def test_something_moved_so_one_motion_is_had_for_half_its_price(turned: Turned) -> None:
    """The blade of a small knife explains 48 points for a price of 50."""
    _, surfaces, extent = turned
    choices = Choices(Labelling.of(surfaces, extent), [TURN.T, inverted(TURN).T])
    gain = choices.gains(frozenset())[0]

    def chosen(price: float) -> dict[int, float]:
        return told_apart(choices, lambda *_: 0.0, price, None)

    assert chosen(0.5 * gain) == {0: 0.5 * gain}
    assert chosen(1.5 * gain) == {0: 0.75 * gain}
    assert chosen(2.5 * gain) == {}


def test_texture_buys_a_motion_of_its_own_at_half_the_price() -> None:
    """Two drawers pulled out by nearly the same: motion 1 explains 30 points besides motion 0."""
    asked, those = set(), []

    class Drawers:
        def gains(self, kept: frozenset[int]) -> dict[int, float]:
            return {k: gain for k, gain in {1: 30.0, 2: 22.0, 3: 15.0}.items() if k not in kept}

        def labels(self, kept: Sequence[int]) -> Labels:
            those[:] = kept
            return np.arange(len(kept) + 1), np.arange(len(kept) + 1)

    def chosen(
        goes_along: dict[tuple[int, int | None], int], parts: int | None = None, *, near: bool = True
    ) -> dict[int, float]:
        """``goes_along``: of 20 patches of the points of one motion, those that go along with another, or with none."""

        def likeness(k: int | None, mine: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
            asked.add(k)
            good = goes_along.get((those[int(np.flatnonzero(mine[0])[0]) - 1], k), 0)
            return np.repeat([0.95, 0.2], [good, 20 - good]) if good != 4 else np.full(4, 0.95)

        return vouched_for(cast(Choices, Drawers()), {0: 40.0}, lambda *_: near, likeness, 20.0, parts)

    assert chosen({(1, 1): 16, (1, 0): 2}) == {0: 40, 1: 20}
    assert chosen({(1, 1): 16, (2, 2): 16}) == {0: 40, 1: 20, 2: 20}
    assert chosen({(1, 1): 16, (1, 0): 14}) == {0: 40}
    assert chosen({(1, 1): 16, (1, None): 14}) == {0: 40}
    assert chosen({(1, 1): 8}) == {0: 40}  # Most go elsewhere.
    assert chosen({(1, 1): 4}) == {0: 40}  # They are all there is.
    assert chosen({(1, 1): 16}, parts=1) == {0: 40}
    assert chosen({(1, 1): 16}, near=False) == {0: 40}
    assert asked == {None, 0, 1, 2}


def test_what_is_nearly_right_is_heard_again_once_it_fits_what_would_be_its_own(monkeypatch) -> None:
    """A motion that is off by 7° explains less than half a price. Corrected it explains more, and texture goes along
    with it; not with what was off, and too little with handles, few patches of which do."""
    made, patches = made_scene("revolute"), [40]

    def compared(_surfaces: Any, _photographs: Any, T_1_0: np.ndarray, *_: Any) -> list[tuple[np.ndarray, float]]:
        return [(np.full(patches[0], 0.95 if np.abs(T_1_0 - TURN.T).max() < 0.02 else 0.2), 1.0)]

    monkeypatch.setattr("hingesplat.segment.compared", compared)
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    evidence, (first, second) = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    off = replace(TURN, value=ANGLE + 0.12)
    case = _Case.of(evidence, (first, second), CONFIG, None)
    gains = Choices(case.problem, [off.T, TURN.T]).gains(frozenset())
    case = replace(case, config=replace(CONFIG, part_cost=gains[1] / 0.7))
    assert gains[0] < 0.5 * case.config.part_cost
    (found,) = case.heard_again([], [off], [[], []], 0)
    assert abs(found.value - ANGLE) < 0.02
    assert case.heard_again([found], [off], [[], []], 0) == [found]
    assert replace(case, parts=0).heard_again([], [off], [[], []], 0) == []
    patches[0] = 20
    assert case.heard_again([], [off], [[], []], 0) == []


@pytest.mark.parametrize(("along", "still", "kept"), [(0, 5, 0), (0, 4, 1), (6, 5, 1)])
def test_what_texture_says_has_stayed_has_not_moved(monkeypatch, along: int, still: int, kept: int) -> None:
    """A wall beside a hinge, in whose place shadows made stereo see nothing, was a part of its own."""
    made = made_scene("revolute")

    def compared(_surfaces: Any, _photographs: Any, T_1_0: np.ndarray, *_: Any) -> list[tuple[np.ndarray, float]]:
        return [(np.full(still if np.array_equal(T_1_0, np.eye(4)) else along, 0.95), 1.0)]

    monkeypatch.setattr("hingesplat.segment.compared", compared)
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    evidence, (first, second) = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    case = _Case.of(evidence, (first, second), CONFIG, None)
    assert case.without_still([TURN], [[], []], 0) == [TURN][:kept]


def test_what_thinned_points_said_is_heard(turned: Turned) -> None:
    """Two motions that are the same: a point follows the one that its thinned neighbours follow."""
    _, surfaces, extent = turned
    problem = Labelling.of(surfaces, extent)
    (usual,) = set(np.concatenate(problem.labels([TURN.T, TURN.T]))) - {0}
    one = problem.labels([TURN.T])
    for said in (usual, 3 - usual):
        found = problem.labels([TURN.T, TURN.T], (said * one[0], said * one[1]))
        for s in (0, 1):
            np.testing.assert_array_equal(found[s], said * one[s])


def test_a_part_meets_itself_and_what_merely_hides_does_not(turned: Turned) -> None:
    made, surfaces, extent = turned
    problem = Labelling.of(surfaces, extent)
    part = [parts_of(made, surface, s) for s, surface in enumerate(surfaces)]
    elsewhere = prismatic(FORWARD, -0.5 * extent)
    assert meeting(problem.partners([TURN.T]), (part[0], part[1]))[0] > 0.8
    assert meeting(problem.partners([elsewhere]), (part[0], part[1]))[0] < 0.3
    # What one state hides of a part has no partner; what it shows has.
    few = np.where(np.arange(len(part[0])) % 5, 0, part[0])
    assert meeting(problem.partners([TURN.T]), (few, part[1]))[0] > 0.8
    # But a state that shows a handful of it says nothing: these would be found anywhere.
    handful = np.where(np.arange(len(part[0])) % 40, 0, part[0])
    assert meeting(problem.partners([TURN.T]), (handful, part[1]))[0] < 0.3
    assert meeting(problem.partners([TURN.T]), (0 * part[0], 0 * part[1]))[0] == 0
    assert meeting(problem.partners([]), (0 * part[0], 0 * part[1])).shape == (0,)


@cache
def latched() -> tuple[tuple[Gaussians, Gaussians], tuple[tuple[View, ...], tuple[View, ...]], np.ndarray]:
    """A door with a latch that turns about the door's normal: Gaussians, photographs, and T_1_0 (3, 4, 4)."""
    latch = box((-0.25, -0.58, -0.05), (0.15, -0.47, 0.05), 0.024, seed=3, part=2)
    whole = concatenate([made_scene("revolute").gaussians, latch])
    turn = revolute([0, 1, 0], [0.05, 0, 0], np.radians(-75))
    T_1_0 = np.stack([np.eye(4), TURN.T, TURN.T @ turn])
    states = whole, posed(whole, dict(enumerate(T_1_0)))
    first, second = (tuple(photograph(g, c) for c in cameras_around(16, 128)) for g in states)
    return states, (first, second), T_1_0


def test_a_latch_is_found_on_the_door_that_carries_it() -> None:
    """It would fit anywhere on the door: only what the door does not explain is somewhere to go."""
    states, views, T_1_0 = latched()
    config = SegmentConfig(sight_size=128)
    low, high, surfaces = survey(states, views, ((), ()), config)
    evidence, (first, second) = gather(surfaces, low, high, config, np.random.default_rng(0))
    door, *bars = _Case.of(evidence, (first, second), config, None).with_hanging([TURN])
    assert len(bars) == 1 and carrier_of(bars[0], [door, *bars]) == 0
    points = [states[0].means[states[0].part == k].double().numpy() for k in (1, 2)]
    assert apart(points[0], door.T, T_1_0[1]) < 0.02
    assert apart(points[1], bars[0].T, T_1_0[2]) < 0.03


def test_what_a_motion_explains_is_not_new() -> None:
    states, views, T_1_0 = latched()
    low, high, surfaces = survey(states, views, ((), ()), CONFIG)
    evidence, _ = gather(surfaces, low, high, CONFIG, np.random.default_rng(0))
    left = evidence.left_by([TURN])
    for s in (0, 1):
        mine = posed(states[0], {k: T_1_0[k] if s else np.eye(4) for k in range(3)})
        part = [states[0].part.numpy()[nearest(e.fresh[s].points, mine)] for e in (evidence, left)]
        before, after = (np.bincount(p, minlength=3) for p in part)
        assert after[1] < 0.2 * before[1]  # the door
        assert after[2] > 0.4 * before[2]  # the latch


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_what_a_motion_gains_is_what_it_takes_off_the_energy(kind: Literal["revolute", "prismatic"]) -> None:
    made = made_scene(kind)
    low, high, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    right = TURN if kind == "revolute" else PULL
    choices = Choices(Labelling.of(surfaces, float((high - low).max())), [inverted(right).T, right.T])
    gains = choices.gains(frozenset())
    assert next(iter(gains)) == 1 and gains[1] > 50 and choices.gains(frozenset({0, 1})) == {}
    # Dearer than what it gains it is not worth having, cheaper it is.
    for share, best in ((0.9, {1}), (1.1, set())):
        assert choices.best(np.array([1e6, share * gains[1]]), None) == best


@pytest.mark.parametrize("height", [0.2, 0.4])
def test_edges_are_those_of_the_plate(rng: np.random.Generator, height: float) -> None:
    """A square one's, too, whose principal axes are any."""
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = rng.uniform(-0.5, 0.5, (2000, 3)) * (0.4, height, 0.01)
    found = edges(flat @ R.T + 1)
    assert len(found) == 4 and all(m.kind == "revolute" and m.value == 0 for m in found)
    sides = [(np.abs(m.axis @ R), (m.pivot - 1) @ R) for m in found]
    for axis, middle in ((0, (0, height / 2, 0)), (0, (0, -height / 2, 0)), (1, (0.2, 0, 0)), (1, (-0.2, 0, 0))):
        off = [np.linalg.norm(place - middle) for along, place in sides if along[axis] > 0.999]
        assert len(off) == 2 and min(off) < 0.015
    thick = rng.uniform(-0.5, 0.5, (2000, 3)) * (0.4, height, 0.2)
    assert edges(thick @ R.T) == []


def test_registered_keeps_the_kind_and_the_sign(turned: Turned) -> None:
    made, (first, second), extent = turned
    mine = first.rows(np.flatnonzero(parts_of(made, first) == 1)[::3])
    for sign in (1.0, -1.0):
        start = Motion("revolute", sign * AXIS, PIVOT + 0.01, sign * (ANGLE + 0.04), 0.5)
        fitted = registered(start, mine.cloud, second.cloud, extent)
        assert fitted.kind == "revolute"
        assert fitted.axis @ start.axis > 0.99
        assert fitted.value == pytest.approx(sign * ANGLE, abs=0.005)
    slid = Cloud(mine.points + SLIDE * FORWARD, mine.normals, mine.colours)
    for sign in (1.0, -1.0):
        start = Motion("prismatic", sign * FORWARD, PIVOT, sign * (SLIDE - 0.01), 0.5)
        fitted = registered(start, mine.cloud, slid, extent)
        assert fitted.kind == "prismatic"
        np.testing.assert_allclose(fitted.axis * fitted.value, SLIDE * FORWARD, atol=0.002)


def test_registering_a_slide_of_nothing_is_no_error(turned: Turned) -> None:
    _, (first, _), extent = turned
    still = replace(PULL, value=0.0)
    np.testing.assert_allclose(registered(still, first.cloud, first.cloud, extent).T, np.eye(4), atol=1e-6)
    few = first.rows(np.arange(5))  # Too few to register at all.
    np.testing.assert_array_equal(registered(still, few.cloud, first.cloud, extent).T, np.eye(4))


def test_pieces_far_apart_become_parts_with_one_motion() -> None:
    shift = Motion("prismatic", np.eye(3)[2], np.zeros(3), 0.5, 1.0)
    base, first, second = patch((0, 0, -1), 20), patch((0, 0, 0)), patch((0.5, 0, 0))
    everything = np.concatenate([base, first, second])
    label = np.repeat([0, 1, 1], [400, 225, 225])
    surfaces = (plain(everything), plain(np.concatenate([base, moved(everything[400:], shift.T)])))
    motions, labels = split_pieces([shift], (label, label), surfaces, 1.0, 25)
    assert motions == [shift, shift]
    for found in labels:
        assert (found[:400] == 0).all()
        assert {len(np.unique(found[400:625])), len(np.unique(found[625:]))} == {1}
        assert found[400] != found[-1] and 0 not in found[400:]
    np.testing.assert_array_equal(labels[0], labels[1])
    near = np.concatenate([base, first, first + np.array([0.15, 0, 0])])
    joined = (plain(near), plain(np.concatenate([base, moved(near[400:], shift.T)])))
    motions, labels = split_pieces([shift], (label, label), joined, 1.0, 25)
    assert motions == [shift] and labels[0].max() == 1


@pytest.mark.parametrize("slit", [0.012, 0.0])
def test_two_doors_on_one_hinge_line_are_two_parts_and_a_plate_on_its_middle_is_one(slit: float) -> None:
    turn = Motion("revolute", np.eye(3)[1], np.zeros(3), 0.8, 1.0)
    half = patch((0, 0, 0), 20) + np.array([0.1, 0, 0])
    first, second = half + np.array([(slit + 0.01) / 2, 0, 0]), half * [-1, 1, 1] - np.array([slit / 2, 0, 0])
    noise = 0.001 * np.random.default_rng(0).normal(size=(2, 800, 3))
    doors, base = np.concatenate([first, second]) + noise, patch((0, 0, -1), 20)
    surfaces = (plain(np.concatenate([base, doors[0]])), plain(np.concatenate([base, moved(doors[1], turn.T)])))
    label = np.repeat([0, 1], [400, 800])
    motions, labels = split_pieces([turn], (label, label), surfaces, 1.0, 25)
    assert len(motions) == (2 if slit else 1)
    for found in labels:
        assert len(np.unique(found[400:800])) == len(np.unique(found[800:])) == 1


@pytest.mark.parametrize(("tall", "gap", "parts"), [(0.05, 0.12, 1), (0.05, 0.04, 1), (0.3, 0.12, 2)])
def test_what_hides_between_the_halves_of_a_lever_does_not_part_them(tall: float, gap: float, parts: int) -> None:
    """A blade of scissors is hidden where the other crosses it; two doors back to back are tall, and far apart less."""
    turn = Motion("revolute", np.eye(3)[1], np.zeros(3), 0.4, 1.0)
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(gap / 2, 0.5, 0.01), np.arange(0, tall, 0.01)))
    half = np.stack([x, y, 0 * x], 1)
    lever, base = np.concatenate([half, half * [-1, 1, 1]]), patch((0, 0, -1), 20)
    surfaces = (plain(np.concatenate([base, lever])), plain(np.concatenate([base, moved(lever, turn.T)])))
    label = np.repeat([0, 1], [len(base), len(lever)])
    assert len(split_pieces([turn], (label, label), surfaces, 1.0, 25)[0]) == parts


SHIFT = Motion("prismatic", np.eye(3)[2], np.zeros(3), 0.5, 1.0)
BASE, PART = patch((0, 0, -1), 20), patch((0, 0, 0))


def test_two_motions_that_nearly_agree_are_tried_as_one_on_what_both_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small door once had two, each a little off to its own side."""
    asked = []
    monkeypatch.setattr("hingesplat.segment.refit", lambda _, motion, own: asked.append((motion, own)) or motion)
    half, other = (Motion("prismatic", np.eye(3)[2], np.zeros(3), value, 1.0) for value in (0.5, 0.53))
    far = Motion("prismatic", np.eye(3)[0], np.zeros(3), 0.5, 1.0)
    evidence = cast(Any, SimpleNamespace(surfaces=(plain(PART), plain(PART)), extent=1.0))
    owners = [(np.arange(10), np.arange(5)), (np.arange(10, 30), np.arange(5, 9)), (np.arange(30, 40), np.arange(0))]
    assert one_for_two(evidence, [half, other, far], owners) == {(1, 0): other}
    ((motion, own),) = asked
    assert motion is other and [rows.tolist() for rows in own] == [list(range(30)), list(range(9))]


def both_states(*parts: tuple[np.ndarray, Motion]) -> tuple[Surface, Surface]:
    """The base and parts that moved."""
    here, there = (plain(np.concatenate([BASE, *p])) for p in zip(*((p, moved(p, m.T)) for p, m in parts), strict=True))
    return here, there


def test_a_piece_seen_in_one_state_only_is_no_part() -> None:
    """The inside of a drawer is there when it is open."""
    second = patch((0.5, 0, 0))
    surfaces = (plain(np.concatenate([BASE, PART])), both_states((PART, SHIFT), (second, SHIFT))[1])
    label = np.repeat([0, 1, 1], [400, 225, 225])
    for given, states in (((label[:625], label), surfaces), ((label, label[:625]), (surfaces[1], surfaces[0]))):
        motion = SHIFT if len(given[0]) == 625 else inverted(SHIFT)
        motions, labels = split_pieces([motion], given, states, 1.0, 25)
        assert motions == [motion]
        assert [set(found) for found in labels] == [{0, 1}, {0, 1}]


def test_a_motion_that_one_state_shows_nothing_of_is_none() -> None:
    """Speckles of a white wall had been matched with speckles elsewhere: each piece was in one state only."""
    here, there = plain(np.concatenate([BASE, PART])), plain(np.concatenate([BASE, patch((0.9, 0.4, 0))]))
    label = np.repeat([0, 1], [400, 225])
    motions, labels = split_pieces([SHIFT], (label, label), (here, there), 1.0, 25)
    assert motions == [] and not labels[0].any() and not labels[1].any()


def test_a_piece_goes_back_to_the_part_that_it_moves_with() -> None:
    """Two motions nearly the same share a part between them, and the smaller share touches the larger."""
    stray, far = patch((0.16, 0, 0)), patch((0.8, 0, 0), 20)
    label = np.repeat([0, 1, 2, 2], [400, 225, 225, 400])
    other = Motion("prismatic", np.eye(3)[0], np.zeros(3), 0.3, 1.0)
    for kin, motion, parts in ((True, replace(SHIFT, value=0.505), 2), (False, other, 3)):
        surfaces = both_states((PART, SHIFT), (stray, motion), (far, motion))
        motions, labels = split_pieces([SHIFT, motion], (label, label), surfaces, 1.0, 25)
        assert len(motions) == parts
        for found in labels:
            assert (found[400:625] == 1).all() and (found[:400] == 0).all()
            assert ((found[625:850] == 1).all()) == kin
            assert len(set(found[850:])) == 1 and found[-1] > 1


def test_fragments_go_to_what_they_touch() -> None:
    """A speck of part 1 in the middle of the base is the base's."""
    true = np.repeat([0, 1], [400, 225])
    wrong = true.copy()
    wrong[[190, 210, 211]] = 1
    surfaces = both_states((PART, SHIFT))
    for given in (true, wrong):
        for found in reattach_fragments([SHIFT.T], (given, given), surfaces, 1.0):
            np.testing.assert_array_equal(found, true)


def test_of_a_part_the_largest_piece_stays_and_of_the_base_every_large_one() -> None:
    still = replace(SHIFT, value=0.0)
    shelf, beside = patch((0, 0, -3), 10), patch((0, 0, -0.95), 14)
    surfaces = both_states((shelf, still), (PART, SHIFT), (beside, still))
    given = np.repeat([0, 0, 1, 1], [400, 100, 225, 196])
    for found in reattach_fragments([SHIFT.T], (given, given), surfaces, 1.0):
        np.testing.assert_array_equal(found, np.repeat([0, 0, 1, 0], [400, 100, 225, 196]))


def test_of_what_a_fragment_touches_photographs_choose(monkeypatch) -> None:
    """The inside of a drawer: part 1 by mistake, part 2 by what it touches, though the cabinet is as near."""
    costs = np.array([0.9, 0.2, 0.25])
    monkeypatch.setattr(
        "hingesplat.pieces.label_costs", lambda surface, *_, **__: np.tile(costs, (len(surface.points), 1))
    )
    still, other = replace(SHIFT, value=0.0), replace(SHIFT, value=0.6)
    inside, beside, front = patch((0, 0.9, -0.4), 10), patch((0, 0.9, -0.43), 14), patch((0, 0.9, -0.37), 14)
    surfaces = both_states((PART, SHIFT), (inside, other), (beside, still), (front, other))
    given = np.repeat([0, 1, 1, 0, 2], [400, 225, 100, 196, 196])
    for found in reattach_fragments([SHIFT.T, other.T], (given, given), surfaces, 1.0):
        assert set(found[625:725]) == {2}


@pytest.mark.parametrize(("costs", "label"), [((0.9, 0.1), 1), ((0.9, 0.3), 1), ((0.3, 0.1), 0)])
def test_a_fragment_that_the_photographs_are_sure_of_stays_what_it_is(
    monkeypatch, costs: tuple[float, float], label: int
) -> None:
    """A knife's blade touches only the handle; it may be what a motion hides (0.3), but it has not stayed there."""
    monkeypatch.setattr(
        "hingesplat.pieces.label_costs", lambda surface, *_, **__: np.tile(costs, (len(surface.points), 1))
    )
    surfaces = both_states((PART, SHIFT), (patch((0, 0, -0.95), 14), SHIFT))
    given = np.repeat([0, 1, 1], [400, 225, 196])
    for found in reattach_fragments([SHIFT.T], (given, given), surfaces, 1.0):
        np.testing.assert_array_equal(found, np.repeat([0, 1, label], [400, 225, 196]))


@pytest.mark.parametrize(("own", "label"), [(0.1, 1), (0.3, 2)])
def test_what_another_motion_merely_hides_goes_to_the_part_that_it_touches(monkeypatch, own: float, label: int) -> None:
    """The handle of a door whose motion is still off: the photographs like it nowhere, and hidden best."""
    monkeypatch.setattr(
        "hingesplat.pieces.label_costs", lambda surface, *_, **__: np.tile([1.0, own, 0.9], (len(surface.points), 1))
    )
    door, other = patch((0, 1.5, 0.5), 15), replace(SHIFT, value=0.6)
    surfaces = both_states((PART, SHIFT), (patch((0, 1.5, 0.53), 8), other), (door, other))
    given = np.repeat([0, 1, 1, 2], [400, 225, 64, 225])
    for found in reattach_fragments([SHIFT.T, other.T], (given, given), surfaces, 1.0):
        np.testing.assert_array_equal(found, np.repeat([0, 1, label, 2], [400, 225, 64, 225]))


def test_a_back_between_two_fronts_follows_the_nearer() -> None:
    may, lost = np.ones(900, bool), np.repeat([False, True], [675, 225])
    told = [np.stack([may, lost])] * 3
    points = np.concatenate([patch((0, 0, z), 15) for z in (0.9, 0.03, -0.05, 0)])
    given = np.repeat([1, 2, 3, 1], 225)
    for found in follow_fronts((given, given), (plain(points), plain(points)), 1.0, (told, told)):
        np.testing.assert_array_equal(found, np.repeat([1, 2, 3, 2], 225))


@pytest.mark.parametrize(("thick", "label"), [(0.04, 2), (0.1, 1)])
def test_the_back_of_a_plate_follows_its_front(thick: float, label: int) -> None:
    """Two doors one above the other: both motions take the inside of the second, thought to be the first's, out of
    sight."""
    first, second, back = (patch((0, 0, z), 15) for z in (0.5, -0.5, -0.5 - thick))
    told = [np.stack([np.ones(1075, bool), np.repeat([False, True], [850, 225])])] * 2
    points = np.concatenate([BASE, first, second, back])
    given = np.repeat([0, 1, 2, 1], [400, 225, 225, 225])
    for found in follow_fronts((given, given), (plain(points), plain(points)), 1.0, (told, told)):
        np.testing.assert_array_equal(found, np.repeat([0, 1, 2, label], [400, 225, 225, 225]))


def test_a_part_is_not_passed_on_from_one_to_another() -> None:
    """Doors that look alike inside, one open in each state: the inside of one was a part that went to the other."""
    doors = [patch((x, 0, 0.5), 15) for x in (-0.5, 0.5)]
    insides = [door - (0, 0, 0.03) for door in doors]
    given = np.repeat([0, 1, 2, 3], [400, 225, 225, 225])
    first, second, apart = (
        plain(np.concatenate([BASE, *doors, inside])) for inside in (*insides, doors[0] + (0.2, 0, 0))
    )
    np.testing.assert_array_equal(passed_on(lying_on((given, given), 3, (first, second), 1.0)), [0, 0, 1])
    for others in ((first, first), (first, apart)):  # A lever stays on its door, and may swing away from it.
        np.testing.assert_array_equal(passed_on(lying_on((given, given), 3, others, 1.0)), [0, 0, 0])
    # On one door in both states it rides.
    np.testing.assert_array_equal(riding(lying_on((given, given), 3, (first, first), 1.0))[2], 1)
    np.testing.assert_array_equal(riding(lying_on((given, given), 3, (first, second), 1.0))[2], 0)
    assert lying_on((given, given), 4, (first, first), 1.0).shape == (2, 4, 4)  # A motion may own nothing.


def test_what_is_left_without_points_in_one_state_is_no_part(monkeypatch) -> None:
    """A blade that one state hides but for its tip is one; a speck of noise that was given away to others is not."""
    monkeypatch.setattr("hingesplat.pieces.gone", lambda surface, _: np.ones(len(surface.points), bool))

    def kept(motions: list[Motion], owned: Labels, least: int) -> tuple[list[Motion], Labels]:
        first, second = (plain(np.zeros((len(label), 3))) for label in owned)
        return seen_to_move(motions, owned, (first, second), 1.0, least)

    motions, first = [SHIFT, inverted(SHIFT), SHIFT], np.repeat([0, 1, 2, 3], [5000, 400, 300, 200])
    second = np.repeat([0, 1, 2, 3], [5000, 500, 10, 25])
    found, labels = kept(motions, (first, second), 25)
    assert found == [SHIFT, SHIFT] and found[0] is motions[0] and found[1] is motions[2]
    np.testing.assert_array_equal(labels[0], np.repeat([0, 1, 0, 2], [5000, 400, 300, 200]))
    np.testing.assert_array_equal(labels[1], np.repeat([0, 1, 0, 2], [5000, 500, 10, 25]))
    few = np.repeat([0, 1], [20_000, 40])
    assert kept([SHIFT], (few, few), 25)[0] == [SHIFT]
    assert kept([SHIFT], (few, few), 50)[0] == []


def test_what_neither_state_shows_to_have_gone_has_not_moved(monkeypatch) -> None:
    """A drawer's front has gone for one state and its inside for nobody: it moved. Two states' depth of a white wall
    differs, and a slight turn explains that; but the wall is still there."""
    went = iter([np.repeat([False, True, False], [1000, 20, 80]), np.repeat([False, True, False], [1000, 40, 60])])
    monkeypatch.setattr("hingesplat.pieces.gone", lambda *_: next(went))
    label, surfaces = np.repeat([0, 1, 2], [1000, 50, 50]), (plain(np.zeros((1100, 3))), plain(np.zeros((1100, 3))))
    motions, labels = seen_to_move([SHIFT, inverted(SHIFT)], (label, label), surfaces, 1.0, 25)
    assert motions == [SHIFT]
    for found in labels:
        np.testing.assert_array_equal(found, np.repeat([0, 1, 0], [1000, 50, 50]))


@pytest.mark.parametrize(("empty", "kept"), [(0.9, 1), (0.4, 0)])
def test_a_part_has_gone_from_where_it_has_not_come_to_lie(monkeypatch, empty: float, kept: int) -> None:
    """A bulge in one state's depth of a white wall would slide back into it, but the wall is where it was."""
    plate = patch((0, 0, 0), 15, 0.02)
    shift = Motion("prismatic", FORWARD, np.zeros(3), 0.15, 1.0)
    first, second = plain(plate), plain(moved(plate, shift.T))
    ahead = [plate[:, 1] > -0.0, plate[:, 1] < -0.02]
    went = iter([a & (np.arange(len(a)) % 10 < 10 * empty) for a in ahead])
    monkeypatch.setattr("hingesplat.pieces.gone", lambda *_: next(went))
    label = np.ones(len(plate), int)
    assert len(seen_to_move([shift], (label, label), (first, second), 1.0, 10)[0]) == kept


def test_a_long_panel_that_slides_over_itself_has_moved(monkeypatch) -> None:
    monkeypatch.setattr("hingesplat.pieces.gone", lambda *_: np.repeat([False, True, False], [1000, 120, 880]))
    label, surfaces = np.repeat([0, 1], [1000, 1000]), (plain(np.zeros((2000, 3))), plain(np.zeros((2000, 3))))
    assert seen_to_move([SHIFT], (label, label), surfaces, 1.0, 25)[0] == [SHIFT]
    assert seen_to_move([SHIFT], (label, label), surfaces, 1.0, 35)[0] == []


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_what_moved_has_gone_and_what_stayed_has_not(kind: Literal["revolute", "prismatic"]) -> None:
    made = made_scene(kind)
    _, _, surfaces = survey((made.gaussians, made.at(1)), made.views, ((), ()), CONFIG)
    for s in (0, 1):
        went, part = gone(surfaces[s], surfaces[1 - s].sight), parts_of(made, surfaces[s], s) == 1
        assert went[part].mean() > 0.5 and went[~part].mean() < 0.05


def test_what_lands_in_another_drawer_is_of_that_drawer() -> None:
    """Two drawers side by side, a cabinet before y = 0 of which photographs see what stays outside. One is open by 0.1,
    the other by 0.3, and the back of its bottom is thought to take the shorter way."""
    motions = [prismatic(np.eye(3)[1], 0.1), prismatic(np.eye(3)[1], 0.3)]
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(0, 0.4, 0.01), np.arange(-0.3, 0.05, 0.01)))
    bottoms = [np.stack([x, y, 0 * x], 1)[y > -0.1], np.stack([x + 0.5, y, 0 * x], 1)]
    fronts = [np.stack([x + aside, 0 * x, y], 1) for aside in (0, 0.5)]
    here, there = plain(np.concatenate(bottoms)), plain(np.concatenate(fronts))
    true = np.repeat([1, 2], [len(bottoms[0]), len(bottoms[1])])
    second = np.repeat([1, 2], [len(x), len(x)])
    thought = np.where(here.points[:, 1] > -0.1, 1, true)

    def outside(surface: Surface, T: np.ndarray) -> np.ndarray:
        return np.tile(moved(surface.points, T)[:, 1] > -1e-9, (2, 1))

    told = [outside(here, T) for T in motions], [outside(there, np.linalg.inv(T)) for T in motions]
    first, after = give_way(motions, (thought, second), (here, there), 1.0, told)
    np.testing.assert_array_equal(first, true)
    np.testing.assert_array_equal(after, second)


def test_labels_spread_to_the_nearest() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0.2, 0, 0], [0.9, 0, 0]])
    assert spread_labels(points, plain(points[:2]), np.array([3, 5])).tolist() == [3, 5, 3, 5]


# The whole.


@pytest.mark.parametrize(("kind", "depth"), [("revolute", False), ("prismatic", False), ("revolute", True)])
def test_the_one_moving_part_is_found(kind: Literal["revolute", "prismatic"], depth: bool) -> None:
    made = made_scene(kind)
    maps = made_maps(kind) if depth else ((), ())
    found = segment((made.gaussians, made.at(1)), made.views, CONFIG, maps=maps)
    assert len(found.motions) == 1
    assert found.unexplained < 0.3 and found.seeds > 100
    T_true = made.T_state_0[1, 1]
    T = found.motions[0].T
    np.testing.assert_allclose(
        T_true, revolute(AXIS, PIVOT, ANGLE) if kind == "revolute" else prismatic(FORWARD, SLIDE)
    )
    assert angle_between(T, T_true) < 1.5  # Pictures of 96 pixels; seeds scatter from 0.5 to 1.2.
    centre = made.gaussians.means[made.gaussians.part == 1].mean(0).double().numpy()[None]
    assert np.linalg.norm(moved(centre, T) - moved(centre, T_true)) < 0.02  # A surface is 0.012 thick.
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
        maps = made_maps(kind) if kind == "revolute" else ((), ())
        (T,) = track((made.gaussians, made.at(1)), made.views, labels, [motion], CONFIG, maps=maps)
        assert angle_between(T, made.T_state_0[1, 1]) < 1.0
        np.testing.assert_allclose(T[:3, 3], made.T_state_0[1, 1, :3, 3], atol=0.01)


def test_tracking_a_part_that_stayed_or_has_no_points_gives_the_identity() -> None:
    made = made_scene("static")
    labels = made.gaussians.part.numpy()
    stayed, absent = track((made.gaussians, made.gaussians), made.views, labels, [PULL, PULL], CONFIG)
    np.testing.assert_allclose(stayed, np.eye(4), atol=1e-3)
    np.testing.assert_array_equal(absent, np.eye(4))


def test_a_part_may_rest_in_all_states_but_one() -> None:
    """A slab before the box slides out in state 2, another behind it in state 1; in state 3 both are halfway."""
    body = box((-0.5, -0.3, -0.4), (0.5, 0.3, 0.4), 0.03, seed=1)
    first = box((-0.35, -0.46, -0.3), (0.35, -0.38, 0.3), 0.03, seed=2, part=1)
    second = box((-0.3, 0.36, -0.25), (0.3, 0.44, 0.25), 0.03, seed=3, part=2)
    whole = concatenate([body, first, second])
    cameras = cameras_around(14, 80)
    ways = {1: (0.3, 0.15), 2: (0.2, 0.1)}
    values = [(0, 0), (0, ways[2][0]), (ways[1][0], 0), (ways[1][1], ways[2][1])]
    true = np.stack([[np.eye(4), prismatic(FORWARD, a), prismatic(-FORWARD, b)] for a, b in values])
    states = [posed(whole, dict(enumerate(T))) for T in true]
    views = [tuple(photograph(g, c) for c in cameras) for g in states]
    found, other, T_state_0 = segment_states(states, views, CONFIG)
    assert len(found.motions) == 2 and other in (2, 3)
    order = [0] + [1 + int(np.argmin([np.abs(T_state_0[:, 1 + k] - true[:, p]).max() for k in (0, 1)])) for p in (1, 2)]
    np.testing.assert_allclose(T_state_0[:, order], true, atol=0.03)
    agree = [(np.array([order.index(p) for p in label]) == whole.part.numpy()).mean() for label in found.labels]
    assert min(agree) > 0.85  # What no camera sees in a state has no label of its own.


def test_states_between_are_not_searched_again_where_all_is_known(monkeypatch) -> None:
    made = made_scene("prismatic")
    half = posed(made.gaussians, {1: prismatic(FORWARD, SLIDE / 2)})
    views = [made.views[0], tuple(photograph(half, v.camera) for v in made.views[0]), made.views[1]]
    searched = []
    monkeypatch.setattr(
        "hingesplat.states.segment", lambda pair, *a, **k: searched.append(pair) or segment(pair, *a, **k)
    )
    found, other, T_state_0 = segment_states([made.gaussians, half, made.at(1)], views, QUICK)
    assert len(searched) == 1 and other == 2 and len(found.motions) == 1
    np.testing.assert_allclose(T_state_0[1, 1, :3, 3], FORWARD * SLIDE / 2, atol=0.015)


def drawer(x: float, out: float) -> Gaussians:
    """A plain front at y = −0.3 − ``out``, and the open box behind it."""
    parts = [box((x - 0.22, -0.33, -0.2), (x + 0.22, -0.3, 0.2), 0.024, 0)]
    parts += [box((x + a, -0.3, -0.18), (x + b, 0.25, 0.1), 0.024, 0) for a, b in ((-0.2, -0.18), (0.18, 0.2))]
    parts += [box((x - 0.2, -0.3, -0.18), (x + 0.2, 0.25, -0.16), 0.024, 0)]
    return posed(concatenate(parts), {0: prismatic(FORWARD, out)})


def test_two_plain_drawers_are_not_one_that_changed_places() -> None:
    """One motion meets all of both boxes and explains more; but each of two slides lays a front on one that is shut."""
    walls = [box((-0.5, 0.3, -0.25), (0.5, 0.33, 0.25), 0.024, 0)]
    walls += [box((-0.5, -0.3, z), (0.5, 0.33, z + 0.03), 0.024, 0) for z in (-0.25, 0.22)]
    walls += [box((x, -0.3, -0.25), (x + 0.03, 0.33, 0.25), 0.024, 0) for x in (-0.5, -0.015, 0.47)]
    states = [concatenate([*walls, drawer(-0.25, a), drawer(0.25, b)]) for a, b in ((0.35, 0.0), (0.0, 0.4))]
    states = [replace(g, sh=0 * g.sh) for g in states]
    cameras = [c for c in cameras_around(40, 96) if c.centre[2] > 0.3 and c.centre[1] < 0.8]
    views = tuple([photograph(g, c) for c in cameras] for g in states)
    low, high, surfaces = survey((states[0], states[1]), (views[0], views[1]), ((), ()), CONFIG)
    extent = float((high - low).max())
    shut, opened = (Motion("prismatic", FORWARD, np.zeros(3), value, 1.0) for value in (-0.35, 0.4))
    aside = np.array([0.5, 0, 0]) + 0.05 * FORWARD
    swap = Motion("prismatic", aside / np.linalg.norm(aside), np.zeros(3), float(np.linalg.norm(aside)), 1.0)
    motions = [shut, opened, swap]
    choices = Choices(Labelling.of(surfaces, extent), [m.T for m in motions])

    def exchanged(kept: set[int]) -> list[int]:
        taken = np.isin(np.arange(3), list(kept))
        return [k for k in sorted(kept) if changed_places(choices, motions, kept, k, taken, extent)]

    alone = choices.gains(frozenset())
    assert alone[2] > alone[0] + choices.gains(frozenset({0}))[1]
    assert exchanged({2}) == [2] and exchanged({0, 1, 2}) == [2] and exchanged({0, 1}) == []
