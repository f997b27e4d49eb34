"""Measure whole runs: the demo, and captures where a folder of them is given.

    python benchmarks/run.py [--captures DIR] [--seeds 0 1 2] [--readme README.md] [--page docs/performance.md]

Writes ``benchmarks/results/`` and sets the table between the marks in the README, and that of the demo's stages in the
page. Leave the machine alone meanwhile. ``hingesplat bench`` and ``hingesplat table N`` make the larger comparisons.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import stages
import tyro
from common import RESULTS, machine, recorded, save, set_between
from rich.console import Console

from hingesplat.bench import BenchOptions, Case, bench, call, results
from hingesplat.files import write_json
from hingesplat.results import Row, cells, grouped, load_rows, markdown

RESULTS_PAGE = RESULTS.parent.parent / "docs" / "results.md"
LEFT_OUT = ("volume off, %", "penetration", "fit s", "segment s", "joint s", "rest s")
"""Columns of ``cells`` that the README does without."""


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


def demo() -> None:
    """The demo twice, in processes of their own: the second run has everything compiled, and is what is told."""
    case = Case("demo", "hingesplat", 0, "standard", None, None)
    row: Row = dict(case.key)
    with tempfile.TemporaryDirectory(prefix="hingesplat-demo-") as folder:
        for _ in range(2):
            started = time.perf_counter()
            error = call("demo", "--out", folder)
            seconds = round(time.perf_counter() - started, 1)
        if error:
            row |= {"error": error}
        else:
            run = Path(folder) / "run"
            save("stages", {"machine": machine(), **stages.stages_of(run), "wall_seconds": seconds})
            row |= results(run)
    write_json(RESULTS / "runs" / f"{case.name}.json", row)


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


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    console = Console()
    if not options.recorded:
        demo()
        if options.captures is not None:
            bench(
                BenchOptions(seeds=options.seeds, out=RESULTS, page=RESULTS_PAGE),
                ("hingesplat",),
                options.captures,
                lambda line: console.print(line, soft_wrap=True, markup=False),
            )
    rows = [r for r in load_rows(RESULTS) if r["method"] == "hingesplat" and r["views"] is None and not r["options"]]
    table = readme_table(sorted(rows, key=lambda r: r["subject"] != "demo"))
    console.print(table, soft_wrap=True, markup=False)
    if options.readme is not None:
        set_between(options.readme, "results", table)
    if options.page is not None and (found := recorded("stages")) is not None:
        set_between(options.page, "stages", stages.table(found))


if __name__ == "__main__":
    main()
