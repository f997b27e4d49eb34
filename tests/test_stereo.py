"""Depth from photographs that are compared with their neighbours, and the clouds made of it."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
import torch

from hingesplat.camera import Camera
from hingesplat.capture import View, visual_hull
from hingesplat.stereo import (
    WITNESSES,
    Cloud,
    DepthMap,
    Picture,
    StereoConfig,
    confirmed,
    cubes,
    depth_map,
    fused,
    measured,
    normals_by_neighbours,
    seen_through,
    stereo,
    sweep,
    witnesses,
)
from scenes import (
    in_the_hollow,
    off_boards,
    one_thread,  # noqa: F401
    open_box,
    texture,
)

SIZE = 96
CONFIG = StereoConfig(image_size=SIZE, planes=64)
SMALL = StereoConfig(image_size=40, planes=24)


def share(yes: np.ndarray) -> float:
    return float(yes.mean())


def known(maps: Iterable[DepthMap], views: Iterable[View]) -> tuple[np.ndarray, np.ndarray]:
    """Depth found and true depth of all pixels that show the object."""
    pairs = [(m.depth[t > 0], t[t > 0]) for m, v in zip(maps, views, strict=True) if (t := v.depth) is not None]
    found, true = map(np.concatenate, zip(*pairs, strict=True))
    return found, true


@pytest.fixture(scope="module")
def maps() -> list[DepthMap]:
    return stereo(open_box(SIZE), CONFIG)


# Whole photographs.


def test_witnesses_are_all_of_few_and_an_even_pick_of_many() -> None:
    assert list(witnesses(0)) == [] and list(witnesses(WITNESSES)) == list(range(WITNESSES))
    for count in (WITNESSES + 1, 200, 400):
        picked = witnesses(count)
        assert WITNESSES / 2 < len(picked) <= WITNESSES and count - picked[-1] <= picked.step


def test_confirmed_depth_is_right_and_mostly_there(maps: list[DepthMap]) -> None:
    found, true = known(maps, open_box(SIZE))
    error = np.abs(found - true)[found > 0]
    assert share(found > 0) > 0.8
    assert share(error < 0.015) > 0.78
    assert share(error < 0.03) > 0.9  # The rest is at edges, where the neighbour's depth is found.
    assert abs(np.median((found - true)[found > 0])) < 0.002


def test_points_lie_on_the_surface_also_in_the_hollow_that_the_hull_closes(maps: list[DepthMap]) -> None:
    points = np.concatenate([m.points()[0] for m in maps])
    assert share(off_boards(points) < 0.01) > 0.85
    inner = points[in_the_hollow(points)]
    assert len(inner) > 10_000
    assert share(off_boards(inner) < 0.015) > 0.9
    hull, voxel = visual_hull(open_box(SIZE), 64)
    lid = np.linalg.norm(hull - [0, 0, 0.2], axis=1) < 2 * voxel
    assert lid.any() and (seen_through(hull[lid], maps, 2 * voxel) >= 5).all()


def test_depth_is_only_where_the_object_is_and_colours_are_the_photographs(maps: list[DepthMap]) -> None:
    for m, view in zip(maps, open_box(SIZE), strict=True):
        alpha = view.rgba[..., 3:] / 255
        assert (m.depth[alpha[..., 0] < 0.5] == 0).all()
        np.testing.assert_allclose(m.rgb, view.rgba[..., :3] / 255 * alpha + 1 - alpha, atol=1e-6)


def test_what_has_no_texture_stays_unknown() -> None:
    views = open_box(SIZE, grey=True)
    found, true = known(stereo(views, CONFIG), views)
    assert share(found > 0) < 0.1  # Outlines are all that can be compared.
    assert share((found > 0) & (np.abs(found - true) > 0.05)) < 0.07


@pytest.mark.parametrize("n", [1, 2])
def test_fewer_photographs_than_must_agree_tell_nothing(n: int) -> None:
    maps = stereo(open_box(SIZE)[:n], SMALL)
    assert len(maps) == n
    assert all((m.depth == 0).all() for m in maps)


def test_depth_grows_with_the_scene() -> None:
    views = open_box(SIZE)[:12]
    larger = [replace(v, camera=replace(v.camera, T_world_camera=grown(v.camera.T_world_camera))) for v in views]
    for small, large in zip(stereo(views, SMALL), stereo(larger, SMALL), strict=True):
        assert small.depth.shape == (40, 40) and small.camera.width == 40
        both = (small.depth > 0) & (large.depth > 0)
        assert both.sum() > 0.95 * (small.depth > 0).sum() > 0
        np.testing.assert_allclose(np.median(large.depth[both] / small.depth[both]), 4, rtol=1e-3)


def grown(T: np.ndarray) -> np.ndarray:
    """A camera's pose in a scene four times as large, somewhere else."""
    T = T.copy()
    T[:3, 3] = 4 * T[:3, 3] + [1, 2, 3]
    return T


