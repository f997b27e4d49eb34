"""From rigid motions to joints: the type by model comparison, then a constrained refinement (section 6)."""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from torch import Tensor

from hingesplat.capture import View
from hingesplat.chains import closest_joint, parents_of
from hingesplat.gaussians import Gaussians
from hingesplat.optim import Adam, GaussianAdam, LearningRates
from hingesplat.patches import PatchConfig, Photograph, adjust, patches_of
from hingesplat.poses import (
    StateLossConfig,
    drawn_parts,
    errors_by_part,
    move_parts_alone,
    part_centres,
    pose_loss,
    pose_step,
    state_loss,
)
from hingesplat.screw import axes_across, distances_to_line
from hingesplat.se3 import from_Rt, rotvec_to_matrix
from hingesplat.stereo import DepthMap
from hingesplat.symmetry import round_about
from hingesplat.training import Report, TrainingView, averaged, shuffled, thinned, training_views
from hingesplat.twin import Joint, JointStd, JointType

log = logging.getLogger(__name__)

JUDGES = 50
"""Photographs of a state that judge the types."""
ACROSS, ALONG = 0.17, 0.065
"""Errors that all photographs share (a label, a highlight), in pixels on the object: of places across a hinge line and
turns about it, and of directions and slides. Taken from the made objects of docs/results.md."""
LEFT = 0.6
"""Share of these errors that patches leave."""


@dataclass(frozen=True)
class JointsConfig:
    """Joint types, and the last refinement."""

    type_steps: int = 60
    """Steps of each type's trial, Gaussians frozen."""
    type_significance: float = 2.0
    """A rotation must beat a slide by this many standard errors, since it has more numbers to fit with."""
    type_gain: float = 0.03
    """It must also lower the error around the part by this fraction: more numbers always fit a little better."""
    hinge_reach: float = 1.0
    """A hinge line farther than this from its part, in extents, is a slide in disguise."""
    steps: int = 500
    """Steps of the constrained refinement, joints and Gaussians together."""
    rate: float = 1e-3
    """Adam step of the joint parameters (radians, extents) at the start; decays to 2 %."""
    patches: PatchConfig = field(default_factory=PatchConfig)
    settled: float = 0.3
    """Share of the steps left for Gaussians alone, once patches have settled the joints."""
    uncertainty_views: int = 12
    """Photographs of each moved state from which standard deviations are made; 0 skips them."""
    render: StateLossConfig = field(default_factory=StateLossConfig)
    rates: LearningRates = field(
        default_factory=lambda: LearningRates(means=6e-4, quats=2e-3, log_scales=4e-3, logit_opacities=2e-2, sh=6e-3)
    )


@dataclass(frozen=True)
class JointResult:
    """The finished model."""

    gaussians: Gaussians
    """In the frame of state 0."""
    state_sh: Tensor
    """(states, n, 3) offset of the constant colour coefficient in each state."""
    joints: tuple[Joint, ...]


