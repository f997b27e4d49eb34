"""The viewer: where it listens, that sliders pose parts as the twin does, what it says of bad input, a real browser."""

import io
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
import trimesh
from PIL import Image

from hingesplat import cli
from hingesplat.gaussians import Gaussians, concatenate
from hingesplat.twin import Joint, Part, Twin
from scenes import box_surface, look_at, one_thread, sheet

pytest.importorskip("viser", reason="viser is not installed")
from hingesplat.viewer import CaptureView, TwinView, Viewer, open_viewer

__all__ = ["one_thread"]

DOOR = Joint(1, 0, "revolute", (0.0, 0.0, 1.0), (0.3, -0.4, 0.0), (0.0, 1.03), (0.0, 1.03), verdict="seen well")
KNOB = Joint(2, 1, "prismatic", (0.0, -1.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.2), (-0.1, 0.2))
TWIN = Twin((Part(0, "base", 0), Part(1, "door", 0, mesh="door.glb"), Part(2, "knob", 0)), (DOOR, KNOB))
BOXES = (
    ((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3), (0.8, 0.1, 0.1)),
    ((-0.3, -0.35, -0.3), (0.3, -0.32, 0.3), (0.1, 0.2, 0.9)),
    ((-0.05, -0.43, -0.05), (0.05, -0.35, 0.05), (0.1, 0.8, 0.1)),
)
"""A red base, a blue door on it and a green knob that is pulled out of the door."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs in two states; that they show something else than the twin does not matter here."""
    out = tmp_path_factory.mktemp("made") / "laptop"
    assert cli.main(["synth", "laptop", "--out", str(out), "--size", "48", "--views", "6", "--quiet"]) == 0
    return out


