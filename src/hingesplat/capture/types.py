"""The first noun: posed photographs of one object in two or more states."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hingesplat.camera import Camera


@dataclass(frozen=True)
class View:
    """One photograph."""

    camera: Camera
    rgba: np.ndarray
    """(height, width, 4) uint8, straight (not premultiplied) alpha; alpha is the object mask."""
    name: str
    """Where it came from, for messages: ``state0/train/000.png``."""
    depth: np.ndarray | None = None
    """(height, width) float32 z-depth in scene units, 0 where unknown; None unless asked for."""


@dataclass(frozen=True)
class State:
    """All photographs of the object in one configuration."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]


@dataclass(frozen=True)
class Capture:
    """An object in two or more states, all cameras in one common world frame."""

    path: Path
    layout: str
    """``transforms``, ``paris``, ``artgs`` or ``colmap``."""
    states: tuple[State, ...]
    metres_per_unit: float = 1.0
