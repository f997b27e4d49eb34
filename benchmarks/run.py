"""Measure everything: the rasteriser, the demo, and captures where a folder of them is given.

    python benchmarks/run.py [--captures DIR] [--seeds 0 1 2] [--readme README.md]

Writes ``benchmarks/results/`` and sets the table between the marks in the README. Leave the machine alone
meanwhile. ``hingesplat bench`` and ``hingesplat table N`` make the larger comparisons.
"""

import os
import platform
import tempfile
from dataclasses import dataclass
from pathlib import Path

import bench_rasteriser
import torch
import tyro
from rich.console import Console

from hingesplat.bench import BenchOptions, Case, bench, call, results
from hingesplat.files import write_json
from hingesplat.results import Row, cells, grouped, load_rows, markdown

RESULTS = Path(__file__).resolve().parent / "results"
PAGE = RESULTS.parent.parent / "docs" / "results.md"
START, END = "<!-- results -->", "<!-- /results -->"
LEFT_OUT = ("penetration", "fit s", "segment s", "joint s", "rest s")
"""Columns of ``cells`` that the README does without."""


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


def demo() -> Row:
    """The demo twice, in processes of their own: the second run has everything compiled."""
    case = Case("demo", "hingesplat", 0, "standard", None, None)
    error, row = None, dict(case.key)
    with tempfile.TemporaryDirectory(prefix="hingesplat-demo-") as folder:
        for _ in range(2):
            error = error or call("demo", "--out", folder)
        row |= {"error": error} if error else results(Path(folder) / "run")
    write_json(RESULTS / "runs" / f"{case.name}.json", row)
    return row


def readme_table(rows: list[Row]) -> str:
    """The table for the README with what stands around it."""
    lines = markdown([cells(group) for group in grouped(rows, "subject").values()], LEFT_OUT)
    seeds = sorted({r["seed"] for r in rows})
    notes = (
        "Axis, position and motion are those of an object's worst joint; one that was not found counts 90°.",
        f"Seeds: {', '.join(map(str, seeds)) or '–'}; ± is the standard deviation over them.",
        f"Machine: {machine()}.",
    )
    return "\n".join([*lines, "", *notes])


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
        demo()
        if options.captures is not None:
            bench(
                BenchOptions(seeds=options.seeds, out=RESULTS, page=PAGE),
                ("hingesplat",),
                options.captures,
                lambda line: console.print(line, soft_wrap=True, markup=False),
            )
    rows = [r for r in load_rows(RESULTS) if r["method"] == "hingesplat" and r["views"] is None and not r["options"]]
    table = readme_table(sorted(rows, key=lambda r: r["subject"] != "demo"))
    console.print(table, soft_wrap=True, markup=False)
    if options.readme is not None:
        set_table(options.readme, table)


if __name__ == "__main__":
    main()
