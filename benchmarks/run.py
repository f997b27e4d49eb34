"""Measure whole runs: the demo, and captures where a folder of them is given.

    python benchmarks/run.py [--captures DIR] [--seeds 0 1 2] [--readme README.md] [--page docs/performance.md]

Writes ``benchmarks/results/*.json`` and sets the table between the marks in the README, and that of the demo's stages
in the page. Leave the machine alone meanwhile.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import stages
import tyro
from captures import Options as CaptureOptions
from captures import by_capture, call, cells, measure_all, results
from common import machine, recorded, save, set_between
from rich.console import Console

LEFT_OUT = ("fit s", "segment s", "joint s", "rest s")
"""Columns of ``captures.cells`` that the README does without."""


@dataclass(frozen=True)
class Options:
    """What to measure beside the demo."""

    captures: Path | None = None
    """Folder whose folders are captures, each with truth/ inside."""
    seeds: tuple[int, ...] = (0, 1, 2)
    readme: Path | None = None
    """File whose table is set."""
    page: Path | None = None
    """Page whose table of stages is set."""
    recorded: bool = False
    """Measure nothing: set the table from what ``benchmarks/results/`` holds."""


def demo() -> dict[str, Any]:
    """The demo twice, in processes of their own: the second run has everything compiled, and is what is told."""
    with tempfile.TemporaryDirectory(prefix="hingesplat-demo-") as folder:
        for _ in range(2):
            started = time.perf_counter()
            error = call("demo", "--out", folder)
            row: dict[str, Any] = {"capture": "demo", "wall_seconds": round(time.perf_counter() - started, 1)}
        if error:
            return row | {"error": error}
        run = Path(folder) / "run"
        save("stages", {"machine": machine(), **stages.stages_of(run), "wall_seconds": row["wall_seconds"]})
        return row | results(run)


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The table for the README with what stands around it."""
    groups = by_capture(rows)
    lines = [cells(group) for group in groups]
    head = [title for title in max(lines, key=len) if title not in LEFT_OUT]
    table = ["| " + " | ".join([*head, "given"]) + " |", "|---" * (len(head) + 1) + "|"]
    for line, group in zip(lines, groups, strict=True):
        given = next((r["summary"]["given"] for r in group if "summary" in r), None)
        told = "" if given is None else ", ".join(k for k, v in given.items() if v) or "nothing"
        table.append("| " + " | ".join([*(line.get(title, "") for title in head), told]) + " |")
    seeds = sorted({r["summary"]["seed"] for r in rows if "summary" in r})
    notes = (
        "Axis, position and motion are those of a capture's worst joint; one that was not found counts 90°.",
        f"Seeds: {', '.join(map(str, seeds)) or '–'}; ± is the standard deviation over them.",
        f"Machine: {machine()}.",
    )
    return "\n".join([*table, "", *notes])


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    console = Console()
    if not options.recorded:
        save("demo", [demo()])
        if options.captures is not None:
            save("captures", measure_all(CaptureOptions(options.captures, seeds=options.seeds), console))
    rows = [row for name in ("demo", "captures") for row in recorded(name) or []]
    table = markdown(rows)
    console.print(table, soft_wrap=True, markup=False)
    if options.readme is not None:
        set_between(options.readme, "results", table)
    if options.page is not None and (found := recorded("stages")) is not None:
        set_between(options.page, "stages", stages.table(found))


if __name__ == "__main__":
    main()