def test_threads_change_nothing() -> None:
    views = open_box(SIZE)[::3]
    one = stereo(views, SMALL)
    torch.set_num_threads(3)  # Taken back by the fixture.
    for a, b in zip(one, stereo(views, SMALL), strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)


# A wall two units away, parallel to the pictures.

DISTANCE = 2.0
PLANES = 1 / np.linspace(1 / 1.5, 1 / 3, 20)


def facing(x: float, y: float = 0.0, size: int = 40) -> Camera:
    """A camera in the plane z = 0 that looks along z."""
    T = np.eye(4)
    T[:2, 3] = x, y
    return Camera(T, 1.2 * size, 1.2 * size, size / 2, size / 2, size, size)


def wall(camera: Camera) -> Picture:
    y, x = np.mgrid[: camera.height, : camera.width]
    points = camera.lifted(x.ravel(), y.ravel(), np.full(x.size, DISTANCE))
    rgb = texture(2 * points, 4).reshape(*x.shape, 3)
    return Picture(camera, np.dstack([rgb, np.ones(x.shape)]).astype(np.float32))


def test_depth_is_found_between_the_planes() -> None:
    others = [wall(facing(x, y)) for x, y in ((0.2, 0.0), (-0.2, 0.05), (0.0, 0.2))]
    depth = sweep(wall(facing(0)), others, PLANES, SMALL)
    at = np.searchsorted(PLANES, DISTANCE)
    step = PLANES[at] - PLANES[at - 1]
    assert np.abs(PLANES - DISTANCE).min() > 0.4 * step
    assert np.median(np.abs(depth - DISTANCE)) < 0.3 * step
    assert share(np.abs(depth - DISTANCE) < step) > 0.9


def test_a_plain_strip_takes_its_depth_from_both_sides() -> None:
    def striped(camera: Camera) -> Picture:
        picture = wall(camera)
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx * DISTANCE + camera.centre[0]
        picture.rgba[:, np.abs(x) < 0.25, :3] = 0.5
        return picture

    others = [striped(facing(x, y)) for x, y in ((0.2, 0.0), (-0.2, 0.05), (0.0, 0.2))]
    target = striped(facing(0))
    strip = (target.rgba[..., :3] == 0.5).all(-1)
    step = np.diff(PLANES)[np.searchsorted(PLANES, DISTANCE) - 1]

    def right(config: StereoConfig) -> float:
        return share((np.abs(sweep(target, others, PLANES, config) - DISTANCE) < step)[strip])

    assert 0.05 < strip.mean() < 0.6
    assert right(replace(SMALL, bend=0, jump=0)) < 0.7 < 0.8 < right(SMALL)


def test_pictures_that_show_something_else_are_outvoted() -> None:
    others = [wall(facing(0.2)), wall(facing(-0.2))]
    rng = np.random.default_rng(0)
    noise = [replace(p, rgba=rng.uniform(0, 1, p.rgba.shape).astype(np.float32)) for p in others]
    depth = sweep(wall(facing(0)), [*noise, *others], PLANES, SMALL)
    assert share(np.abs(depth - DISTANCE) < 0.05) > 0.9
    all_must = sweep(wall(facing(0)), [*noise, *others], PLANES, replace(SMALL, best=4))
    assert share(np.abs(all_must - DISTANCE) < 0.02) < share(np.abs(depth - DISTANCE) < 0.02)


def test_an_empty_picture_has_no_depth_and_a_masked_one_only_inside() -> None:
    whole = wall(facing(0))
    hole = whole.rgba.copy()
    hole[:10, :, 3] = 0
    hole[20, 20, 3] = 0
    depth = sweep(replace(whole, rgba=hole), [wall(facing(0.2)), wall(facing(-0.2))], PLANES, SMALL)
    np.testing.assert_array_equal(depth > 0, hole[..., 3] > 0)
    empty = replace(whole, rgba=np.zeros_like(whole.rgba))
    assert (sweep(empty, [whole], PLANES, SMALL) == 0).all()


# Maps made by hand.


