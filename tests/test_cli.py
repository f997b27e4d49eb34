"""The command line: one clear line for each bad input, exit codes, and a quick ``--help``."""

import errno
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console
from safetensors import SafetensorError

import hingesplat
from hingesplat import cli, pipeline
from hingesplat.console import StageProgress, show_metrics
from hingesplat.gaussians import Gaussians
from hingesplat.pipeline import ReconstructConfig, Run, preset
from hingesplat.twin import Joint, JointStd, Part, Twin

HINGE = Joint(
    1,
    0,
    "revolute",
    (0.0, 0.0, 1.0),
    (0.1, 0.2, 0.3),
    (0.0, 1.0),
    (0.0, 1.0),
    JointStd(0.1, 0.01, 0.02),
    0.93,
)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture whose photographs nobody fits: small and few."""
    out = tmp_path_factory.mktemp("made") / "cabinet"
    assert cli.main(["synth", "cabinet", "--out", str(out), "--size", "48", "--views", "6", "--quiet"]) == 0
    return out


@pytest.fixture
def capture(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "capture"))


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Run], None]], None]:
    """Replaces the stages by two: one that writes a twin of a hinge, and the given one."""

    def first(run: Run) -> None:
        z = torch.zeros
        g = Gaussians(z(2, 3), z(2, 4), z(2, 3), z(2), z(2, 1, 3), torch.tensor([0, 1]))
        g.save(run / "gaussians.safetensors")
        Twin((Part(0, "base", 1), Part(1, "part_1", 1)), (HINGE,)).save(run / "twin.json")

    def put(second: Callable[[Run], None]) -> None:
        monkeypatch.setattr(pipeline, "STAGES", {"first": first, "second": second})

    put(lambda run: None)
    return put


def edit_json(path: Path, change: Callable[[dict], None]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def poses(c: Path, change: Callable[[np.ndarray], np.ndarray], frames: slice = slice(None)) -> None:
    def apply(data: dict) -> None:
        for frame in data["frames"][frames]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    edit_json(c / "state_1" / "transforms_train.json", apply)


def with_nan(T: np.ndarray) -> np.ndarray:
    T[0, 3] = np.nan
    return T


def shifted(T: np.ndarray) -> np.ndarray:
    T[:3, 3] += 5
    return T


def few(data: dict) -> None:
    del data["frames"][2:]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:300])


def opaque(c: Path) -> None:
    for path in (c / "state_0" / "train").glob("*.png"):
        Image.open(path).convert("RGB").save(path)


BAD: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "no folder": (lambda c: shutil.rmtree(c), ["does not exist"]),
    "empty folder": (lambda c: [shutil.rmtree(p) for p in c.iterdir()], ["no capture found"]),
    "one state": (lambda c: shutil.rmtree(c / "state_1"), ["2 states"]),
    "no image": (lambda c: (c / "state_0/train/002.png").unlink(), ["002.png", "does not exist"]),
    "broken JSON": (
        lambda c: truncate(c / "state_1/transforms_train.json"),
        ["transforms_train.json", "JSON"],
    ),
    "no key": (
        lambda c: edit_json(c / "state_0/transforms_train.json", lambda d: d.pop("fl_x")),
        ["state_0/transforms_train.json", "fl_x"],
    ),
    "truncated image": (lambda c: truncate(c / "state_0/train/001.png"), ["001.png", "truncated"]),
    "size": (
        lambda c: Image.new("RGBA", (31, 48)).save(c / "state_0/train/003.png"),
        ["003.png", "31×48"],
    ),
    "no mask": (opaque, ["no mask", "--masks"]),
    "NaN pose": (lambda c: poses(c, with_nan, slice(1, 2)), ["transforms_train.json", "frame 1", "NaN"]),
    "stretched pose": (lambda c: poses(c, lambda T: T * 2, slice(4, 5)), ["frame 4", "rigid"]),
    "frames apart": (lambda c: poses(c, shifted), ["state_1", "frame"]),
    "few views": (lambda c: edit_json(c / "state_0/transforms_train.json", few), ["state_0", "2", "3"]),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_clear_line(name: str, capture: Path, tmp_path: Path, capfd) -> None:
    spoil, words = BAD[name]
    spoil(capture)
    assert cli.main(["reconstruct", str(capture), "--out", str(tmp_path / "run")]) == 2
    out, err = capfd.readouterr()
    assert err.startswith("hingesplat: ") and err.count("\n") == 1 and out == ""
    assert all(word in err for word in words), err
    assert not (tmp_path / "run").exists()


def run_toy(capture: Path, out: Path, *options: str) -> int:
    return cli.main(["reconstruct", str(capture), "--out", str(out), *options])


def test_joints_and_paths_are_shown_at_the_end(stage, capture: Path, tmp_path: Path, monkeypatch, capfd) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert run_toy(capture, tmp_path / "run") == 0
    out, err = capfd.readouterr()
    for text in ("part_1", "revolute", "0.000 0.000 1.000", "0.0 … 57.3°", "0.93", "twin.json"):
        assert text in out, text
    assert err == ""
    assert run_toy(capture, tmp_path / "run", "--quiet") == 0
    assert capfd.readouterr() == ("", "")


def test_a_warning_is_heard_even_when_quiet(stage, capture: Path, tmp_path: Path, capfd) -> None:
    stage(lambda run: pipeline.log.warning("no motion found between state 0 and state 1"))
    assert run_toy(capture, tmp_path / "run", "--quiet") == 0
    assert capfd.readouterr() == ("", "hingesplat: no motion found between state 0 and state 1\n")


def test_run_folder_of_another_capture(stage, capture: Path, tmp_path: Path, capfd) -> None:
    assert run_toy(capture, tmp_path / "run", "--quiet") == 0
    other = shutil.copytree(capture, tmp_path / "other")
    assert run_toy(Path(other), tmp_path / "run", "--quiet") == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and "belongs to another capture" in err and "--overwrite" in err
    assert run_toy(Path(other), tmp_path / "run", "--quiet", "--overwrite") == 0


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)"),
    ],
)
def test_a_full_disk(stage, capture: Path, tmp_path: Path, capfd, error: Exception) -> None:
    def full(run: Run) -> None:
        (run / "half.tmp").write_text("half")
        raise error

    stage(full)
    assert run_toy(capture, tmp_path / "run") == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and "disk is full" in err
    assert not (tmp_path / "run" / "half.tmp").exists()


def test_out_that_cannot_be_made(stage, capture: Path, tmp_path: Path, capfd) -> None:
    (tmp_path / "file").write_text("")
    assert run_toy(capture, tmp_path / "file" / "run") == 2
    assert "file" in (err := capfd.readouterr().err) and err.count("\n") == 1


def test_interrupted_then_resumed(stage, capture: Path, tmp_path: Path, capfd) -> None:
    def interrupt(run: Run) -> None:
        raise KeyboardInterrupt

    stage(interrupt)
    assert run_toy(capture, tmp_path / "run") == 130
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and "interrupted" in err
    assert list(json.loads((tmp_path / "run" / "stages.json").read_text())) == ["first"]
    stage(lambda run: None)
    assert run_toy(capture, tmp_path / "run") == 0


def test_a_bug_leaves_its_traceback_in_the_log(stage, capture: Path, tmp_path: Path, capfd) -> None:
    def bug(run: Run) -> None:
        raise ZeroDivisionError("seven by zero")

    stage(bug)
    assert run_toy(capture, tmp_path / "run") == 1
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and "seven by zero" in err and str(tmp_path / "run" / "log.txt") in err
    assert "Traceback" in (tmp_path / "run" / "log.txt").read_text()


def test_options_of_stages_start_from_the_preset() -> None:
    args = ["reconstruct", "photos", "--out", "twin", "--preset", "fast", "--fit.steps", "7", "--parts", "3"]
    args += ["--depth", "--stereo.planes", "50"]
    command = cli.parse(args)
    assert isinstance(command, cli.Reconstruct)
    fast = preset("fast")
    assert command.config == replace(
        fast, parts=3, depth=True, fit=replace(fast.fit, steps=7), stereo=replace(fast.stereo, planes=50)
    )
    plain = cli.parse(args[:4])
    assert isinstance(plain, cli.Reconstruct) and plain.config == ReconstructConfig()


@pytest.mark.parametrize("args", [["reconstruct"], ["nonsense"], ["synth", "cabinet"], ["reconstruct", "x", "--bad"]])
def test_wrong_options_exit_with_2(args: list[str], capfd) -> None:
    assert cli.main(args) == 2
    assert "Traceback" not in capfd.readouterr().err


def test_other_commands_name_what_is_missing(tmp_path: Path, made: Path, capfd) -> None:
    nothing = str(tmp_path / "nothing")
    for args, word in (
        (["evaluate", nothing, "--truth", str(made)], "no such run folder"),
        (["export", nothing], "no such run folder"),
        (["synth", "teapot", "--out", nothing], "teapot"),
        (["synth", "laptop", "--out", str(made)], "already there"),
    ):
        assert cli.main(args) == 2
        err = capfd.readouterr().err
        assert word in err and err.count("\n") == 1
    assert not Path(nothing).exists()


def test_metrics_table_shows_what_was_missed(capfd) -> None:
    joint = {"truth": "door", "part": None, "type_true": "revolute", "type_found": None, "axis_deg": 90.0}
    metrics = {
        "parts_true": 2,
        "parts_found": 1,
        "superfluous_parts": 0,
        "joints": [joint | {"position_x10": None, "pivot": None, "motion_deg": 90.0, "motion_units": None}],
        "cd": {"static": 1.0, "movable": [12.0], "whole": 2.0},
        "penetration": {"volume_fraction": 0.0, "depth": 0.0},
        "views": {"psnr": None, "ssim": None, "why_null": "no photographs"},
        "part_iou": None,
    }
    show_metrics(Console(width=120), metrics)
    out = capfd.readouterr().out
    assert "missed" in out and "90.000" in out and "no photographs" in out


def test_progress_shows_step_loss_and_time(capfd) -> None:
    console = Console(force_terminal=True, width=120)
    with StageProgress(console) as report:
        report(stage="stereo")
        report(stage="stereo", state=0, step=1, steps=2)
        report(stage="fit")
        report(stage="fit", state=0, step=50, steps=100, loss=0.125, psnr=31.26, gaussians=900)
        report(stage="fit", state=1, step=1, steps=100, loss=0.5, psnr=20.0, gaussians=800)
        report(stage="fit", seconds=2.0)
        report(stage="mesh")
    out = capfd.readouterr().out
    assert "stereo state 0" in out and "1/2" in out
    for text in ("fit state 0", "50/100", "loss 0.1250", "31.3 dB", "900 Gaussians", "fit state 1", "mesh"):
        assert text in out, text


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from hingesplat.cli import main; code = main(['--help']); "
        "heavy = {'torch', 'numba', 'scipy', 'trimesh'} & set(sys.modules); sys.exit(code or len(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "reconstruct" in done.stdout and "demo" in done.stdout


def test_a_run_does_without_the_compiler_of_torch() -> None:
    code = (
        "import sys, torch; from hingesplat import pipeline; from hingesplat.poses import Adam, pose_step\n"
        "x = torch.zeros(1, requires_grad=True); x.grad = torch.ones(1)\n"
        "with pipeline._repeatable('cpu'):\n    pose_step(Adam([x]), 0.1, 0.5)\n"
        "heavy = {'torch._dynamo', 'torch._inductor', 'sklearn'} & set(sys.modules); print(heavy); sys.exit(len(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_public_names_come_when_asked_for() -> None:
    assert hingesplat.reconstruct is pipeline.reconstruct
    assert hingesplat.ReconstructConfig is ReconstructConfig
    assert callable(hingesplat.load_capture) and callable(hingesplat.evaluate)
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        hingesplat.nothing_of_this_name  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
