"""Part poses, and a state drawn with them."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from hingesplat.gaussians import Gaussians
from hingesplat.optim import GaussianAdam, LearningRates
from hingesplat.poses import PoseDelta, StateLossConfig, draw_state, errors_by_part, part_centres, state_loss
from hingesplat.render import move, render
from hingesplat.se3 import apply, rotvec_to_matrix
from hingesplat.training import training_view, training_views
from scenes import (
    one_thread,  # noqa: F401
    scene,
)

MADE = scene("revolute", 48, 0.08)
G = MADE.gaussians
T = torch.from_numpy(MADE.T_state_0).float()
CENTRES = part_centres(G, 2)


def test_zero_is_the_start() -> None:
    R, t = PoseDelta(T, CENTRES, 2.0).Rt()
    torch.testing.assert_close(R, T[..., :3, :3])
    torch.testing.assert_close(t, T[..., :3, 3])


def test_the_base_and_state_0_stay_put_whatever_the_parameters() -> None:
    poses = PoseDelta(T, CENTRES, 2.0)
    with torch.no_grad():
        for p in poses.parameters:
            p.normal_(generator=torch.Generator().manual_seed(0))
    R, t = poses.Rt()
    torch.testing.assert_close(R[0], T[0, :, :3, :3])
    torch.testing.assert_close(t[0], T[0, :, :3, 3])
    torch.testing.assert_close(R[:, 0], T[:, 0, :3, :3])
    torch.testing.assert_close(t[:, 0], T[:, 0, :3, 3])
    assert float((R[1, 1] - T[1, 1, :3, :3]).detach().abs().max()) > 0.1
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), rtol=0, atol=1e-5)


def test_turns_are_about_the_moved_centre_and_shifts_are_in_extents() -> None:
    poses = PoseDelta(T, CENTRES, 2.0)
    with torch.no_grad():
        poses.turn[1, 1] = torch.tensor([0.1, -0.2, 0.3])
    where = apply(T[1, 1], CENTRES[1:])
    R, t = poses.Rt()
    torch.testing.assert_close(R[1, 1], rotvec_to_matrix(torch.tensor([0.1, -0.2, 0.3])) @ T[1, 1, :3, :3])
    torch.testing.assert_close((R[1, 1] @ CENTRES[1] + t[1, 1])[None], where)
    with torch.no_grad():
        poses.shift[1, 1] = torch.tensor([0.01, 0.0, 0.0])
    R, t = poses.Rt()
    torch.testing.assert_close((R[1, 1] @ CENTRES[1] + t[1, 1])[None], where + torch.tensor([[0.02, 0, 0]]))


def test_gradients_of_the_poses() -> None:
    poses = PoseDelta(T.double(), CENTRES.double(), 2.0)

    def Rt(turn: torch.Tensor, shift: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        poses.turn, poses.shift = turn, shift
        return poses.Rt()

    some = 0.1 * torch.randn((2, 2, 2, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert gradcheck(Rt, tuple(some.requires_grad_()))


def test_move_is_each_parts_own_transform() -> None:
    R, t = PoseDelta(T, CENTRES, 2.0).Rt()
    moved = move(G.means, G.part, R[1].detach(), t[1].detach())
    torch.testing.assert_close(moved, apply(T[1][G.part], G.means))
    torch.testing.assert_close(moved, MADE.at(1).means)


def test_part_centres() -> None:
    centres = part_centres(G, 4)
    for k in (0, 1):
        torch.testing.assert_close(centres[k], G.means[G.part == k].mean(0), rtol=0, atol=1e-5)
    assert (centres[2:] == 0).all()


def same_picture(a: Gaussians, drawn: torch.Tensor, state: int) -> None:
    camera = MADE.views[state][0].camera
    torch.testing.assert_close(drawn, render(a, camera).rgb, rtol=0, atol=2e-3)


def test_a_state_is_drawn_as_it_stands() -> None:
    for state in (0, 1):
        camera = MADE.views[state][0].camera
        drawn = draw_state(G, T[state, :, :3, :3], T[state, :, :3, 3], camera)
        same_picture(MADE.at(state), drawn.rgb, state)


def test_given_centres_and_light_are_used() -> None:
    camera = MADE.views[0][0].camera
    R, t = T[0, :, :3, :3], T[0, :, :3, 3]
    shift = torch.tensor([0.1, 0.0, 0.0])
    offset = 0.3 * torch.ones((len(G), 3))
    there = MADE.at(0)
    there.means = there.means + shift
    same_picture(there, draw_state(G, R, t, camera, means=G.means + shift).rgb, 0)
    lit = MADE.at(0)
    lit.sh = lit.sh + offset[:, None]
    same_picture(lit, draw_state(G, R, t, camera, sh_offset=offset).rgb, 0)


def loss_of(poses: PoseDelta, state: int, light: float = 0.0) -> tuple[torch.Tensor, GaussianAdam]:
    extra = {"state_sh": (torch.full((len(G), 1, 3), light), 1e-3)}
    optimiser = GaussianAdam(G, LearningRates(), 1.0, extra)
    R, t = poses.Rt()
    view = training_view(MADE.views[state][0])
    return state_loss(optimiser, R[state], t[state], view, state, StateLossConfig(), 1.0)[0], optimiser


def test_the_photograph_moves_the_movable_part_only() -> None:
    poses = PoseDelta(T, CENTRES, 1.0)
    with torch.no_grad():
        poses.turn[1, 1, 2] = 0.03
    loss, _ = loss_of(poses, 1)
    loss.backward()
    for p in poses.parameters:
        assert p.grad is not None and bool(p.grad.isfinite().all())
        assert float(p.grad[1, 1].abs().max()) > 0
        assert float(p.grad[0].abs().max()) == 0 and float(p.grad[:, 0].abs().max()) == 0
    assert poses.turn.grad is not None
    assert float(poses.turn.grad[1, 1, 2]) > 0  # Downhill is back.


@pytest.mark.parametrize("state", [0, 1])
def test_the_truth_costs_least(state: int) -> None:
    poses = PoseDelta(T, CENTRES, 1.0)
    at_truth = float(loss_of(poses, state)[0].detach())
    if state == 1:
        with torch.no_grad():
            poses.shift[1, 1, 0] = 0.02
        assert float(loss_of(poses, state)[0].detach()) > at_truth + 0.003
    assert float(loss_of(poses, state, light=0.3)[0].detach()) > at_truth + 0.003 or state == 0


def test_light_of_the_other_state_leaves_state_0_alone_and_is_paid_for() -> None:
    poses = PoseDelta(T, CENTRES, 1.0)
    dark, lit = loss_of(poses, 0)[0], loss_of(poses, 0, light=0.5)[0]
    assert torch.equal(dark, lit)
    loss, optimiser = loss_of(poses, 1, light=0.5)
    loss.backward()
    gradient = optimiser.values["state_sh"].grad
    assert gradient is not None and float(gradient.sum()) > 0
    assert np.isfinite(float(loss.detach()))


def test_a_part_that_hides_is_judged_where_it_should_be_seen() -> None:
    """A door once sank into its cabinet: the strip of it that was left agreed with the photographs."""
    training = training_views([views[:4] for views in MADE.views])
    R, t = PoseDelta(T, CENTRES, 2.0).Rt()
    away = t.detach().clone()
    away[1, 1] += 100.0
    true, gone = errors_by_part(G, [(R, t), (R, away)], training)
    assert np.isfinite(gone[:, 0]).any() and (np.isfinite(true) == np.isfinite(gone)).all()
    assert np.nanmean(gone) > 3 * np.nanmean(true)
    np.testing.assert_array_equal(errors_by_part(G, [(R, away), (R, t)], training)[::-1], [true, gone])
    assert np.isnan(errors_by_part(G, [(R, away)], training)).all()