def flat(depth: float | np.ndarray, camera: Camera | None = None, rgb: float = 0.5) -> DepthMap:
    camera = camera or facing(0)
    shape = camera.height, camera.width
    return DepthMap(camera, np.broadcast_to(depth, shape).astype(np.float32), np.full((*shape, 3), rgb, np.float32))


def test_points_are_where_their_pixels_are() -> None:
    camera = open_box(SIZE)[3].camera
    depth = np.random.default_rng(0).uniform(1, 3, (SIZE, SIZE)).astype(np.float32)
    depth[::2] = 0
    rgb = np.random.default_rng(1).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    points, colours = DepthMap(camera, depth, rgb).points()
    uv, z = camera.project(points)
    x, y = np.floor(uv).astype(int).T
    assert len(points) == SIZE * SIZE / 2 and (y % 2 == 1).all()
    np.testing.assert_allclose(z, depth[y, x], rtol=1e-6)
    np.testing.assert_allclose(uv, np.column_stack([x, y]) + 0.5, atol=1e-4)
    np.testing.assert_array_equal(colours, rgb[y, x])


def test_depth_that_no_other_map_confirms_is_dropped() -> None:
    wrong = np.full((40, 40), 2.0)
    wrong[10:20, 10:20] = 1.5
    maps = [flat(wrong), flat(2.0, facing(0.05)), flat(2.0, facing(0, 0.05))]
    kept = confirmed(0, maps, 0.02, 2)
    assert (kept[10:20, 10:20] == 0).all()
    assert (kept[22:36, 22:36] == 2).all()  # Within sight of all three.
    assert (kept[(kept > 0)] == 2).all()
    assert (confirmed(0, maps, 0.02, 3) == 0).all()
    assert confirmed(0, maps, 0.6, 2)[15, 15] == 1.5
    assert (confirmed(0, [maps[0], flat(0.0), flat(0.0)], 0.02, 1) == 0).all()


@pytest.mark.parametrize(("through", "kept"), [(4, True), (5, False)])
def test_twice_as_many_that_see_through_outvote_those_that_confirm(through: int, kept: bool) -> None:
    maps = [flat(2.0)] * 3 + [flat(3.0)] * through
    assert (confirmed(0, maps, 0.02, 2) == (2 if kept else 0)).all()


def test_what_is_in_front_neither_confirms_nor_contradicts() -> None:
    assert (confirmed(0, [flat(2.0)] * 3 + [flat(1.5)] * 9, 0.02, 2) == 2).all()


def test_seen_through_counts_the_maps_that_see_behind() -> None:
    maps = [flat(2.0), flat(2.5), flat(0.0), flat(3.0, facing(50.0))]
    on_axis = np.column_stack([np.zeros((6, 2)), [1.0, 1.95, 2.2, 2.45, 3.0, -1.0]])
    assert seen_through(on_axis, maps, 0.1).tolist() == [2, 1, 1, 0, 0, 0]
    aside = np.array([[5.0, 0.0, 1.0], [50.0, 0.0, 1.0]])
    assert seen_through(aside, maps, 0.1).tolist() == [0, 1]
    assert seen_through(on_axis, [], 0.1).tolist() == [0] * 6


def test_fused_is_the_mean_of_each_cell_with_two_pixels() -> None:
    rng = np.random.default_rng(0)
    maps = [flat(rng.uniform(1.9, 2.1, (40, 40)), facing(x)) for x in (0.0, 0.1)]
    maps = [replace(m, rgb=rng.uniform(0, 1, m.rgb.shape).astype(np.float32)) for m in maps]
    size = 0.07
    cells = defaultdict(list)
    for m in maps:
        for p, c in zip(*m.points(), strict=True):
            cells[tuple(np.floor(p / size).astype(int))].append(np.concatenate([p, c]))
    expected = {cell: np.mean(rows, 0) for cell, rows in cells.items() if len(rows) >= 2}
    cloud = fused(maps, size)
    assert 0 < len(cloud) == len(expected) < len(cells)
    for p, c in zip(cloud.points, cloud.colours, strict=True):
        np.testing.assert_allclose(np.concatenate([p, c]), expected[tuple(np.floor(p / size).astype(int))], atol=1e-9)


