"""Part meshes: closed, of the right size, and silent about what nobody saw."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

from hingesplat.camera import Camera
from hingesplat.gaussians import SH_C0, Gaussians, concatenate
from hingesplat.mesh import (
    MeshConfig,
    _solid_unseen,
    _surface_points,
    close_surface,
    hull_mesh,
    mesh_parts,
)
from hingesplat.metrics.surface import penetration
from hingesplat.se3 import matrix_to_wxyz
from hingesplat.stereo import DepthMap
from hingesplat.tsdf import DepthView, DistanceGrid, distance_to, fuse_depth, tangent_planes, wall_thickness
from hingesplat.twin import Joint, Part, Twin


def look_at(eye: np.ndarray, target: np.ndarray | None = None, size: int = 96) -> Camera:
    forward = (np.zeros(3) if target is None else target) - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.1, 0.02, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye
    return Camera(T, 1.2 * size, 1.2 * size, size / 2, size / 2, size, size)


def sphere_of_cameras(n: int, radius: float = 3.0, size: int = 96) -> list[Camera]:
    """Spread evenly over the whole sphere."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z**2)
    return [look_at(radius * p, size=size) for p in np.column_stack([r * np.cos(turn), r * np.sin(turn), z])]


def traced(camera: Camera, mesh: trimesh.Trimesh) -> DepthView:
    """Exact depth of a mesh, all of it the part's own."""
    origin, rays = camera.rays()
    flat = rays.reshape(-1, 3)
    points, index, _ = mesh.ray.intersects_location(np.broadcast_to(origin, flat.shape), flat, multiple_hits=False)
    depth = np.full(len(flat), np.inf, np.float32)
    depth[index] = (points - origin) @ camera.T_world_camera[:3, 2]
    depth = depth.reshape(camera.height, camera.width)
    rgb = np.full((*depth.shape, 3), 0.5, np.float32)
    return DepthView(camera, depth, np.isfinite(depth), rgb, tangent_planes(camera, depth, 0.05))


def fused(shape: trimesh.Trimesh, cameras: list[Camera], resolution: int = 64) -> trimesh.Trimesh | None:
    voxel = float(shape.extents.max()) / resolution
    lower = shape.bounds[0] - 4 * voxel
    grid = tuple(int(n) for n in np.ceil(shape.extents / voxel) + 9)
    assert len(grid) == 3
    fusion = fuse_depth([traced(c, shape) for c in cameras], lower, grid, voxel, 2.5 * voxel)
    return close_surface(fusion.distance, lower, voxel, MeshConfig())


def box_gaussians(
    extents: tuple[float, float, float], centre: tuple[float, float, float], part: int, spacing: float = 0.03
) -> Gaussians:
    """Round, opaque Gaussians on the faces of a box, coloured by part."""
    box = trimesh.creation.box(extents, trimesh.transformations.translation_matrix(centre))
    points, faces = trimesh.sample.sample_surface(box, int(4 * box.area / spacing**2), seed=part)
    n = len(points)
    turns = np.array([trimesh.geometry.align_vectors([0, 0, 1], v)[:3, :3] for v in box.face_normals])[faces]
    scales = torch.tensor([spacing / 2.5, spacing / 2.5, spacing / 20]).log()
    colour = torch.tensor([[0.8, 0.2, 0.2], [0.2, 0.7, 0.2], [0.2, 0.3, 0.9]])[part % 3]
    return Gaussians(
        means=torch.tensor(points, dtype=torch.float32),
        quats=matrix_to_wxyz(torch.tensor(turns, dtype=torch.float32)),
        log_scales=scales.expand(n, 3).clone(),
        logit_opacities=torch.full((n,), 4.0),
        sh=((colour - 0.5) / SH_C0).expand(n, 1, 3).clone(),
        part=torch.full((n,), part, dtype=torch.int64),
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda: trimesh.creation.box((1.0, 0.7, 0.5)),
        lambda: trimesh.creation.icosphere(subdivisions=4, radius=0.5),
        lambda: trimesh.creation.box((1.0, 0.6, 0.06)),
    ],
    ids=["box", "sphere", "plate"],
)
def test_a_shape_seen_from_everywhere_comes_back_closed_and_of_its_size(make: Callable[[], trimesh.Trimesh]):
    shape = make()
    mesh = fused(shape, sphere_of_cameras(40))
    assert mesh is not None
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(shape.volume, rel=0.1)
    assert len(mesh.split()) == 1
    surface, _ = trimesh.sample.sample_surface(shape, 100_000, seed=0)
    assert KDTree(surface).query(mesh.vertices)[0].mean() < 0.5 / 64


