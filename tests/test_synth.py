"""Made objects: the pictures agree with the truth that is written beside them."""

import itertools
import json
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
from PIL import Image

from hingesplat.capture import load_capture
from hingesplat.errors import HingesplatError
from hingesplat.metrics.truth import load_truth
from hingesplat.synth import NAMES, make
from hingesplat.synth.make import camera_at
from hingesplat.synth.model import Body, Model
from hingesplat.synth.objects import build
from hingesplat.synth.shapes import (
    Solid,
    box,
    capsule,
    extrude,
    glossy,
    lathe,
    moved,
    open_box,
    rod,
    round_hole,
    solid_mesh,
    tube,
)
from hingesplat.synth.textures import noise, plain, wood
from hingesplat.synth.trace import LitScene, Surface

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
PLAIN = wood((1, 1, 1), (0, 0, 0), 2, 0)


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "cabinet"
    return make("cabinet", out, seed=2, size=64, train_views=6, test_views=2)


def united(solids: tuple[Solid, ...]) -> trimesh.Trimesh:
    return trimesh.boolean.union([solid_mesh(s) for s in solids], engine="manifold")


def manifold(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(manifold3d.Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)))


TURN = np.linspace(0, 2 * np.pi, 40, endpoint=False)
CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)], 1)
RING = np.column_stack([CIRCLE, np.zeros(40)])
TILT = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [0.5, 0, 0])
SOLIDS = {
    "box": (box((0, 0, 0), (1, 2, 3), PLAIN), 6),
    "rounded box": (box((0, 0, 0), (1, 1, 1), PLAIN, 0.5), np.pi / 6),  # All rounding: a ball.
    "capsule": (capsule((0, 0, 0), (0.3, 0.4, 0), 0.1, PLAIN), np.pi * 0.01 * 0.5 + 4 / 3 * np.pi * 0.001),
    "rod": (rod((0, 0, 0), (0, 3, 4), 0.1, PLAIN, 40), np.pi * 0.01 * 5),
    "loop": (tube(RING, (0, 0, 1), (0.2, 0.1), PLAIN, closed=True), 2 * np.pi**2 * 0.02),
    "hook": (tube(RING[:21], (0, 0, 1), 0.1, PLAIN), np.pi * 0.01 * np.pi + 4 / 3 * np.pi * 0.001),
    "cup": (lathe([(0, 0), (1, 0), (1, 2), (0.5, 2), (0.5, 1), (0, 1)], (0, 0, 5), (1, 0, 0), PLAIN), 1.75 * np.pi),
    "disc": (extrude(CIRCLE, 1, 1, 3, PLAIN), 2 * np.pi),
    "plate": (extrude((hole := round_hole((0, 0), (4, 3), 1))[0], 0, 0, 0.5, PLAIN, hole[1]), 6 - np.pi / 2),
    "moved": (moved((box((0, 0, 0), (1, 2, 3), PLAIN),), TILT)[0], 6),
}


@pytest.mark.parametrize(("solid", "volume"), SOLIDS.values(), ids=SOLIDS)
def test_solids_are_closed_of_the_right_volume_and_face_outward(solid: Solid, volume: float) -> None:
    mesh = solid_mesh(solid)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(volume, rel=0.06)
    for patch in solid:
        s, t = (np.linspace(0.13, 0.87, 5) * size for size in patch.size)
        outside = patch.at(s, t) + 0.05 * patch.normals(s, t)
        inside = patch.at(s, t) - 0.05 * patch.normals(s, t)
        assert not mesh.contains(outside).any() and mesh.contains(inside).all()


@pytest.mark.parametrize("face", range(6))
def test_an_open_box_is_open_at_one_face_only(face: int) -> None:
    hollow = united(open_box((-1, -1, -1), (1, 1, 1), 0.1, PLAIN, PLAIN, face))
    hits = hollow.ray.intersects_any(np.zeros((6, 3)), np.repeat(np.eye(3), 2, 0) * np.tile([[-1], [1]], (3, 1)))
    assert np.flatnonzero(~hits).tolist() == [face]
    assert hollow.volume == pytest.approx(8 - 1.8 * 1.8 * 1.9)


def test_noise_is_continuous_and_uses_its_range() -> None:
    x = np.random.default_rng(0).uniform(-50, 50, (5000, 3))
    assert np.abs(noise(x + 1e-4, 3) - noise(x, 3)).max() < 2e-3
    assert noise(x, 3).min() < 0.1 and noise(x, 3).max() > 0.9
    assert np.abs(np.corrcoef(noise(x, 3), noise(x, 4))[0, 1]) < 0.1


R, P = "revolute", "prismatic"
TYPES = {
    **dict.fromkeys(["foldchair", "fridge", "laptop", "oven", "scissor", "stapler", "usb", "washer"], (R,)),
    **dict.fromkeys(["blade", "storage"], (P,)),
    "fridge3": (R, R),
    "table4": (P, P, P),
    "table5": (P, R, P, R),
    "storage3": (P, R),
    "storage4": (R, R, R),
    "storage7": (R, P, R, R, P, R),
    "oven4": (R, R, R),
    "cabinet": (R, P),
    "latchdoor": (R, R),
    "stapler3": (R, R),
}


