"""Redundant slots die; parts that are different stay."""

import numpy as np
import pytest

from hingesplat.screw import prismatic, revolute
from hingesplat.slots import SlotsConfig, living_slots

UP, TURN = prismatic([0, 0, 1], 0.2), revolute([0.0, 0, 1], [0.0, 0, 0], 0.5)


def block(x: float, n: int = 300, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((x, 0, 0), (x + 0.3, 0.3, 0.3), (n, 3))


def living(points: np.ndarray, part: np.ndarray, *motions: np.ndarray) -> tuple[np.ndarray, list[int]]:
    T = np.stack([np.tile(np.eye(4), (1 + len(motions), 1, 1)), np.stack([np.eye(4), *motions])])
    return living_slots(points, part, T, 1.0, SlotsConfig())


@pytest.fixture
def three() -> tuple[np.ndarray, np.ndarray]:
    """Base and two blocks that touch each other."""
    return np.concatenate([block(x, seed=i) for i, x in enumerate((0, 0.4, 0.7))]), np.repeat([0, 1, 2], 300)


def test_parts_that_move_differently_live(three) -> None:
    label, slots = living(*three, UP, TURN)
    assert slots == [0, 1, 2]
    np.testing.assert_array_equal(label, three[1])


def test_an_empty_slot_dies_and_numbers_close_up(three) -> None:
    points, part = three
    label, slots = living(points, np.where(part == 2, 3, part), UP, TURN, TURN)
    assert slots == [0, 1, 3]
    np.testing.assert_array_equal(label, part)


def test_a_slot_with_few_points_leaves_them_to_their_neighbours(three) -> None:
    points, part = three
    few = part.copy()
    few[[310, 320]] = 3
    label, slots = living(points, few, UP, TURN, prismatic([1, 0, 0], 0.5))
    assert slots == [0, 1, 2]
    np.testing.assert_array_equal(label, part)


def test_two_slots_with_one_motion_are_one_part_if_they_touch(three) -> None:
    points, part = three
    label, slots = living(points, part, UP, prismatic([0, 0, 1], 0.201))
    assert slots == [0, 1]
    np.testing.assert_array_equal(label, np.minimum(part, 1))
    apart = points + 0.4 * (part == 2)[:, None] * [1, 0, 0]
    assert living(apart, part, UP, UP)[1] == [0, 1, 2]


def test_a_slot_that_does_not_move_is_the_base(three) -> None:
    points, part = three
    label, slots = living(points, part, prismatic([1, 0, 0], 0.001), UP)
    assert slots == [0, 2]
    np.testing.assert_array_equal(label, (part == 2).astype(int))


def test_nothing_may_be_left_but_the_base(three) -> None:
    points, part = three
    label, slots = living(points, np.full_like(part, 1), np.eye(4), np.eye(4))
    assert slots == [0] and not label.any()
