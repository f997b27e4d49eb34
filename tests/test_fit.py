"""One state's photographs to Gaussians."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from hingesplat.capture import View
from hingesplat.fit import FitConfig, fit, hull_shell, start_from_points
from hingesplat.gaussians import SH_C0, Gaussians
from hingesplat.optim import LearningRates
from hingesplat.training import mean_psnr, seen_weight, training_view
from scenes import (
    box_surface,
    cameras_around,
    one_thread,  # noqa: F401
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


def points() -> np.ndarray:
    """A rough start, as sparse points from elsewhere would be."""
    some = painted_box().means.numpy()
    return some + np.random.default_rng(0).normal(0, 0.02, some.shape).astype(np.float32)


def test_start_is_a_grey_ball_on_every_point_as_wide_as_its_neighbourhood() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3), -1).reshape(-1, 3) * 0.1
    g = start_from_points(grid, 0.5, torch.Generator())
    np.testing.assert_allclose(g.means.numpy(), grid, atol=1e-7)
    torch.testing.assert_close(g.scales, torch.full((64, 3), 0.08))
    assert (g.sh == 0).all() and (g.opacities == 0.5).all() and (g.part == 0).all()
    lone = start_from_points(grid[:1], 0.5, torch.Generator())
    torch.testing.assert_close(lone.scales, torch.full((1, 3), 0.4))


def test_hull_shell_lies_mostly_on_the_surface() -> None:
    shell, extent = hull_shell(matt_views(), 800, np.random.default_rng(0))
    assert shell.shape == (800, 3)
    assert extent == pytest.approx(1.0, rel=0.35)  # The hull of few views bulges.
    depth = (np.abs(shell) / CORNER).max(1)
    assert depth.max() < 1.6
    assert (depth > 0.85).mean() > 0.7


def test_photographs_are_reproduced_from_the_hull() -> None:
    assert mean_psnr(fitted(), [training_view(v) for v in matt_views()]) > 20


def test_unseen_views_are_reproduced_from_points() -> None:
    g = fit(matt_views(), CONFIG, points=points())
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
    assert fit(views, quick, points=points()).sh_degree == 1
    assert fit(matt_views(), quick, points=points()).sh_degree == 0


def test_same_seed_same_gaussians() -> None:
    config = replace(CONFIG, steps=30)
    a, b, c = (fit(matt_views(), config, seed=s, points=points()) for s in (0, 0, 1))
    for name, value in vars(a).items():
        assert torch.equal(value, getattr(b, name)), name
    assert len(a) != len(c) or not torch.equal(a.means, c.means)


def test_given_points_replace_the_hull() -> None:
    few = points()[::4]
    g = fit(matt_views(), replace(CONFIG, steps=30), points=few)
    assert len(g) <= len(few)
    assert float(torch.cdist(g.means, torch.from_numpy(few)).amin(1).median()) < 0.05


def test_the_set_grows_up_to_its_cap() -> None:
    config = replace(CONFIG, steps=400, max_gaussians=450, densify_every=20)
    counts: list[int] = []
    fit(matt_views(), config, points=points()[::5][:300], report=lambda **r: counts.append(r["gaussians"]))
    assert counts[0] == 300
    assert 320 < max(counts) <= 450


def test_progress_is_reported_and_gets_better() -> None:
    seen: list[dict] = []
    fit(matt_views(), replace(CONFIG, steps=101), points=points(), report=lambda **r: seen.append(r))
    assert [r["step"] for r in seen[:3]] == [1, 51, 101]
    assert all(set(r) == {"step", "steps", "loss", "psnr", "gaussians"} for r in seen)
    assert all(np.isfinite([r["loss"], r["psnr"]]).all() for r in seen)
    assert seen[2]["psnr"] > seen[0]["psnr"] + 1
    assert seen[2]["loss"] < seen[0]["loss"]


def test_few_views_are_enough_to_run_and_all_of_them_teach() -> None:
    few = matt_views()[:4]
    g = fit(few, replace(CONFIG, steps=60), points=points())
    assert g.sh_degree == 0
    assert mean_psnr(g, [training_view(v) for v in few]) > 17
    assert float((g.sh[:, 0] * SH_C0 + 0.5).mean()) == pytest.approx(0.5, abs=0.2)
