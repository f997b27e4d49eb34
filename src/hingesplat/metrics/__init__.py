"""The comparison with the truth. Nothing that trains may import this."""

from hingesplat.metrics.evaluate import evaluate
from hingesplat.metrics.truth import Truth, load_truth

__all__ = ["Truth", "evaluate", "load_truth"]
