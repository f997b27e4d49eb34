"""One state's photographs to Gaussians."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from hingesplat.capture import View, visual_hull
from hingesplat.fit import FLATNESS, FitConfig, fit, start_cloud, start_from_cloud
from hingesplat.gaussians import SH_C0, Gaussians
from hingesplat.optim import LearningRates
from hingesplat.register import normals_of
from hingesplat.stereo import Cloud, DepthMap, measured, seen_through
from hingesplat.training import mean_psnr, seen_weight, training_view
from scenes import (
    box_surface,
    cameras_around,
    in_the_hollow,
    off_boards,
    one_thread,  # noqa: F401
    open_box,
    photograph,
    sheet,
)

CORNER = np.array([0.5, 0.4, 0.45])
CONFIG = FitConfig(steps=200, start_gaussians=1200, max_gaussians=1600, max_sh_degree=1)


def painted_box() -> Gaussians:
    """Broad colours that a 48-pixel picture can show."""
    points, normals = box_surface(-CORNER, CORNER, 0.05)
    colours = 0.5 + 0.35 * np.sin(points @ np.array([[4.0, 1, 0], [0, 4, 1], [1, 0, 4]]) + normals)
    return sheet(points, normals, colours, 0.03)


@cache
def matt_views() -> tuple[View, ...]:
    return tuple(photograph(painted_box(), c) for c in cameras_around(20, 48))


@cache
def fitted() -> Gaussians:
    """The one fit that starts from the visual hull."""
    return fit(matt_views(), CONFIG)


def cloud() -> Cloud:
    """A rough start, as sparse points from elsewhere would be."""
    some = painted_box().means.numpy().astype(np.float64)
    return Cloud.of(some + np.random.default_rng(0).normal(0, 0.02, some.shape))


def grid(normal: np.ndarray) -> Cloud:
    """Points a tenth apart on a plane, all of another colour."""
    u = np.linalg.svd(normal[None])[2][1:]
    x, y = (a.ravel() * 0.1 for a in np.meshgrid(np.arange(6), np.arange(6)))
    points = x[:, None] * u[0] + y[:, None] * u[1] + [3.0, 2.0, 1.0]
    return Cloud(points, np.tile(normal, (36, 1)), np.random.default_rng(0).uniform(0, 1, points.shape))


@pytest.mark.parametrize(
    "normal", [[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [0.6, 0, 0.8], [-0.48, 0.64, -0.6], [0.6, -0.8, -1e-9]]
)
def test_start_is_a_disc_on_every_point_as_wide_as_its_neighbourhood(normal: list[float]) -> None:
    plane = grid(np.array(normal))
    g = start_from_cloud(plane, 0.5)
    np.testing.assert_allclose(g.means.numpy(), plane.points, atol=1e-6)
    np.testing.assert_allclose(np.abs((normals_of(g) * normal).sum(1)), 1, atol=1e-5)
    inner = ((plane.points - plane.points.mean(0)) ** 2).sum(1) < 0.2**2
    torch.testing.assert_close(g.scales[inner], torch.tensor([[0.08, 0.08, 0.08 * FLATNESS]]).repeat(inner.sum(), 1))
    np.testing.assert_allclose((g.sh[:, 0] * SH_C0 + 0.5).numpy(), plane.colours, atol=1e-6)
    assert (g.opacities == 0.5).all() and (g.part == 0).all() and g.sh_degree == 0


def test_a_lone_point_is_as_wide_as_it_is_told() -> None:
    lone = start_from_cloud(grid(np.array([0.0, 0, 1])).rows(np.arange(1)), 0.5)
    torch.testing.assert_close(lone.scales, torch.tensor([[0.4, 0.4, 0.4 * FLATNESS]]))


def test_points_in_one_place_have_a_size() -> None:
    twice = grid(np.array([0.0, 0, 1])).rows(np.zeros(8, int))
    assert (start_from_cloud(twice, 0.5).scales > 0).all()


def test_without_depth_the_start_is_on_the_shell_of_the_hull() -> None:
    shell = start_cloud(matt_views(), (), 800, np.random.default_rng(0))
    assert len(shell) == pytest.approx(800, rel=0.2)
    assert (shell.colours == 0.5).all()
    depth = (np.abs(shell.points) / CORNER).max(1)
    assert depth.max() < 1.6  # The hull of few views bulges.
    assert (depth > 0.85).mean() > 0.7
    nothing = [replace(m, depth=np.zeros_like(m.depth)) for m in measured(matt_views(), 48)]
    same = start_cloud(matt_views(), nothing, 800, np.random.default_rng(0))
    np.testing.assert_array_equal(shell.points, same.points)


VOXEL = 1 / 96
"""Of the open box's hull, about."""


