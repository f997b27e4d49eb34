"""Do the poses fit the masks? If not, which of the usual mistakes would explain it?

A state's poses are judged by *coverage*: the share of each mask that the visual hull fills again.
Right poses give a hull that projects onto every mask; wrong ones leave no hull, or crumbs.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.ndimage import distance_transform_edt

from hingesplat.capture.frames import FLIP_YZ
from hingesplat.capture.hull import Silhouette, carve, inside, silhouettes
from hingesplat.capture.types import State
from hingesplat.errors import HingesplatError

MASK_SIZE, RESOLUTION, MAX_VIEWS = 64, 32, 40
"""Pixels, voxels and views looked at: enough to tell right from wrong in a fraction of a second."""
MIN_COVERAGE = 0.3
"""Median coverage below which poses are called wrong; right ones reach 0.9 and more."""
FITTING_COVERAGE = 0.7
"""Median coverage from which a correction is called a fit."""
MIN_OVERLAP = 0.05
"""Share of one state's hull that must lie in the other's: the static base lies in both."""

SURE_OVERLAP = 0.7
"""Overlap from which no other frame is tried; two states of real captures had 0.84 to 0.95."""

Correction = Callable[[np.ndarray], np.ndarray]


def check_states(states: Sequence[State], layout: str) -> None:
    """Raise HingesplatError when a state's masks share no hull, or the states' hulls lie apart.

    The message names the mistaken convention that would fit, if one does.
    """
    hulls = []
    for state in states:
        step = max(1, -(-len(state.train) // MAX_VIEWS))
        found = silhouettes(state.train[::step], MASK_SIZE)
        points, voxel = carve(found, RESOLUTION)
        if coverage(found, points, voxel) < MIN_COVERAGE:
            raise HingesplatError(_wrong_poses(state.name, found, layout))
        hulls.append((found, points, voxel))
    for state, hull in zip(states[1:], hulls[1:], strict=True):
        _check_same_frame(states[0].name, hulls[0], state.name, hull)


def coverage(views: Sequence[Silhouette], points: np.ndarray, voxel: float) -> float:
    """Median over the views of the share of the mask that the voxels (m, 3) fill; 0 without voxels."""
    if len(points) == 0:
        return 0.0
    shares = []
    for view in views:
        uv, z = view.camera.project(points)
        h, w = view.distance.shape
        kept = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < w) & (uv[:, 1] < h)
        empty = np.ones((h, w), bool)
        empty[uv[kept, 1].astype(int), uv[kept, 0].astype(int)] = False
        footprint = 1 + view.camera.fx * voxel / max(float(np.median(z)), 1e-6)
        mask = view.distance <= 0
        gaps = np.asarray(distance_transform_edt(empty))
        shares.append((gaps <= footprint)[mask].mean() if kept.any() else 0.0)
    return float(np.median(shares))


def _wrong_poses(state: str, views: Sequence[Silhouette], layout: str) -> str:
    """The message, with the correction that gives the best coverage if that is a fit."""
    wrong = f"{state}: the masks share no common visual hull, so the camera poses look wrong"
    best, name = 0.0, ""
    for candidate, correct in _mistakes(layout).items():
        fixed = [_corrected(v, correct) for v in views]
        score = coverage(fixed, *carve(fixed, RESOLUTION))
        if score > best:
            best, name = score, candidate
    if best < FITTING_COVERAGE:
        return f"{wrong}; no usual mistake (axes, direction, up) explains it; check poses, lens and masks"
    return f"{wrong}; they would fit if {name}"


def _corrected(view: Silhouette, correct: Correction) -> Silhouette:
    return replace(view, camera=replace(view.camera, T_world_camera=correct(view.camera.T_world_camera)))


def _mistakes(layout: str) -> dict[str, Correction]:
    """What could be wrong with poses of a layout → the camera-to-world OpenCV poses that would be right."""
    expected = ("OpenCV", "world-to-camera") if layout == "colmap" else ("OpenGL", "camera-to-world")
    mistakes: dict[str, Correction] = {}
    for axes, direction in product(("OpenCV", "OpenGL"), ("camera-to-world", "world-to-camera")):
        if (axes, direction) != expected:
            name = (
                f"the matrices are {direction} with {axes} axes, "
                f"where this layout ({layout}) has {expected[1]} with {expected[0]} axes"
            )
            mistakes[name] = _reread(expected, (axes, direction))
    for degrees in (90.0, -90.0):
        name = f"positions are turned by {degrees:+.0f}° about x (y-up positions with z-up rotations)"
        mistakes[f"the camera {name}"] = _turned_positions(_about_x(degrees))
    return mistakes


def _reread(read_as: tuple[str, str], really: tuple[str, str]) -> Correction:
    """Undo the reading ``read_as`` (axes, direction) and read the stored matrix as ``really``."""

    def convert(T: np.ndarray, axes: str, direction: str, undo: bool) -> np.ndarray:
        flip = FLIP_YZ if axes == "OpenGL" else np.eye(4)
        turn = np.linalg.inv if direction == "world-to-camera" else np.asarray
        return turn(T @ flip) if undo else turn(T) @ flip

    return lambda T: convert(convert(T, *read_as, undo=True), *really, undo=False)


def _turned_positions(R: np.ndarray) -> Correction:
    """Turn where the cameras stand, but not where they look."""

    def turned(T: np.ndarray) -> np.ndarray:
        out = T.copy()
        out[:3, 3] = R @ T[:3, 3]
        return out

    return turned


def _about_x(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


Hull = tuple[Sequence[Silhouette], np.ndarray, float]


def _check_same_frame(name_a: str, a: Hull, name_b: str, b: Hull) -> None:
    """Raise HingesplatError when the hulls of two states do not share the static base."""
    as_is = _overlap(a, b, np.eye(3))
    for degrees in (90.0, -90.0) if as_is < SURE_OVERLAP else ():
        if _overlap(a, b, _about_x(degrees)) > max(0.8, as_is + 0.2):
            raise HingesplatError(
                f"{name_a} and {name_b} are in different frames: they would fit if one has y up, the other "
                f"z up (turn {name_b} by {degrees:+.0f}° about x)"
            )
    if as_is < MIN_OVERLAP:
        centres = " and ".join(f"({', '.join(f'{x:.2f}' for x in h[1].mean(0))})" for h in (a, b))
        raise HingesplatError(
            f"{name_a} and {name_b} are in different frames: their visual hulls do not overlap (centres "
            f"{centres}); register the cameras of all states together"
        )


def _overlap(a: Hull, b: Hull, R_a_b: np.ndarray) -> float:
    """The larger of the shares of one hull inside the other, b turned by ``R_a_b`` about the origin."""
    b_in_a = inside(a[0], (b[1] @ R_a_b.T).astype(np.float32), a[2]).mean()
    a_in_b = inside(b[0], (a[1] @ R_a_b).astype(np.float32), b[2]).mean()
    return float(max(a_in_b, b_in_a))
