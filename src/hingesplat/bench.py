"""Benchmarks: methods × objects × seeds, each run a process of its own, each result a file; what is there is kept.

Truth is opened by ``evaluate`` after a run has ended. The one thing told beforehand is the number of parts, to the
methods that need it: it is counted on the made object, or in the capture's truth, and the results say who was told.
"""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import date
from hashlib import blake2b
from pathlib import Path
from typing import Any

from PIL import Image

from hingesplat.errors import HingesplatError
from hingesplat.files import read_json, whole_file, write_json
from hingesplat.results import (
    BROKEN_ROW,
    PAPER_OBJECTS,
    Row,
    Table,
    load_rows,
    paper_table,
    variant_options,
    write_page,
)

METHODS = ("hingesplat", "part2gs", "artgs", "vanilla")
PRESETS = ("fast", "standard", "paper")
TOLD_K = METHODS[1:]
"""Methods that must be told the number of parts."""
PICTURE_SIZE = 480
"""Width in pixels of the small summaries on the page."""


@dataclass(frozen=True)
class BenchOptions:
    """What every benchmark can be told."""

    objects: tuple[str, ...] = ()
    """Only these made objects; all of the benchmark's, or of the table's, if none is given."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Each draws another object of the name, and every random choice of its reconstruction."""
    preset: str = "standard"
    """Preset of every run."""
    views: int = 100
    """Training views a state of the made objects."""
    size: int = 400
    """Width and height of their pictures, pixels."""
    out: Path = Path("benchmarks/results")
    """Folder of the results: OUT/runs has a file a run."""
    page: Path = Path("docs/results.md")
    """The page made of all results in OUT."""
    work: Path | None = None
    """Where made captures and run folders go and stay; else they go when they have been measured."""
    retry: bool = False
    """Run again what failed before."""
    busy: bool = False
    """The machine has other work meanwhile: how long runs take is not taken down."""
    recorded: bool = False
    """Run nothing: make the page anew."""


@dataclass(frozen=True)
class Case:
    """One run: what makes its result what it is."""

    subject: str
    """Name of a made object, or of a capture."""
    method: str
    seed: int
    preset: str
    views: int | None
    """Training views a state; None for a capture that came with its truth."""
    size: int | None
    options: dict[str, str] = field(default_factory=dict)
    """Of ``reconstruct``, beside the method's; in ``parts``, K stands for the true number."""

    @property
    def key(self) -> dict[str, Any]:
        return asdict(self) | {"options": dict(sorted(self.options.items()))}

    @property
    def name(self) -> str:
        """Of its files: readable, and a digest of everything."""
        digest = blake2b(json.dumps(self.key, sort_keys=True).encode(), digest_size=4).hexdigest()
        return f"{self.subject}_{self.method}_{self.seed}_{digest}"


def cases_of_bench(options: BenchOptions, methods: Sequence[str]) -> list[Case]:
    """Objects × seeds × methods."""
    o = options
    return [
        Case(name, method, seed, o.preset, o.views, o.size)
        for name in o.objects or PAPER_OBJECTS
        for seed in o.seeds
        for method in methods
    ]


def cases_of_table(table: Table, options: BenchOptions, methods: Sequence[str]) -> list[Case]:
    """A table's objects × seeds × variants, for each base method, and that method as it is."""
    o = options
    lost = set(o.objects) - set(table.objects)
    if lost:
        raise HingesplatError(f"table {table.number}: has no {', '.join(sorted(lost))}; {', '.join(table.objects)}")
    plan = [(v.method or base, variant_options(table, v.options, v.method or base)) for v, base in table.each(methods)]
    plan += [(base, {}) for base in methods if table.ablates and not table.given]
    plan = [plan[i] for i in range(len(plan)) if plan[i] not in plan[:i]]
    return [
        Case(name, method, seed, o.preset, o.views, o.size, chosen)
        for name in o.objects or table.objects
        for seed in o.seeds
        for method, chosen in plan
    ]


def bench(options: BenchOptions, methods: Sequence[str], captures: Path | None, say: Callable[[str], None]) -> Path:
    """Run what is not there yet and write the page; returns its path.

    Raises:
        HingesplatError: no such object or method, no capture with a truth in ``captures``.
    """
    _check(options, methods)
    cases = cases_of_bench(options, methods)
    homes: dict[str, Path] = {}
    if captures is not None:
        homes = captures_in(captures)
        if not options.objects:
            cases = []
        cases += [
            Case(name, method, seed, options.preset, None, None)
            for name in homes
            for seed in options.seeds
            for method in methods
        ]
    return _finish(options, cases, homes, say)


def bench_table(number: int, options: BenchOptions, methods: Sequence[str], say: Callable[[str], None]) -> Path:
    """Run what a table of the paper's supplement still lacks, at our scale, and write the page; returns its path."""
    _check(options, methods)
    return _finish(options, cases_of_table(paper_table(number), options, methods), {}, say)


def captures_in(folder: Path) -> dict[str, Path]:
    """Captures with their truth, by name."""
    found = {p.name: p for p in sorted(folder.iterdir()) if (p / "truth").is_dir()} if folder.is_dir() else {}
    if not found:
        raise HingesplatError(f"{folder}: no capture with truth/ inside")
    return found