class JointPoses:
    """Part poses with one degree of freedom each: an axis, a pivot, and a value a state."""

    def __init__(
        self,
        types: Sequence[str],
        axes: np.ndarray,
        pivots: np.ndarray,
        values: np.ndarray,
        extent: float,
        parents: Sequence[int] = (),
        device: torch.device | str = "cpu",
    ) -> None:
        """``axes`` and ``pivots`` (joints, 3); ``values`` (states − 1, joints), radians or scene units.

        ``parents`` are part ids, joint j being that of part j + 1; all the base if none are given.
        """
        self.extent, self.parents = extent, list(parents) or [0] * len(types)
        self.revolute = torch.tensor([kind == "revolute" for kind in types]).to(device)
        across = np.stack([axes_across(axis) for axis in axes])
        self.across, self.axis0, self.pivot0, self.value0 = (
            torch.from_numpy(x).float().to(device) for x in (across, axes, pivots, values)
        )
        unit = torch.where(self.revolute, 1.0, extent)
        self.unit = unit
        # Two tilts of the axis, two shifts of the pivot across it, then a change of the value in every state.
        self.theta = torch.zeros((len(types), 4 + len(values)), requires_grad=True, device=device)

    @property
    def parameters(self) -> list[Tensor]:
        return [self.theta]

    def axis(self) -> Tensor:
        tilt = (self.theta[:, :2, None] * self.across).sum(1)
        return torch.nn.functional.normalize(self.axis0 + tilt, dim=1)

    def pivot(self) -> Tensor:
        return self.pivot0 + self.extent * (self.theta[:, 2:4, None] * self.across).sum(1)

    def values(self) -> Tensor:
        """(states, joints); zero in state 0."""
        moved = self.value0 + self.theta[:, 4:].T * self.unit
        return torch.cat([torch.zeros_like(moved[:1]), moved])

    def Rt(self) -> tuple[Tensor, Tensor]:
        """Rotations (states, 1 + joints, 3, 3) and translations (states, 1 + joints, 3); the base first."""
        axis, pivot, value = self.axis(), self.pivot(), self.values()
        angle = value * self.revolute
        R = rotvec_to_matrix(angle[..., None] * axis)
        turn = pivot - (R @ pivot[..., None])[..., 0]
        t = torch.where(self.revolute[:, None], turn, value[..., None] * axis)
        eye = torch.eye(3, device=R.device).expand(len(value), 1, 3, 3)
        R, t = torch.cat([eye, R], 1), torch.cat([t.new_zeros((len(value), 1, 3)), t], 1)
        return self._on_parents(R, t) if any(self.parents) else (R, t)

    @torch.no_grad()
    def place(self, joint: int, theta: np.ndarray) -> np.ndarray:
        """T_state_0 (states, 4, 4) of a joint's part if the joint's row of ``theta`` were this one."""
        own = self.theta[joint].clone()
        self.theta[joint] = torch.from_numpy(theta).to(self.theta)
        R, t = self.Rt()
        self.theta[joint] = own
        return from_Rt(R[:, joint + 1], t[:, joint + 1]).cpu().double().numpy()

    def parents_first(self) -> list[int]:
        """Joints in an order in which none comes before the one that it hangs on."""

        def depth(part: int) -> int:
            return 0 if part == 0 else 1 + depth(self.parents[part - 1])

        return sorted(range(len(self.parents)), key=lambda joint: depth(joint + 1))

    def _on_parents(self, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Every part's motion carried along by that of its parent."""
        chained = {0: (R[:, 0], t[:, 0])}

        def carried(part: int) -> tuple[Tensor, Tensor]:
            if part not in chained:
                R_parent, t_parent = carried(self.parents[part - 1])
                chained[part] = R_parent @ R[:, part], (R_parent @ t[:, part, :, None])[..., 0] + t_parent
            return chained[part]

        both = [carried(part) for part in range(R.shape[1])]
        return torch.stack([r for r, _ in both], 1), torch.stack([s for _, s in both], 1)


def find_joints(
    gaussians: Gaussians,
    T_state_0: np.ndarray,
    state_sh: Tensor,
    views: Sequence[Sequence[View]],
    config: JointsConfig,
    *,
    maps: Sequence[Sequence[DepthMap]] = (),
    seed: int = 0,
    device: torch.device | str = "cpu",
    report: Report = lambda **_: None,
) -> JointResult:
    """Each part's motions to one joint, and everything refined with the joints as constraints.

    Args:
        gaussians: canonical, frame of state 0.
        T_state_0: (states, parts, 4, 4) free rigid motions.
        state_sh: (states, n, 3) colour offsets.
        maps: the depth of every photograph where it is known.
        device: where to optimise; what comes out is on the CPU.
    """
    rng = np.random.default_rng(seed)
    low, high = np.quantile(gaussians.means.numpy(), [0.002, 0.998], axis=0)
    extent = float((high - low).max())
    n_parts = T_state_0.shape[1]
    if n_parts == 1:
        return JointResult(gaussians, state_sh, ())
    training = training_views(views, maps, device)
    centroids = part_centres(gaussians, n_parts).double().numpy()[1:]
    points = [gaussians.means[gaussians.part == k].double().numpy() for k in range(n_parts)]
    parents = parents_of(T_state_0, points, extent)
    gaussians, state_sh = gaussians.to(device), state_sh.to(device)
    T_parent = np.linalg.inv(T_state_0[1:, parents]) @ T_state_0[1:, 1:]

    def poses_of(kinds: Sequence[str]) -> JointPoses:
        start = [closest_joint(k, T_parent[:, i], centroids[i]) for i, k in enumerate(kinds)]
        axes, pivots, values = (np.stack(column) for column in zip(*start, strict=True))
        return JointPoses(kinds, axes, pivots, values.T, extent, parents, device)

    kinds, confidence = _choose_types(gaussians, state_sh, training, poses_of, n_parts - 1, config, rng)
    poses = poses_of(kinds)
    extra = {"state_sh": (state_sh[1:].permute(1, 0, 2), config.rates.sh)}
    optimiser = GaussianAdam(gaussians, config.rates, extent, extra)
    adam = Adam(poses.parameters)
    photographs = shuffled(training, rng)
    tell = averaged(report, config.steps)

    def refine(steps: range, joints_too: bool) -> tuple[Gaussians, Tensor]:
        for step in steps:
            state, view = next(photographs)
            R, t = poses.Rt()
            if not joints_too:
                R, t = R.detach(), t.detach()
            loss, error = state_loss(optimiser, R[state], t[state], view, state, config.render, extent)
            loss.backward()
            optimiser.step(step / config.steps)
            if joints_too:
                pose_step(adam, config.rate, step / steps.stop)
            tell(loss, error, len(optimiser))
        offsets = optimiser.values["state_sh"].detach().permute(1, 0, 2)
        return optimiser.gaussians.detached(), torch.cat([torch.zeros_like(offsets[:1]), offsets]).contiguous()

    together = round((1 - config.settled if config.patches.per_part else 1) * config.steps)
    finished, all_sh = refine(range(together), joints_too=True)
    shared = covariance = _shared_errors(finished, training, poses)
    if config.uncertainty_views:
        covariance = shared + _covariances(finished, all_sh, training, poses, config)
    if config.patches.per_part:
        covariance = _by_patches(finished, training, poses, covariance, LEFT**2 * shared, config.patches, rng)
    finished, all_sh = refine(range(together, config.steps), joints_too=False)
    seen = _views_that_show(finished, training, poses)
    finished, all_sh = finished.to("cpu"), all_sh.cpu()
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) if config.uncertainty_views else None
    joints = _joints(kinds, poses, finished, confidence, deviation, seen, sum(len(s) for s in training))
    return JointResult(finished, all_sh, joints)