def test_the_table_of_objects() -> None:
    assert set(TYPES) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_every_object_rests_on_the_ground_and_seeds_vary_it(name: str) -> None:
    values = []
    for seed in range(5):
        model = build(name, seed)
        assert tuple(b.hinge.type for b in model.bodies if b.hinge) == TYPES[name]
        for hinge in (b.hinge for b in model.bodies[1:]):
            assert hinge is not None
            assert all(hinge.limits[0] <= v <= hinge.limits[1] for v in hinge.states)
            assert abs(hinge.states[1] - hinge.states[0]) > 0.12 * (hinge.limits[1] - hinge.limits[0])
        values.append([v for state in (0, 1, 2, 3) for v in model.values(state).values()])
        low = min(p.mesh()[0][:, 2].min() for body in model.bodies for solid in body.solids for p in solid)
        assert low == pytest.approx(0, abs=1e-4)
    assert np.std(values, axis=0).min() > 0.01 * np.mean(values)


@pytest.mark.parametrize("name", NAMES)
def test_parts_are_closed_and_never_meet(name: str) -> None:
    """In both states, on the way between them, and wherever else the joints may take them."""
    for seed in range(2):
        model = build(name, seed)
        parts = {b.name: united(b.solids) for b in model.bodies}
        assert all(p.is_watertight for p in parts.values())
        size = np.ptp(np.concatenate([p.vertices for p in parts.values()]), axis=0).max()
        rng = np.random.default_rng(seed)
        anywhere = {b.name: rng.uniform(*b.hinge.limits) for b in model.bodies if b.hinge}
        limits = {b.name: b.hinge.limits[1 - seed] for b in model.bodies if b.hinge}
        for values in (*map(model.values, range(3)), anywhere, limits):
            poses = model.poses(values)
            posed = [manifold(part.copy().apply_transform(poses[name])) for name, part in parts.items()]
            for a, b in itertools.combinations(posed, 2):
                assert abs((a ^ b).volume()) / size**3 < 1e-7


@pytest.mark.parametrize("name", NAMES)
def test_every_object_becomes_a_capture_with_its_truth(name: str, tmp_path: Path) -> None:
    capture = make(name, tmp_path / name, size=24, train_views=3, test_views=1)
    assert [len(s.test) for s in load_capture(capture).states] == [1, 1]
    truth = load_truth(capture)
    assert tuple(j.type for j in truth.joints) == TYPES[name]
    assert all(m.is_watertight for p in truth.parts for m in p.meshes)
    points = np.concatenate([m.vertices for p in truth.parts for m in p.meshes])
    assert np.ptp(points, axis=0).max() == pytest.approx(1, abs=1e-3)
    seen = [np.array(Image.open(truth.part_picture(state, "000"))) for state in (0, 1)]
    assert {1, 2} <= set(np.unique(seen)) <= set(range(len(truth.parts) + 1))


@pytest.mark.parametrize(("name", "parent", "child"), [("latchdoor", 1, 2), ("stapler3", 1, 2)])
def test_a_part_hangs_on_another_moving_part(name: str, parent: int, child: int, tmp_path: Path) -> None:
    """Its motion in the world is its own after its parent's, in the tree that was written as in the object."""
    truth = load_truth(make(name, tmp_path / name, size=16, train_views=1, test_views=0))
    joints = {j.child: j for j in truth.joints}
    assert (joints[parent].parent, joints[child].parent) == (0, parent)
    T = joints[parent].transform() @ joints[child].transform()
    start, end = truth.parts[child].meshes
    assert np.abs(start.vertices @ T[:3, :3].T + T[:3, 3] - end.vertices).max() < 1e-6
    alone = joints[child].transform()
    assert np.abs(start.vertices @ alone[:3, :3].T + alone[:3, 3] - end.vertices).max() > 0.05


def test_further_states_lie_between_the_first_two(tmp_path: Path) -> None:
    out = make("storage3", tmp_path / "s", size=24, train_views=3, test_views=1, states=4)
    assert len(load_capture(out).states) == 4
    assert (out / "truth" / "partid_state3" / "test_000.png").is_file()
    shares = []
    for joint in json.loads((out / "truth" / "joints.json").read_text())["joints"]:
        a, b, *rest = (joint[f"state{k}"] for k in range(4))
        shares.append([(v - a) / (b - a) for v in rest])
    assert np.min(shares) > 0 and np.max(shares) < 1
    assert np.abs(np.diff(shares, axis=0)).min() > 0.1  # The joints do not go in step.


