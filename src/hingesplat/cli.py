"""The commands. What takes seconds to import is imported where a command runs: ``--help`` is quick."""

import logging
import os
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, make_dataclass, replace
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.table import Table
from rich.text import Text

import hingesplat
from hingesplat.bench import METHODS, BenchOptions, bench, bench_table
from hingesplat.errors import HingesplatError
from hingesplat.export import FORMATS, ExportConfig, export_twin

if TYPE_CHECKING:
    from hingesplat.export.check import Check
    from hingesplat.pipeline import ReconstructConfig
    from hingesplat.twin import Twin

INTERRUPTED, BAD_INPUT, BUG = 130, 2, 1
"""Exit codes beside 0."""
FLAGS = (tyro.conf.FlagCreatePairsOff,)
"""Of tyro: ``--quiet`` without a ``--no-quiet`` beside it."""


@dataclass(frozen=True)
class Reconstruct:
    """Photographs of an object in two or more states to a moving twin; every stage has its options."""

    capture: tyro.conf.Positional[Path]
    """Folder of the capture; its layout is recognised."""
    out: Path
    """Run folder. A run that was stopped goes on after its last finished stage."""
    masks: Path | None = None
    """Folder of masks (MASKS/STATE/IMAGE.png), where the images have none."""
    overwrite: bool = False
    """Start afresh where the run folder holds another run."""
    parents: tuple[Path, ...] = ()
    """Other runs of this capture: a new run takes over their first stages as far as the options agree."""
    quiet: bool = False
    """Say nothing but warnings and errors."""
    config: tyro.conf.Suppress[Any] = None  # A ReconstructConfig; ``parse_reconstruct`` makes options of it.

    @property
    def log_folder(self) -> Path:
        return self.out

    def run(self, console: Console) -> None:
        from hingesplat.capture import load_capture

        config = self.config
        capture = load_capture(self.capture, max_size=config.max_size, masks=self.masks, with_depth=config.depth)
        twin = _reconstruct(capture, config, self.out, self.overwrite, console, self.parents)
        show_joints(console, twin)
        show_paths(console, self.out)


@dataclass(frozen=True)
class View:
    """Look at a run (splats, meshes, joints on sliders, photographs) or a capture (cameras, hulls) in the browser."""

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN|CAPTURE")]
    """A run folder or a capture."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines in."""
    port: int = 8080
    """Port to listen on."""
    masks: Path | None = None
    """Folder with one mask per photograph, as `reconstruct` was given it."""
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        from hingesplat.viewer import open_viewer

        with open_viewer(self.folder, host=self.host, port=self.port, masks=self.masks) as viewer:
            console.print(f"{viewer.url} shows {escape(str(self.folder))}; Ctrl-C ends it", soft_wrap=True)
            with suppress(KeyboardInterrupt):
                threading.Event().wait()


@dataclass(frozen=True)
class Render:
    """Film a run's twin, drawn from its splats: around it, its joints moving, or one after the other."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder."""
    out: Path
    """The film: .mp4 or .gif."""
    what: Literal["orbit", "sweep", "both"] = "both"
    """Once around it; the joints through their range and back; both, one after the other."""
    size: int = 720
    """Width and height, pixels."""
    fps: float = 30
    """Pictures a second."""
    seconds: float = 8
    """Of the whole film, which loops."""
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        from hingesplat.run_folder import load_result, up_of
        from hingesplat.video import write_video

        gaussians, twin = load_result(self.run_folder)
        with StageProgress(console) as report:
            write_video(
                self.out,
                gaussians,
                twin,
                what=self.what,
                up=up_of(self.run_folder),
                size=self.size,
                fps=self.fps,
                seconds=self.seconds,
                report=report,
            )
        console.print(f"written: {escape(str(self.out))}", soft_wrap=True)


@dataclass(frozen=True)
class Report:
    """Write RUN/report.html anew: the twin with sliders, joints, pictures, curves, in one file for any browser."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder."""
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        from hingesplat.report import write_report

        console.print(f"written: {escape(str(write_report(self.run_folder)))}", soft_wrap=True)


