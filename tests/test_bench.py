"""The bookkeeping of benchmarks: what is there is kept, what fails is a row, tables are made of recorded rows."""

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from hingesplat import bench as module
from hingesplat import cli
from hingesplat.bench import BenchOptions, Case, bench, bench_table, cases_of_table
from hingesplat.errors import HingesplatError
from hingesplat.files import write_json
from hingesplat.results import (
    TITLES,
    Row,
    Variant,
    by_variant,
    cells,
    load_rows,
    number_of,
    paper_table,
    trends,
    variant_options,
)


def measured(axis: float = 0.1, parts: int = 2, cd: float = 0.5, motion: float = 0.2, psnr: float = 34.0) -> Row:
    """What a run leaves: a hinge."""
    joint = {
        "truth": "lid",
        "part": 1,
        "type_true": "revolute",
        "type_found": "revolute",
        "axis_deg": axis,
        "position_x10": 0.01,
        "pivot": 0.001,
        "motion_deg": motion,
        "motion_units": None,
    }
    return {
        "summary": {
            "seconds": {"fit": 60.0, "total": 120.0},
            "peak_memory_mb": 900.0,
            "given": {"parts": False, "types": False, "depth": False},
            "machine": "a toaster",
        },
        "metrics": {
            "parts_true": 2,
            "parts_found": parts,
            "joints": [joint],
            "cd": {"static": 1.0, "movable": [cd], "movable_mean": cd, "whole": 0.7},
            "penetration": {"volume_fraction": 0.01, "depth": 0.001},
            "views": {"psnr": psnr, "ssim": 0.98, "lpips": None},
        },
    }


class Runner:
    """Stands in for processes: remembers commands, writes what they would."""

    def __init__(self) -> None:
        self.commands: list[tuple[str, ...]] = []
        self.fails: Callable[[tuple[str, ...]], str | None] = lambda args: None

    def __call__(self, *args: str) -> str | None:
        self.commands.append(args)
        if (error := self.fails(args)) is not None:
            return error
        found = measured()
        if args[0] == "synth":
            Path(args[3]).mkdir(parents=True)
        if args[0] == "reconstruct":
            run = Path(args[3])
            run.mkdir()
            write_json(run / "summary.json", found["summary"])
            write_json(run / "stages.json", {})
            Image.new("RGB", (1200, 800)).save(run / "summary.png")
        if args[0] == "evaluate":
            write_json(Path(args[1]) / "metrics.json", found["metrics"] | {"truth": args[3]})
        return None

    def count(self, command: str) -> int:
        return sum(c[0] == command for c in self.commands)


@pytest.fixture
def runner(monkeypatch) -> Runner:
    runner = Runner()
    monkeypatch.setattr(module, "call", runner)
    monkeypatch.setattr(module, "number_of_parts", lambda told, capture: told.replace("K", "2"))
    return runner


@pytest.fixture
def options(tmp_path: Path) -> BenchOptions:
    return BenchOptions(
        ("laptop", "blade"), seeds=(0, 1), preset="fast", views=9, size=64, out=tmp_path, page=tmp_path / "page.md"
    )


def told(line: str) -> None:
    pass


def test_every_run_once_and_never_again(runner: Runner, options: BenchOptions, tmp_path: Path) -> None:
    page = bench(options, ("hingesplat", "part2gs"), None, told)
    assert runner.count("reconstruct") == runner.count("evaluate") == 8
    assert runner.count("synth") == 4  # Methods share a capture.
    assert len(load_rows(tmp_path)) == 8
    assert "laptop" in page.read_text() and "part2gs" in page.read_text()

    bench(options, ("hingesplat", "part2gs"), None, told)
    assert runner.count("reconstruct") == 8
    bench(options, ("hingesplat", "part2gs", "artgs"), None, told)
    assert runner.count("reconstruct") == 12
    bench(replace(options, views=10), ("hingesplat",), None, told)
    assert runner.count("reconstruct") == 16  # At another scale it is another run.
    bench(replace(options, seeds=(7,), recorded=True), ("hingesplat",), None, told)
    assert runner.count("reconstruct") == 16


def test_commands_say_what_a_run_is(runner: Runner, options: BenchOptions) -> None:
    bench(replace(options, objects=("laptop",), seeds=(3,)), ("hingesplat", "part2gs"), None, told)
    synth, ours, _, theirs, _ = runner.commands
    assert synth[:2] == ("synth", "laptop") and synth[4:] == ("--seed", "3", "--size", "64", "--views", "9")
    assert ours[5:] == ("--preset", "fast", "--method", "hingesplat", "--seed", "3")
    assert theirs[5:13] == ("--preset", "fast", "--method", "part2gs", "--seed", "3", "--parts", "2")
    assert theirs[13:] == ("--parents", ours[3])  # The fits are not made twice.


