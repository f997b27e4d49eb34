"""A drawer: what one state alone shows of it is its own, and what its cabinet hides goes on as it was last seen."""

from dataclasses import replace

import numpy as np
import pytest

from hingesplat.drawer import behind_fronts, insides
from hingesplat.drawer_box import drawn_out
from hingesplat.screw import prismatic, revolute
from hingesplat.surface import Surface
from hingesplat.tsdf import DistanceGrid
from hingesplat.visibility import Sight

OUT = prismatic([0, -1, 0], 0.3)
"""From state 0, shut, to state 1."""


def tray(depth: float) -> np.ndarray:
    """Points of a drawer, open: its front at y = 0 and its bottom and sides as deep as photographs see."""
    u = np.linspace(0, 1, 40)
    a, b = (x.ravel() for x in np.meshgrid(u, u))
    front = np.stack([0.6 * a - 0.3, 0 * a, 0.24 * b - 0.02], 1)
    bottom = np.stack([0.5 * a - 0.25, depth * b, 0 * a], 1)
    sides = [np.stack([0 * a + x, depth * b, 0.2 * a], 1) for x in (-0.25, 0.25)]
    return np.concatenate([front, bottom, *sides])


def surface(points: np.ndarray) -> Surface:
    nobody = Sight(np.zeros((0, 3, 4)), np.zeros((0, 1, 1), np.float32), np.zeros((0, 1, 1, 3), np.float32), 0.01)
    n = len(points)
    return Surface(points, np.full((n, 3), 0.5), np.tile([0.0, 0, 1], (n, 1)), np.zeros(n), nobody)


@pytest.mark.parametrize("hides", [True, False])
@pytest.mark.parametrize("T", [OUT, revolute([0, 0, 1], [0.3, 0, 0], 0.5)])
def test_what_lies_in_a_drawer_is_the_drawers(monkeypatch: pytest.MonkeyPatch, hides: bool, T: np.ndarray) -> None:
    monkeypatch.setattr("hingesplat.drawer.hidden", lambda some, *_: np.full(len(some.points), hides))
    u = np.linspace(-0.2, 0.2, 9)
    a, b = (x.ravel() for x in np.meshgrid(u, u))
    deep = np.stack([a, 0.4 + 0.2 * b, 0 * a + 0.01], 1)
    floor, frame = np.stack([a, 0.4 + 0.2 * b, 0 * a - 0.04], 1), np.stack([a, 0 * a + 0.02, 0 * a + 0.26], 1)
    mine = tray(0.3)
    there = np.concatenate([mine, deep, floor, frame])
    here = np.concatenate([mine[:1600] + np.array([0, 0.3, 0]), floor])
    owned = np.repeat([1, 0], [1600, 81]), np.repeat([1, 0], [len(mine), 243])
    found = insides([T], owned, (surface(here), surface(there)), 1.0)
    np.testing.assert_array_equal(found[0], owned[0])
    expected = owned[1].copy()
    expected[len(mine) : len(mine) + 81] = hides and T is OUT
    np.testing.assert_array_equal(found[1], expected)


@pytest.mark.parametrize("slides", [True, False])
def test_what_is_behind_a_drawers_front_is_that_drawers(slides: bool) -> None:
    """Of two, one above the other, each motion hides the walls of the other, too."""
    lower = tray(0.3)
    upper_front = lower[:1600] + np.array([0, 0, 0.4])
    walls = len(lower) - 1600
    points = np.concatenate([lower, upper_front])
    given = np.repeat(
        [1, 2, 2], [1600, walls, 1600]
    )  # Labels of the lower drawer's front and walls, and the upper front.
    may = np.ones(len(points), bool)
    firm_lower, firm_upper = np.arange(len(points)) < 1600, np.arange(len(points)) >= len(lower)
    told = [np.stack([~firm_upper, ~may]), np.stack([~firm_lower, ~firm_upper])]
    T = [OUT if slides else revolute([0, 0, 1], [0.3, 0, 0], 0.5), prismatic([0, -1, 0], 0.2)]
    for found in behind_fronts(T, (given, given), (surface(points),) * 2, 1.0, (told, told)):
        wanted = given.copy()
        wanted[1600 : 1600 + walls] = 1 if slides else 2
        np.testing.assert_array_equal(found, wanted)


