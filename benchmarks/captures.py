"""Reconstruct captures that have their truth beside them, and put the results in one table.

    python benchmarks/captures.py --captures DIR [--names a b] [--seeds 0 1 2] [--preset standard]

Every run is a process of its own, so that seconds and memory are its own; ``truth/`` is opened after it has
ended.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from common import save
from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Options:
    """What to reconstruct."""

    captures: Path
    """Folder whose folders are captures, each with truth/ inside."""
    names: tuple[str, ...] = ()
    """Only these."""
    seeds: tuple[int, ...] = (0,)
    preset: Literal["fast", "standard", "paper"] = "standard"
    runs: Path | None = None
    """Where the run folders go and stay; a temporary folder if none is given."""


def call(*args: str) -> str | None:
    """Run one command of the program in a process of its own; its last words if it fails."""
    command = [sys.executable, "-m", "hingesplat.cli", *args, "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stderr.strip() or f"exit code {done.returncode}"
    return said.splitlines()[-1] if done.returncode else None


def results(run: Path) -> dict[str, Any]:
    """What a run says of itself, and what ``evaluate`` says of it."""
    found = {name: json.loads((run / f"{name}.json").read_text()) for name in ("summary", "metrics")}
    found["metrics"].pop("truth", None)  # A folder of this machine says nothing elsewhere.
    return found


def measure(capture: Path, run: Path, *options: str) -> dict[str, Any]:
    """Reconstruct and evaluate once; a run that fails is a row, too."""
    error = call("reconstruct", str(capture), "--out", str(run), "--overwrite", *options)
    error = error or call("evaluate", str(run), "--truth", str(capture))
    row = {"capture": capture.name, "options": list(options)}
    return row | ({"error": error} if error else results(run))


def measure_all(options: Options, console: Console) -> list[dict[str, Any]]:
    """Every capture with every seed."""
    folders = sorted(p for p in options.captures.iterdir() if (p / "truth").is_dir())
    chosen = [p for p in folders if not options.names or p.name in options.names]
    lost = set(options.names) - {p.name for p in chosen}
    if lost or not chosen:
        raise SystemExit(f"{options.captures}: no capture with a truth named {', '.join(sorted(lost)) or '(any)'}")
    runs = options.runs or Path(tempfile.mkdtemp(prefix="hingesplat-bench-"))
    runs.mkdir(parents=True, exist_ok=True)
    rows = []
    try:
        for capture in chosen:
            for seed in options.seeds:
                args = ("--seed", str(seed), "--preset", options.preset)
                rows.append(measure(capture, runs / f"{capture.name}_{seed}", *args))
                save("captures", rows)
                line = cells(rows[-1:])
                console.print("  ".join(f"{k} {v}" for k, v in line.items()), soft_wrap=True)
    finally:
        if options.runs is None:
            shutil.rmtree(runs, ignore_errors=True)
    return rows


def by_capture(rows: Sequence[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Runs grouped by capture, in order."""
    names = dict.fromkeys(row["capture"] for row in rows)
    return [[row for row in rows if row["capture"] == name] for name in names]


def cells(rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    """One line of the table: the runs of one capture, mean ± standard deviation over them.

    Axis, position and motion are those of a run's worst joint.
    """
    good = [row for row in rows if "metrics" in row]
    if not good:
        return {"capture": rows[0]["capture"], "parts": f"failed: {rows[0]['error']}"}

    def joint(key: str) -> list[float | None]:
        """The worst joint of each run."""
        values = ([j[key] for j in r["metrics"]["joints"] if j[key] is not None] for r in good)
        return [max(v) if v else None for v in values]

    def seconds(*stages: str) -> list[float]:
        return [sum(r["summary"]["seconds"].get(s, 0.0) for s in stages) for r in good]

    joints = [j for r in good for j in r["metrics"]["joints"]]
    right = sum(j["type_true"] == j["type_found"] for j in joints)
    parts = sorted({f"{r['metrics']['parts_found']}/{r['metrics']['parts_true']}" for r in good})
    cd = [r["metrics"]["cd"] for r in good]
    failed = f" ({len(rows) - len(good)} failed)" if len(good) < len(rows) else ""
    return {
        "capture": rows[0]["capture"] + failed,
        "parts": ", ".join(parts),
        "types": f"{right}/{len(joints)}",
        "axis °": spread(joint("axis_deg"), 3),
        "position": spread(joint("position_x10"), 3),
        "motion °": spread(joint("motion_deg"), 3),
        "motion, units": spread(joint("motion_units"), 4),
        "PSNR": spread([r["metrics"]["views"]["psnr"] for r in good], 1),
        "CD-s": spread([c["static"] for c in cd], 2),
        "CD-m": spread([c["movable_mean"] for c in cd], 2),
        "CD-w": spread([c["whole"] for c in cd], 2),
        "seconds": spread(seconds("total"), 0),
        "fit s": spread(seconds("stereo", "fit"), 0),
        "segment s": spread(seconds("segment"), 0),
        "joint s": spread(seconds("fuse", "articulate", "joints"), 0),
        "rest s": spread(seconds("mesh", "export", "pictures"), 0),
        "MB": spread([r["summary"]["peak_memory_mb"] for r in good], 0),
    }


def spread(values: Sequence[float | None], digits: int) -> str:
    """Mean ± standard deviation of what is there."""
    there = [v for v in values if v is not None]
    if not there:
        return "–"
    text = f"{np.mean(there):.{digits}f}"
    return text if len(there) < 2 else f"{text} ± {np.std(there):.{digits}f}"


def main() -> None:
    console = Console()
    rows = measure_all(tyro.cli(Options, description=__doc__), console)
    lines = [cells(group) for group in by_capture(rows)]
    head = max(lines, key=len)
    table = Table(*head)
    for line in lines:
        table.add_row(*(line.get(title, "") for title in head))
    console.print(table)
    console.print(f"written: {save('captures', rows)}", soft_wrap=True)


if __name__ == "__main__":
    main()