@dataclass(frozen=True)
class Export:
    """Write a run's twin for simulators and splat viewers, each format into a folder that can be moved."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder."""
    format: Annotated[tuple[str, ...], tyro.conf.arg(metavar=f"{{{','.join(FORMATS)}}} ...")] = ("urdf", "mjcf")
    """One or more; OUT/FORMAT is what is written."""
    out: Path | None = None
    """Folder to write to; RUN/export if none is given."""
    options: Annotated[ExportConfig, tyro.conf.arg(name="")] = field(default_factory=ExportConfig)
    check: bool = True
    """Whether what was written is loaded in the simulators installed, and each joint driven end to end."""
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        from hingesplat.export.check import check_export
        from hingesplat.run_folder import load_meshes, load_result

        gaussians, twin = load_result(self.run_folder)
        meshes = load_meshes(self.run_folder, twin)
        home = self.run_folder / "export"
        paths = export_twin(twin, meshes, gaussians, self.out or home, self.format, self.options, cache=home / ".hulls")
        for form, path in paths.items():
            console.print(f"written: {escape(str(path))}", soft_wrap=True)
            for check in check_export(form, path) if self.check else ():
                show_check(console, form, check)


@dataclass(frozen=True)
class Evaluate:
    """Compare a run with the truth; every number goes to RUN/metrics.json, and into RUN/report.html."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder."""
    truth: Path
    """Folder of the truth, or the capture that holds it."""
    masks: Path | None = None
    """The folder of masks that the run was given, if any."""
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        from hingesplat.export.check import simulation
        from hingesplat.metrics import evaluate
        from hingesplat.report import write_report

        show_metrics(console, evaluate(self.run_folder, self.truth, simulation(self.run_folder / "export"), self.masks))
        write_report(self.run_folder)
        console.print(f"written: {escape(str(self.run_folder / 'metrics.json'))}", soft_wrap=True)


@dataclass(frozen=True)
class Synth:
    """Make an articulated object and its photographs: a capture with its truth beside it."""

    name: tyro.conf.Positional[str]
    """What to make: docs/objects.png shows all; an unknown name lists them."""
    out: Path
    """Folder for the capture."""
    seed: int = 0
    """Draws shape, textures, joint values and cameras."""
    size: int = 400
    """Width and height of the pictures, pixels."""
    views: int = 100
    """Training views a state."""
    test_views: int = 20
    """Test views a state."""
    states: int = 2
    """Those after the second have joint values between those of the first two."""
    below: float = 0.0
    """Share of the views that look up from slightly below; the others are on the upper hemisphere."""
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        from hingesplat.synth import make

        with StageProgress(console) as report:
            report(stage="synth")
            make(
                self.name,
                self.out,
                seed=self.seed,
                size=self.size,
                train_views=self.views,
                test_views=self.test_views,
                states=self.states,
                below=self.below,
                progress=lambda done, total: report(stage="synth", step=done, steps=total),
            )
        console.print(f"written: {escape(str(self.out))}", soft_wrap=True)


@dataclass(frozen=True)
class Demo:
    """Make a cabinet of a door and a drawer, photograph it, rebuild it as a twin, and measure the twin."""

    out: Path = Path("demo")
    """Gets capture/, made once, and run/, made anew each time."""
    quiet: bool = False
    """Say nothing but warnings and errors."""

    @property
    def log_folder(self) -> Path:
        return self.out / "run"

    def run(self, console: Console) -> None:
        from hingesplat.capture import load_capture
        from hingesplat.export.check import simulation
        from hingesplat.metrics import evaluate
        from hingesplat.report import write_report

        started = time.perf_counter()
        capture, run = self.out / "capture", self.out / "run"
        if not (capture / "truth" / "meta.json").is_file():
            Synth("cabinet", capture, size=200, views=60, test_views=10, below=0.125).run(console)
        twin = _reconstruct(load_capture(capture), demo_config(), run, True, console)
        show_joints(console, twin)
        show_metrics(console, evaluate(run, capture / "truth", simulation(run / "export")))
        write_report(run)
        show_paths(console, run)
        console.print(f"{time.perf_counter() - started:.0f} s in all")


def demo_config() -> "ReconstructConfig":
    """The standard preset with fewer Gaussians, for the demo's 200 pixels, and longer over them."""
    from hingesplat.pipeline import ReconstructConfig

    config = ReconstructConfig()
    return replace(
        config,
        fit=replace(config.fit, start_gaussians=3000, max_gaussians=8000),
        articulate=replace(config.articulate, steps=1700, max_gaussians=16_000),
        mesh=replace(config.mesh, views=32, image_size=200),
    )


