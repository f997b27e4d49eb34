"""Photographs of an articulated thing in two states in, a moving digital twin out."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# OpenMP threads that spin while they wait make a step up to five times slower on busy cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
__all__ = ["ReconstructConfig", "evaluate", "load_capture", "reconstruct"]

if TYPE_CHECKING:
    from hingesplat.capture import load_capture
    from hingesplat.metrics import evaluate
    from hingesplat.pipeline import ReconstructConfig, reconstruct

_HOMES = {
    "ReconstructConfig": "hingesplat.pipeline",
    "evaluate": "hingesplat.metrics",
    "load_capture": "hingesplat.capture",
    "reconstruct": "hingesplat.pipeline",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: the libraries behind them take seconds to load."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