def _choose_types(
    g: Gaussians,
    sh: Tensor,
    training: Sequence[Sequence[TrainingView]],
    poses_of,
    n_joints: int,
    config: JointsConfig,
    rng: np.random.Generator,
) -> tuple[list[JointType], np.ndarray]:
    """Type of every joint and how sure it is, from photographs: which one-degree motion draws them better.

    A slide is the simpler model, so a rotation must win significantly over the views. All joints are tried at once, but
    each is judged with the others as they are likely to be: a wrong type carries a part before its neighbours.
    """
    weight, tried = config.render.ssim_weight, []
    far = np.zeros(n_joints, bool)
    for kind in ("prismatic", "revolute"):
        poses = poses_of([kind] * n_joints)
        if kind == "revolute":
            far = _reach(g, poses) >= config.hinge_reach  # A turn about so far a line would run away.
            poses = poses_of(["prismatic" if slides else "revolute" for slides in far])
        move_parts_alone(g, poses, training, config.type_steps, config.rate, weight, rng, state_sh=sh)
        tried.append([x.detach() for x in poses.Rt()])
    reach = _reach(g, poses)
    kinds: list[JointType] = []
    confidence = np.zeros(n_joints)
    for j, (slide, turn) in enumerate(_beside_likely(g, sh, thinned(training, JUDGES), tried, ~far)):
        z = gain = 0.0
        judged = len(slide) > 1  # Photographs that show the part; one alone does not scatter.
        if judged:
            difference = slide - turn
            error = difference.std() / math.sqrt(len(difference)) + 1e-12
            z = float(difference.mean() / error)
            gain = float(difference.mean() / slide.mean())
        hinged = z > config.type_significance and gain > config.type_gain and reach[j] < config.hinge_reach
        log.debug("joint %d: z %.1f, gain %.3f, reach %.2f", j + 1, z, gain, reach[j])
        kinds.append("revolute" if hinged else "prismatic")
        # An even verdict between nested models speaks for the slide.
        certainty = z - config.type_significance if hinged else max(config.type_significance - z, 0.0)
        confidence[j] = 0.5 * (1 + math.erf(judged * certainty / math.sqrt(2)))
    return kinds, confidence