def _check(options: BenchOptions, methods: Sequence[str]) -> None:
    from hingesplat.synth.objects import NAMES

    named = (("object", options.objects, NAMES), ("method", methods, METHODS), ("preset", [options.preset], PRESETS))
    for kind, names, known in named:
        lost = [n for n in names if n not in known]
        if lost:
            raise HingesplatError(f"{lost[0]}: no such {kind}; there are {', '.join(known)}")


def _finish(options: BenchOptions, cases: Sequence[Case], homes: dict[str, Path], say: Callable[[str], None]) -> Path:
    if not options.recorded:
        run_all(cases, options, homes, say)
    return write_page(options.page, load_rows(options.out), options.out)


def run_all(cases: Sequence[Case], options: BenchOptions, homes: dict[str, Path], say: Callable[[str], None]) -> None:
    """Run every case that has no result yet, those of one object and seed together: they share their first stages."""
    missing = [case for case in cases if not is_there(case, options)]
    say(f"{len(cases)} runs, {len(cases) - len(missing)} of them there")
    work = options.work or Path(tempfile.mkdtemp(prefix="hingesplat-bench-"))
    done = 0
    groups = list(dict.fromkeys((c.subject, c.seed, c.views, c.size) for c in missing))
    try:
        for subject, seed, views, size in groups:
            home = work / f"{subject}_{seed}_{views}_{size}"
            mine = [c for c in missing if (c.subject, c.seed, c.views, c.size) == (subject, seed, views, size)]
            for case in mine:
                row = measure(case, homes.get(subject) if views is None else None, home, options.out)
                done += 1
                how = row.get("error") or f"{row['summary']['seconds']['total'] / 60:.1f} min"
                if options.busy and "summary" in row:
                    row["summary"]["seconds"] = {}
                write_json(options.out / "runs" / f"{case.name}.json", row)
                what = f"{case.subject} {case.method} seed {case.seed} {_plain(case.options)}"
                say(f"{done}/{len(missing)} {what}: {how}")
            if options.work is None:
                shutil.rmtree(home, ignore_errors=True)
    finally:
        if options.work is None:
            shutil.rmtree(work, ignore_errors=True)


def is_there(case: Case, options: BenchOptions) -> bool:
    path = options.out / "runs" / f"{case.name}.json"
    return path.is_file() and not (options.retry and "error" in read_json(path, BROKEN_ROW))


def measure(case: Case, capture: Path | None, home: Path, out: Path) -> Row:
    """Make the capture if there is none, reconstruct, evaluate; what fails is a row with its error line."""
    row: Row = dict(case.key)
    run = home / case.name
    home.mkdir(parents=True, exist_ok=True)
    (out / "runs").mkdir(parents=True, exist_ok=True)
    if capture is None:
        capture = home / "capture"
        if not capture.is_dir():
            scale = ("--seed", str(case.seed), "--size", str(case.size), "--views", str(case.views))
            if error := call("synth", case.subject, "--out", str(capture), *scale):
                return row | {"error": error}
    told = case.options
    if case.method in TOLD_K:
        told = {"parts": "K"} | told
    try:
        told = {k: number_of_parts(v, capture) if k == "parts" else v for k, v in told.items()}
    except HingesplatError as e:
        return row | {"error": str(e).replace(str(capture), case.subject)}
    args = ["--preset", case.preset, "--method", case.method, "--seed", str(case.seed)]
    args += [word for k, v in told.items() for word in (f"--{k}", v)]
    parents = [str(p) for p in sorted(home.iterdir()) if (p / "stages.json").is_file() and p != run]
    args += ["--parents", *parents] if parents else []
    error = call("reconstruct", str(capture), "--out", str(run), "--overwrite", *args)
    error = error or call("evaluate", str(run), "--truth", str(capture))
    if error:
        return row | {"error": error.replace(str(capture), case.subject)}
    if not case.options:
        _keep_picture(run / "summary.png", out / "summaries" / f"{case.name}.jpg")
    return row | results(run) | {"recorded": date.today().isoformat()}


def results(run: Path) -> Row:
    """What a run says of itself, and what ``evaluate`` says of it."""
    found = {name: read_json(run / f"{name}.json") for name in ("summary", "metrics")}
    found["metrics"].pop("truth", None)  # A folder of this machine says nothing elsewhere.
    return found


def call(*args: str) -> str | None:
    """Run one command of the program in a process of its own; its last words if it fails."""
    command = [sys.executable, "-m", "hingesplat", *args, "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stderr.strip() or f"exit code {done.returncode}"
    return said.splitlines()[-1] if done.returncode else None


def number_of_parts(told: str, capture: Path) -> str:
    """``K``, ``K+2``, … with K the capture's true number of parts, the base included."""
    from hingesplat.metrics.truth import load_truth

    match = re.fullmatch(r"K([+-]\d+)?", told)
    return told if match is None else str(max(len(load_truth(capture).parts) + int(match[1] or 0), 2))


def _keep_picture(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(source) as picture, whole_file(target) as tmp:
        small = picture.convert("RGB").resize((PICTURE_SIZE, picture.height * PICTURE_SIZE // picture.width))
        small.save(tmp, "JPEG", quality=80)


def _plain(options: dict[str, str]) -> str:
    return " ".join(f"{k.removeprefix('articulate.')}={v}" for k, v in options.items())
