"""The stages on a device that is not the CPU: the same results, and a loop that does not wait for it."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from hingesplat.align import AlignConfig, align
from hingesplat.articulate import ArticulateConfig, articulate
from hingesplat.fit import FitConfig, fit
from hingesplat.gaussians import Gaussians
from hingesplat.identity import IdentityConfig
from hingesplat.joints import JointsConfig, find_joints
from hingesplat.matching import nearest
from hingesplat.optim import GaussianAdam, LearningRates
from hingesplat.physics import PhysicsConfig, RepelConfig
from hingesplat.render import cuda_lacks, gsplat_backend
from hingesplat.stereo import Cloud
from hingesplat.training import grow
from scenes import one_thread, scene  # noqa: F401 (a fixture)
from standin import definition_as_gsplat, standin, waits

MADE = scene("revolute", 32, 0.12)
CLOUD = Cloud.of(MADE.gaussians.means.numpy())
FEW = ArticulateConfig(steps=4, pose_rate=2e-3, densify_every=100)
EVERYTHING = {
    "found before": FEW,
    "the paper's": ArticulateConfig(
        steps=4,
        densify_every=100,
        identity=IdentityConfig("embedding", hard_from=0.5),
        repel=RepelConfig(points=50),
        physics=PhysicsConfig(art=1.0, contact=0.5, velocity=0.5, vector=0.5),
    ),
    "centres, matched": ArticulateConfig(
        steps=4,
        densify_every=100,
        identity=IdentityConfig("centres"),
        physics=PhysicsConfig(art=1.0, targets="matched"),
    ),
    "no parts": ArticulateConfig(steps=4, densify_every=100, identity=IdentityConfig("none")),
}


ON_CUDA = pytest.param("cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(bool(cuda_lacks()), reason=cuda_lacks())])


@pytest.fixture(params=["standin", ON_CUDA])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The stand-in for a GPU, and a GPU where there is one."""
    if request.param == "standin":
        monkeypatch.setattr(gsplat_backend, "_gsplat", lambda means: definition_as_gsplat)
        return standin()
    return request.param


def fitted(steps: int, where: str) -> Gaussians:
    config = FitConfig(steps=steps, max_sh_degree=1)
    return fit(MADE.views[0], config, cloud=CLOUD, device=where)


def articulated(config: ArticulateConfig, where: str) -> tuple[Gaussians, np.ndarray]:
    states = (MADE.gaussians, MADE.at(1))
    found = articulate(MADE.gaussians, MADE.T_state_0, MADE.views, config, fitted=states, device=where)
    return found.gaussians, found.T_state_0


def aligned(steps: int, where: str) -> np.ndarray:
    labels, off = MADE.gaussians.part.numpy(), MADE.T_state_0.copy()
    off[1, 1, :3, 3] += 0.02
    pair = MADE.gaussians, MADE.at(1)
    return align(pair, (labels, labels), 1, off, MADE.views, AlignConfig(steps=steps), device=where)


def with_joints(steps: int, where: str) -> tuple[Gaussians, np.ndarray]:
    offsets = torch.zeros((2, len(MADE.gaussians), 3))
    config = JointsConfig(steps=steps, type_steps=2, uncertainty_views=2)
    found = find_joints(MADE.gaussians, MADE.T_state_0, offsets, MADE.views, config, device=where)
    (joint,) = found.joints
    return found.gaussians, np.array([*joint.axis, *joint.pivot, *joint.states, joint.std.axis_deg])


def assert_alike(found: Gaussians, expected: Gaussians) -> None:
    assert found.means.device.type == "cpu"
    for name in ("means", "log_scales", "sh"):
        # Adam's first steps are as long for a gradient that is rounding as for any.
        assert float((getattr(found, name) - getattr(expected, name)).abs().mean()) < 1e-3
    assert torch.equal(found.part, expected.part)


def test_a_fit_is_the_same(device: str) -> None:
    assert_alike(fitted(4, device), fitted(4, "cpu"))


def test_a_set_grows_and_keeps_its_order(device: str) -> None:
    made = {}
    for where in (device, "cpu"):
        optimiser = GaussianAdam(MADE.gaussians.to(where), LearningRates(), 1.0)
        statistics = torch.rand((len(optimiser), 3), generator=torch.Generator().manual_seed(1)).to(where)
        grow(optimiser, statistics, 2 * len(optimiser), 0.02, 1.0, torch.Generator().manual_seed(0))
        made[where] = optimiser.gaussians.detached().to("cpu")
    assert len(made[device]) > len(MADE.gaussians)
    assert_alike(made[device], made["cpu"])


@pytest.mark.parametrize("name", EVERYTHING)
def test_joint_optimisation_is_the_same(device: str, name: str) -> None:
    (found, T), (expected, T_expected) = (articulated(EVERYTHING[name], where) for where in (device, "cpu"))
    assert_alike(found, expected)
    np.testing.assert_allclose(T, T_expected, atol=5e-3)


def test_an_alignment_is_the_same(device: str) -> None:
    np.testing.assert_allclose(aligned(4, device), aligned(4, "cpu"), atol=5e-3)


def test_joints_are_the_same(device: str) -> None:
    (found, joint), (expected, joint_expected) = (with_joints(4, where) for where in (device, "cpu"))
    assert_alike(found, expected)
    np.testing.assert_allclose(joint, joint_expected, atol=5e-3)


@pytest.mark.parametrize(
    "run",
    [fitted, aligned, lambda n, where: articulated(ArticulateConfig(steps=n, pose_rate=2e-3), where), with_joints],
)
@pytest.mark.parametrize("device", ["standin"], indirect=True)
def test_no_step_waits_for_the_device(device: str, run: Callable[[int, str], object]) -> None:
    counts = []
    for steps in (2, 4):  # The same reports and judgements in both; steps alone differ.
        before = waits()
        run(steps, device)
        counts.append(waits() - before)
    assert counts[0] == counts[1] > 0


def test_the_nearest_are_the_same(device: str) -> None:
    g = torch.Generator().manual_seed(0)
    points, among = torch.rand((5000, 3), generator=g), torch.rand((40, 3), generator=g)
    for a, b in zip(nearest(points, among, 3), nearest(points.to(device), among.to(device), 3), strict=True):
        torch.testing.assert_close(a, b.cpu())
