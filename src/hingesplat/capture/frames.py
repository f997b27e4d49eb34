"""What a reader finds before any pixel is decoded, and the helpers that every reader shares."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hingesplat.camera import Camera
from hingesplat.errors import HingesplatError

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL camera axes (y up, looks along −z) to OpenCV (y down, z forward), and back."""

MAX_DISTORTION_PX = 0.5
"""Lens distortion below this shift at the image corner is taken for none."""


@dataclass(frozen=True)
class Frame:
    """One photograph still on disk."""

    camera: Camera
    image: Path
    name: str
    """Path relative to the capture, for messages."""
    mask: Path | None = None
    depth: Path | None = None
    depth_unit: float = 0.001
    """Scene units a stored depth value."""
    min_depth: float = 0.0
    """Depths below this (scene units) are not measurements."""


@dataclass(frozen=True)
class StateFrames:
    """The photographs of one state; ``folder`` is where its default ``masks`` folder is looked for."""

    name: str
    folder: Path
    train: list[Frame]
    test: list[Frame]


def require(data: dict[str, Any], key: str, where: str) -> Any:
    """``data[key]``; raises HingesplatError naming ``where`` and the key."""
    if key not in data:
        raise HingesplatError(f'{where}: lacks the key "{key}"')
    return data[key]


def number(value: Any, where: str) -> float:
    """A finite number; raises HingesplatError naming ``where``."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise HingesplatError(f"{where}: must be a finite number, not {value!r}")
    return float(value)


def rigid(matrix: Any, where: str, tolerance: float = 1e-3) -> np.ndarray:
    """A 4×4 (or 3×4) rigid matrix as float64 4×4, its rotation made orthonormal to machine precision.

    Raises HingesplatError naming ``where`` when it has another shape, is not finite, or scales, shears
    or mirrors by more than ``tolerance``.
    """
    try:
        M = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise HingesplatError(f"{where}: the pose is not a 4×4 matrix of numbers") from e
    if M.shape not in ((4, 4), (3, 4)):
        raise HingesplatError(f"{where}: the pose has shape {M.shape}, not 4×4")
    if not np.isfinite(M).all():
        raise HingesplatError(f"{where}: the pose holds NaN or infinity")
    U, s, Vt = np.linalg.svd(M[:3, :3])
    if abs(s - 1).max() > tolerance:
        raise HingesplatError(f"{where}: the pose is not rigid (its rotation scales by {s.min():.4g} to {s.max():.4g})")
    if np.linalg.det(U @ Vt) < 0:
        raise HingesplatError(f"{where}: the pose is not rigid (it mirrors: determinant −1)")
    if M.shape[0] == 4 and abs(M[3] - [0, 0, 0, 1]).max() > tolerance:
        raise HingesplatError(f"{where}: the pose is not rigid (its last row is not 0 0 0 1)")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = U @ Vt, M[:3, 3]
    return T


def reject_distortion(
    focal: float, width: int, height: int, radial: Iterable[float], tangential: Iterable[float], where: str
) -> None:
    """Raises HingesplatError when the lens bends by more than MAX_DISTORTION_PX at the image corner.

    ``radial`` multiply r³, r⁵, … and ``tangential`` 3 r² in normalised coordinates (an upper bound of the
    OpenCV model).
    """
    r = np.hypot(width, height) / (2 * focal)
    shift = sum(abs(k) * r ** (2 * i + 3) for i, k in enumerate(radial))
    shift = focal * (shift + 3 * r**2 * sum(abs(p) for p in tangential))
    if shift > MAX_DISTORTION_PX:
        raise HingesplatError(
            f"{where}: the lens distorts by up to {shift:.1f} pixels; undistort the images first "
            "(COLMAP: image_undistorter)"
        )


def natural_key(name: str) -> tuple:
    """Sorts ``start`` before ``end`` and ``state2`` before ``state10``."""
    pieces = re.split(r"(\d+)", name.lower())
    return name.lower() == "end", [(0, int(s), "") if s.isdigit() else (1, 0, s) for s in pieces if s]


def is_state_name(name: str) -> bool:
    """Whether a folder is called ``start``, ``end``, ``state0``, ``state_0``, …"""
    return re.fullmatch(r"start|end|state_?\d+", name, re.IGNORECASE) is not None


def state_folders(root: Path) -> list[Path]:
    """Folders under ``root`` named like states, in order."""
    found = [p for p in root.iterdir() if p.is_dir() and is_state_name(p.name)]
    return sorted(found, key=lambda p: natural_key(p.name))