def test_the_unknown_stays_unknown_and_free_space_is_outside():
    wall = trimesh.creation.box((4.0, 4.0, 0.2))
    view = traced(look_at(np.array([0.0, 0.0, 3.0])), wall)
    grid = fuse_depth([view], np.array([0.0, 0.0, -1.0]), (1, 1, 41), 0.05, 0.1)
    distance, weight = grid.distance, grid.weight
    z = np.linspace(-1, 1, 41)
    assert (distance[0, 0, z > 0.21] == 1).all() and (weight[0, 0, z > 0.21] > 0).all()
    assert (weight[0, 0, z < -0.01] == 0).all()
    near = np.abs(z - 0.1) < 0.09
    assert distance[0, 0, near] == pytest.approx((z[near] - 0.1) / 0.1, abs=0.02)


def test_a_stranger_in_front_clears_only_what_lies_before_it():
    wall = trimesh.creation.box((4.0, 4.0, 0.2))
    view = replace(traced(look_at(np.array([0.0, 0.0, 3.0])), wall), own=np.zeros((96, 96), bool))
    weight = fuse_depth([view], np.array([0.0, 0.0, -1.0]), (1, 1, 41), 0.05, 0.1).weight
    z = np.linspace(-1, 1, 41)
    assert (weight[0, 0, z < 0.19] == 0).all() and (weight[0, 0, z > 0.21] == 1).all()


def test_no_surface_gives_no_mesh_and_cavities_are_filled():
    assert close_surface(np.ones((8, 8, 8), np.float32), np.zeros(3), 0.1, MeshConfig()) is None
    x = np.linspace(-1, 1, 40)
    r = np.sqrt(x[:, None, None] ** 2 + x[None, :, None] ** 2 + x**2)
    shell = (np.abs(r - 0.6) - 0.2).astype(np.float32)
    mesh = close_surface(shell, np.full(3, -1.0), x[1] - x[0], MeshConfig())
    assert mesh is not None and mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.05)


def test_the_hull_of_a_flat_or_tiny_group_is_still_a_solid():
    flat = box_gaussians((0.4, 0.4, 0.02), (0, 0, 0), 0, 0.1)
    for group in (flat, flat[torch.arange(1)]):
        mesh = hull_mesh(group)
        assert mesh.is_watertight and mesh.volume > 0


def test_the_surface_of_a_small_part_has_no_holes() -> None:
    """Its pixels are wider than a 128th of it: cells that small are seen three times only by chance."""
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    points = _surface_points([traced(camera, box) for camera in sphere_of_cameras(24)], 128)
    assert KDTree(points).query(box.sample(2000, seed=0))[0].max() < 0.05  # Pixels are 0.026 wide there.


