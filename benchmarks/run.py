"""Measure everything: the rasteriser, the demo, and captures where a folder of them is given.

    python benchmarks/run.py [--captures DIR] [--seeds 0 1 2] [--readme README.md]

Writes ``benchmarks/results/*.json`` and sets the table between the marks in the README. Leave the machine
alone meanwhile.
"""

import json
import os
import platform
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench_rasteriser
import torch
import tyro
from captures import RESULTS, by_capture, call, cells, measure_all, results, save
from captures import Options as CaptureOptions
from rich.console import Console

START, END = "<!-- results -->", "<!-- /results -->"
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
    recorded: bool = False
    """Measure nothing: set the table from what ``benchmarks/results/`` holds."""


def demo() -> list[dict[str, Any]]:
    """The demo twice, in processes of their own: the second run has everything compiled."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="hingesplat-demo-") as folder:
        for _ in range(2):
            started = time.perf_counter()
            error = call("demo", "--out", folder)
            row = {"capture": "demo", "wall_seconds": round(time.perf_counter() - started, 1)}
            rows.append(row | ({"error": error} if error else results(Path(folder) / "run")))
    return rows


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


def machine() -> str:
    processor = f"{os.cpu_count()} × {platform.machine()}"
    return f"{processor}, Python {platform.python_version()}, torch {torch.__version__}"


def set_table(readme: Path, table: str) -> None:
    """Replace what stands between the two marks."""
    text = readme.read_text()
    if START not in text or END not in text:
        raise SystemExit(f"{readme}: lacks the marks {START} and {END}")
    before, after = text.split(START)[0], text.split(END)[1]
    tmp = readme.with_name(readme.name + ".tmp")
    tmp.write_text(f"{before}{START}\n{table}\n{END}{after}")
    tmp.replace(readme)


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    console = Console()
    if not options.recorded:
        bench_rasteriser.main()
        save("demo", demo()[-1:])
        if options.captures is not None:
            save("captures", measure_all(CaptureOptions(options.captures, seeds=options.seeds), console))
    files = [RESULTS / f"{name}.json" for name in ("demo", "captures")]
    rows = [row for file in files if file.is_file() for row in json.loads(file.read_text())]
    table = markdown(rows)
    console.print(table, soft_wrap=True, markup=False)
    if options.readme is not None:
        set_table(options.readme, table)


if __name__ == "__main__":
    main()
