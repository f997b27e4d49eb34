"""Captures of two spheres, drawn analytically, in every layout; bad input; hulls; conventions."""

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hingesplat.camera import Camera
from hingesplat.capture import View, load_capture, visual_hull, write_state
from hingesplat.capture.check import check_states
from hingesplat.capture.images import downsampled
from hingesplat.capture.types import State
from hingesplat.errors import HingesplatError

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
BASE = (np.array([0.1, -0.05, 0.15]), 0.4)
MOVER = {"start": (np.array([0.5, 0.2, 0.3]), 0.2), "end": (np.array([0.3, -0.4, 0.4]), 0.2)}
COLOURS = ((200, 60, 30), (30, 120, 220))


def look_at(centre: np.ndarray, target: np.ndarray, size: tuple[int, int], focal: float) -> Camera:
    """A camera at ``centre`` looking at ``target``, z up, with an off-centre principal point."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = centre
    w, h = size
    return Camera(T, focal, focal * 1.05, w / 2 + 1.5, h / 2 - 0.5, w, h)


def ring(n: int, size: tuple[int, int] = (48, 40), focal: float = 55.0, turn: float = 0.0) -> list[Camera]:
    """Cameras on a spiral over the upper hemisphere, radius about 2.5, not all looking at one point."""
    rng = np.random.default_rng(3)
    cameras = []
    for i in range(n):
        azimuth, z = turn + 2.4 * i, 0.1 + 0.8 * (i + 0.5) / n
        direction = np.array([np.cos(azimuth) * (1 - z * z) ** 0.5, np.sin(azimuth) * (1 - z * z) ** 0.5, z])
        target = BASE[0] + rng.normal(0, 0.05, 3)
        cameras.append(look_at(BASE[0] + (2.5 + 0.2 * (i % 3)) * direction, target, size, focal))
    return cameras


def draw(camera: Camera, spheres: list[tuple[np.ndarray, float]], name: str = "x") -> View:
    """Flat-coloured spheres with hard masks and z-depth."""
    origin, d = camera.rays()
    nearest = np.full(d.shape[:2], np.inf)
    rgba = np.zeros((*d.shape[:2], 4), np.uint8)
    for (centre, radius), colour in zip(spheres, COLOURS, strict=False):
        along = d @ (centre - origin)
        gap = radius**2 - ((centre - origin) ** 2).sum() + along**2
        t = np.where(gap > 0, along - np.sqrt(np.maximum(gap, 0)), np.inf)
        front = t < nearest
        rgba[front] = (*colour, 255)
        nearest[front] = t[front]
    hit = np.isfinite(nearest)
    z = d @ camera.T_world_camera[:3, 2]
    depth = np.where(hit, np.where(hit, nearest, 0) * z, 0).astype(np.float32)
    return View(camera, rgba, name, depth)


def views(state: str, n: int = 8, **kwargs) -> list[View]:
    return [draw(c, [BASE, MOVER[state]]) for c in ring(n, turn=0.7 * (state == "end"), **kwargs)]


def ours(root: Path, names: tuple[str, str] = ("state0", "state1"), n: int = 8) -> Path:
    """A capture in our own layout, with a test split."""
    for name, state in zip(names, MOVER, strict=True):
        write_state(root / name, views(state, n), "train")
        write_state(root / name, views(state, 3), "test")
    return root


def edit(path: Path, change) -> None:
    """Apply ``change`` to a JSON file's data in place."""
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def same_views(loaded: tuple[View, ...], expected: list[View]) -> None:
    assert len(loaded) == len(expected)
    for a, b in zip(loaded, expected, strict=True):
        np.testing.assert_allclose(a.camera.T_world_camera, b.camera.T_world_camera, atol=1e-6)
        lens = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in (a.camera, b.camera)]
        np.testing.assert_allclose(lens[0], lens[1], rtol=1e-6)
        assert a.rgba.dtype == np.uint8
        np.testing.assert_array_equal(a.rgba, b.rgba)


# Layouts.