def grid(full: bool = False) -> DistanceGrid:
    """The same drawer as voxels of 0.01: seen for 0.15, unknown behind."""
    lower, shape = np.array([-0.35, -0.05, -0.07]), (71, 36, 36)
    x, y, z = lower[:, None, None, None] + 0.01 * np.indices(shape)
    front = (np.abs(x) < 0.3) & (np.abs(y) < 0.015) & (z > -0.02) & (z < 0.22)
    outer = (np.abs(x) < 0.265) & (z > -0.015) & (z < 0.2) & (y > 0) & (y < 0.15)
    hollow = (np.abs(x) < 0.235) & (z > 0.015) & (not full)
    solid = front | (outer & ~hollow)
    return DistanceGrid(lower, 0.01, 0.025, np.where(solid, -1, 1).astype(np.float32), (y < 0.15).astype(np.float32))


BACK = np.stack([x.ravel() for x in np.meshgrid(np.linspace(-0.3, 0.3, 31), [0.9], np.linspace(-0.1, 0.3, 21))], 1)


def solid_at(found: DistanceGrid, *place: float) -> bool:
    i = tuple(np.round((np.array(place) - found.lower) / found.voxel).astype(int))
    inside = all(0 <= a < n for a, n in zip(i, found.distance.shape, strict=True))
    return inside and bool(found.distance[i] < 0)


def test_a_drawer_goes_on_to_the_back_of_its_cabinet() -> None:
    part = grid()
    found = drawn_out(part, tray(0.15), BACK, [np.eye(4), OUT], (0.02, 0.04))
    for y in (0.1, 0.3, 0.6, 0.8):
        assert solid_at(found, 0, y, 0) and solid_at(found, 0.25, y, 0.1) and solid_at(found, -0.25, y, 0.1)
        assert not solid_at(found, 0, y, 0.1) and not solid_at(found, 0, y, -0.05) and not solid_at(found, 0.3, y, 0.1)
    assert solid_at(found, 0, 0.85, 0.1) and not solid_at(found, 0, 0.88, 0.1)
    # What was seen is what it was.
    shift = np.round((part.lower - found.lower) / part.voxel).astype(int)
    window = tuple(slice(a, a + n) for a, n in zip(shift, part.distance.shape, strict=True))
    np.testing.assert_array_equal(found.distance[window][part.weight > 0], part.distance[part.weight > 0])


def test_a_drawer_seen_open_alone_ends_where_it_would_be_when_shut() -> None:
    found = drawn_out(grid(), tray(0.15), BACK, [np.eye(4), np.linalg.inv(OUT)], (0.02, 0.04))
    assert solid_at(found, 0, 0.55, 0.1) and not solid_at(found, 0, 0.58, 0.1)


def test_a_drawer_that_was_always_ajar_ends_where_it_would_be_when_shut() -> None:
    x, z = (a.ravel() for a in np.meshgrid(np.linspace(-0.29, 0.29, 40), np.linspace(-0.01, 0.21, 20)))
    rim = (np.abs(x) > 0.275) | (z > 0.203)
    frame = np.stack([x, 0 * x + 0.12, z], 1)[rim]
    depth = np.linspace(0.12, 0.9, 40)
    sides = np.stack([np.repeat([-0.29, 0.29], 40), np.tile(depth, 2), np.full(80, 0.1)], 1)

    def ends_at(base: np.ndarray, y: float) -> bool:
        found = drawn_out(grid(), tray(0.15), base, [np.eye(4), OUT], (0.02, 0.04))
        return any(solid_at(found, 0, y + d, 0.1) for d in (-0.02, -0.01, 0)) and not solid_at(found, 0, y + 0.02, 0.1)

    assert ends_at(np.concatenate([BACK, frame, sides]), 0.76) and ends_at(np.concatenate([BACK, frame]), 0.76)
    assert ends_at(np.concatenate([BACK, sides]), 0.86)  # Without a frame, nothing tells.