def blocks() -> Gaussians:
    parts = []
    for i, (low, high, colour) in enumerate(BOXES):
        points, normals = box_surface(low, high, 0.03)
        g = sheet(points, normals, np.tile(colour, (len(points), 1)), 0.018)
        parts.append(g.with_part(g.part + i))
    return concatenate(parts)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder without its photographs."""
    folder = tmp_path / "run"
    folder.mkdir()
    blocks().save(folder / "gaussians.safetensors")
    TWIN.save(folder / "twin.json")
    trimesh.creation.box((0.6, 0.04, 0.6)).export(folder / "door.glb")
    return folder


@pytest.fixture
def viewer(run: Path) -> Iterator[Viewer]:
    with open_viewer(run, port=0) as viewer:
        yield viewer


@pytest.fixture
def twin_view(viewer: Viewer) -> TwinView:
    assert isinstance(viewer.shown, TwinView)
    return viewer.shown


def pose(view: TwinView, part: int) -> np.ndarray:
    """Where the browser is told to put a part, in world units."""
    w, x, y, z = view.frames[part].wxyz
    T = np.eye(4)
    T[:3, :3] = 2 * np.array(
        [
            [0.5 - y * y - z * z, x * y - z * w, x * z + y * w],
            [x * y + z * w, 0.5 - x * x - z * z, y * z - x * w],
            [x * z - y * w, y * z + x * w, 0.5 - x * x - y * y],
        ]
    )
    T[:3, 3] = np.asarray(view.frames[part].position) / view.stage.scale
    return T


def until(condition: Callable[[], bool], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_it_listens_on_this_machine_only(viewer: Viewer) -> None:
    port = viewer.server.get_port()
    assert viewer.url == f"http://127.0.0.1:{port}"
    with urlopen(viewer.url) as page:
        assert page.status == 200
    if sys.platform == "linux":  # Every address in 127/8 is this machine's, and a server on all would hear this one.
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", port), timeout=2).close()


def test_a_slider_moves_its_part_and_what_hangs_on_it(twin_view: TwinView) -> None:
    twin_view.sliders[1].value = 40.0
    there = TWIN.transforms({1: np.radians(40.0)})
    for part in (0, 1, 2):
        assert pose(twin_view, part) == pytest.approx(there[part], abs=1e-6)
    assert pose(twin_view, 0) == pytest.approx(np.eye(4))
    twin_view.sliders[2].value = 0.15
    there = TWIN.transforms({1: np.radians(40.0), 2: 0.15})
    for part in (0, 1, 2):
        assert pose(twin_view, part) == pytest.approx(there[part], abs=1e-6)
    assert not np.allclose(there[2], there[1])


def test_sliders_are_round_and_hold_the_limits(twin_view: TwinView) -> None:
    door, knob = twin_view.sliders[1], twin_view.sliders[2]
    assert (door.min, door.max, door.value) == (0, 59.1, 0) and (knob.min, knob.max) == (-0.1, 0.2)
    assert "door (°)" in door.label and "revolute on base: seen well" in str(door.hint)
    door.value = door.max
    assert twin_view.values == {1: 1.03, 2: 0}
    twin_view.to_state(1)
    assert twin_view.values == pytest.approx({1: 1.03, 2: 0.2})
    twin_view.to_state(0)
    assert pose(twin_view, 2) == pytest.approx(np.eye(4))


def test_play_runs_through_the_range_until_paused(twin_view: TwinView) -> None:
    seen = []
    twin_view.sliders[1].on_update(lambda event: seen.append(event.target.value))
    twin_view.play(True)
    until(lambda: len(seen) > 5)
    twin_view.play(False)
    time.sleep(0.15)
    count = len(seen)
    assert seen[:5] == sorted(seen[:5]) and seen[4] > seen[0]
    assert pose(twin_view, 1) == pytest.approx(TWIN.transforms(twin_view.values)[1], abs=1e-6)
    time.sleep(0.15)
    assert len(seen) == count


def test_parts_without_a_mesh_and_static_twins_are_shown(run: Path) -> None:
    Twin((Part(0, "base", 0),), ()).save(run / "twin.json")
    with open_viewer(run, port=0) as viewer:
        assert isinstance(viewer.shown, TwinView)
        assert viewer.shown.sliders == {} and tuple(viewer.shown.look.options) == ("splats", "splats, parts coloured")


def test_a_photograph_sets_the_state_and_stands_beside_its_render(run: Path, made: Path) -> None:
    (run / "config.json").write_text(json.dumps({"capture": str(made)}))
    with open_viewer(run, port=0) as viewer:
        view = viewer.shown
        assert isinstance(view, TwinView) and view.photos is not None
        assert view.photos.state == 1 and view.values == pytest.approx({1: 1.03, 2: 0.2})
        view.photos.choose(0, 2)
        assert view.values == {1: 0, 2: 0} and view.photos.view.name.endswith("state_0/train/002.png")
        until(lambda: "002.png" in view.photos.caption)
        pair = view.photos.picture.astype(int)
        size = pair.shape[0]
        rgba = view.photos.view.rgba / 255
        photo = np.asarray(Image.fromarray(np.uint8(255 * (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]))))
        shown = np.asarray(Image.fromarray(np.uint8(pair[:, :size])).resize(photo.shape[:2], Image.Resampling.BOX))
        assert np.abs(shown.astype(int) - photo).mean() < 5
        right = pair[:, -size:]
        assert ((right[..., 0] > 150) & (right[..., 1] < 100)).any(), "the red base is not in the render"
        before = right.copy()
        view.sliders[1].value = 59.1
        until(lambda: not np.array_equal(view.photos.picture[:, -size:], before))


def test_repel_points_are_shown_where_the_run_had_some(run: Path) -> None:
    (run / "config.json").write_text(json.dumps({"articulate": {"repel": {"points": 50}}}))
    blocks().save(run / "canonical.safetensors")
    from hingesplat.run_folder import repel_points_of

    points = repel_points_of(run)
    assert points.shape == (50, 3) and (np.abs(points) < 0.31).all()
    with open_viewer(run, port=0) as viewer:
        labels = [handle.label for handle in viewer.server.gui._gui_input_handle_from_uuid.values()]
        assert "Repel points" in labels


def test_a_capture_shows_cameras_and_hulls(made: Path) -> None:
    with open_viewer(made, port=0) as viewer:
        assert isinstance(viewer.shown, CaptureView)
        nodes = viewer.server.scene._handle_from_node_name
        assert sum(bool(re.fullmatch(r"/state_\d/camera_\d", name)) for name in nodes) == 12
        hull: Any = nodes["/hull_0"]
        assert len(hull.points) > 500 and nodes["/hull_0"].visible and not nodes["/hull_1"].visible
        viewer.shown.photos.choose(1, 3)
        assert "state_1/train/003.png" in viewer.shown.photos.caption


def fails(capfd: Any, *args: str) -> str:
    assert cli.main(["view", *args]) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("hingesplat: ") and err.count("\n") == 1
    return err


def test_bad_input_gets_one_clear_line(run: Path, tmp_path: Path, capfd) -> None:
    assert "does not exist" in fails(capfd, str(tmp_path / "nothing"))
    (tmp_path / "empty").mkdir()
    err = fails(capfd, str(tmp_path / "empty"))
    assert "no twin.json" in err and "no capture" in err
    assert "host" in fails(capfd, str(run), "--host", "no.such.host.invalid")
    assert "65535" in fails(capfd, str(run), "--port", "99999")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        err = fails(capfd, str(run), "--port", port)
        assert port in err and "in use" in err
    (run / "gaussians.safetensors").unlink()
    assert "gaussians.safetensors" in fails(capfd, str(run))
    (run / "twin.json").unlink()
    (run / "config.json").write_text("{}")
    assert "no twin yet" in fails(capfd, str(run))


def test_without_viser_it_says_what_to_install(run: Path, monkeypatch: pytest.MonkeyPatch, capfd) -> None:
    monkeypatch.delitem(sys.modules, "hingesplat.viewer")
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'hingesplat[view]'" in fails(capfd, str(run))


def test_a_capture_that_is_gone_leaves_the_twin(run: Path, made: Path, tmp_path: Path, caplog) -> None:
    (run / "config.json").write_text(json.dumps({"capture": str(tmp_path / "gone")}))
    with open_viewer(run, port=0) as viewer:
        assert isinstance(viewer.shown, TwinView) and viewer.shown.photos is None


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is another thing there")
def test_the_command_serves_until_interrupted(run: Path) -> None:
    command = [sys.executable, "-m", "hingesplat", "view", str(run), "--port", "0"]

    def hear_ctrl_c() -> None:  # Shells start what runs in the background deaf to it.
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=hear_ctrl_c) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            url = re.match(r"http://127\.0\.0\.1:\d+", line)
            assert url is not None, line
            with urlopen(url[0]) as page:
                assert page.status == 200
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, out, err) == (0, "", "")


KNOWN = ("computeBoundingSphere(): Computed radius is NaN", "net::ERR_FILE_NOT_FOUND")
"""viser's own: the corners of its splats have two coordinates; a picture that was replaced before it was drawn."""


