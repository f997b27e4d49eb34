"""Rigid motions to joints."""

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from hingesplat.chains import closest_joint, parents_of
from hingesplat.joints import JointPoses, JointResult, JointsConfig, _joints, _shared_errors, find_joints
from hingesplat.poses import part_centres
from hingesplat.render import move
from hingesplat.screw import line_distance, prismatic, revolute
from hingesplat.training import TrainingView
from hingesplat.twin import Joint, JointType, Part, Twin
from scenes import (
    ANGLE,
    AXIS,
    FORWARD,
    PIVOT,
    SLIDE,
    look_at,
    one_thread,  # noqa: F401
    scene,
)

SLANT = np.array([0.48, 0.6, 0.64])
POINT = np.array([0.3, -0.2, 0.5])
CENTROID = np.array([1.0, 0.5, -0.3])
CONFIG = JointsConfig(type_steps=24, steps=40, uncertainty_views=4)
Kind = Literal["revolute", "prismatic"]


def joint_transform(kind: str, axis: np.ndarray, pivot: np.ndarray, value: float) -> np.ndarray:
    return revolute(axis, pivot, value) if kind == "revolute" else prismatic(axis, value)


# The joint nearest to a motion.


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("values", [[0.7], [-0.7], [0.2, 0.9, -0.4], [0.9, 0.0]])
def test_a_true_joints_motions_are_that_joint(kind: str, values: list[float]) -> None:
    T = np.stack([joint_transform(kind, SLANT, POINT, v) for v in values])
    axis, pivot, found = closest_joint(kind, T, CENTROID)
    assert np.linalg.norm(axis) == pytest.approx(1)
    for M, v in zip(T, found, strict=True):
        np.testing.assert_allclose(joint_transform(kind, axis, pivot, v), M, atol=1e-9)
    if kind == "revolute":
        assert line_distance(pivot, axis, POINT, SLANT) < 1e-9
        assert abs((pivot - CENTROID) @ axis) < 1e-9  # The pivot is the axis' point nearest the part.
    else:
        np.testing.assert_allclose(pivot, CENTROID)


def test_a_turn_seen_as_a_slide_moves_the_centroid_rightly() -> None:
    T = revolute(SLANT, POINT, 0.3)[None]
    axis, _, values = closest_joint("prismatic", T, CENTROID)
    np.testing.assert_allclose(CENTROID + axis * values[0], T[0, :3, :3] @ CENTROID + T[0, :3, 3])


def test_a_slide_along_a_turn_is_dropped() -> None:
    T = (prismatic(SLANT, 0.05) @ revolute(SLANT, POINT, 0.8))[None]
    axis, pivot, values = closest_joint("revolute", T, CENTROID)
    np.testing.assert_allclose(revolute(axis, pivot, values[0]), revolute(SLANT, POINT, 0.8), atol=1e-9)


# Poses with one degree of freedom.


def poses() -> JointPoses:
    axes = np.stack([SLANT, np.array([0.0, 0.0, 1.0])])
    values = np.array([[0.7, 0.2], [-0.3, 0.5]])
    return JointPoses(["revolute", "prismatic"], axes, np.stack([POINT, CENTROID]), values, 2.0)


def matrices(p: JointPoses) -> np.ndarray:
    R, t = (x.detach().double().numpy() for x in p.Rt())
    T = np.tile(np.eye(4), (*R.shape[:2], 1, 1))
    T[..., :3, :3], T[..., :3, 3] = R, t
    return T


def test_joint_poses_are_their_screws() -> None:
    T = matrices(poses())
    assert T.shape == (3, 3, 4, 4)
    expected = np.tile(np.eye(4), (3, 3, 1, 1))
    for s, (turn, slide) in enumerate([(0.7, 0.2), (-0.3, 0.5)], start=1):
        expected[s, 1], expected[s, 2] = revolute(SLANT, POINT, turn), prismatic([0, 0, 1], slide)
    np.testing.assert_allclose(T, expected, atol=1e-6)