def test_a_failed_run_is_a_row_and_is_run_again_only_when_asked(runner: Runner, options: BenchOptions) -> None:
    runner.fails = lambda args: "hingesplat: no rigid parts" if args[0] == "reconstruct" and "part2gs" in args else None
    page = bench(options, ("hingesplat", "part2gs"), None, told)
    text = page.read_text()
    assert "- blade, part2gs, seed 1: failed: hingesplat: no rigid parts" in text
    assert "failed: hingesplat: no rigid parts" in cells([r for r in load_rows(options.out) if "error" in r])["parts"]
    n = runner.count("reconstruct")
    bench(options, ("hingesplat", "part2gs"), None, told)
    assert runner.count("reconstruct") == n
    runner.fails = lambda args: None
    page = bench(replace(options, retry=True), ("hingesplat", "part2gs"), None, told)
    assert runner.count("reconstruct") == n + 4
    assert "no rigid parts" not in page.read_text()


def test_a_broken_row_is_named_and_what_to_do_about_it(runner: Runner, options: BenchOptions) -> None:
    bench(options, ("hingesplat",), None, told)
    row = next((options.out / "runs").glob("*.json"))
    row.write_text('{"object": ')
    for again in (options, replace(options, retry=True)):
        with pytest.raises(HingesplatError, match=r"line 1.*delete it") as told_user:
            bench(again, ("hingesplat",), None, told)
        assert str(row) in str(told_user.value)
    assert runner.count("reconstruct") == 4


def test_an_object_that_cannot_be_made_is_a_row(runner: Runner, options: BenchOptions) -> None:
    runner.fails = lambda args: "no space" if args[0] == "synth" else None
    bench(options, ("hingesplat",), None, told)
    assert [r["error"] for r in load_rows(options.out)] == ["no space"] * 4


def test_what_was_interrupted_goes_on(runner: Runner, options: BenchOptions) -> None:
    def interrupt(args: tuple[str, ...]) -> None:
        if runner.count("reconstruct") == 3:
            raise KeyboardInterrupt

    runner.fails = interrupt
    with pytest.raises(KeyboardInterrupt):
        bench(options, ("hingesplat",), None, told)
    assert len(load_rows(options.out)) == 2
    runner.fails = lambda args: None
    bench(options, ("hingesplat",), None, told)
    assert len(load_rows(options.out)) == 4


def test_captures_are_a_section_of_their_own(runner: Runner, options: BenchOptions, tmp_path: Path) -> None:
    (tmp_path / "photos" / "lever" / "truth").mkdir(parents=True)
    (tmp_path / "photos" / "untold").mkdir()
    text = bench(replace(options, objects=()), ("hingesplat",), tmp_path / "photos", told).read_text()
    assert runner.count("synth") == 0 and runner.count("reconstruct") == 2
    assert "## Captures, fast preset" in text and "| lever | 2/2 | 2/2 |" in text and "Made objects" not in text
    with pytest.raises(HingesplatError, match="truth/"):
        bench(options, ("hingesplat",), tmp_path / "photos" / "untold", told)


def test_a_capture_named_like_a_made_object_is_not_taken_for_it(
    runner: Runner, options: BenchOptions, tmp_path: Path
) -> None:
    (tmp_path / "photos" / "laptop" / "truth").mkdir(parents=True)
    bench(replace(options, objects=("laptop",), seeds=(0,)), ("hingesplat",), tmp_path / "photos", told)
    assert runner.count("synth") == 1 and runner.count("reconstruct") == 2
    bare = [r for r in load_rows(options.out) if r["views"] is None]
    assert len(bare) == 1


@pytest.mark.parametrize(("objects", "methods"), [(("teapot",), ("hingesplat",)), ((), ("dta",))])
def test_unknown_names_are_said(options: BenchOptions, objects, methods) -> None:
    with pytest.raises(HingesplatError, match="no such"):
        bench(replace(options, objects=objects), methods, None, told)