def half_known() -> list[DepthMap]:
    """Exact depth of the open box, but for its outer faces at x < 0."""
    maps = []
    for m in measured(open_box(96), 96):
        depth = m.depth.copy()
        y, x = np.nonzero(depth)
        gone = m.camera.lifted(x, y, depth[y, x])[:, 0] < -0.45
        depth[y[gone], x[gone]] = 0
        maps.append(replace(m, depth=depth))
    return maps


def test_the_start_lies_on_known_depth_and_not_on_lids() -> None:
    start = start_cloud(open_box(96), measured(open_box(96), 96), 2000, np.random.default_rng(0))
    assert len(start) == pytest.approx(2000, rel=0.1)
    assert in_the_hollow(start.points).mean() > 0.25
    on_depth = (start.colours != 0.5).any(1)
    assert on_depth.mean() > 0.6 and start.points[~on_depth, 2].max() < 0.4
    assert (off_boards(start.points[on_depth]) < 0.1 * VOXEL).mean() > 0.95
    assert (off_boards(start.points) < 5 * VOXEL).mean() > 0.95  # No camera sees the underside: the hull bulges.
    hollow = in_the_hollow(start.points) & (off_boards(start.points) > 3 * VOXEL)
    assert hollow.mean() < 0.005


def test_where_depth_is_unknown_the_start_is_grey_on_the_hull() -> None:
    start = start_cloud(open_box(96), half_known(), 2000, np.random.default_rng(0))
    grey = (start.colours == 0.5).all(1)
    side = (start.points[:, 0] < -0.47) & (np.abs(start.points[:, 1:]) < 0.3).all(1)
    assert side.sum() > 50 and grey[side].all()
    assert (np.abs(start.points[side, 0] + 0.5) < 0.08).all()
    assert grey[start.points[:, 0] > 0].mean() < 0.25
    hollow = in_the_hollow(start.points) & (off_boards(start.points) > 3 * VOXEL)
    assert hollow.mean() < 0.01


def test_what_two_maps_see_through_is_carved_and_what_one_does_is_not() -> None:
    maps = measured(open_box(96), 96)
    hull, voxel = visual_hull(open_box(96), 96)
    lid = (np.abs(hull - [0, 0, 0.35]) < [0.2, 0.15, 0.02]).all(1)
    assert (seen_through(hull[lid], maps[:2], 2 * voxel) == 2).all()
    for n, closed in ((1, True), (2, False)):
        start = start_cloud(open_box(96), maps[:n], 2000, np.random.default_rng(0))
        above = (np.abs(start.points[:, :2]) < [0.2, 0.15]).all(1) & (start.points[:, 2] > 0.2)
        assert above.any() == closed


def test_photographs_are_reproduced_from_the_hull() -> None:
    assert mean_psnr(fitted(), [training_view(v) for v in matt_views()]) > 20


def test_unseen_views_are_reproduced_from_a_cloud() -> None:
    g = fit(matt_views(), CONFIG, cloud=cloud())
    unseen = [photograph(painted_box(), c) for c in cameras_around(5, 48, 2.8)]
    assert mean_psnr(g, [training_view(v) for v in unseen]) > 22