def test_normals_are_unit_and_towards_the_camera() -> None:
    assert np.abs(fused([flat(2.0)], 0.1).normals - [0, 0, -1]).max() < 1e-6
    T = np.diag([1.0, -1, -1, 1])
    T[2, 3] = 4
    assert np.abs(fused([flat(2.0, replace(facing(0), T_world_camera=T))], 0.1).normals - [0, 0, 1]).max() < 1e-6
    cloud = fused(measured(open_box(SIZE), SIZE), 0.03)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-9)
    floor = in_the_hollow(cloud.points) & (np.abs(cloud.points[:, :2]) < [0.35, 0.25]).all(1)
    assert floor.any() and (cloud.normals[floor, 2] > 0.99).all()
    outside = (cloud.points[:, 0] > 0.49) & (np.abs(cloud.points[:, 1:]) < 0.3).all(1)
    assert outside.any() and (cloud.normals[outside, 0] > 0.99).all()
    within = (np.abs(cloud.points[:, 0] - 0.42) < 0.01) & (np.abs(cloud.points[:, 1:]) < 0.22).all(1)
    assert within.any() and (cloud.normals[within, 0] < -0.99).all()


def test_no_maps_and_empty_maps_make_an_empty_cloud() -> None:
    for maps in ([], [flat(0.0)], [flat(0.0), flat(0.0)]):
        cloud = fused(maps, 0.1)
        assert len(cloud) == 0 and cloud.points.shape == cloud.colours.shape == cloud.normals.shape == (0, 3)


# Depth pictures.


def test_measured_is_the_depth_pictures() -> None:
    views = open_box(SIZE)[:3]
    for m, view in zip(measured(views, SIZE), views, strict=True):
        seen = view.rgba[..., 3] >= 128
        assert view.depth is not None and m.camera == view.camera
        np.testing.assert_array_equal(m.depth, np.where(seen, view.depth, 0))
        assert off_boards(m.points()[0]).max() < 1e-5
    smaller = measured(views, 40)[0]
    assert smaller.depth.shape == (40, 40) and (smaller.camera.width, smaller.camera.height) == (40, 40)
    assert share(off_boards(smaller.points()[0]) < 0.02) > 0.95
    assert measured(views, 10 * SIZE)[0].depth.shape == (SIZE, SIZE)  # Never larger than they are.


def test_without_depth_pictures_nothing_is_known() -> None:
    views = [replace(open_box(SIZE)[0], depth=None), open_box(SIZE)[1]]
    bare, with_depth = measured(views, SIZE)
    assert (bare.depth == 0).all() and bare.depth.shape == bare.rgb.shape[:2] == (SIZE, SIZE)
    assert (with_depth.depth > 0).any()


def test_a_saved_depth_gets_its_photograph_back() -> None:
    view = replace(open_box(SIZE)[0], rgba=open_box(SIZE)[0].rgba[:60], depth=None)
    view = replace(view, camera=view.camera.cropped(0, 0, SIZE, 60))
    depth = np.ones((30, 48), np.float32)
    m = depth_map(view, depth)
    assert m.depth is depth and m.rgb.shape == (30, 48, 3)
    assert (m.camera.width, m.camera.height) == (48, 30)


# Clouds.


def test_bare_points_are_grey_and_get_their_neighbours_normals() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 1, (200, 2)), np.zeros(200)])
    cloud = Cloud.of(points)
    assert len(cloud) == 200 and (cloud.colours == 0.5).all()
    np.testing.assert_allclose(np.abs(cloud.normals), np.tile([0, 0, 1.0], (200, 1)), atol=1e-6)


@pytest.mark.parametrize("n", [0, 1, 3, 5])
def test_a_handful_of_points_has_unit_normals(n: int) -> None:
    normals = normals_by_neighbours(np.random.default_rng(n).normal(size=(n, 3)))
    assert normals.shape == (n, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


def test_rows_and_joined_undo_each_other() -> None:
    rng = np.random.default_rng(0)
    cloud = Cloud(*rng.normal(size=(3, 10, 3)))
    again = cloud.rows(np.arange(4)).joined(cloud.rows(np.arange(4, 10)))
    for name, value in vars(cloud).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    mask = np.arange(10) % 2 == 0
    np.testing.assert_array_equal(cloud.rows(mask).normals, cloud.normals[::2])


def test_points_share_a_number_if_and_only_if_they_share_a_cube() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (500, 3))
    by_row = np.unique(np.floor(points / 0.7).astype(int), axis=0, return_inverse=True)[1].ravel()
    np.testing.assert_array_equal(np.unique(cubes(points, 0.7), return_inverse=True)[1], by_row)
    assert cubes(points[:0], 0.7).shape == (0,)