def test_the_page_shows_the_worst_of_ours_and_what_went_wrong(options: BenchOptions, runner: Runner) -> None:
    bench(options, ("hingesplat",), None, told)
    for path, found in zip(
        sorted((options.out / "runs").glob("*.json")), [{}, {"parts": 3}, {"cd": 9.0}, {"axis": 40.0}], strict=True
    ):
        write_json(path, json.loads(path.read_text()) | measured(**found))
    text = bench(replace(options, recorded=True), ("hingesplat",), None, told).read_text()
    assert "3 parts of 2" in text and "axis of lid off by 40°" in text
    shown = [line for line in text.splitlines() if line.startswith("![")]
    assert len(shown) == 3
    for line in shown:
        path = options.page.parent / line.split("(")[1].rstrip(")")
        assert path.stat().st_size < 50_000
    order = [line for line in text.splitlines() if "CD-m" in line and "parts of" in line]
    assert "3 parts of 2" in order[0] and "CD-m 9.00" in order[1]
    assert "| 3/4 |" in text  # K right.


def test_medians_beside_other_methods_are_computed(options: BenchOptions) -> None:
    for method, found in (("hingesplat", measured(axis=0.1, cd=0.5)), ("artgs", measured(axis=0.05, cd=0.7))):
        case = Case("laptop", method, 0, "fast", 9, 64)
        write_json_in(options, case, found)
    text = bench(replace(options, recorded=True), ("hingesplat",), None, told).read_text()
    assert "Side by side (runs: 1), artgs's median is better in: axis ° (0.05 against 0.1)." in text


def test_times_of_a_busy_machine_are_not_kept(runner: Runner, options: BenchOptions) -> None:
    said: list[str] = []
    page = bench(replace(options, busy=True), ("hingesplat",), None, said.append)
    assert all(row["summary"]["seconds"] == {} for row in load_rows(options.out))
    head, _, line = [row for row in page.read_text().splitlines() if row.startswith("|")][:3]
    assert dict(zip(head.split(" | "), line.split(" | "), strict=True))["minutes"] == "–"
    assert said[-1].endswith(" min")  # Whoever waits is told.


def write_json_in(options: BenchOptions, case: Case, found: dict[str, Any]) -> None:
    (options.out / "runs").mkdir(parents=True, exist_ok=True)
    write_json(options.out / "runs" / f"{case.name}.json", case.key | found)


@pytest.mark.parametrize("number", range(4, 16))
def test_every_table_of_the_paper_can_be_planned(number: int, options: BenchOptions) -> None:
    from hingesplat.synth.objects import NAMES

    table = paper_table(number)
    assert set(table.objects) <= set(NAMES) and set(table.metrics) <= set(TITLES)
    assert table.reference in {v.name for v in table.variants}
    for figures in table.paper.values():
        assert any(name in figures for name in (v.name for v in table.variants))
    chosen = replace(options, objects=table.objects[:1], seeds=(0,))
    cases = cases_of_table(table, chosen, ("part2gs", "hingesplat"))
    assert len({c.name for c in cases}) == len(cases) > 0


def test_options_of_tables_are_those_of_reconstruct() -> None:
    values: dict[str, list[str]] = {}
    for number in range(4, 16):
        table = paper_table(number)
        for variant in table.variants:
            for key, value in variant_options(table, variant.options, "hingesplat").items():
                values.setdefault(key, []).append(value.replace("K", "4")[:1] if key == "parts" else value)
    for i in range(5):
        chosen = {key: sorted(set(found))[i % len(set(found))] for key, found in values.items()}
        args = ["reconstruct", "x", "--out", "y", *(word for k, v in chosen.items() for word in (f"--{k}", v))]
        assert isinstance(cli.parse(args), cli.Reconstruct)


def test_a_number_that_is_no_table(options: BenchOptions) -> None:
    with pytest.raises(HingesplatError, match="4, 5, 6"):
        bench_table(3, options, ("part2gs",), told)


def test_a_variant_that_changes_nothing_is_the_method_itself(options: BenchOptions) -> None:
    five = paper_table(5)
    assert [variant_options(five, v.options, "part2gs") for v in five.variants] == [
        {"articulate.repel.points": "500"},
        {},
        {"articulate.repel.points": "4000"},
    ]
    ours = variant_options(five, five.variants[1].options, "hingesplat")
    assert ours["articulate.repel.points"] == "2000" and ours["fuse.strategy"] == "global"
    thirteen = paper_table(13)
    assert variant_options(thirteen, {"parts": "K"}, "part2gs") == {}
    assert variant_options(thirteen, {"parts": "K+2"}, "hingesplat") == {"parts": "K+2"}


def test_a_table_runs_what_it_lacks_and_stands_beside_the_paper(runner: Runner, options: BenchOptions) -> None:
    options = replace(options, objects=("table5",), seeds=(0,))
    bench(options, ("part2gs",), None, told)
    text = bench_table(9, options, ("part2gs",), told).read_text()
    assert runner.count("reconstruct") == 1 + 5
    assert "### Table 9: Physics losses, one by one; part2gs (random start)" in text
    assert "| table5 | + contact | 2/2 | 0.10 (0.05) |" in text
    assert "comparisons come out as in the paper" in text
    assert "A difference on one side only:" in text  # All runs of the stand-in are alike.


