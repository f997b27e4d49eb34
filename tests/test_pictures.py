"""Pictures: the right shapes, colours that tell parts apart, a motion that comes back."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hingesplat.camera import Camera
from hingesplat.capture.types import View
from hingesplat.gaussians import SH_C0, Gaussians
from hingesplat.pictures import _sweep, in_part_colours, part_colour, sweep_values, write_motion_gif, write_summary
from hingesplat.twin import Joint, Part, Twin


@pytest.fixture
def scene() -> tuple[Gaussians, Twin, Camera]:
    """Two dots side by side, of which the right one slides further right."""
    gaussians = Gaussians(
        torch.tensor([[-0.3, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        torch.full((2, 3), 0.1).log(),
        torch.full((2,), 5.0),
        torch.zeros(2, 1, 3),
        torch.tensor([0, 1]),
    )
    joint = Joint(1, 0, "prismatic", (1.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.4), (0.0, 0.4))
    T = np.eye(4)
    T[2, 3] = -2.0
    return (
        gaussians,
        Twin((Part(0, "base", 1), Part(1, "slider", 1)), (joint,)),
        Camera(T, 80, 80, 40, 30, 80, 60),
    )


def darkest_column(picture: np.ndarray) -> int:
    """Where the dot right of the middle is."""
    return 36 + int(picture[:, 36:, :3].sum((0, 2)).argmin())


def test_the_gif_moves_out_and_back(scene: tuple[Gaussians, Twin, Camera], tmp_path: Path):
    gaussians, twin, camera = scene
    write_motion_gif(tmp_path / "motion.gif", gaussians, twin, camera, frames=8, size=80)
    with Image.open(tmp_path / "motion.gif") as gif:
        assert gif.n_frames == 8 and gif.size == (80, 60) and gif.info["loop"] == 0
        columns = []
        for i in range(gif.n_frames):
            gif.seek(i)
            frame = np.asarray(gif.convert("RGB"))
            assert (frame[0, 0] == 255).all()
            columns.append(darkest_column(frame))
    assert columns[4] == max(columns) == columns[0] + 16
    assert columns[1:4] == sorted(columns[1:4]) and columns[3] == columns[5]
    assert [p.name for p in tmp_path.iterdir()] == ["motion.gif"]


def test_the_gif_shrinks_to_its_limit(scene: tuple[Gaussians, Twin, Camera], tmp_path: Path):
    path = tmp_path / "motion.gif"
    write_motion_gif(path, *scene, frames=6, size=200, max_bytes=8_000)
    assert path.stat().st_size <= 8_000
    with Image.open(path) as gif:
        assert gif.n_frames == 6


def test_a_twin_without_joints_makes_a_still(scene: tuple[Gaussians, Twin, Camera], tmp_path: Path):
    gaussians, _, camera = scene
    write_motion_gif(tmp_path / "still.gif", gaussians, Twin((Part(0, "base", 2),), ()), camera, size=40)
    with Image.open(tmp_path / "still.gif") as gif:
        assert getattr(gif, "n_frames", 1) == 1


@pytest.mark.parametrize("limits", [(0.0, 1.2), (-0.7, 0.0), (-0.5, 0.9), (0.2, 0.6), (0.0, 0.0)])
def test_a_sweep_starts_and_ends_at_rest_and_reaches_both_limits(limits: tuple[float, float]):
    joint = Joint(1, 0, "revolute", (0, 0, 1), (0, 0, 0), (0.0, 1.0), limits)
    values = np.array([_sweep(joint, p) for p in np.linspace(0, 1, 2001)])
    rest = np.clip(0.0, *limits)
    assert values[0] == values[-1] == rest
    assert values.min() == pytest.approx(limits[0], abs=1e-5)
    assert values.max() == pytest.approx(limits[1], abs=1e-5)
    assert np.abs(np.diff(values)).max() < 0.01  # no jumps


def test_every_joint_has_its_turn():
    joints = [Joint(i, 0, "revolute", (0, 0, 1), (0, 0, 0), (0.0, 1.0), (0.0, 1.0)) for i in (1, 2, 3)]
    values = np.array([list(sweep_values(joints, t).values()) for t in np.linspace(0, 1, 401)])
    assert values.max(0) == pytest.approx(np.ones(3), abs=1e-3)
    assert (values[0] == 0).all() and (values[-1] == 0).all()
    assert list(values.argmax(0)) == sorted(values.argmax(0))


def test_the_summary_has_a_row_a_state_and_shows_what_moved(scene: tuple[Gaussians, Twin, Camera], tmp_path: Path):
    gaussians, twin, camera = scene
    photo = np.zeros((60, 80, 4), np.uint8)  # transparent: white in the sheet
    states = [(View(camera, photo, "x"), twin.at_state(s)) for s in (0, 1)]
    write_summary(tmp_path / "summary.png", gaussians, states, size=80)
    with Image.open(tmp_path / "summary.png") as image:
        sheet = np.asarray(image)
    gap, head = 12, 30
    assert sheet.shape == (head + 2 * (60 + gap), 3 * (80 + gap) + gap, 3)

    def cell(row: int, column: int) -> np.ndarray:
        top, left = head + row * (60 + gap), gap + column * (80 + gap)
        return sheet[top + 24 : top + 60, left : left + 80]  # below the label

    assert (cell(0, 0) == 255).all()
    assert darkest_column(cell(1, 1)) - darkest_column(cell(0, 1)) == 16
    part = cell(0, 2)[6, 44].astype(float)
    assert part / part.max() == pytest.approx(np.array(part_colour(1)) / max(part_colour(1)), abs=0.1)


def test_parts_have_colours_of_their_own(scene: tuple[Gaussians, Twin, Camera]):
    colours = np.array([part_colour(i) for i in range(12)])
    apart = np.linalg.norm(colours[:, None] - colours[None], axis=-1) + 9 * np.eye(12)
    assert apart.min() > 0.15
    painted = in_part_colours(scene[0])
    rgb = 0.5 + SH_C0 * painted.sh[:, 0]
    assert rgb[0].std() < 0.05 < rgb[1].std()
