"""``curves.json`` as small line charts: paths in a unit square, labels apart, so that the page can stretch them."""

import math
from typing import Any

import numpy as np

METRICS = {"psnr": "PSNR, dB", "loss": "loss"}
SMOOTH = 7
"""Points that a line is averaged over: each step saw one photograph only, and some are harder than others."""


def curve_figures(curves: dict[str, dict[str, list[float]]]) -> list[dict[str, Any]]:
    """A chart for every stage and number, the states of a stage as lines of one chart.

    Args:
        curves: ``{stage or "stage state t": {"step": [...], "loss": [...], "psnr": [...], ...}}``.

    Returns:
        Charts as ``{stage, metric, low, high, steps, gaussians, lines}``; a line is ``{label, raw, smooth, last}``
        with SVG path data, x to the right and y downwards in [0, 1].
    """
    stages: dict[str, dict[str, dict[str, list[float]]]] = {}
    for label, series in curves.items():
        stage, _, state = label.partition(" ")
        stages.setdefault(stage, {})[state] = series
    return [_chart(stage, metric, lines) for metric in METRICS for stage, lines in stages.items()]


def _chart(stage: str, metric: str, lines: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    smooth = {label: _smooth(series[metric]) for label, series in lines.items()}
    everything = np.concatenate([np.asarray(s[metric], float) for s in lines.values()])
    finite = everything[np.isfinite(everything)]
    low, high = (float(np.quantile(finite, q)) for q in (0.01, 0.99)) if len(finite) else (0.0, 1.0)
    steps = max(series["step"][-1] for series in lines.values())
    height = max(high - low, 1e-9)

    def path(series: dict[str, list[float]], values: np.ndarray) -> str:
        x = np.asarray(series["step"], float) / steps
        y = 1 - ((values - low) / height).clip(0, 1)
        kept = np.isfinite(y)
        return "M" + "L".join(f"{a:.4f} {b:.4f}" for a, b in zip(x[kept], y[kept], strict=True))

    return {
        "stage": stage,
        "metric": METRICS[metric],
        "low": _short(low),
        "high": _short(high),
        "steps": int(steps),
        "gaussians": sum(int(series["gaussians"][-1]) for series in lines.values()),
        "lines": [
            {
                "label": label,
                "raw": path(series, np.asarray(series[metric], float)),
                "smooth": path(series, smooth[label]),
                "last": _short(float(smooth[label][-1])),
            }
            for label, series in lines.items()
        ],
    }


def _smooth(values: list[float]) -> np.ndarray:
    """Centred means over up to SMOOTH points; the window shrinks at the ends."""
    v = np.asarray(values, float)
    half = SMOOTH // 2
    reach = [min(half, i, len(v) - 1 - i) for i in range(len(v))]
    return np.array([v[i - r : i + r + 1].mean() for i, r in enumerate(reach)])


def _short(value: float) -> str:
    """Three digits that say something."""
    if value == 0 or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"