def test_gaussians_lie_on_the_surface_and_all_are_seen() -> None:
    g = fitted()
    assert float(seen_weight(g, [v.camera for v in matt_views()]).min()) > 0.1
    depth = (g.means.abs() / torch.from_numpy(CORNER)).amax(1)
    assert float(((depth > 0.85) & (depth < 1.15)).float().mean()) > 0.7
    assert (g.part == 0).all() and not g.means.requires_grad


def test_a_matt_object_gets_constant_colours() -> None:
    assert fitted().sh_degree == 0


def test_a_colour_that_turns_with_the_view_gets_harmonics() -> None:
    shiny = painted_box()
    shiny.sh = torch.cat([shiny.sh, torch.zeros((len(shiny), 3, 3))], 1)
    shiny.sh[:, 1:] = torch.tensor([[0.5, -0.5, 0.2], [-0.4, 0.4, 0.4], [0.4, 0.3, -0.5]])
    views = [photograph(shiny, c) for c in cameras_around(20, 48)]
    quick = replace(CONFIG, rates=LearningRates(sh=0.5))  # Lobes learn at a tenth of this.
    assert fit(views, quick, cloud=cloud()).sh_degree == 1
    assert fit(matt_views(), quick, cloud=cloud()).sh_degree == 0


def test_same_seed_same_gaussians() -> None:
    config = replace(CONFIG, steps=30)
    a, b, c = (fit(matt_views(), config, seed=s, cloud=cloud()) for s in (0, 0, 1))
    for name, value in vars(a).items():
        assert torch.equal(value, getattr(b, name)), name
    assert len(a) != len(c) or not torch.equal(a.means, c.means)


def test_a_given_cloud_replaces_the_hull() -> None:
    some = cloud()
    few = some.rows(np.arange(0, len(some), 4))
    g = fit(matt_views(), replace(CONFIG, steps=30), cloud=few)
    assert len(g) <= len(few)
    assert float(torch.cdist(g.means, torch.from_numpy(few.points).float()).amin(1).median()) < 0.05


def test_with_depth_a_fit_gets_into_the_hollow() -> None:
    views = open_box(32)
    config = replace(CONFIG, steps=40, max_sh_degree=0)
    hull, known = fit(views, config), fit(views, config, maps=measured(views, 32))
    assert np.median(off_boards(known.means.numpy())) < 0.7 * np.median(off_boards(hull.means.numpy()))
    assert in_the_hollow(known.means.numpy()).mean() > 0.2
    assert in_the_hollow(hull.means.numpy()).mean() < 0.02
    training = [training_view(v) for v in views]
    assert mean_psnr(known, training) > mean_psnr(hull, training) + 2


def test_the_set_grows_up_to_its_cap() -> None:
    config = replace(CONFIG, steps=400, max_gaussians=450, densify_every=20)
    counts: list[int] = []
    fit(
        matt_views(),
        config,
        cloud=cloud().rows(np.arange(0, 1500, 5)),
        report=lambda **r: counts.append(r["gaussians"]),
    )
    assert counts[0] == 300
    assert 320 < max(counts) <= 450


def test_progress_is_reported_and_gets_better() -> None:
    seen: list[dict] = []
    fit(matt_views(), replace(CONFIG, steps=101), cloud=cloud(), report=lambda **r: seen.append(r))
    assert [r["step"] for r in seen[:3]] == [1, 51, 101]
    assert all(set(r) == {"step", "steps", "loss", "psnr", "gaussians"} for r in seen)
    assert all(np.isfinite([r["loss"], r["psnr"]]).all() for r in seen)
    assert seen[2]["psnr"] > seen[0]["psnr"] + 1
    assert seen[-1]["loss"] < seen[0]["loss"]


def test_few_views_are_enough_to_run_and_all_of_them_teach() -> None:
    few = matt_views()[:4]
    g = fit(few, replace(CONFIG, steps=60), cloud=cloud())
    assert g.sh_degree == 0
    assert mean_psnr(g, [training_view(v) for v in few]) > 17
    assert float((g.sh[:, 0] * SH_C0 + 0.5).mean()) == pytest.approx(0.5, abs=0.2)