def test_own_layout_round_trip(tmp_path):
    capture = load_capture(ours(tmp_path), with_depth=True)
    assert capture.layout == "transforms"
    assert [s.name for s in capture.states] == ["state0", "state1"]
    for state, name in zip(capture.states, MOVER, strict=True):
        same_views(state.train, views(name))
        same_views(state.test, views(name, 3))
        for a, b in zip(state.train, views(name), strict=True):
            np.testing.assert_allclose(a.depth, b.depth, atol=0.00051)
    assert capture.states[0].train[2].name == "state0/train/002.png"
    assert load_capture(tmp_path).states[0].train[0].depth is None


def test_own_layout_with_a_lens_for_each_view(tmp_path):
    ours(tmp_path)
    mixed = [*views("start", 4), *views("start", 4, size=(30, 36), focal=40.0)]
    write_state(tmp_path / "state0", mixed, "train")
    data = json.loads((tmp_path / "state0" / "transforms_train.json").read_text())
    assert "fl_x" not in data and data["frames"][7]["w"] == 30
    same_views(load_capture(tmp_path).states[0].train, mixed)


def test_deep_scenes_choose_a_unit_that_fits_sixteen_bits(tmp_path):
    ours(tmp_path)
    deep = [replace(v, depth=v.depth * 100) for v in views("start")]
    write_state(tmp_path / "state0", deep, "train")
    loaded = load_capture(tmp_path, with_depth=True).states[0].train[0].depth
    np.testing.assert_allclose(loaded, deep[0].depth, atol=0.0051)