@dataclass(frozen=True)
class Bench:
    """Reconstruct and measure methods × objects × seeds, and make the page of results; what is there is kept."""

    methods: tuple[str, ...] = METHODS
    """hingesplat, part2gs, artgs, vanilla; the last three are told the number of parts."""
    captures: Path | None = None
    """Folder of captures with truth/ inside, to be measured instead of made objects, or beside those of --objects."""
    options: Annotated[BenchOptions, tyro.conf.arg(name="")] = field(default_factory=BenchOptions)
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        page = bench(self.options, self.methods, self.captures, _saying(console))
        console.print(f"written: {escape(str(page))}", soft_wrap=True)


@dataclass(frozen=True)
class TableCommand:
    """Make one of the paper's supplementary tables, 4 to 15, on made objects of the same names, at our scale."""

    number: Annotated[tyro.conf.Positional[int], tyro.conf.arg(metavar="N")]
    """Of the table."""
    methods: tuple[str, ...] = ("part2gs", "hingesplat")
    """What the table's variants are variants of, where its rows are not methods themselves."""
    options: Annotated[BenchOptions, tyro.conf.arg(name="")] = field(default_factory=BenchOptions)
    quiet: bool = False
    """Say nothing but warnings and errors."""

    def run(self, console: Console) -> None:
        page = bench_table(self.number, self.options, self.methods, _saying(console))
        console.print(f"written: {escape(str(page))}", soft_wrap=True)


def _saying(console: Console) -> Callable[[str], None]:
    return lambda line: console.print(escape(line), soft_wrap=True)


