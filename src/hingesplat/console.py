"""What the command line shows of a run: its progress, its joints, its errors beside the truth, its files."""

import logging
import sys
from collections.abc import Callable, Sequence
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from hingesplat.export.check import Check
    from hingesplat.twin import Twin


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
        say(f"{form} in {check.program}: {warning}")
    if not check.ok and not check.warnings:
        say(f"{form} in {check.program}: a joint misses its end by {check.error_percent:.2g} % of its range")


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


class ConsoleHandler(logging.Handler):
    """Log lines above the progress bars; warnings go to stderr, even when quiet."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.INFO)
        self.console = console

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno > logging.INFO:
            say(record.getMessage())
        else:
            self.console.print(escape(record.getMessage()), style="dim", soft_wrap=True)


def say(message: str) -> None:
    """One line on stderr."""
    sys.stderr.write(f"hingesplat: {' '.join(message.split())}\n")
