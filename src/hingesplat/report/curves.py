"""``curves.json`` as small line charts: paths in a unit square, labels apart, so that the page can stretch them."""

import math
from typing import Any

import numpy as np

METRICS = {"psnr": "PSNR, dB", "loss": "loss"}
SMOOTH = 3
"""Points that a line is averaged over: each stands for a few photographs, and some are harder than others."""


def chart_rows(curves: dict[str, dict[str, list[float]]]) -> list[list[dict[str, Any]]]:
    """A row for every number, in it a chart for every stage, the states of a stage as lines of one chart.

    Args:
        curves: ``{stage or "stage state t": {"step": [...], "loss": [...], "psnr": [...], ...}}``.

    Returns:
        Rows of charts; a chart is ``{stage, metric, low, high, steps, lines}``, a line ``{label, raw, smooth, last}``
        with SVG path data, x to the right and y downwards in [0, 1].
    """
    stages: dict[str, dict[str, dict[str, list[float]]]] = {}
    for label, series in curves.items():
        stage, _, state = label.partition(" ")
        begun = slice(1 if len(series["step"]) > 2 else 0, None)  # The first point is one photograph's alone.
        stages.setdefault(stage, {})[state] = {name: values[begun] for name, values in series.items()}
    return [[_chart(stage, metric, lines) for stage, lines in stages.items()] for metric in METRICS if stages]


def _chart(stage: str, metric: str, lines: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    raw = {label: np.asarray(series[metric], float) for label, series in lines.items()}
    smooth = {label: _smooth(values) for label, values in raw.items()}
    everything = np.concatenate(list(raw.values()))
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
        "lines": [
            {
                "label": label,
                "raw": path(series, raw[label]),
                "smooth": path(series, smooth[label]),
                "last": _short(float(smooth[label][-1])),
            }
            for label, series in lines.items()
        ],
    }


def _smooth(values: np.ndarray) -> np.ndarray:
    """Centred means over up to SMOOTH points; the window shrinks at the ends."""
    reach = [min(SMOOTH // 2, i, len(values) - 1 - i) for i in range(len(values))]
    return np.array([values[i - r : i + r + 1].mean() for i, r in enumerate(reach)])


def _short(value: float) -> str:
    """Three digits that say something."""
    if value == 0 or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"
