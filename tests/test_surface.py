"""What one state shows of itself: points on its visible surface."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from hingesplat.gaussians import SH_C0, Gaussians, concatenate
from hingesplat.stereo import DepthMap, fused, measured
from hingesplat.surface import Surface, bounds, surface_of, thin
from hingesplat.visibility import FREE, SURFACE, ask
from scenes import (
    in_the_hollow,
    off_boards,
    one_thread,  # noqa: F401
    open_box,
    sheet,
)

SIZE = 96
SPACING = 0.04
TOLERANCE = 0.02


@cache
def fit() -> Gaussians:
    """The open box as a good fit has it."""
    cloud = fused(measured(open_box(SIZE), SIZE), 0.9 * SPACING)
    return sheet(cloud.points, cloud.normals, cloud.colours, 0.03)


@cache
def lid() -> Gaussians:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.36, 0.36, 20), np.linspace(-0.26, 0.26, 15)))
    points = np.column_stack([x, y, np.full(x.shape, 0.3)])
    return sheet(points, np.tile([0.0, 0, 1], (len(points), 1)), np.full(points.shape, 0.5), 0.03)


def known_where(positive: bool) -> list[DepthMap]:
    """Depth of what lies at x > 0, or of everything."""
    maps = measured(open_box(SIZE), SIZE)
    if not positive:
        return maps
    half = []
    for m in maps:
        depth = m.depth.copy()
        y, x = np.nonzero(depth)
        gone = m.camera.lifted(x, y, depth[y, x])[:, 0] <= 0
        depth[y[gone], x[gone]] = 0
        half.append(replace(m, depth=depth))
    return half


@cache
def surface(lidded: bool, maps: str) -> Surface:
    known = {"none": [], "half": known_where(True), "all": known_where(False)}[maps]
    gaussians = concatenate([fit(), lid()]) if lidded else fit()
    return surface_of(gaussians, open_box(SIZE), known, SIZE, SPACING, TOLERANCE)


def cells(points: np.ndarray) -> np.ndarray:
    return np.floor(points / SPACING).astype(int)


def rows_of(points: np.ndarray, among: np.ndarray) -> np.ndarray:
    """(n,) bool: points that are, to the last digit, among others."""
    return np.all(np.isin(points.astype(np.float32), among.astype(np.float32)), axis=1)


def test_without_maps_it_is_the_gaussians_that_cameras_see() -> None:
    s = surface(False, "none")
    means = fit().means.numpy()
    assert rows_of(s.points, means).all()
    assert 0.8 < len(s.points) / len(means) <= 1
    answer = ask(s.points, s.colours, s.sight)
    assert (answer[:, SURFACE] >= 2).all()
    assert (answer[:, FREE] <= 0.15 * answer[:, :3].sum(1)).all()


def test_points_are_spread_evenly_on_known_depth() -> None:
    s = surface(False, "all")
    assert len(np.unique(cells(s.points), axis=0)) == len(s.points) > 1000
    assert (off_boards(s.points) < 0.5 * SPACING).mean() > 0.98
    np.testing.assert_allclose(np.linalg.norm(s.normals, axis=1), 1, atol=1e-6)
    assert in_the_hollow(s.points).sum() > 300


def test_gaussians_fill_in_where_maps_know_nothing() -> None:
    s = surface(False, "half")
    gaussian = rows_of(s.points, fit().means.numpy())
    x = s.points[:, 0]
    assert (x[gaussian] < 3 * SPACING).mean() > 0.99 and (x[~gaussian] > -0.01).all()
    whole = surface(False, "none").points
    assert gaussian.sum() == pytest.approx((whole[:, 0] < -2 * SPACING).sum(), rel=0.1)
    expected = (fit().sh[:, 0] * SH_C0 + 0.5).numpy()
    of = [int(np.abs(fit().means.numpy() - p).sum(1).argmin()) for p in s.points[gaussian][:20]]
    np.testing.assert_allclose(s.colours[gaussian][:20], expected[of], atol=1e-6)


def test_a_lid_is_surface_until_it_is_seen_through() -> None:
    def on_lid(s: Surface) -> int:
        return int((np.abs(s.points - [0, 0, 0.3]) < [0.34, 0.24, 0.01]).all(1).sum())

    assert on_lid(surface(True, "none")) > 200
    assert on_lid(surface(True, "half")) <= 10
    assert on_lid(surface(True, "all")) == 0


def test_faint_gaussians_and_floaters_are_no_surface() -> None:
    faint = replace(fit(), logit_opacities=torch.full((len(fit()),), -3.0))
    assert len(surface_of(faint, open_box(SIZE)[::3], [], SIZE, SPACING, TOLERANCE).points) == 0
    floater = replace(lid(), means=lid().means + torch.tensor([0.0, 0.0, 0.4]))
    s = surface_of(concatenate([fit(), floater]), open_box(SIZE), [], SIZE, SPACING, TOLERANCE)
    assert (s.points[:, 2] < 0.5).all() and len(s.points) > 1000


def test_rows_are_seen_by_the_same_cameras_and_make_a_sheet() -> None:
    s = surface(False, "all")
    few = s.rows(np.arange(0, 100, 7))
    assert few.sight is s.sight and len(few.points) == 15
    for name in ("points", "colours", "normals"):
        np.testing.assert_array_equal(getattr(few, name), getattr(s, name)[:100:7])
        assert getattr(few.cloud, name) is getattr(few, name)


def test_blurred_is_the_mean_of_neighbours() -> None:
    s = surface(False, "all")
    grey = replace(s, colours=np.full(s.colours.shape, 0.3))
    np.testing.assert_allclose(grey.blurred(), 0.3)
    assert s.blurred().std(0).max() < s.colours.std(0).max()
    np.testing.assert_allclose(s.blurred(1), s.colours)
    few = s.rows(np.arange(3))
    np.testing.assert_allclose(few.blurred(), np.tile(few.colours.mean(0), (3, 1)))
    np.testing.assert_allclose(s.rows(np.arange(1)).blurred(), s.colours[:1])


def test_bounds_have_a_margin_and_forget_stragglers() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 1, (5000, 3)) * [1, 2, 0.5], rng.uniform([0, 1, 0], [1, 2, 1], (5000, 3))
    low, high = bounds([a, b])
    np.testing.assert_allclose(low, [-0.06, -0.06, -0.06], atol=0.015)
    np.testing.assert_allclose(high, [1.06, 2.06, 1.06], atol=0.015)
    straying = np.concatenate([b, [[50.0, -50.0, 50.0]] * 5])
    np.testing.assert_allclose(bounds([a, straying]), (low, high), atol=0.03)


def test_thin_takes_one_random_point_of_each_cube() -> None:
    rng = np.random.default_rng(0)
    dense, sparse = rng.uniform(0, 1, (5000, 3)), rng.uniform(1, 3, (300, 3))
    points = np.concatenate([dense, sparse])
    chosen = thin(points, 0.2, np.random.default_rng(1))
    occupied = np.unique(np.floor(points / 0.2).astype(int), axis=0)
    taken = np.floor(points[chosen] / 0.2).astype(int)
    assert len(np.unique(taken, axis=0)) == len(chosen) == len(occupied)
    np.testing.assert_array_equal(chosen, thin(points, 0.2, np.random.default_rng(1)))
    assert set(chosen) != set(thin(points, 0.2, np.random.default_rng(2)))
    half = chosen[: len(chosen) // 2]  # In random order, so that the first few are spread as well.
    assert (points[half] < 1).all(1).mean() == pytest.approx((points[chosen] < 1).all(1).mean(), abs=0.1)
