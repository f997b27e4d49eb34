"""Made objects: the pictures agree with the truth that is written beside them."""

import json
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
from PIL import Image

from hingesplat.capture import load_capture
from hingesplat.errors import HingesplatError
from hingesplat.synth import NAMES, make
from hingesplat.synth.objects import MAKERS
from hingesplat.synth.shapes import box, capsule, solid_mesh
from hingesplat.synth.textures import noise, wood
from hingesplat.synth.trace import LitScene, Surface
from hingesplat.twin import Joint

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
PLAIN = wood((1, 1, 1), (0, 0, 0), 2, 0)


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "cabinet"
    return make("cabinet", out, seed=2, size=64, train_views=6, test_views=2)


def posed_truth(truth: Path, state: int) -> list[trimesh.Trimesh]:
    tree = json.loads((truth / "joints.json").read_text())
    by_child = {j["child"]: j for j in tree["joints"]}
    meshes = []
    for name in tree["parts"]:
        mesh = trimesh.load(truth / "parts" / f"{name}.obj", process=False)
        if name in by_child:
            j = by_child[name]
            joint = Joint(1, 0, j["type"], j["axis"], j["origin"], (0, 0), (0, 0))
            mesh.apply_transform(joint.transform(j[f"state{state}"]))
        meshes.append(mesh)
    return meshes


def manifold(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(manifold3d.Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)))


def test_solids_are_closed_and_of_the_right_volume() -> None:
    assert solid_mesh(box((0, 0, 0), (1, 2, 3), PLAIN)).volume == pytest.approx(6)
    rod = solid_mesh(capsule((0, 0, 0), (0.3, 0.4, 0), 0.1, PLAIN))
    assert rod.is_watertight and rod.is_winding_consistent
    assert rod.volume == pytest.approx(np.pi * 0.01 * 0.5 + 4 / 3 * np.pi * 0.001, rel=0.05)


@pytest.mark.parametrize("solid", [box((0, 0, 0), (1, 2, 3), PLAIN), capsule((0, 0, 0), (1, 2, 3), 0.4, PLAIN)])
def test_normals_point_outward(solid: tuple) -> None:
    mesh = solid_mesh(solid)
    for patch in solid:
        s, t = (np.linspace(0.1, 0.9, 5) * size for size in patch.size)
        outside = patch.at(s, t) + 0.05 * patch.normals(s, t)
        inside = patch.at(s, t) - 0.05 * patch.normals(s, t)
        assert not mesh.contains(outside).any() and mesh.contains(inside).all()


def test_noise_is_continuous_and_uses_its_range() -> None:
    x = np.random.default_rng(0).uniform(-50, 50, (5000, 3))
    assert np.abs(noise(x + 1e-4, 3) - noise(x, 3)).max() < 2e-3
    assert noise(x, 3).min() < 0.1 and noise(x, 3).max() > 0.9
    assert np.abs(np.corrcoef(noise(x, 3), noise(x, 4))[0, 1]) < 0.1


@pytest.mark.parametrize("name", NAMES)
def test_parts_of_every_object_stay_apart_and_joints_within_limits(name: str) -> None:
    for seed in range(3):
        model = MAKERS[name](seed)
        for body in model.bodies[1:]:
            assert body.hinge is not None
            assert all(body.hinge.limits[0] <= v <= body.hinge.limits[1] for v in body.hinge.states)
        for state in (0, 1):
            poses = model.state(state)
            united = [
                trimesh.boolean.union([solid_mesh(s) for s in b.solids], engine="manifold").apply_transform(
                    poses[b.name]
                )
                for b in model.bodies
            ]
            for part in united[1:]:
                assert abs((manifold(united[0]) ^ manifold(part)).volume()) < 1e-7  # Cubic metres.


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
    parts = posed_truth(cabinet / "truth", state)
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


def test_truth_parts_are_watertight_in_a_unit_box(cabinet: Path) -> None:
    both = [m for state in (0, 1) for m in posed_truth(cabinet / "truth", state)]
    assert all(m.is_watertight for m in both)
    points = np.concatenate([m.vertices for m in both])
    assert np.ptp(points, axis=0).max() == pytest.approx(1, abs=1e-4)
    assert np.abs(points.max(0) + points.min(0)).max() < 1e-4


def test_same_seed_same_pictures_another_seed_others(cabinet: Path, tmp_path: Path) -> None:
    again = make("cabinet", tmp_path / "again", seed=2, size=64, train_views=6, test_views=2)
    other = make("cabinet", tmp_path / "other", seed=3, size=64, train_views=6, test_views=2)
    picture = Path("state_1/train/003.png")
    assert (again / picture).read_bytes() == (cabinet / picture).read_bytes()
    assert (other / picture).read_bytes() != (cabinet / picture).read_bytes()


def test_light_stays_in_the_world(cabinet: Path) -> None:
    """A surface that turns is lit differently: the door's colours change, those of the base hardly."""
    model = MAKERS["cabinet"](2)
    surface = Surface(model, 0.02)
    lit = [LitScene(surface, model.state(t)).colours for t in (0, 1)]
    change = np.abs(lit[1] - lit[0]).mean(1)

    def front(body: str) -> slice:
        biggest = max((t for t in surface.texels if t.body == body), key=lambda t: t.shape[0] * t.shape[1])
        return slice(biggest.offset, biggest.offset + biggest.shape[0] * biggest.shape[1])

    assert np.median(change[front("door")]) > 5
    assert np.median(change[front("base")]) < 3  # Only what the door and the drawer shade.


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
    with pytest.raises(ZeroDivisionError):
        make("laptop", tmp_path / "t", size=16, progress=lambda i, n: i / 0)
    assert list(tmp_path.iterdir()) == []
