"""Films: decoded back, they have the frames they should, show all of the object, and move what moves."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hingesplat import cli
from hingesplat.camera import Camera, common_up, look_at
from hingesplat.gaussians import Gaussians, concatenate
from hingesplat.twin import Joint, Part, Twin
from hingesplat.video import _shot, write_video
from scenes import box, one_thread

__all__ = ["one_thread"]

DOOR = Joint(1, 0, "revolute", (0.0, 0.0, 1.0), (0.3, -0.35, 0.0), (0.0, 1.2), (0.0, 1.2))
TWIN = Twin((Part(0, "base", 0), Part(1, "door", 0)), (DOOR,))


@pytest.fixture(scope="module")
def blocks() -> Gaussians:
    base = box((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3), 0.05, seed=1)
    return concatenate([base, box((-0.3, -0.4, -0.3), (0.3, -0.35, 0.3), 0.05, seed=2, part=1)])


def frames_of(path: Path, size: int = 96) -> np.ndarray:
    """(n, size, size, 3) uint8."""
    if path.suffix == ".gif":
        with Image.open(path) as gif:
            frames = []
            for i in range(getattr(gif, "n_frames", 1)):
                gif.seek(i)
                frames.append(np.asarray(gif.convert("RGB")))
            return np.stack(frames)
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed")
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, size, size, 3)


def solid(frames: np.ndarray) -> np.ndarray:
    """Pixels of the object: the background is grey and bright."""
    f = frames.astype(int)
    return (f.max(-1) - f.min(-1) > 30) | (f.max(-1) < 200)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_has_its_frames_and_cuts_nothing_off(blocks: Gaussians, tmp_path: Path, suffix: str) -> None:
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed")
    path = tmp_path / "films" / f"turn{suffix}"
    steps = []
    write_video(path, blocks, TWIN, size=96, fps=10, seconds=2.4, report=lambda **r: steps.append(r["step"]))
    frames = frames_of(path)
    assert frames.shape == (24, 96, 96, 3) and steps == list(range(1, 25))
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    seen = solid(frames)
    assert not seen[:, [0, -1]].any() and not seen[:, :, [0, -1]].any()
    rows, columns = np.nonzero(seen.any(0))
    assert max(np.ptp(rows), np.ptp(columns)) > 0.7 * 96, "the object could be larger"
    rows, columns = np.nonzero(seen[0])
    assert abs(rows.mean() - 48) < 9 and abs(columns.mean() - 48) < 9
    assert seen.any((1, 2)).all()


def test_a_sweep_moves_the_door_and_not_the_base(blocks: Gaussians, tmp_path: Path) -> None:
    write_video(tmp_path / "sweep.gif", blocks, TWIN, what="sweep", size=96, fps=10, seconds=1.2)
    frames = frames_of(tmp_path / "sweep.gif").astype(int)
    moved = np.abs(frames - frames[0]).max(-1) > 40
    assert moved[6].mean() > 0.05 and moved[6].sum() > 3 * moved[1].sum()
    unmoved = solid(frames).all(0) & ~moved.any(0)
    assert unmoved.mean() > 0.03, "everything moves"


def test_an_orbit_leaves_joints_alone_and_both_goes_on_where_it_began() -> None:
    n = 400
    for what in ("orbit", "sweep", "both"):
        shots = [_shot(what, i / n, [DOOR]) for i in range(n)]
        turns = np.unwrap([turn for turn, _ in shots] + [0.0])
        values = np.array([v.get(1, 0.0) for _, v in shots] + [0.0])
        assert abs(np.diff(turns)).max() < 0.07 and abs(np.diff(values)).max() < 0.03  # no jumps, nor at the seam
        assert (np.ptp(turns) > 6.2) == (what != "sweep")
        assert values.max() == pytest.approx(0 if what == "orbit" else 1.2, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "options", "word"),
    [
        ("turn.avi", {}, ".mp4 or .gif"),
        ("turn.gif", {"size": 97}, "even"),
        ("turn.gif", {"fps": 60}, "fps"),
        ("turn.gif", {"seconds": 0}, "seconds"),
        (".", {}, ".mp4 or .gif"),
    ],
)
def test_bad_input_gets_one_clear_line(
    blocks: Gaussians, tmp_path: Path, capfd, name: str, options: dict[str, float], word: str
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    blocks.save(run / "gaussians.safetensors")
    TWIN.save(run / "twin.json")
    args = [text for key, value in options.items() for text in (f"--{key}", str(value))]
    assert cli.main(["render", str(run), "--out", str(tmp_path / name), *args]) == 2
    out, err = capfd.readouterr()
    assert word in err and err.count("\n") == 1 and out == ""
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_what_cannot_be_filmed_is_said_before_anything_is_drawn(
    blocks: Gaussians, tmp_path: Path, capfd, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = str(tmp_path / "turn.mp4")
    assert cli.main(["render", str(tmp_path / "nothing"), "--out", out]) == 2
    assert "no such run folder" in capfd.readouterr().err
    assert cli.main(["render", str(tmp_path), "--out", out]) == 2
    assert "twin.json" in capfd.readouterr().err
    blocks.save(tmp_path / "gaussians.safetensors")
    Twin(TWIN.parts[:1], ()).save(tmp_path / "twin.json")
    still = tmp_path / "still.gif"
    assert cli.main(["render", str(tmp_path), "--out", str(still), "--what", "sweep"]) == 2
    assert "no joint" in capfd.readouterr().err
    assert cli.main(["render", str(tmp_path), "--out", str(still), "--size", "32", "--fps", "4", "--seconds", "1"]) == 0
    assert still.is_file()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    capfd.readouterr()
    assert cli.main(["render", str(tmp_path), "--out", out]) == 2
    err = capfd.readouterr().err
    assert "hingesplat[video]" in err and err.count("\n") == 1


def test_a_failing_encoder_leaves_nothing_behind(
    blocks: Gaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd
) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed")
    (tmp_path / "turn.mp4").write_text("the old film")
    blocks.save(tmp_path / "gaussians.safetensors")
    TWIN.save(tmp_path / "twin.json")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "false")
    args = ["render", str(tmp_path), "--out", str(tmp_path / "turn.mp4"), "--size", "64", "--seconds", "1"]
    assert cli.main(args) == 2
    err = capfd.readouterr().err
    assert "turn.mp4" in err and "ffmpeg" in err and err.count("\n") == 1
    assert (tmp_path / "turn.mp4").read_text() == "the old film" and not list(tmp_path.glob("*.tmp"))


@pytest.mark.parametrize("true_up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.48, 0.6, 0.64)])
@pytest.mark.parametrize("front", [False, True])
def test_level_cameras_know_which_way_is_up(true_up: tuple[float, float, float], front: bool) -> None:
    up = np.array(true_up)
    side = np.cross(up, [0.3, 0.5, -0.7])
    side /= np.linalg.norm(side)
    cameras = []
    for azimuth in np.linspace(0, 1.5 if front else 2 * np.pi, 12, endpoint=False):
        level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
        T = look_at(3 * level + 2 * up, np.zeros(3), up)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1) and T[:3, 1] @ up < 0
        cameras.append(Camera(T, 100, 100, 50, 50, 100, 100))
    assert common_up(cameras) == pytest.approx(up, abs=1e-6)