def test_joint_poses_stay_one_degree_joints_whatever_the_parameters() -> None:
    p = poses()
    with torch.no_grad():
        p.theta.copy_(0.2 * torch.randn(p.theta.shape, generator=torch.Generator().manual_seed(0)))
    T = matrices(p)
    axis, pivot, values = (x.detach().double().numpy() for x in (p.axis(), p.pivot(), p.values()))
    np.testing.assert_allclose(np.linalg.norm(axis, axis=1), 1, atol=1e-6)
    assert abs(axis[0] @ SLANT) < 0.999 and np.linalg.norm(pivot[0] - POINT) > 0.01
    np.testing.assert_allclose(T[0], np.tile(np.eye(4), (3, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(T[:, 0], np.tile(np.eye(4), (3, 1, 1)), atol=1e-6)
    for s in (1, 2):
        np.testing.assert_allclose(T[s, 1], revolute(axis[0], pivot[0], values[s, 0]), atol=1e-5)
        np.testing.assert_allclose(T[s, 2], prismatic(axis[1], values[s, 1]), atol=1e-5)


def test_units_of_the_parameters() -> None:
    """Radians for turns and tilts, extents for slides and pivots."""
    p = poses()
    with torch.no_grad():
        p.theta[:, 4:] = 0.01
        p.theta[0, 2] = 0.01
    change = p.values().detach()[1:] - p.value0
    torch.testing.assert_close(change, torch.tensor([[0.01, 0.02], [0.01, 0.02]]))
    shift = (p.pivot() - p.pivot0).detach().double().numpy()
    assert np.linalg.norm(shift[0]) == pytest.approx(0.02, rel=1e-5)
    assert abs(shift[0] @ SLANT) < 1e-6
    with torch.no_grad():
        p.theta[0, 0] = 0.01
    tilt = np.arccos(min(float(p.axis().detach()[0].double() @ torch.from_numpy(SLANT)), 1.0))
    assert tilt == pytest.approx(0.01, rel=0.02)


def test_gradients_of_joint_poses() -> None:
    p = poses()
    for name in ("across", "axis0", "pivot0", "value0"):
        setattr(p, name, getattr(p, name).double())

    def motion(theta: torch.Tensor) -> torch.Tensor:
        p.theta = theta
        R, t = p.Rt()
        points = torch.eye(3, dtype=torch.float64)
        return torch.stack([move(points, torch.arange(3), R[s].double(), t[s].double()) for s in range(3)])

    theta = 0.1 * torch.randn((2, 6), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert gradcheck(motion, (theta.requires_grad_(),), eps=1e-5, atol=1e-4)


# The whole.


@cache
def found(kind: Kind) -> JointResult:
    """From a motion a little off the truth, and no more a pure turn or slide."""
    made = scene(kind, 64, 0.06)
    T = made.T_state_0.copy()
    T[1, 1] = prismatic([1, 0, 1], 0.004) @ revolute([1.0, 1, 0.5], PIVOT, np.radians(0.7)) @ T[1, 1]
    return find_joints(made.gaussians, T, torch.zeros((2, len(made.gaussians), 3)), made.views, CONFIG)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_type_axis_and_value_are_found(kind: Kind) -> None:
    (joint,) = found(kind).joints
    assert joint.type == kind
    assert (joint.child, joint.parent) == (1, 0)
    true_axis = AXIS * np.sign(ANGLE) if kind == "revolute" else FORWARD
    axis, value = np.array(joint.axis), joint.states[1]
    assert np.degrees(np.arccos(min(axis @ true_axis, 1.0))) < 1.5
    assert value == pytest.approx(abs(ANGLE) if kind == "revolute" else SLIDE, abs=0.015)
    if kind == "revolute":
        assert line_distance(np.array(joint.pivot), axis, PIVOT, AXIS) < 0.02


def test_what_slides_is_not_tried_as_a_turn_about_a_line_far_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drawer tried so ran away, over the door beside it, which was then taken for a slide."""
    tried = []
    monkeypatch.setattr("hingesplat.joints.move_parts_alone", lambda g, p, *_, **__: tried.append(p.revolute.tolist()))
    for kind in ("prismatic", "revolute"):
        made = scene(kind, 64, 0.06)
        sh, nearly = torch.zeros((2, len(made.gaussians), 3)), made.T_state_0.copy()
        nearly[1, 1] = nearly[1, 1] @ revolute(AXIS, PIVOT, 0.01)
        find_joints(made.gaussians, nearly, sh, made.views, replace(CONFIG, steps=1, uncertainty_views=0))
    assert tried == [[False], [False], [False], [True]]


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_values_start_at_zero_their_largest_is_positive_and_limits_cover_them(kind: Kind) -> None:
    (joint,) = found(kind).joints
    assert joint.states[0] == 0 and len(joint.states) == 2
    assert max(joint.states, key=abs) > 0
    assert joint.limits[0] <= min(joint.states) and max(joint.states) <= joint.limits[1]
    centre = part_centres(found(kind).gaussians, 2)[1].double().numpy()
    across = np.array(joint.pivot) - centre
    assert abs(across @ np.array(joint.axis)) < 1e-4
    assert np.linalg.norm(joint.axis) == pytest.approx(1, abs=1e-9)


def test_a_joint_that_was_refined_backwards_is_turned_round() -> None:
    """Three states, the farthest at a negative value: the axis turns, and the motion stays what it was."""
    made = scene("prismatic", 48, 0.1)
    values = np.array([[0.2], [-0.9]])
    for kind in ("revolute", "prismatic"):
        p = JointPoses([kind], SLANT[None], POINT[None], values, 1.0)
        (joint,) = _joints([kind], p, made.gaussians, np.ones(1), None, np.ones(1, int), 1)
        np.testing.assert_allclose(joint.states, [0, -0.2, 0.9], atol=1e-6)
        np.testing.assert_allclose(joint.limits, [-0.2, 0.9], atol=1e-6)
        for state, value in enumerate([0.0, 0.2, -0.9]):
            expected = joint_transform(kind, SLANT, POINT, value)
            np.testing.assert_allclose(joint.transform(joint.states[state]), expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_deviations_are_finite_positive_and_small(kind: Kind) -> None:
    (joint,) = found(kind).joints
    assert joint.std.axis_deg is not None and 0 < joint.std.axis_deg < 5
    assert joint.std.motion is not None and 0 < joint.std.motion < 0.1
    if kind == "revolute":
        assert joint.std.pivot is not None and 0 < joint.std.pivot < 0.1
    else:
        assert joint.std.pivot is None
    assert joint.confidence is not None and 0.5 <= joint.confidence <= 1
    assert "views" in joint.verdict


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_no_joint_is_surer_than_a_part_of_a_pixel(kind: Kind) -> None:
    """Photographs may agree perfectly; labels and highlights are wrong in all of them alike."""
    made = scene(kind, 48, 0.1)
    axis, pivot, value = (AXIS, PIVOT, ANGLE) if kind == "revolute" else (FORWARD, np.zeros(3), SLIDE)
    p = JointPoses([kind], np.asarray(axis)[None], np.asarray(pivot)[None], np.array([[value]]), 1.0)
    coarse, fine = (
        np.sqrt(np.diag(_shared_errors(made.gaussians, [[TrainingView(camera, np.zeros((1, 1, 4), np.uint8))]], p)[0]))
        for camera in (look_at(np.array([0.0, -3.0, 1.0]), size) for size in (60, 120))
    )
    np.testing.assert_allclose(coarse, 2 * fine)
    assert 0.0005 <= fine[4] <= 0.02


def test_deviations_can_be_skipped_and_the_seed_decides() -> None:
    made = scene("prismatic", 48, 0.1)
    quick = JointsConfig(type_steps=4, steps=6, uncertainty_views=0)
    light = torch.zeros((2, len(made.gaussians), 3))
    a, b = (find_joints(made.gaussians, made.T_state_0, light, made.views, quick, seed=3) for _ in range(2))
    assert a.joints[0].std.axis_deg is None
    assert a.joints == b.joints
    assert torch.equal(a.gaussians.means, b.gaussians.means)
    assert a.state_sh.shape == light.shape and float(a.state_sh[0].abs().max()) == 0


def test_without_movable_parts_there_is_nothing_to_do() -> None:
    made = scene("static", 48, 0.1)
    base = made.gaussians.with_part(torch.zeros_like(made.gaussians.part))
    light = torch.zeros((2, len(base), 3))
    result = find_joints(base, np.tile(np.eye(4), (2, 1, 1, 1)), light, made.views, CONFIG)
    assert result.joints == () and result.gaussians is base


def test_a_part_hangs_on_another_only_where_its_motion_is_one_joint_there_and_not_on_the_base():
    rng = np.random.default_rng(0)
    door = revolute((0, 0, 1), (0.5, 0, 0), 1.1)
    lever = revolute((0, 1, 0), (0.2, 0.1, 0.1), 0.6)
    drawer = prismatic((0, -1, 0), 0.3)
    T = np.stack([np.eye(4), drawer, door @ lever, door])
    T_state_0 = np.stack([np.tile(np.eye(4), (4, 1, 1)), T])
    points = [rng.uniform(-0.5, 0.5, (200, 3)) + offset for offset in ([0, 0, 0], [0, 0, 1], [0.2, 0.1, 0], [0, 0, 0])]
    assert parents_of(T_state_0, points, 1.0) == [0, 3, 0]
    noise = np.stack([revolute(rng.normal(size=3), rng.normal(size=3), 1e-3) for _ in range(4)])
    assert parents_of(np.stack([T_state_0[0], noise @ T]), points, 1.0) == [0, 3, 0]


def test_two_doors_on_the_base_do_not_hang_on_each_other():
    T = np.stack([np.eye(4), revolute((0, 0, 1), (0.5, 0, 0), 1.1), revolute((0, 0, 1), (-0.5, 0, 0), -0.8)])
    T_state_0 = np.stack([np.tile(np.eye(4), (3, 1, 1)), T])
    points = [np.random.default_rng(k).uniform(-0.5, 0.5, (100, 3)) for k in range(3)]
    assert parents_of(T_state_0, points, 1.0) == [0, 0]


def test_a_chain_of_joints_moves_as_the_twin_made_of_it_does():
    kinds: list[JointType] = ["revolute", "revolute"]
    axes, pivots = np.array([[0, 1.0, 0], [0, 0, 1.0]]), np.array([[0.2, 0.1, 0.1], [0.5, 0, 0]])
    poses = JointPoses(kinds, axes, pivots, np.array([[0.6, 1.1]]), 1.0, [2, 0])
    R, t = poses.Rt()
    joints = [
        Joint(k + 1, poses.parents[k], kinds[k], tuple(axes[k]), tuple(pivots[k]), (0.0, v), (0.0, v))
        for k, v in enumerate((0.6, 1.1))
    ]
    there = Twin(tuple(Part(i, str(i), 0) for i in range(3)), tuple(joints)).at_state(1)
    for part in range(3):
        assert R[1, part].detach().numpy() == pytest.approx(there[part][:3, :3], abs=1e-6)
        assert t[1, part].detach().numpy() == pytest.approx(there[part][:3, 3], abs=1e-6)
