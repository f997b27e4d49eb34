"""A made object for the stages' tests: a textured box and a slab in front of it that turns or slides.

It is a sheet of flat, opaque Gaussians, so that its photographs are exact renders and its truth is known to the
last digit. What has to be proved on ray-traced photographs is proved on ``hingesplat.synth``.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from hingesplat.camera import Camera
from hingesplat.capture import View
from hingesplat.gaussians import SH_C0, Gaussians, concatenate, posed
from hingesplat.render import render
from hingesplat.screw import prismatic, revolute
from hingesplat.se3 import matrix_to_wxyz

AXIS = np.array([0.0, 0.0, 1.0])
PIVOT = np.array([-0.35, -0.42, 0.0])
ANGLE = -0.6
"""Radians: the slab swings open like a door, away from the box."""
FORWARD = np.array([0.0, -1.0, 0.0])
SLIDE = 0.25


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """For test files that import it. At these sizes threads mostly wait for each other, more so on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def look_at(eye: np.ndarray, size: int, target: Iterable[float] = (0.0, 0.0, 0.0)) -> Camera:
    """A square picture of ``size`` pixels that looks from ``eye`` to ``target``."""
    forward = np.array(list(target)) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.02, 0.01, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye
    return Camera(T, 1.4 * size, 1.4 * size, size / 2, size / 2, size, size)


def cameras_around(n: int, size: int, radius: float = 3.0) -> list[Camera]:
    """Cameras spread evenly over the sphere, the poles aside."""
    k = np.arange(n) + 0.5
    z, turn = 0.85 * (1 - 2 * k / n), np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z**2)
    return [look_at(radius * eye, size) for eye in np.column_stack([r * np.cos(turn), r * np.sin(turn), z])]