def test_parts_of_a_scene_in_two_states_come_back_apart_closed_and_coloured():
    """A door in front of a block: seen from the front only when shut, from both sides when it has opened."""
    spacing = 0.04
    scene = concatenate(
        [
            box_gaussians((0.8, 0.4, 0.8), (0, 0.21, 0), 0, spacing),
            box_gaussians((0.8, 0.06, 0.8), (0, -0.05, 0), 1, spacing),
        ]
    )
    joint = Joint(1, 0, "revolute", (0.0, 0.0, -1.0), (-0.4, -0.02, 0.0), (0.0, 1.5), (0.0, 1.5))
    cameras = sphere_of_cameras(24)
    states = [(cameras, {0: np.eye(4), 1: joint.transform(value)}) for value in joint.states]
    meshes = mesh_parts(scene, states, MeshConfig(resolution=48, image_size=96))
    for part_id, extents, rgb in [(0, (0.8, 0.4, 0.8), (204, 51, 51)), (1, (0.8, 0.06, 0.8), (51, 178, 51))]:
        mesh = meshes[part_id]
        assert mesh.is_watertight and mesh.volume > 0
        centre = (0, 0.21, 0) if part_id == 0 else (0, -0.05, 0)
        true = trimesh.creation.box(extents, trimesh.transformations.translation_matrix(centre))
        surface, _ = trimesh.sample.sample_surface(true, 20_000, seed=0)
        gap, _ = KDTree(surface).query(trimesh.sample.sample_surface(mesh, 5_000, seed=0)[0])
        # The Gaussians spill over the rims of the faces by about a spacing.
        assert np.percentile(gap, 95) < 1.5 * spacing
        assert np.median(mesh.visual.vertex_colors[:, :3], axis=0) == pytest.approx(rgb, abs=12)
    assert meshes[1].volume < 0.8 * 0.8 * 0.16


@pytest.mark.parametrize("part", [0, 1])
def test_a_sheet_seen_from_one_side_is_a_thin_solid_not_a_brick(part: int):
    rest = box_gaussians((0.8, 0.8, 0.8), (0, 0, 0), 0, 0.04)
    front = (rest.means[:, 1] < -0.39).long() == part
    cameras = [c for c in sphere_of_cameras(40) if c.centre[1] < -0.5]
    mesh = mesh_parts(rest.with_part(front.long()), [(cameras, {})], MeshConfig(resolution=48, image_size=96))[part]
    assert mesh.is_watertight
    assert mesh.extents[1] < 0.15
    assert mesh.extents[[0, 2]] == pytest.approx([0.8, 0.8], abs=0.1)


def open_box(extents: tuple[float, float, float], wall: float) -> trimesh.Trimesh:
    """A drawer: a box without a lid."""
    inner = np.array(extents) - [2 * wall, 2 * wall, 0]
    hole = trimesh.creation.box(inner, trimesh.transformations.translation_matrix([0, 0, wall]))
    return trimesh.boolean.difference([trimesh.creation.box(extents), hole], engine="manifold")


def known_depth(camera: Camera, mesh: trimesh.Trimesh) -> DepthMap:
    view = traced(camera, mesh)
    return DepthMap(camera, np.where(np.isfinite(view.depth), view.depth, 0).astype(np.float32), view.rgb)