Command = (
    Reconstruct
    | View
    | Render
    | Report
    | Export
    | Evaluate
    | Synth
    | Demo
    | Bench
    | Annotated[TableCommand, tyro.conf.subcommand("table")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 for bad input, 130 for Ctrl-C, 1 for a bug of ours."""
    command = None
    try:
        command = parse(list(sys.argv[1:] if argv is None else argv))
        console = Console(quiet=command.quiet, highlight=False)
        with _logging_to(console):
            use_all_cores()
            command.run(console)
        return 0
    except SystemExit as e:  # Help, or options that make no sense; tyro has said so.
        return e.code if isinstance(e.code, int) else BAD_INPUT
    except HingesplatError as e:
        return _fail(str(e), BAD_INPUT)
    except KeyboardInterrupt:
        return _fail("interrupted; what is finished is kept, the same command goes on there", INTERRUPTED)
    except Exception as e:
        if (message := _system_message(e)) is not None:
            return _fail(message, BAD_INPUT)
        where = _write_traceback(command)
        return _fail(f"a fault in the program ({type(e).__name__}: {e}); its traceback is in {where}", BUG)


def parse(args: list[str]) -> Command:
    """The command line to a command. Raises SystemExit, as tyro does."""
    if args[:1] == ["reconstruct"] and len(args) > 1:
        return parse_reconstruct(args[1:])
    commands: Any = tyro.conf.OmitSubcommandPrefixes[Command]
    return tyro.cli(commands, args=args, prog="hingesplat", description=hingesplat.__doc__, config=FLAGS)


def parse_reconstruct(args: list[str]) -> Reconstruct:
    """The options of ``reconstruct`` with those of every stage; their defaults are the preset's and the method's."""
    from hingesplat.methods import configure
    from hingesplat.pipeline import ReconstructConfig

    def parsed(default: ReconstructConfig) -> Any:
        nested: Any = Annotated[ReconstructConfig, tyro.conf.arg(name="")]
        fields = [("config", nested, field(default=default, kw_only=True))]
        full = make_dataclass("Reconstruct", fields, bases=(Reconstruct,), frozen=True)
        prog = "hingesplat reconstruct"
        return tyro.cli(full, args=args, prog=prog, description=Reconstruct.__doc__, config=FLAGS)

    command = parsed(ReconstructConfig())
    default = configure(command.config.method, command.config.preset)
    return command if default == ReconstructConfig() else parsed(default)


def _reconstruct(
    capture: Any, config: Any, out: Path, overwrite: bool, console: Console, parents: Sequence[Path] = ()
) -> "Twin":
    from hingesplat.pipeline import reconstruct

    with StageProgress(console) as report:
        return reconstruct(capture, config, out=out, overwrite=overwrite, parents=parents, report=report)


class _Remaining(ProgressColumn):
    """Time left while the steps are known, time taken before and after."""

    def render(self, task: Task) -> Text:
        if task.finished or task.total is None or task.time_remaining is None:
            return Text(f"{task.elapsed or 0:.0f} s")
        return Text(f"{task.time_remaining:.0f} s left")


class StageProgress:
    """What the pipeline reports, as one line a stage: bar, step, loss, PSNR, Gaussians, time left."""

    def __init__(self, console: Console) -> None:
        columns = (
            SpinnerColumn(finished_text="[green]✓[/]"),
            TextColumn("{task.description}"),
            BarColumn(24),
            TextColumn("{task.fields[numbers]}"),
            _Remaining(),
        )
        self.progress = Progress(*columns, console=console, disable=console.quiet or not console.is_terminal)
        self.tasks: dict[str, Any] = {}

    def __enter__(self) -> Callable[..., None]:
        self.progress.start()
        return self.report

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def report(self, *, stage: str, state: int | None = None, seconds: float | None = None, **numbers: Any) -> None:
        label = stage if state is None else f"{stage} state {state}"
        if seconds is not None:
            for name, task in self.tasks.items():
                if name == stage or name.startswith(f"{stage} state "):
                    self._finish(task)
            return
        if label not in self.tasks:
            if state is not None and stage in self.tasks:  # A stage's first state takes the line of the stage.
                self.tasks[label] = self.tasks.pop(stage)
                self.progress.update(self.tasks[label], description=label)
            else:
                for name, task in self.tasks.items():
                    if name.split()[0] != stage:  # States are fitted at once.
                        self._finish(task)
                self.tasks[label] = self.progress.add_task(label, total=None, numbers="")
        if "steps" in numbers:
            self.progress.update(
                self.tasks[label],
                total=numbers["steps"],
                completed=numbers["step"],
                numbers=_numbers(numbers),
            )

    def _finish(self, task: Any) -> None:
        total = self.progress.tasks[self.progress.task_ids.index(task)].total or 1
        self.progress.update(task, total=total, completed=total)


def _numbers(numbers: dict[str, Any]) -> str:
    texts = [f"{numbers['step']}/{numbers['steps']}"]
    if numbers.get("loss") is not None:
        texts.append(f"loss {numbers['loss']:.4f}")
    if numbers.get("psnr") is not None:
        texts.append(f"{numbers['psnr']:.1f} dB")
    if numbers.get("gaussians") is not None:
        texts.append(f"{numbers['gaussians']} Gaussians")
    return "  ".join(texts)


def show_joints(console: Console, twin: "Twin") -> None:
    """The table of the joints found."""
    if not twin.joints:
        console.print("No joints: the twin is static.")
        return
    names = {part.id: part.name for part in twin.parts}
    table = Table(title="Joints found", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for title in ("part", "type", "axis", "pivot", "range", "conf"):
        table.add_column(title, no_wrap=title != "pivot")
    for j in twin.joints:
        turns = j.type == "revolute"
        low, high = (degrees(v) if turns else v for v in j.limits)
        table.add_row(
            names[j.child],
            j.type,
            _vector(j.axis, 3),
            _vector(j.pivot, 2) if turns else "",
            f"{low:.1f} … {high:.1f}°" if turns else f"{low:.3f} … {high:.3f}",
            "" if j.confidence is None else f"{j.confidence:.2f}",
        )
    console.print(table)
    for j in twin.joints:
        console.print(f"{names[j.child]} on {names[j.parent]}: {escape(j.verdict)}", soft_wrap=True)


def show_metrics(console: Console, metrics: dict[str, Any]) -> None:
    """The tables of an evaluation: joints, then surfaces and pictures."""
    titles = ("truth", "part", "type", "axis °", "pos. ×10", "pivot", "motion", "CD")
    table = Table(*titles, title="Beside the truth", box=SIMPLE_HEAD)
    for joint, cd in zip(metrics["joints"], metrics["cd"]["movable"], strict=True):
        motion = [_number(joint["motion_deg"], 3, "°"), _number(joint["motion_units"], 4)]
        found = "missed" if joint["part"] is None else str(joint["part"])
        kind = joint["type_true"]
        table.add_row(
            escape(joint["truth"]),
            found,
            kind if joint["type_found"] == kind else f"{joint['type_found']}, is {kind}",
            _number(joint["axis_deg"], 3),
            _number(joint["position_x10"], 3),
            _number(joint["pivot"], 4),
            "".join(motion),
            _number(cd, 2),
        )
    console.print(table)
    views, depth = metrics["views"], metrics["penetration"]["depth"]
    numbers = {
        "parts": f"{metrics['parts_found']} of {metrics['parts_true']}",
        "extra": str(metrics["superfluous_parts"]),
        "CD static": _number(metrics["cd"]["static"], 2),
        "CD whole": _number(metrics["cd"]["whole"], 2),
        "penetration": _number(depth, 4),
        "PSNR": _number(views["psnr"], 2, " dB"),
        "SSIM": _number(views["ssim"], 4),
        "part IoU": _number(metrics["part_iou"], 3),
    }
    rest = Table(*numbers, box=SIMPLE_HEAD)
    rest.add_row(*numbers.values())
    console.print(rest)
    if (row := metrics.get("simulation")) is not None:
        worst = max(row[form]["error_percent"] or 0.0 for form in ("mjcf", "urdf"))
        how = f"worst tracking error {worst:.2g} % of range" if row["ok"] else "fails; metrics.json says how"
        console.print(f"exports in {row['program']}: {how}")
    if views.get("why_null"):
        console.print(f"no pictures compared: {escape(views['why_null'])}", soft_wrap=True)


def show_check(console: Console, form: str, check: "Check") -> None:
    """What a simulator made of an export; to stderr, too, what went wrong."""
    parts = [f"{check.joints} joint{'' if check.joints == 1 else 's'}"]
    if check.error_percent is not None:
        parts.append(f"worst tracking error {check.error_percent:.2g} % of range")
        parts.append(f"contacts: {'; '.join(check.contacts) or 'none'}")
        if check.ignored:
            parts.append(f"may pass through each other, as their meshes meet: {'; '.join(check.ignored)}")
    parts.append(f"warnings: {len(check.warnings) or 'none'}")
    console.print(f"  {form} in {check.program}: {', '.join(parts)}", soft_wrap=True)
    for warning in check.warnings:
        _say(f"{form} in {check.program}: {warning}")
    if not check.ok and not check.warnings:
        _say(f"{form} in {check.program}: a joint misses its end by {check.error_percent:.2g} % of its range")


def show_paths(console: Console, run: Path) -> None:
    """What a run wrote and what it is for."""
    table = Table.grid(padding=(0, 2))
    for name, what in {
        "report.html": "the twin in a browser",
        "twin.json": "parts and joints",
        "parts": "splats and meshes",
        "export/urdf/twin.urdf": "for robotics",
        "export/mjcf/twin.xml": "for MuJoCo",
        "motion.gif": "the joints moving",
        "summary.png": "photographs, renders, parts",
        "metrics.json": "beside the truth",
    }.items():
        if (run / name).exists():
            table.add_row(what, escape(str(run / name)))
    console.print(table)


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "" if value is None else f"{value:.{digits}f}{unit}"


def _vector(v: Sequence[float], digits: int) -> str:
    return " ".join(f"{round(x, digits) + 0.0:.{digits}f}" for x in v)


class _ConsoleHandler(logging.Handler):
    """Log lines above the progress bars; warnings go to stderr, even when quiet."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.INFO)
        self.console = console

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno > logging.INFO:
            _say(record.getMessage())
        else:
            self.console.print(escape(record.getMessage()), style="dim", soft_wrap=True)


@contextmanager
def _logging_to(console: Console) -> Iterator[None]:
    package = logging.getLogger("hingesplat")
    handler, level = _ConsoleHandler(console), package.level
    package.addHandler(handler)
    package.setLevel(logging.INFO)
    try:
        yield
    finally:
        package.removeHandler(handler)
        package.setLevel(level)


def _say(message: str) -> None:
    """One line on stderr."""
    sys.stderr.write(f"hingesplat: {' '.join(message.split())}\n")


def _fail(message: str, code: int) -> int:
    _say(message)
    return code


def _system_message(error: Exception) -> str | None:
    """One line for what the system refuses (no space, no permission), None for anything else."""
    if "No space left on device" in str(error):  # From safetensors it comes as an error of its own.
        where = getattr(error, "filename", None) or "writing"
        return f"{where}: the disk is full; make room and run the same command again"
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}"
    return None


def _write_traceback(command: Command | None) -> Path:
    folder = getattr(command, "log_folder", None)
    path = (
        folder / "log.txt"
        if folder is not None and (folder / "config.json").is_file()  # Else it is no run yet, and must stay empty.
        else Path(tempfile.gettempdir()) / "hingesplat-log.txt"
    )
    with suppress(OSError), path.open("a", encoding="utf-8") as file:
        traceback.print_exc(file=file)
    return path


def use_all_cores() -> None:
    """Torch takes half of the hardware threads by itself; an explicit OMP_NUM_THREADS wins."""
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(os.cpu_count() or 1)


if __name__ == "__main__":
    sys.exit(main())
