"""The commands. What takes seconds to import is imported where a command runs: ``--help`` is quick."""

import os
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape

import hingesplat
from hingesplat.bench import METHODS, BenchOptions, bench, bench_table
from hingesplat.console import ConsoleHandler, StageProgress, say, show_check, show_joints, show_metrics, show_paths
from hingesplat.errors import HingesplatError
from hingesplat.export import FORMATS, ExportConfig, export_twin
from hingesplat.logs import heard_by

if TYPE_CHECKING:
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

        viewing = open_viewer(self.folder, host=self.host, port=self.port, masks=self.masks)
        with viewing as viewer, suppress(KeyboardInterrupt):  # From the moment on that the user is told of it.
            console.print(f"{viewer.url} shows {escape(str(self.folder))}; Ctrl-C ends it", soft_wrap=True)
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
    """The standard preset with fewer Gaussians a state, for the demo's 200 pixels."""
    from hingesplat.pipeline import ReconstructConfig

    config = ReconstructConfig()
    return replace(config, fit=replace(config.fit, start_gaussians=3000, max_gaussians=8000))


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
        with heard_by(ConsoleHandler(console)):
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


def _fail(message: str, code: int) -> int:
    say(message)
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