def test_a_drawer_under_a_painted_lid_is_hollow_where_stereo_sees_into_it_in_either_state():
    """Shut, its inside is hidden by the base above it; pulled out, photographs look in. The fit is a solid box."""
    extents, far = (0.6, 0.5, 0.24), 0.6
    drawer = open_box(extents, 0.05)
    cover = trimesh.creation.box((0.8, 0.6, 0.2), trimesh.transformations.translation_matrix([0, 0.02, 0.24]))
    scene = concatenate(
        [box_gaussians((0.8, 0.6, 0.2), (0, 0.02, 0.24), 0, 0.05), box_gaussians(extents, (0, 0, 0), 1, 0.05)]
    )
    joint = Joint(1, 0, "prismatic", (0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (0.0, far), (0.0, far))
    cameras = sphere_of_cameras(24)
    states = [(cameras, {0: np.eye(4), 1: joint.transform(value)}) for value in joint.states]
    maps = []
    for _, poses in states:
        whole = trimesh.util.concatenate([cover, drawer.copy().apply_transform(poses[1])])
        maps.append([known_depth(camera, whole) for camera in cameras])
    config = MeshConfig(resolution=48, image_size=96)
    solid, hollow = (mesh_parts(scene, states, config, maps=m)[1] for m in ((), maps))
    assert solid.volume > 0.8 * drawer.convex_hull.volume
    assert hollow.is_watertight and hollow.volume == pytest.approx(drawer.volume, rel=0.1)
    assert drawer.volume < 0.6 * drawer.convex_hull.volume
    surface, _ = trimesh.sample.sample_surface(drawer, 20_000, seed=0)
    assert KDTree(surface).query(trimesh.sample.sample_surface(hollow, 5_000, seed=0)[0])[0].mean() < 0.01


@pytest.mark.parametrize("height", [0.5, 0.1])
def test_a_block_is_solid_though_no_camera_sees_its_underside_and_that_is_flat(height: float):
    shape = trimesh.creation.box((0.8, 0.8, height))
    cameras = [c for c in sphere_of_cameras(36) if c.centre[2] > 0.3]
    maps = [[known_depth(c, shape) for c in cameras]]
    scene = box_gaussians((0.8, 0.8, height), (0, 0, 0), 0)
    mesh = mesh_parts(scene, [(cameras, {})], MeshConfig(resolution=48, image_size=96), maps=maps)[0]
    assert mesh.is_watertight and mesh.volume == pytest.approx(shape.volume, rel=0.1)
    assert mesh.bounds[0][2] == pytest.approx(-height / 2, abs=0.8 / 48)


@pytest.mark.parametrize(("wall", "resolution"), [(0.04, 48), (0.02, 96)])
def test_what_is_unseen_in_the_depth_of_an_open_carcass_is_empty(wall: float, resolution: int):
    """Only its back and floor are seen through the opening; behind the others there is no more than such a wall."""
    lying = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    carcass = open_box((0.8, 0.8, 0.8), wall).apply_transform(lying)
    front = [c for c in sphere_of_cameras(120) if c.centre[1] < -2.9]
    cameras = front + [c for c in sphere_of_cameras(24) if c.centre[1] > -1]
    maps = [[known_depth(c, carcass) for c in cameras]]
    scene = box_gaussians((0.8, 0.8, 0.8), (0, 0, 0), 0)
    mesh = mesh_parts(scene, [(cameras, {})], MeshConfig(resolution=resolution, image_size=96), maps=maps)[0]
    assert mesh.is_watertight and mesh.volume == pytest.approx(carcass.volume, rel=0.1)


@pytest.mark.parametrize("open_", [False, True])
def test_specks_seen_to_be_free_do_not_hollow_a_block_but_a_way_in_does(open_: bool):
    n, depth = 48, np.full((48, 48, 48), 48)
    for axis in range(3):
        at = np.arange(n).reshape([-1 if a == axis else 1 for a in range(3)])
        depth = np.minimum(depth, np.minimum(at, n - 1 - at))  # Voxels from the border.
    distance, weight = np.where(depth < 4, 1, -1).astype(np.float32), (depth < 6).astype(np.float32)
    free = np.zeros_like(weight, bool)
    free[9:-9:3, 9:-9:3, 9:-9:3] = True
    if open_:
        free[8:-8, 8:-8, :20] = True
    distance[free], weight[free] = 1, 1
    surface = np.argwhere(depth == 4).astype(float)
    inside = _solid_unseen(DistanceGrid(np.zeros(3), 1.0, 2.5, distance, weight), depth >= 4, surface, 3.0)
    assert inside[24, 24, 32] != open_


def test_no_part_is_where_another_has_been():
    """A slab in the dark of a block: what hides it might be solid, but the slab needs a way out."""
    block = trimesh.creation.box((0.8, 0.8, 0.5))
    slab = trimesh.creation.box((0.5, 0.5, 0.2), trimesh.transformations.translation_matrix([0, 0.1, 0]))
    scene = concatenate([box_gaussians((0.8, 0.8, 0.5), (0, 0, 0), 0), box_gaussians((0.5, 0.5, 0.2), (0, 0.1, 0), 1)])
    joint = Joint(1, 0, "prismatic", (0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0), (0.0, 1.0))
    twin = Twin((Part(0, "base", 0), Part(1, "slab", 0)), (joint,))
    cameras = sphere_of_cameras(36)
    states, maps = [], []
    for state in (0, 1):
        poses = twin.at_state(state)
        whole = trimesh.util.concatenate([block, slab.copy().apply_transform(poses[1])])
        states.append((cameras, poses))
        maps.append([known_depth(c, whole) for c in cameras])
    config = MeshConfig(resolution=64, image_size=96)
    shut, free = (mesh_parts(scene, states, config, maps=maps, path=p) for p in ((), twin.on_the_way(1, 12)))
    within, without = (
        penetration(m[0], m[1], [poses[1] for poses in twin.on_the_way(1, 7)]).volume_fraction for m in (shut, free)
    )
    assert without < 0.05 < 0.3 < within
    assert free[0].is_watertight and 0.15 * block.volume < free[0].volume < shut[0].volume
    assert free[0].bounds == pytest.approx(block.bounds, abs=0.03)


def test_distance_to_another_grid_is_the_least_over_its_poses():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    views = [traced(c, ball) for c in sphere_of_cameras(40, size=240)]
    grid = fuse_depth(views, np.full(3, -0.5), (51, 51, 51), 0.02, 0.05)
    apart = trimesh.transformations.translation_matrix([0.4, 0, 0])
    found = distance_to(grid, grid, [np.eye(4), apart])
    x, y, z = np.moveaxis(np.indices(grid.distance.shape) * 0.02 - 0.5, 0, 0)
    true = np.minimum(np.hypot(np.hypot(x, y), z), np.hypot(np.hypot(x - 0.4, y), z)) - 0.3
    assert ((found < 0) == (true < 0))[np.abs(true) > 0.01].all()
    assert np.abs(found - true)[(true > -0.03) & (true < 0)].mean() < 0.005
    assert np.isinf(distance_to(grid, grid, [trimesh.transformations.translation_matrix([3, 0, 0])])).all()


def test_a_wall_is_as_thick_as_its_two_sides_say_however_it_stands():
    plate = trimesh.creation.box((1.0, 0.6, 0.06))
    plate.apply_transform(trimesh.transformations.rotation_matrix(0.4, [1, 0.3, 0.2]))
    cameras = sphere_of_cameras(60, size=240)
    lower, shape = plate.bounds[0] - 0.06, tuple(int(n) for n in plate.extents / 0.015 + 9)
    assert len(shape) == 3
    both, one = (
        fuse_depth([traced(c, plate) for c in some], lower, shape, 0.015, 0.03)
        for some in (cameras, [c for c in cameras if c.centre @ np.array([0, 0, 1]) > 1])
    )
    known = wall_thickness(both, 0.1)
    assert np.median(known) == pytest.approx(0.06, rel=0.1) and known.max() <= 0.1
    assert len(wall_thickness(both, 0.03)) < 0.05 * len(known)
    assert len(wall_thickness(one, 0.1)) < 0.1 * len(known)


def test_tangent_planes_are_those_of_a_slanted_wall_whatever_stands_behind_it():
    camera = look_at(np.array([0.0, 0.0, 3.0]))
    normal = np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    origin, rays = camera.rays()
    depth = -(origin @ normal) / (rays @ normal) * (rays @ camera.T_world_camera[:3, 2])
    depth[:, 60:] += 1.0
    planes = tangent_planes(camera, depth, 0.2)[2:-2, 2:-2]
    assert (planes[..., 4] > 0).all()
    in_camera = camera.T_world_camera[:3, :3].T @ normal
    assert planes[:, :56, :3] == pytest.approx(np.broadcast_to(in_camera, planes[:, :56, :3].shape), abs=1e-4)
    assert planes[:, :56, 3] == pytest.approx(-(origin @ normal) * -1, abs=1e-3)