@pytest.mark.parametrize("why", ["turns", "stands still", "is full", "nothing is behind"])
def test_what_is_no_drawer_stays_as_it_is(why: str) -> None:
    way = {"turns": revolute([0, 0, 1], [0.3, 0, 0], 0.5), "stands still": np.eye(4)}.get(why, OUT)
    part, back = grid(full=why == "is full"), BACK[:0] if why == "nothing is behind" else BACK
    assert drawn_out(part, tray(0.15), back, [np.eye(4), way], (0.02, 0.04)) is part


def test_a_drawer_whose_back_was_seen_ends_there_but_no_strip_of_its_floor_is_a_back() -> None:
    u, z = (a.ravel() for a in np.meshgrid(np.linspace(-0.23, 0.23, 30), np.linspace(0.03, 0.15, 8), indexing="ij"))
    back = np.stack([u, 0 * u + 0.3, z], 1)

    def ends_with(more: np.ndarray) -> bool:
        found = drawn_out(grid(), np.concatenate([tray(0.15), more]), BACK, [np.eye(4), OUT], (0.02, 0.04))
        return solid_at(found, 0, 0.31, 0.1) and not solid_at(found, 0, 0.35, 0)

    assert ends_with(back)
    assert not ends_with(back[12 * 8 : 18 * 8])  # Something in it.
    assert not ends_with(back[z < 0.06])


@pytest.mark.parametrize("way", [[1, 0, 0], [0, -1, 0]])
def test_a_flat_part_has_no_section(way: list[float]) -> None:
    plate = tray(0.15)[:1600]
    part = grid()
    assert drawn_out(part, plate, BACK, [np.eye(4), prismatic(way, 0.3)], (0.02, 0.04)) is part


@pytest.mark.parametrize("something_in_it", [False, True])
def test_a_bottom_that_was_always_hidden_is_there_and_an_open_top_stays_open(something_in_it: bool) -> None:
    part = grid()
    z = part.lower[2] + 0.01 * np.arange(36)
    below = np.broadcast_to((z < 0.06) & (z > -0.06), part.distance.shape).copy()
    below[:, :8] = False  # The front was seen.
    x = np.abs(part.lower[0] + 0.01 * np.arange(71))
    below[x > 0.23] = False  # So were the sides.
    part = replace(part, weight=np.where(below, 0, part.weight), distance=np.where(below, 1, part.distance))
    if something_in_it:
        part.distance[15:56, 8:, 13:16] = -1  # At z = 0.06 to 0.08.
    found = drawn_out(part, tray(0.15), BACK, [np.eye(4), OUT], (0.02, 0.04))
    for y in (0.1, 0.3, 0.6):
        assert solid_at(found, 0, y, -0.01) and solid_at(found, 0.25, y, 0.1)
        assert not solid_at(found, 0, y, 0.1) and not solid_at(found, 0, y, 0.19) and not solid_at(found, 0, y, -0.05)


def test_what_nobody_saw_of_a_drawer_is_as_thick_as_its_walls() -> None:
    part = grid()
    x = np.abs(part.lower[0] + 0.01 * np.arange(71))[:, None, None]
    beside = np.broadcast_to(x > 0.245, part.distance.shape).copy()
    beside[:, :8] = False  # The front was seen.
    guess = beside & (x < 0.3)  # As thick as walls that nobody measured.
    part = replace(part, weight=np.where(beside, 0, part.weight), distance=np.where(guess, -1, part.distance))
    found = drawn_out(part, tray(0.15), BACK, [np.eye(4), OUT], (0.05, 0.04))
    for y in (0.06, 0.12, 0.3, 0.6):
        assert solid_at(found, 0.25, y, 0.1) and not solid_at(found, 0.29, y, 0.1)


def test_a_wall_with_a_ragged_end_goes_on_from_where_it_was_whole() -> None:
    part = grid()
    notch = part.distance.copy()
    notch[61 - 5 : 61 + 5, 16:, 12:] = 1  # Of the wall at x = 0.25, behind y = 0.11: seen to be free, by mistake.
    found = drawn_out(replace(part, distance=notch), tray(0.15), BACK, [np.eye(4), OUT], (0.02, 0.04))
    assert all(solid_at(found, x, y, 0.15) for x in (-0.25, 0.25) for y in (0.12, 0.14, 0.3))