def box_surface(low: Iterable[float], high: Iterable[float], spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on a grid over the six faces of a box, and their outward normals (n, 3)."""
    lo, hi = np.array(list(low)), np.array(list(high))
    points, normals = [], []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        u, v = (np.linspace(0, 1, max(round((hi - lo)[k] / spacing), 1) + 1) for k in (a, b))
        u, v = (x.ravel() for x in np.meshgrid((u[1:] + u[:-1]) / 2, (v[1:] + v[:-1]) / 2))
        for side, level in ((-1.0, lo[axis]), (1.0, hi[axis])):
            p = np.empty((len(u), 3))
            p[:, axis], p[:, a], p[:, b] = level, lo[a] + u * (hi - lo)[a], lo[b] + v * (hi - lo)[b]
            points.append(p)
            normals.append(np.broadcast_to(side * np.eye(3)[axis], p.shape))
    return np.concatenate(points), np.concatenate(normals)


def texture(points: np.ndarray, seed: int) -> np.ndarray:
    """Colours (n, 3) in 0.1 … 0.9 that vary over about a fifth of a unit and do not repeat within the object."""
    rng = np.random.default_rng(seed)
    waves = np.sin(points @ rng.normal(0, 9, (3, 12)) + rng.uniform(0, 2 * np.pi, 12)).reshape(-1, 4, 3)
    return 0.5 + 0.4 * np.tanh(waves.sum(1))


def sheet(
    points: np.ndarray, normals: np.ndarray, colours: np.ndarray, size: float, opacity: float = 0.98
) -> Gaussians:
    """Flat Gaussians on a surface, ``size`` their standard deviation along it; part 0."""
    n = len(points)
    helper = np.eye(3)[np.abs(normals).argmin(1)]
    u = np.cross(normals, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    R = np.stack([u, np.cross(normals, u), normals], 2)
    return Gaussians(
        means=torch.from_numpy(points).float(),
        quats=matrix_to_wxyz(torch.from_numpy(R)).float(),
        log_scales=torch.tensor([size, size, 0.05 * size]).log().repeat(n, 1),
        logit_opacities=torch.full((n,), opacity).logit(),
        sh=torch.from_numpy((colours - 0.5) / SH_C0).float()[:, None],
        part=torch.zeros(n, dtype=torch.int64),
    )


def box(low: Iterable[float], high: Iterable[float], spacing: float, seed: int, part: int = 0) -> Gaussians:
    """A textured box."""
    points, normals = box_surface(low, high, spacing)
    g = sheet(points, normals, texture(points, seed), 0.6 * spacing)
    return g.with_part(torch.full((len(g),), part))


def photograph(gaussians: Gaussians, camera: Camera, name: str = "made") -> View:
    """The picture that a camera would take, with straight alpha."""
    with torch.no_grad():
        r = render(gaussians, camera)
    rgb = r.rgb / r.alpha.clamp_min(1e-3)
    rgba = torch.cat([rgb, r.alpha[None]]).clamp(0, 1).permute(1, 2, 0).numpy()
    return View(camera, np.round(255 * rgba).astype(np.uint8), name)


@dataclass(frozen=True)
class Scene:
    """A box (part 0) and a slab (part 1) in two states."""

    gaussians: Gaussians
    """Frame of state 0, true part ids."""
    T_state_0: np.ndarray
    """(2, 2, 4, 4) pose of each part in each state."""
    views: tuple[tuple[View, ...], tuple[View, ...]]

    def at(self, state: int) -> Gaussians:
        """As it stands in a state."""
        return posed(self.gaussians, transforms_of(self.T_state_0[state]))


def transforms_of(T: np.ndarray) -> Mapping[int, np.ndarray]:
    return dict(enumerate(T))


@cache
def scene(kind: Literal["revolute", "prismatic", "static"], size: int, spacing: float = 0.05) -> Scene:
    """The made object, photographed at ``size`` pixels from twelve sides. Cached: treat it as read-only.

    ``spacing`` is the grid of the Gaussians, scene units.
    """
    base = box((-0.5, -0.3, -0.4), (0.5, 0.3, 0.4), spacing, seed=1)
    slab = box((-0.35, -0.46, -0.3), (0.35, -0.38, 0.3), spacing, seed=2, part=1)
    whole = concatenate([base, slab])
    motion = {"revolute": revolute(AXIS, PIVOT, ANGLE), "prismatic": prismatic(FORWARD, SLIDE), "static": np.eye(4)}
    T = np.tile(np.eye(4), (2, 2, 1, 1))
    T[1, 1] = motion[kind]
    cameras = cameras_around(12, size)
    states = [posed(whole, transforms_of(t)) for t in T]
    first, second = (tuple(photograph(g, c) for c in cameras) for g in states)
    return Scene(whole, T, (first, second))


def off_by(made: Scene, degrees: float, shift: float = 0.01) -> np.ndarray:
    """The true motions, the slab's disturbed."""
    T = made.T_state_0.copy()
    T[1, 1] = prismatic([0, 1, 1], shift) @ revolute([1.0, 1.0, 0.5], PIVOT, np.radians(degrees)) @ T[1, 1]
    return T


def distance(T: np.ndarray, made: Scene) -> float:
    """Mean distance of the moved slab's Gaussians from where they belong."""
    points = made.gaussians.means[made.gaussians.part == 1].double().numpy()
    off = T[1, 1] - made.T_state_0[1, 1]
    return float(np.linalg.norm(points @ off[:3, :3].T + off[:3, 3], axis=1).mean())


def angle_between(T: np.ndarray, T_true: np.ndarray) -> float:
    """Degrees from one motion (4, 4) to another."""
    R = T[:3, :3].T @ T_true[:3, :3]
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def nearest(points: np.ndarray, gaussians: Gaussians) -> np.ndarray:
    """(n,) index of the Gaussian next to each of points (n, 3)."""
    return np.asarray(KDTree(gaussians.means.numpy()).query(points)[1])


BOARDS = np.array(
    [
        [[-0.5, -0.4, -0.4], [0.5, 0.4, -0.32]],
        [[-0.5, -0.4, -0.4], [-0.42, 0.4, 0.4]],
        [[0.42, -0.4, -0.4], [0.5, 0.4, 0.4]],
        [[-0.5, -0.4, -0.4], [0.5, -0.32, 0.4]],
        [[-0.5, 0.32, -0.4], [0.5, 0.4, 0.4]],
    ]
)
"""(5, 2, 3) lower and upper corners of the boards of an open box: the visual hull has a lid on it."""


def off_boards(points: np.ndarray) -> np.ndarray:
    """Distance of points (n, 3) from the surface of the nearest board."""
    outside = [np.maximum(low - points, points - high) for low, high in BOARDS]
    return np.min([np.linalg.norm(q.clip(0), axis=1) + np.abs(q.max(1).clip(max=0)) for q in outside], 0)


def in_the_hollow(points: np.ndarray) -> np.ndarray:
    """(n,) bool: on the inner faces of the open box or between them, clear of its opening."""
    return np.all(np.abs(points) < [0.44, 0.34, 0.35], axis=1)


def boards_depth(camera: Camera) -> np.ndarray:
    """(h, w) exact depth of the open box at the pixels' centres; 0 beside it."""
    origin, d = camera.rays()
    d = d / (d @ camera.T_world_camera[:3, 2])[..., None]
    nearest = np.full(d.shape[:2], np.inf)
    for corners in BOARDS:
        slabs = (corners[:, None, None] - origin) / d
        enter, leave = slabs.min(0).max(-1), slabs.max(0).min(-1)
        nearest = np.where(enter < leave, np.minimum(nearest, enter), nearest)
    return np.where(np.isfinite(nearest), nearest, 0)


@cache
def open_box(size: int, grey: bool = False) -> tuple[View, ...]:
    """Ray-traced photographs of the open box with their depth, from 24 sides, most of them above."""
    k = (np.arange(24) + 0.5) / 24
    z, turn = 0.95 - 1.3 * k**2, 24 * np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z**2)
    eyes = 2.6 * np.column_stack([r * np.cos(turn), r * np.sin(turn), z])
    return tuple(_traced(look_at(eye, size), grey) for eye in eyes)


def _traced(camera: Camera, grey: bool) -> View:
    fine = camera.scaled(2 * camera.width, 2 * camera.height)
    depth = boards_depth(fine)
    y, x = np.nonzero(depth)
    rgba = np.zeros((*depth.shape, 4))
    rgba[y, x, :3] = 0.5 if grey else texture(2 * fine.lifted(x, y, depth[y, x]), 1)
    rgba[y, x, 3] = 1
    rgba = rgba.reshape(camera.height, 2, camera.width, 2, 4).mean((1, 3))
    rgba[..., :3] /= rgba[..., 3:].clip(1e-6)
    return View(camera, np.round(255 * rgba).astype(np.uint8), "open box", boards_depth(camera).astype(np.float32))