def test_nerfstudio_three_states_in_order_with_per_frame_lens_and_angles(tmp_path):
    """``transforms.json`` alone; states sort by number; a frame's own lens wins; no suffix (Blender)."""
    for i, state in ((10, "end"), (2, "start"), (0, "end")):
        folder = tmp_path / f"state_{i}"
        write_state(folder, views(state), "train")
        (folder / "transforms_train.json").rename(folder / "transforms.json")

    def change(data):
        data["fl_x"] = data["fl_y"] = 1000.0
        for frame in data["frames"]:
            frame["camera_angle_x"] = 2 * np.arctan(24 / 55.0)
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")

    edit(tmp_path / "state_2" / "transforms.json", change)
    capture = load_capture(tmp_path)
    assert [s.name for s in capture.states] == ["state_0", "state_2", "state_10"]
    assert capture.states[1].test == ()
    camera = capture.states[1].train[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((55.0, 55.0))


def opaque(view: View, path: Path) -> None:
    """Save as RGB on grey, without the mask."""
    path.parent.mkdir(parents=True, exist_ok=True)
    colour = np.where(view.rgba[..., 3:] > 0, view.rgba[..., :3], 128).astype(np.uint8)
    Image.fromarray(colour).save(path)


@pytest.mark.parametrize("where", ["argument", "state folder", "capture folder", "mask_path"])
def test_rgb_images_with_masks(tmp_path, where):
    root = ours(tmp_path / "capture")
    for name, state in zip(("state0", "state1"), MOVER, strict=True):
        for split, n in (("train", 8), ("test", 3)):
            for i, view in enumerate(views(state, n)):
                opaque(view, root / name / split / f"{i:03d}.png")
                base = {
                    "argument": tmp_path / "masks" / name,
                    "state folder": root / name / "masks",
                    "capture folder": root / "masks" / name,
                    "mask_path": root / name / "segmentation",
                }[where]
                target = base / split / (f"{i:03d}.png.png" if where == "capture folder" else f"{i:03d}.png")
                target.parent.mkdir(parents=True, exist_ok=True)
                label = view.rgba[..., 3] // (255 if where == "argument" else 1)
                Image.fromarray(label).save(target)
            if where == "mask_path":
                edit(
                    root / name / f"transforms_{split}.json",
                    lambda d: [f.update(mask_path=f"segmentation/{f['file_path']}") for f in d["frames"]],
                )
    capture = load_capture(root, masks=tmp_path / "masks" if where == "argument" else None)
    expected = views("end")[5].rgba
    loaded = capture.states[1].train[5].rgba
    np.testing.assert_array_equal(loaded[..., 3], expected[..., 3])
    np.testing.assert_array_equal(loaded[loaded[..., 3] > 0], expected[expected[..., 3] > 0])


def test_masks_folder_beside_an_images_folder(tmp_path):
    for state in MOVER:
        write_state(tmp_path / state, views(state), "images")
        (tmp_path / state / "transforms_images.json").rename(tmp_path / state / "transforms.json")
        (tmp_path / state / "masks").mkdir()
        for i, view in enumerate(views(state)):
            opaque(view, tmp_path / state / "images" / f"{i:03d}.png")
            Image.fromarray(view.rgba[..., 3]).save(tmp_path / state / "masks" / f"{i:03d}.png")
    loaded = load_capture(tmp_path).states[0].train[3].rgba
    np.testing.assert_array_equal(loaded[..., 3], views("start")[3].rgba[..., 3])


def test_a_given_mask_folder_must_hold_every_mask(tmp_path):
    root = ours(tmp_path / "capture")
    (tmp_path / "masks").mkdir()
    with pytest.raises(HingesplatError, match=r"state0/train/000.png: has no mask in"):
        load_capture(root, masks=tmp_path / "masks")


def test_paris(tmp_path):
    for state in MOVER:
        for split, n in (("train", 8), ("val", 2), ("test", 3)):
            folder = tmp_path / state / split
            folder.mkdir(parents=True)
            shots = views(state, n)
            c = shots[0].camera
            cameras: dict = {"K": [[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]}
            for i, view in enumerate(shots):
                Image.fromarray(view.rgba).save(folder / f"{i:04d}.png")
                cameras[f"{i:04d}"] = (view.camera.T_world_camera @ FLIP).tolist()
            (tmp_path / state / f"camera_{split}.json").write_text(json.dumps(cameras))
    capture = load_capture(tmp_path)
    assert capture.layout == "paris"
    assert [s.name for s in capture.states] == ["start", "end"]
    for state in capture.states:
        same_views(state.train, views(state.name))
        same_views(state.test, views(state.name, 3))
    (tmp_path / "end" / "camera_train.json").unlink()
    with pytest.raises(HingesplatError, match=r"end/camera_train.json: cannot be read"):
        load_capture(tmp_path)


def centred(camera: Camera) -> Camera:
    """ArtGS has square pixels and a centred principal point."""
    return replace(camera, fy=camera.fx, cx=camera.width / 2, cy=camera.height / 2)


@pytest.mark.parametrize("joint_file", [True, False])
def test_artgs(tmp_path, joint_file):
    shots = {s: [draw(centred(v.camera), [BASE, MOVER[s]]) for v in views(s)] for s in MOVER}
    frames = {s: [] for s in MOVER}
    for time, state in enumerate(MOVER):
        for kind in ("rgba", "depth"):
            (tmp_path / state / "train" / kind).mkdir(parents=True)
        for i, view in enumerate(shots[state]):
            path = f"{state}/train/rgba/{i:04d}.png"
            Image.fromarray(view.rgba).save(tmp_path / path)
            millimetres = np.round(np.where(view.depth > 0, view.depth * 1000, 50)).astype(np.uint16)
            Image.fromarray(millimetres).save(tmp_path / path.replace("rgba", "depth"))
            pose = (view.camera.T_world_camera @ FLIP).tolist()
            frames[state].append({"file_path": path, "time": float(time), "transform_matrix": pose})
    c = shots["start"][0].camera
    header = {"camera_angle_x": 2 * np.arctan(c.width / 2 / c.fx), "camera_angle_y": 1.0}
    files = {"": frames["start"] + frames["end"]} if joint_file else {f"_{s}": f for s, f in frames.items()}
    for name, entries in files.items():
        (tmp_path / f"transforms_train{name}.json").write_text(json.dumps({**header, "frames": entries}))
    capture = load_capture(tmp_path, with_depth=True)
    assert capture.layout == "artgs"
    assert [s.name for s in capture.states] == ["start", "end"]
    for state in capture.states:
        same_views(state.train, shots[state.name])
        # The 50 mm background lies below the least valid depth.
        np.testing.assert_allclose(state.train[0].depth, shots[state.name][0].depth, atol=0.00051)


def colmap(root: Path, model: str, suffix: str, distortion: float = 0.0, in_images: bool = True) -> Path:
    """A COLMAP capture with one lens, test images below STATE/test."""
    sparse = root / model
    sparse.mkdir(parents=True, exist_ok=True)
    shots = {}
    for state in MOVER:
        shots |= {f"{state}/{i:03d}.png": v for i, v in enumerate(views(state))}
        shots |= {f"{state}/test/{i:03d}.png": v for i, v in enumerate(views(state, 3))}
    c = next(iter(shots.values())).camera
    kind = (4, "OPENCV") if distortion else (1, "PINHOLE")
    params = [c.fx, c.fy, c.cx, c.cy] + ([distortion, 0.0, 0.0, 0.0] if distortion else [])
    cameras = struct.pack("<QiiQQ", 1, 7, kind[0], c.width, c.height) + struct.pack(f"<{len(params)}d", *params)
    text = ["# Image list with two lines of data per image"]
    images = struct.pack("<Q", len(shots))
    for i, (name, view) in enumerate(reversed(shots.items())):
        path = (root / "images" if in_images else root) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(view.rgba).save(path)
        T = np.linalg.inv(view.camera.T_world_camera)
        pose = [*np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1), *T[:3, 3]]
        points = i % 3
        images += struct.pack("<i7di", i + 1, *pose, 7) + name.encode() + b"\0" + struct.pack("<Q", points)
        images += struct.pack("<ddq", 1.0, 2.0, -1) * points
        text += [f"{i + 1} {' '.join(map(repr, map(float, pose)))} 7 {name}", "1.0 2.0 -1 " * points]
    if suffix == ".bin":
        (sparse / "cameras.bin").write_bytes(cameras)
        (sparse / "images.bin").write_bytes(images)
    else:
        line = f"7 {kind[1]} {c.width} {c.height} {' '.join(map(str, params))}"
        (sparse / "cameras.txt").write_text(f"# Camera list\n{line}\n")
        (sparse / "images.txt").write_text("\n".join(text) + "\n")
    return root


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize(("model", "in_images"), [("sparse/0", True), ("sparse", False), (".", True)])
def test_colmap(tmp_path, model, suffix, in_images):
    capture = load_capture(colmap(tmp_path, model, suffix, distortion=1e-5, in_images=in_images))
    assert capture.layout == "colmap"
    assert [s.name for s in capture.states] == ["start", "end"]
    for state in capture.states:
        same_views(state.train, views(state.name))
        same_views(state.test, views(state.name, 3))


def test_colmap_refuses_what_is_no_pinhole(tmp_path):
    root = colmap(tmp_path, "sparse/0", ".bin", distortion=0.1)
    with pytest.raises(HingesplatError, match=r"cameras.bin: camera 7: the lens distorts by up to .* pixels"):
        load_capture(root)
    cameras = root / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(struct.pack("<QiiQQ", 1, 7, 5, 48, 40))
    with pytest.raises(HingesplatError, match="camera 7: camera model number 5 is not a pinhole"):
        load_capture(root)
    cameras.write_bytes(struct.pack("<QiiQQd", 1, 7, 1, 48, 40, 1.0))
    with pytest.raises(HingesplatError, match=r"cameras.bin: is truncated"):
        load_capture(root)


def test_colmap_images_need_a_folder_for_the_state(tmp_path):
    root = colmap(tmp_path, "sparse/0", ".txt")
    listing = root / "sparse" / "0" / "images.txt"
    listing.write_text(listing.read_text().replace("start/000.png", "000.png"))
    with pytest.raises(HingesplatError, match=r"image 000.png: has no folder that tells its state"):
        load_capture(root)


# Downsampling.


def test_lifted_undoes_project() -> None:
    camera = ring(3)[2].cropped(3, 5, 40, 30)
    rng = np.random.default_rng(0)
    x, y, depth = rng.integers(0, 40, 100), rng.integers(0, 30, 100), rng.uniform(0.5, 4, 100)
    points = camera.lifted(x, y, depth)
    uv, z = camera.project(points)
    np.testing.assert_allclose(uv, np.column_stack([x, y]) + 0.5, atol=1e-9)  # The pixels' centres.
    np.testing.assert_allclose(z, depth)
    origin, d = camera.rays()
    along = points - origin
    np.testing.assert_allclose(along / np.linalg.norm(along, axis=1, keepdims=True), d[y, x], atol=1e-9)
    assert camera.lifted(x[:0], y[:0], depth[:0]).shape == (0, 3)


def test_downsampling_keeps_projections_and_colours(tmp_path):
    view = views("start", size=(96, 80), focal=110.0)[0]
    small = downsampled(view, 36)
    assert small.rgba.shape == (30, 36, 4)
    assert (small.camera.width, small.camera.height) == (36, 30)
    mover = MOVER["start"][0][None]
    before, after = view.camera.project(mover)[0][0], small.camera.project(mover)[0][0]
    np.testing.assert_allclose(after, before * 36 / 96)
    # The mask's centroid is where the camera says, to a fraction of a pixel.
    for v, scale in ((view, 1.0), (small, 36 / 96)):
        weight = v.rgba[..., 3] / 255
        v_, u_ = np.mgrid[: v.camera.height, : v.camera.width] + 0.5
        centroid = np.array([(weight * u_).sum(), (weight * v_).sum()]) / weight.sum() / scale
        if scale == 1.0:
            full = centroid
        else:
            np.testing.assert_allclose(centroid, full, atol=0.05)
    # Colours are mixed from the object alone: the background is black, but no darker red appears.
    solid = replace(view, rgba=np.where(view.rgba[..., 3:] > 0, [200, 60, 30, 255], 0).astype(np.uint8))
    rgba = downsampled(solid, 36).rgba
    edge = (rgba[..., 3] > 5) & (rgba[..., 3] < 250)
    assert edge.any() and abs(rgba[edge][:, :3].astype(int) - [200, 60, 30]).max() <= 1
    # Depths are original values: no mixtures across an edge.
    assert set(np.unique(small.depth)) <= set(np.unique(view.depth))


def test_area_filter_preserves_the_mean_at_any_ratio():
    rng = np.random.default_rng(0)
    rgba = rng.integers(0, 256, (37, 53, 4), dtype=np.uint8)
    rgba[..., 3] = 255
    camera = Camera(np.eye(4), 50, 50, 26, 18, 53, 37)
    small = downsampled(View(camera, rgba, "x"), 20).rgba
    np.testing.assert_allclose(small.mean((0, 1)), rgba.mean((0, 1)), atol=0.2)


def test_max_size_only_shrinks(tmp_path):
    root = ours(tmp_path)
    assert load_capture(root, max_size=24).states[1].test[0].rgba.shape == (20, 24, 4)
    assert load_capture(root, max_size=500).states[0].train[0].rgba.shape == (40, 48, 4)


# Hulls.


def test_hull_of_a_sphere():
    centre, radius = np.array([0.1, -0.05, 0.15]), 0.4
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cameras = [look_at(centre + 2.5 * d, centre, (128, 128), 250.0) for d in directions]
    points, voxel = visual_hull([draw(c, [(centre, radius)]) for c in cameras], resolution=64)
    assert points.dtype == np.float32
    distance = np.linalg.norm(points - centre, axis=1)
    assert 0.7 * 0.8 / 64 < voxel < 1.3 * 0.8 / 64
    assert radius - 2 * voxel < distance.max() < radius + 2.5 * voxel
    volume = 4 / 3 * np.pi * radius**3
    assert len(points) * voxel**3 == pytest.approx(volume, rel=0.15)
    # Nothing is missing: every voxel centre of the ball has a voxel of the hull within reach.
    samples = centre + rng.uniform(-radius, radius, (500, 3))
    samples = samples[np.linalg.norm(samples - centre, axis=1) < radius]
    gaps = cKDTree(points).query(samples)[0]
    assert gaps.max() < voxel


def test_hull_survives_a_few_bad_masks_and_objects_cut_by_the_frame():
    good = views("start", 40, size=(64, 56), focal=70.0)
    points, _ = visual_hull(good, 32)
    bad = list(good)
    bad[3] = replace(bad[3], rgba=np.zeros_like(bad[3].rgba))
    flipped = bad[11].rgba[:, ::-1].copy()
    bad[11] = replace(bad[11], rgba=flipped)
    speck = np.zeros_like(bad[20].rgba)
    speck[:4, :4] = 255
    bad[20] = replace(bad[20], rgba=speck)
    again, _ = visual_hull(bad, 32)
    assert np.ptp(again, axis=0) == pytest.approx(np.ptp(points, axis=0), rel=0.15)

    cut = list(good)
    for i in range(0, 40, 4):  # Ten close-ups that show less than half of the object.
        v = good[i]
        cut[i] = replace(v, camera=v.camera.cropped(20, 0, 20, 56), rgba=v.rgba[:, 20:40])
    again, _ = visual_hull(cut, 32)
    assert np.ptp(again, axis=0) == pytest.approx(np.ptp(points, axis=0), rel=0.1)


def test_no_hull_is_an_error():
    away = [replace(v, camera=replace(v.camera, T_world_camera=v.camera.T_world_camera @ FLIP)) for v in views("end")]
    with pytest.raises(HingesplatError, match="no common visual hull"):
        visual_hull(away)


# Conventions.


def check_message(root: Path) -> str:
    with pytest.raises(HingesplatError) as e:
        load_capture(root)
    assert "\n" not in str(e.value)
    return str(e.value)


def turn_x(degrees: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    return T


def moved_positions(M: np.ndarray) -> np.ndarray:
    out = M.copy()
    out[:3, 3] = (turn_x(90) @ M)[:3, 3]
    return out


MISTAKES = {
    "camera-to-world with OpenCV axes": lambda M: M @ FLIP,
    "world-to-camera with OpenGL axes": np.linalg.inv,
    "world-to-camera with OpenCV axes": lambda M: np.linalg.inv(M @ FLIP),
    "turned by -90° about x (y-up": moved_positions,
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("n", [8, 40])
def test_each_mistaken_convention_is_named(tmp_path, mistake, n):
    root = ours(tmp_path, n=n)

    def change(data):
        for frame in data["frames"]:
            frame["transform_matrix"] = MISTAKES[mistake](np.array(frame["transform_matrix"])).tolist()

    edit(root / "state1" / "transforms_train.json", change)
    message = check_message(root)
    assert message.startswith("state1: the masks share no common visual hull")
    assert mistake in message


def test_mistaken_colmap_poses_are_named():
    wrong = [replace(v, camera=replace(v.camera, T_world_camera=v.camera.T_camera_world)) for v in views("start")]
    state = State("start", tuple(wrong), ())
    with pytest.raises(HingesplatError, match="matrices are camera-to-world with OpenCV axes"):
        check_states([state, state], "colmap")


def test_random_poses_fit_no_convention(tmp_path):
    root = ours(tmp_path)
    rotations = Rotation.random(8, random_state=np.random.default_rng(1)).as_matrix()

    def change(data):
        for frame, R in zip(data["frames"], rotations, strict=True):
            frame["transform_matrix"][0][:3], frame["transform_matrix"][1][:3] = R[0].tolist(), R[1].tolist()
            frame["transform_matrix"][2][:3] = R[2].tolist()

    edit(root / "state0" / "transforms_train.json", change)
    assert "no usual mistake" in check_message(root)


@pytest.mark.parametrize(("change", "said"), [("shift", "do not overlap"), ("y-up", "y up, the other z up")])
def test_states_in_different_frames(tmp_path, change, said):
    T = np.eye(4)
    T[:3, 3] = [3.0, 0, 0]
    T = T if change == "shift" else turn_x(-90)
    if change == "y-up":  # Away from the origin, so that a turn about it moves the object.
        T[:3, 3] = T[:3, :3] @ [0.0, 0.5, 0.0]
    base = np.eye(4)
    base[1, 3] = 0.5 * (change == "y-up")
    root = ours(tmp_path)
    for name, M in (("state0", base), ("state1", T)):
        edit(
            root / name / "transforms_train.json",
            lambda d, M=M: [
                f.update(transform_matrix=(M @ np.array(f["transform_matrix"])).tolist()) for f in d["frames"]
            ],
        )
    message = check_message(root)
    assert message.startswith("state0 and state1 are in different frames") and said in message


# Bad input: one clear line that names file, frame or key.


def drop(key):
    return lambda root: edit(root / "state1" / "transforms_train.json", lambda d: d.pop(key))


def in_frame(key, value, file="state1/transforms_train.json"):
    def apply(root):
        edit(root / file, lambda d: d["frames"][2].__setitem__(key, value))

    return apply


def drop_in_frame(key):
    return lambda root: edit(root / "state1" / "transforms_train.json", lambda d: d["frames"][2].pop(key))


def set_pose(row, column, value):
    def change(data):
        data["frames"][2]["transform_matrix"][row][column] = value

    return lambda root: edit(root / "state1" / "transforms_train.json", change)


def mirrored(root):
    def change(data):
        M = np.array(data["frames"][2]["transform_matrix"])
        data["frames"][2]["transform_matrix"] = (M @ np.diag([-1.0, 1, 1, 1])).tolist()

    edit(root / "state1" / "transforms_train.json", change)


def truncated(root):
    path = root / "state0" / "train" / "004.png"
    path.write_bytes(path.read_bytes()[:-60])


def resized(root):
    Image.new("RGBA", (20, 20)).save(root / "state0" / "train" / "004.png")


def no_mask(root):
    opaque(views("start")[4], root / "state0" / "train" / "004.png")


def empty_masks(root):
    for path in (root / "state1" / "train").iterdir():
        Image.new("RGBA", (48, 40)).save(path)


def write(text):
    return lambda root: (root / "state1" / "transforms_train.json").write_text(text)


FRAME = r"state1/transforms_train.json: frame 2 \(train/002.png\)"
BAD = {
    "folder is missing": (shutil.rmtree, "does not exist"),
    "one state only": (lambda r: shutil.rmtree(r / "state1"), "at least 2 states, found state0"),
    "unknown layout": (
        lambda r: [shutil.rmtree(r / s) for s in ("state0", "state1")],
        "no capture found here; looked for .*ArtGS.*PARIS.*STATE/transforms.json.*COLMAP",
    ),
    "state without json": (
        lambda r: (r / "state1" / "transforms_train.json").unlink(),
        r"state1: has no transforms.json or transforms_train.json",
    ),
    "too few views": (
        lambda r: edit(r / "state1" / "transforms_train.json", lambda d: d.update(frames=d["frames"][:2])),
        "state1 has 2 training views; needs at least 3",
    ),
    "broken json": (
        write('{"frames": [,]}'),
        r"state1/transforms_train.json: not valid JSON \(line 1, column 13",
    ),
    "json is a list": (write("[]"), "must hold a JSON object, not a list"),
    "no frames": (drop("frames"), r'state1/transforms_train.json: lacks the key "frames"'),
    "frames no list": (write('{"frames": 3}'), '"frames" must be a list of objects'),
    "no focal length": (drop("fl_x"), r'frame 0 \(train/000.png\): lacks the key "fl_x"'),
    "no file path": (
        drop_in_frame("file_path"),
        r'transforms_train.json: frame 2: lacks the key "file_path"',
    ),
    "no pose": (drop_in_frame("transform_matrix"), FRAME + ': lacks the key "transform_matrix"'),
    "text for a number": (in_frame("fl_x", "wide"), FRAME + ": fl_x: must be a finite number, not 'wide'"),
    "angle of view zero": (in_frame("camera_angle_x", 0), "camera_angle_x must lie between 0 and π, not 0"),
    "NaN pose": (set_pose(0, 3, float("nan")), FRAME + ": transform_matrix: the pose holds NaN"),
    "ragged pose": (in_frame("transform_matrix", [[1, 2], [3]]), "the pose is not a 4×4 matrix of numbers"),
    "small pose": (in_frame("transform_matrix", [[1, 2], [3, 4]]), r"the pose has shape \(2, 2\)"),
    "scaled pose": (set_pose(2, 2, 5.0), FRAME + ": transform_matrix: the pose is not rigid"),
    "mirrored pose": (mirrored, "it mirrors"),
    "projective pose": (set_pose(3, 0, 0.5), "last row"),
    "missing image": (
        in_frame("file_path", "train/999.png"),
        "frame 2: image .*train/999.png does not exist",
    ),
    "missing mask file": (in_frame("mask_path", "m.png"), FRAME + ": mask_path .*m.png does not exist"),
    "truncated image": (truncated, "state0/train/004.png: .* is truncated or no image"),
    "not an image": (
        lambda r: (r / "state0" / "train" / "004.png").write_text("hello"),
        r"frame 4 \(train/004.png\): .*004.png is not a readable image",
    ),
    "wrong size": (resized, r"the image is 20×20 pixels, but w, h say 48×40"),
    "no mask": (no_mask, "state0/train/004.png: has no mask .* pass --masks DIR"),
    "empty masks": (empty_masks, "state1: the masks of all 8 views are empty"),
    "distorted": (in_frame("k1", 0.2), FRAME + ": the lens distorts by up to"),
    "fisheye": (in_frame("camera_model", "OPENCV_FISHEYE"), FRAME + ": camera_model OPENCV_FISHEYE is not"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_clear_line(tmp_path, case):
    root = ours(tmp_path / "capture")
    spoil, expected = BAD[case]
    spoil(root)
    with pytest.raises(HingesplatError, match=expected) as e:
        load_capture(root)
    assert "\n" not in str(e.value)


def test_a_single_state_folder_says_to_give_its_parent(tmp_path):
    with pytest.raises(HingesplatError, match=r"holds a single state; .* give their parent"):
        load_capture(ours(tmp_path) / "state0")


def test_identical_states_and_a_slightly_rounded_pose_are_accepted(tmp_path):
    for name in ("start", "end"):
        write_state(tmp_path / name, views("start"), "train")
    edit(
        tmp_path / "end" / "transforms_train.json",
        lambda d: [f.update(transform_matrix=np.round(f["transform_matrix"], 4).tolist()) for f in d["frames"]],
    )
    R = load_capture(tmp_path).states[1].train[0].camera.T_world_camera[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)


# Real photographs.


@pytest.mark.captures
def test_development_capture(captures):
    capture = load_capture(captures / "mw_window", max_size=100, with_depth=True)
    assert capture.layout == "transforms"
    assert [(len(s.train), len(s.test)) for s in capture.states] == [(40, 8), (40, 8)]
    for state in capture.states:
        points, voxel = visual_hull(state.train, 64)
        view = state.test[0]
        assert view.depth is not None and view.rgba.shape == (100, 100, 4)
        rows, columns = np.nonzero((view.depth > 0) & (view.rgba[..., 3] == 255))
        origin, d = view.camera.rays()
        z = d @ view.camera.T_world_camera[:3, 2]
        surface = origin + (d * (view.depth / z)[..., None])[rows, columns]
        gaps = cKDTree(points).query(surface)[0]
        assert np.quantile(gaps, 0.99) < 1.5 * voxel
