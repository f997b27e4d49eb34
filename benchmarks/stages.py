"""Where the time of a whole run goes, stage by stage: reconstructs a made cabinet twice, in processes of their own.

    python benchmarks/stages.py [--run FOLDER] [--page docs/performance.md]

The first run compiles, the second does not; ``--run`` takes a run folder that is already there instead. Writes
benchmarks/results/stages.json.
"""

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from common import machine, markdown, save, set_between

from hingesplat.bench import call


@dataclass(frozen=True)
class Options:
    """What to look at."""

    run: Path | None = None
    """A finished run folder; the demo is made if none is given."""
    page: Path | None = None
    """Page whose table is set."""


def stages_of(run: Path) -> dict[str, Any]:
    """Seconds and peak memory of each stage, and what the run says of itself."""
    summary = json.loads((run / "summary.json").read_text())
    gaussians = {part["id"]: part["gaussians"] for part in json.loads((run / "twin.json").read_text())["parts"]}
    return {
        "stages": json.loads((run / "stages.json").read_text()),
        "preset": summary["preset"],
        "threads": summary["machine"],
        "parts": len(gaussians),
        "gaussians": sum(gaussians.values()),
    }


def demo() -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="hingesplat-demo-") as folder:
        for _ in range(2):
            start = time.perf_counter()
            if error := call("demo", "--out", folder):
                raise SystemExit(error)
            wall = time.perf_counter() - start
        return stages_of(Path(folder) / "run") | {"wall_seconds": round(wall, 1)}


def table(found: dict[str, Any]) -> str:
    """For the page."""
    stages = found["stages"]
    total = sum(s["seconds"] for s in stages.values())
    rows = [
        (name, f"{s['seconds']:.1f}", f"{s['seconds'] / total:.0%}", f"{s['peak_memory_mb'] or 0:.0f}")
        for name, s in stages.items()
    ]
    rows.append(("all stages", f"{total:.1f}", "", f"{max(s['peak_memory_mb'] or 0 for s in stages.values()):.0f}"))
    if "wall_seconds" in found:
        rows.append(("with loading, evaluation and report", f"{found['wall_seconds']:.1f}", "", ""))
    what = "The demo with its own settings" if "wall_seconds" in found else f"Preset {found['preset']}"
    told = f"{what}: {found['gaussians']:,} Gaussians in {found['parts']} parts, {found['threads']}"
    head = ("stage", "seconds", "share", "most memory so far, MB")
    return "\n".join([markdown(head, rows), "", f"{told}.", f"Machine: {found['machine']}."])


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    found = {"machine": machine()} | (demo() if options.run is None else stages_of(options.run))
    save("stages", found)
    if options.page is not None:
        set_between(options.page, "stages", table(found))


if __name__ == "__main__":
    main()