def rows_of_nine(values: dict[str, list[float]]) -> dict[tuple[str, str], list[Row]]:
    return {("table5", name): [measured(cd=v) for v in cds] for name, cds in values.items()}


def test_trends_are_told_apart_from_noise() -> None:
    """The paper's CD-m of table5: 4.47 without, 1.78 with contact, 3.11 with velocity."""
    nine = replace(paper_table(9), metrics=("cd_movable",))
    found = rows_of_nine({"none": [1.0, 1.2], "+ contact": [0.5, 0.6], "+ velocity": [3.0, 3.2]})
    text = "\n".join(trends(nine, found))
    assert "1 of 2 comparisons" in text
    assert "The other way round:\n\n- CD-m of table5, + velocity: 3.1 against 1.1 (paper 3.11 against 4.47)" in text
    noisy = rows_of_nine({"none": [1.0, 7.0], "+ contact": [0.5, 2.0]})
    assert "0 of 1" in trends(nine, noisy)[0] and "one side only" in "".join(trends(nine, noisy))
    assert trends(nine, {}) == []


def test_no_trend_is_read_from_runs_that_failed() -> None:
    nine = paper_table(9)
    lost = {("table5", name): [measured(axis=a, cd=c)] for name, a, c in (("none", 70, 9), ("+ contact", 80, 90))}
    assert trends(nine, lost) == [
        "Like `none`, these miss the joints by more than 5°: + contact of table5.",
        "No trend is read from them.",
    ]
    found = lost | {("table5", "none"): [measured()]}
    assert any("CD-m of table5, + contact: 90 against 0.5" in line for line in trends(nine, found))


def test_rows_whose_variants_are_methods(options: BenchOptions) -> None:
    for method in ("artgs", "part2gs", "hingesplat"):
        write_json_in(options, Case("stapler", method, 0, "fast", 9, 64), measured())
    found = by_variant(paper_table(15), load_rows(options.out), "")
    assert [name for _, name in found] == ["ArtGS", "Part²GS", "hingesplat"]
    assert Variant("x", {}).method is None
    assert number_of(measured(psnr=31.0), "psnr") == 31.0 and number_of(measured(), "lpips") is None
    assert number_of(measured(), "minutes") == 2


def test_means_and_spreads_of_an_object() -> None:
    rows = [{"subject": "laptop"} | measured(axis=a) for a in (0.1, 0.3)] + [{"subject": "laptop", "error": "lost"}]
    line = cells(rows)
    assert line["object"] == "laptop (1 failed)" and line["axis °"] == "0.200 ± 0.100" and line["types"] == "2/2"


def test_k_is_counted_with_the_base(tmp_path: Path) -> None:
    assert cli.main(["synth", "table4", "--out", str(tmp_path / "t"), "--size", "32", "--views", "3", "--quiet"]) == 0
    numbers = [module.number_of_parts(told, tmp_path / "t") for told in ("K", "K+2", "K-1", "K-9", "7")]
    assert numbers == ["4", "6", "3", "2", "7"]


def test_wrong_tables_and_objects_exit_with_2(capfd) -> None:
    for args in (["table", "3"], ["bench", "--objects", "teapot"], ["bench", "--preset", "quick"]):
        assert cli.main(args) == 2
        assert capfd.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("name", ["cpp", "pixelwise", "warp_port", "taichi_port"])
def test_yardsticks_draw_what_ours_draws(monkeypatch, name: str) -> None:
    """What ours is measured against leans on parts of it, and is no yardstick once these have changed."""
    benchmarks = Path(__file__).parents[1] / "benchmarks"
    monkeypatch.syspath_prepend(str(benchmarks))
    yardstick = importlib.import_module(f"peers.{name}")
    if (why := getattr(yardstick, "why_not", lambda: None)()) is not None:
        pytest.skip(why)
    # In a process of its own: how the code of others has the processor round is not felt by other tests.
    code = f"import rasteriser as r; from peers import {name}; r.check({name!r}, r.peer({name}, *r.SMALL))"
    if name == "cpp":  # It is ours: fast-math would flush small numbers to zero, as Taichi does on loading.
        code += "; assert r.np.array([1e-310]) * 1.0 > 0"
    done = subprocess.run([sys.executable, "-c", code], cwd=benchmarks, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