def _beside_likely(
    g: Gaussians,
    sh: Tensor,
    training: Sequence[Sequence[TrainingView]],
    tried: Sequence[tuple[Tensor, Tensor]],
    may_turn: np.ndarray,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For every joint, errors (photographs,) where it slides and where it turns, with the others of likely types.

    Args:
        tried: poses R, t in which all slide, and in which those of ``may_turn`` (joints,) turn.
    """
    slides, turns = np.nansum(errors_by_part(g, tried, training, sh), axis=1)
    likely = (turns < slides) & may_turn

    def mixed(turning: np.ndarray) -> tuple[Tensor, Tensor]:
        """Poses in which these joints turn, and the others slide."""
        part = torch.tensor([False, *turning]).to(g.means.device)
        (R0, t0), (R1, t1) = tried
        return torch.where(part[:, None, None], R1, R0), torch.where(part[:, None], t1, t0)

    one_other = (likely ^ np.eye(len(likely), dtype=bool)) & may_turn
    as_likely, *otherwise = errors_by_part(g, [mixed(turning) for turning in (likely, *one_other)], training, sh)
    for j, other in enumerate(otherwise):
        pair = np.stack([as_likely[:, j], other[:, j]])
        slide, turn = pair[::-1] if likely[j] else pair
        shown = np.isfinite(slide)
        yield slide[shown], turn[shown]


def _reach(g: Gaussians, poses: JointPoses) -> np.ndarray:
    """(joints,) distance in extents from each part's centre to its joint's line."""
    axis, offset = poses.axis().detach(), part_centres(g, len(poses.parents) + 1)[1:] - poses.pivot().detach()
    return (torch.linalg.cross(offset, axis, dim=1).norm(dim=1) / poses.extent).cpu().numpy()


def _by_patches(
    g: Gaussians,
    training: Sequence[Sequence[TrainingView]],
    poses: JointPoses,
    covariance: np.ndarray,
    left: np.ndarray,
    config: PatchConfig,
    rng: np.random.Generator,
) -> np.ndarray:
    """Settle ``poses`` by the texture of the parts, as far as that tells more than is known; what is known then.

    ``covariance`` (joints, p, p), of what is known and of what comes out, is that of the rows of ``theta``; ``left``
    (joints, p, p) is what patches do not take away.
    """
    R, t = (x.detach() for x in poses.Rt())
    photographs = [
        [Photograph.of(view.camera, view.image, r) for view, r in drawn_parts(g, R[s : s + 1], t[s : s + 1], [views])]
        for s, views in enumerate(thinned(training, config.views))
    ]
    settled = covariance.copy()
    for j in poses.parents_first():
        patches = patches_of(j + 1, photographs[0], config, rng)
        if patches is not None:
            start = poses.theta[j].detach().cpu().double().numpy()
            known = np.linalg.inv(covariance[j])
            place = partial(poses.place, j)
            theta, settled[j] = adjust(
                patches, photographs, place, start, known, poses.extent, config.rounds, config.alike
            )
            settled[j] += left[j]
            with torch.no_grad():
                poses.theta[j] = torch.from_numpy(theta).to(poses.theta)
    return settled


def _shared_errors(g: Gaussians, training: Sequence[Sequence[TrainingView]], poses: JointPoses) -> np.ndarray:
    """(joints, 4 + states − 1, 4 + states − 1) covariance of ``theta`` by what all photographs get wrong alike."""
    centre = g.means.mean(0).double().cpu().numpy()
    cameras = [view.camera for state in training for view in state]
    pixel = float(np.median([np.linalg.norm(c.centre - centre) / c.fx for c in cameras])) / poses.extent
    axes, pivots = (x.detach().cpu().double().numpy() for x in (poses.axis(), poses.pivot()))
    variance = np.zeros(poses.theta.shape)
    for j, turns in enumerate(poses.revolute.cpu().tolist()):
        points = g.means[g.part == j + 1].cpu().double().numpy()
        spread = math.sqrt(points.var(0).sum()) / poses.extent if len(points) else 1.0
        across = distances_to_line(points, pivots[j], axes[j]) / poses.extent
        lever = math.sqrt(np.mean(across**2)) if len(points) else spread
        variance[j, :2] = (ALONG * pixel / max(spread, 1e-9)) ** 2 / 2
        variance[j, 2:4] = (ACROSS * pixel) ** 2 / 2
        variance[j, 4:] = (ACROSS * pixel / max(lever, 1e-9) if turns else ALONG * pixel) ** 2
    return variance[:, :, None] * np.eye(variance.shape[1])


def _covariances(
    g: Gaussians, sh: Tensor, training: Sequence[Sequence[TrainingView]], poses: JointPoses, config: JointsConfig
) -> np.ndarray:
    """(joints, 4 + states − 1, 4 + states − 1) covariance of ``theta``: the sandwich H⁻¹ (Σ g gᵀ) H⁻¹ of photographs.

    H is the curvature of the summed photometric loss (finite differences of its gradient, joints independent of each
    other); g are single photographs' gradients, whose scatter tells how far they disagree.
    """
    chosen = [
        (s, i)
        for s in range(1, len(training))
        for i in np.linspace(0, len(training[s]) - 1, min(config.uncertainty_views, len(training[s]))).astype(int)
    ]

    def gradients() -> np.ndarray:
        rows = []
        for s, i in chosen:
            R, t = poses.Rt()
            loss = pose_loss(g, R[s], t[s], training[s][i], config.render.ssim_weight, sh[s])
            (grad,) = torch.autograd.grad(loss, poses.theta)
            rows.append(grad.cpu().double().numpy())
        return np.stack(rows)

    n_views = sum(len(state) for state in training[1:])
    at = gradients()
    size = poses.theta.shape[1]
    H = np.zeros((poses.theta.shape[0], size, size))
    step = 2e-3
    for k in range(size):
        for sign in (1, -1):
            with torch.no_grad():
                poses.theta[:, k] += sign * step
            H[:, k] += sign * gradients().sum(0) / (2 * step)
            with torch.no_grad():
                poses.theta[:, k] -= sign * step
    covariance = np.zeros_like(H)
    for j in range(len(H)):
        symmetric = (H[j] + H[j].T) / 2
        value, vector = np.linalg.eigh(symmetric)
        # Directions the photographs do not feel (a slide's pivot) get no say.
        keep = value > 1e-3 * value.max()
        inverse = (vector[:, keep] / value[keep]) @ vector[:, keep].T
        scatter = np.einsum("vi,vj->ij", at[:, j], at[:, j])
        covariance[j] = inverse @ scatter @ inverse * len(chosen) / n_views
    return covariance


def _views_that_show(g: Gaussians, training: Sequence[Sequence[TrainingView]], poses: JointPoses) -> np.ndarray:
    """(joints,) number of photographs in which a part covers at least 30 pixels."""
    shown = [(r.channels > 0.5).flatten(1).sum(1) >= 30 for _, r in drawn_parts(g, *poses.Rt(), training)]
    return torch.stack(shown).sum(0).cpu().numpy()


def _ambiguity(kind: JointType, points: np.ndarray, axis: np.ndarray, pivot: np.ndarray) -> str:
    """What the shape of a part leaves open, in words."""
    if not round_about(points, axis, pivot):
        return ""
    if kind == "revolute":
        return "; ambiguous: round about its axis, so that only its texture tells how far it turned"
    return "; ambiguous: round about its axis, so that only its texture would tell if it turned as well"


def _joints(
    kinds: Sequence[JointType],
    poses: JointPoses,
    g: Gaussians,
    confidence: np.ndarray,
    deviation: np.ndarray | None,
    seen: np.ndarray,
    n_views: int,
) -> tuple[Joint, ...]:
    """What is written down; ``deviation`` (joints, 4 + states − 1) is the standard deviation of ``theta``."""
    axes, pivots = (x.detach().cpu().double().numpy() for x in (poses.axis(), poses.pivot()))
    values = poses.values().detach().cpu().double().numpy()
    centroids = part_centres(g, len(kinds) + 1).double().numpy()[1:]
    joints = []
    for j, kind in enumerate(kinds):
        axis, states = axes[j] / np.linalg.norm(axes[j]), values[:, j]
        if states[np.abs(states).argmax()] < 0:
            axis, states = -axis, -states
        pivot = pivots[j] + axis * ((centroids[j] - pivots[j]) @ axis) if kind == "revolute" else centroids[j]
        std, words = JointStd(), ""
        points = g.means[g.part == j + 1].double().numpy()
        if deviation is not None:
            d = deviation[j]
            axis_deg = math.degrees(math.hypot(d[0], d[1]))
            motion = float(d[4:].max()) * float(poses.unit[j])
            place = math.hypot(d[2], d[3]) * poses.extent if kind == "revolute" else None
            std = JointStd(axis_deg, place, motion)
            words = f"axis ±{axis_deg:.2g}°, "
        joints.append(
            Joint(
                child=j + 1,
                parent=poses.parents[j],
                type=kind,
                axis=(float(axis[0]), float(axis[1]), float(axis[2])),
                pivot=(float(pivot[0]), float(pivot[1]), float(pivot[2])),
                states=tuple(float(v) for v in states),
                limits=(float(states.min()), float(states.max())),
                std=std,
                confidence=float(confidence[j]),
                verdict=f"{words}seen in {seen[j]} of {n_views} views" + _ambiguity(kind, points, axis, pivot),
            )
        )
    return tuple(joints)