def test_in_a_browser_a_slider_moves_its_part_and_not_the_base(viewer: Viewer, twin_view: TwinView, browser) -> None:
    page = browser.new_page(viewport={"width": 800, "height": 500}, accept_downloads=True)
    errors, elsewhere = [], []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda m: m.type == "error" and not any(k in m.text for k in KNOWN) and errors.append(m.text))
    page.on("request", lambda r: r.url.startswith((viewer.url, "data:", "blob:")) or elsewhere.append(r.url))
    try:
        page.goto(viewer.url)
        slider = page.get_by_role("slider").first
        slider.wait_for(timeout=30_000)
        until(lambda: bool(viewer.server.get_clients()))

        def canvas() -> np.ndarray:
            """Once it stands still: splats fade in, and software draws slowly."""
            last = None
            for _ in range(40):
                page.wait_for_timeout(500)
                now = np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)[:, 430:]
                if last is not None and (now < 200).any() and np.abs(now - last).max() < 3:
                    return now
                last = now
            pytest.fail("the picture never stood still")

        before = canvas()
        slider.focus()
        page.keyboard.press("End")
        until(lambda: twin_view.values[1] == 1.03)
        after = canvas()
        with page.expect_download(timeout=60_000) as download:
            page.get_by_role("button", name="Screenshot").click()
        with Image.open(download.value.path()) as image:
            shot = np.array(image)
        client = next(iter(viewer.server.get_clients().values()))
        twin_view.stage.look_through(client, camera := look_at(np.array([1.0, -3.0, 1.0]), 100))
        seen_from = client.camera.position / twin_view.stage.scale
    finally:
        page.close()
    assert errors == [] and elsewhere == []
    assert shot.shape[2] == 4 and 0.02 < (shot[..., 3] > 200).mean() < 0.9
    assert seen_from == pytest.approx(camera.centre) and client.camera.fov > 2 * np.arctan(0.5 / 1.4) - 1e-6

    def of(picture: np.ndarray, channel: int) -> np.ndarray:
        rest = np.delete(picture, channel, axis=2).max(2)
        return picture[..., channel] > rest + 60

    door = of(before, 2) != of(after, 2)
    assert door.sum() > 500, "the door has not moved"
    base = of(before, 0)
    assert base.sum() > 500, "the base is not to be seen"
    still = base & of(after, 0)
    assert np.abs(before[still] - after[still]).mean() < 3, "the base has moved"
    assert (base & ~of(after, 0) & ~of(after, 2)).sum() < 0.02 * base.sum(), "the base has moved"