def test_capture_loads_and_has_different_cameras(cabinet: Path) -> None:
    capture = load_capture(cabinet)
    assert [len(s.train) for s in capture.states] == [6, 6]
    assert [len(s.test) for s in capture.states] == [2, 2]
    a, b = (np.array([v.camera.centre for v in s.train]) for s in capture.states)
    assert np.linalg.norm(a[:, None] - b[None], axis=-1).min() > 0.02
    rgba = capture.states[0].train[0].rgba
    assert 0.03 < (rgba[..., 3] > 128).mean() < 0.7
    assert rgba[rgba[..., 3] == 255][:, :3].std() > 10


@pytest.mark.parametrize("state", [0, 1])
def test_part_pictures_and_depth_follow_from_the_truth(cabinet: Path, state: int) -> None:
    """The truth meshes, posed by joints.json, are where the pictures show them."""
    parts = [p.meshes[state] for p in load_truth(cabinet).parts]
    scene = trimesh.util.concatenate(parts)
    owner = np.repeat(np.arange(len(parts)) + 1, [len(p.faces) for p in parts])
    capture = load_capture(cabinet, with_depth=True)
    for i, view in enumerate(capture.states[state].train[:3]):
        ids = np.array(Image.open(cabinet / "truth" / f"partid_state{state}" / f"train_{i:03d}.png"))
        origin, d = view.camera.rays()
        d = d.reshape(-1, 3)
        where, ray, face = scene.ray.intersects_location(np.tile(origin, (len(d), 1)), d, multiple_hits=False)
        expected = np.zeros(len(d), int)
        expected[ray] = owner[face]
        assert (expected == ids.ravel()).mean() > 0.995
        assert set(np.unique(expected)) == set(np.unique(ids))
        _, z = view.camera.project(where)
        assert view.depth is not None
        assert np.median(np.abs(view.depth.ravel()[ray] - z)) < 1e-3


def test_same_seed_same_pictures_another_seed_others(cabinet: Path, tmp_path: Path) -> None:
    again = make("cabinet", tmp_path / "again", seed=2, size=64, train_views=6, test_views=2)
    other = make("cabinet", tmp_path / "other", seed=3, size=64, train_views=6, test_views=2)
    picture = Path("state_1/train/003.png")
    assert (again / picture).read_bytes() == (cabinet / picture).read_bytes()
    assert (other / picture).read_bytes() != (cabinet / picture).read_bytes()


def test_light_stays_in_the_world(cabinet: Path) -> None:
    """A surface that turns is lit differently: the door's colours change, those of the base hardly."""
    model = build("cabinet", 2)
    surface = Surface(model, 0.02)
    lit = [LitScene(surface, model.state(t)).colours for t in (0, 1)]
    change = np.abs(lit[1] - lit[0]).mean(1)

    def front(body: str) -> slice:
        biggest = max((t for t in surface.texels if t.body == body), key=lambda t: t.shape[0] * t.shape[1])
        return slice(biggest.offset, biggest.offset + biggest.shape[0] * biggest.shape[1])

    assert np.median(change[front("door")]) > 5
    assert np.median(change[front("base")]) < 3  # Only what the door and the drawer shade.


def test_only_a_clear_coat_looks_different_from_elsewhere() -> None:
    def colour(gloss: float, eye: tuple[float, float, float]) -> np.ndarray:
        ball = glossy((box((-1, -1, 0), (1, 1, 0.4), plain((0.3, 0.2, 0.2), 0, 0.0)),), gloss)
        model = Model("slab", (Body("base", ball),))
        scene = LitScene(Surface(model, 0.05), model.state(0))
        return scene.photograph(camera_at(np.array(eye), np.array([0, 0, 0.4]), 15))[0][7, 7, :3].astype(int)

    mirror, aside = (2.25, 3.75, 4.9), (3.75, -2.25, 4.9)  # Into the first sun's reflection, and as steep beside it.
    assert np.abs(colour(0.0, mirror) - colour(0.0, aside)).max() <= 1
    assert (colour(1.0, mirror) - colour(1.0, aside)).min() > 20
    assert (colour(1.0, aside) >= colour(0.0, aside)).all()


def test_progress_is_told(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    make(
        "laptop",
        tmp_path / "l",
        size=16,
        train_views=2,
        test_views=1,
        progress=lambda i, n: seen.append((i, n)),
    )
    assert seen == [(i, 6) for i in range(1, 7)]


def test_bad_requests_are_refused_and_nothing_is_left(cabinet: Path, tmp_path: Path) -> None:
    with pytest.raises(HingesplatError, match="teapot: no such object; there are cabinet"):
        make("teapot", tmp_path / "t")
    with pytest.raises(HingesplatError, match="already there"):
        make("laptop", cabinet)
    with pytest.raises(HingesplatError, match="≥ 16 pixels"):
        make("laptop", tmp_path / "t", size=2)
    with pytest.raises(HingesplatError, match="≥ 2 states"):
        make("laptop", tmp_path / "t", states=1)
    with pytest.raises(ZeroDivisionError):
        make("laptop", tmp_path / "t", size=16, progress=lambda i, n: i / 0)
    assert list(tmp_path.iterdir()) == []
