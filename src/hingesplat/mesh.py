"""Part meshes: fuse depth of all states into one signed distance grid a part, then close it.

Depth is that of stereo where it is known, else that of the Gaussians unless stereo sees through it: fits put lids on
hollows. A view of any state carves a part in the part's own frame. What no view ever saw is solid behind the surfaces
that were seen, as thick as a wall, and farther in where these close around it; what they leave open is empty, behind
walls as thick as those that were seen from both sides. But two parts are never in one place, so the base has room for
its movers all along their way.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import manifold3d
import numpy as np
import torch
import trimesh
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree, QhullError
from skimage.measure import marching_cubes
from trimesh.visual import ColorVisuals

from hingesplat.camera import Camera
from hingesplat.drawer_box import drawn_out
from hingesplat.gaussians import SH_C0, Gaussians, posed
from hingesplat.render import rasterize
from hingesplat.screw import slide_of
from hingesplat.se3 import wxyz_to_matrix
from hingesplat.stereo import DepthMap, contradicted, cubes
from hingesplat.tsdf import DepthView, DistanceGrid, distance_to, fuse_depth, tangent_planes, usual_thickness

log = logging.getLogger(__name__)

MOST = 0.5
"""Share of a part that must lie within the convex hull of what was seen of it for that to be its bound."""
HOLLOW = 0.08
"""An unseen pocket is empty where more than this share of what borders on it was seen to be: it was 0.10 to 0.48 of
cabinets and drawers, and 0.05 at most of solid memory sticks and panels."""
DENSE, WIDER = 0.15, 1.2
"""Share of the cells that pixels fall into that three of them must see, and the factor by which cells grow for that. Of
parts of two objects it was 0.19 to 0.62, but 0.007 of a small drawer."""


@dataclass(frozen=True)
class MeshConfig:
    """How part meshes are made."""

    image_size: int = 240
    """Longest side of the depth maps, pixels, where no stereo gives them its size."""
    views: int = 48
    """Views a state at most, evenly picked."""
    resolution: int = 128
    """Voxels along the longest side of each part's own box."""
    truncation: float = 2.5
    """Depth of the band behind a surface, voxels; at most half of the thinnest wall."""
    reach: float = 0.04
    """How far behind its surface unseen space belongs to a part in any case; fraction of its longest side."""
    spread: float = 0.02
    """Pixels whose blended depths deviate by more than this (fraction of the scene) are not used."""
    steps: int = 24
    """Places on the way from state to state at which the base leaves room for its movers."""
    clearance: float = 0.3
    """Gap between the base and what moves in it, voxels of the base."""
    floater: float = 0.02
    """Components with less than this share of the part's surface are dropped."""
    max_triangles: int = 50_000
    """Triangles a part at most."""


def mesh_parts(
    gaussians: Gaussians,
    states: Sequence[tuple[Sequence[Camera], Mapping[int, np.ndarray]]],
    config: MeshConfig | None = None,
    *,
    maps: Sequence[Sequence[DepthMap]] = (),
    path: Sequence[Mapping[int, np.ndarray]] = (),
) -> dict[int, trimesh.Trimesh]:
    """Closed, coloured triangle meshes of every part, in the frame of state 0.

    Args:
        gaussians: in state 0, with ``part`` ids.
        states: for each state its cameras (world frame) and its part poses ``{part id: T_state_part0}``
            (4×4), as ``Twin.at_state`` gives them.
        config: defaults when None.
        maps: for each state the depth that stereo knows of each of its cameras; without them, rendered depth is all.
        path: part poses like those of ``states``, all along the motion: places where the base (part 0) leaves room.

    Returns:
        ``{part id: mesh}``: watertight 2-manifolds with vertex colours; the convex hull of a part's Gaussians
        where nothing closes.
    """
    config = config or MeshConfig()
    ids = [int(i) for i in gaussians.part.unique()]
    views = _depth_views(gaussians.detached(), states, ids, config, maps)
    grids = _solids(views, [*(poses for _, poses in states), *path], config)
    meshes = {}
    for i in ids:
        part, grid = gaussians[gaussians.part == i].detached(), grids.get(i)
        mesh = None if grid is None else close_surface(grid.distance, grid.lower, grid.voxel, config)
        if mesh is None:
            log.warning("part %d: its surface does not close; its convex hull stands in", i)
            mesh = hull_mesh(part)
        tolerance = np.inf if grid is None else grid.truncation
        mesh.visual = ColorVisuals(mesh, vertex_colors=_vertex_colours(mesh, part, views[i], tolerance))
        meshes[i] = mesh
    return meshes


def close_surface(distance: np.ndarray, lower: np.ndarray, voxel: float, config: MeshConfig) -> trimesh.Trimesh | None:
    """The zero level of a signed distance grid as a watertight manifold; cavities filled, floaters dropped.

    ``lower`` (3,) is the centre of voxel (0, 0, 0). None where there is no closed surface.
    """
    padded = np.pad(distance, 1, constant_values=1.0)
    padded = np.where(np.abs(padded) < 1e-3, np.float32(1e-3), padded)  # no vertex on a grid point: no slivers
    if not (padded < 0).any():
        return None
    vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="descent")
    vertices = ((vertices - 1) * voxel + lower).astype(np.float32)
    solid = manifold3d.Manifold(manifold3d.Mesh(vertices, faces.astype(np.uint32)))
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        return None
    tolerance = 0.15 * voxel
    solid = solid.simplify(tolerance)
    while solid.num_tri() > config.max_triangles:
        tolerance *= 1.5
        solid = solid.simplify(tolerance)
    pieces = [p for p in solid.decompose() if p.volume() > 0]  # a cavity's own volume is negative
    area = sum(p.surface_area() for p in pieces)
    pieces = [p for p in pieces if p.surface_area() >= config.floater * area]
    if not pieces:
        return None
    solid = _refined(manifold3d.Manifold.compose(pieces), 2.5 * voxel, config.max_triangles)
    out = solid.to_mesh()
    mesh = trimesh.Trimesh(np.asarray(out.vert_properties)[:, :3], np.asarray(out.tri_verts), process=False)
    return mesh if mesh.is_watertight and mesh.volume > 0 else None


def _refined(solid: manifold3d.Manifold, length: float, most: int) -> manifold3d.Manifold:
    """The same solid with edges of at most ``length``, or somewhat more to keep within ``most`` triangles.

    Colours stand at vertices, and flat faces have none in their middle.
    """
    while (fine := solid.refine_to_length(length)).num_tri() > most:
        length *= 1.25
        if length > solid.surface_area() ** 0.5:
            return solid
    return fine


def _solids(
    views: Mapping[int, list[DepthView]], poses: Sequence[Mapping[int, np.ndarray]], config: MeshConfig
) -> dict[int, DistanceGrid]:
    """Distances of every part that was seen, no two parts in one place.

    What was seen stays before what was guessed, and the base gives way to its movers: a mover's guess ends where the
    base was seen, and all that a mover passes through on its way is empty. The box of a drawer goes on all the same:
    what was seen where it must be is more likely its own.
    """
    grids, surfaces = {}, {}
    for i in views:
        surface = _surface_points(views[i], config.resolution)
        if len(surface):
            grids[i], surfaces[i] = _fused_grid(views[i], surface, config), surface
    base = grids.get(0)
    if base is None:
        return {i: _filled(grid, surfaces[i], config) for i, grid in grids.items()}
    known = replace(base, distance=np.where(base.weight > 0, base.distance, np.float32(1)))
    room = np.full(base.distance.shape, np.inf, np.float32)
    for i in grids.keys() - {0}:
        T_base_mover = [p.get(i, np.eye(4)) for p in poses]
        mover = _filled(grids[i], surfaces[i], config, bounded=slide_of(T_base_mover) is None)
        taken = -distance_to(mover, known, [np.linalg.inv(T) for T in T_base_mover]) / mover.truncation
        guess = np.maximum(mover.distance, np.minimum(taken, 1))
        mover = replace(mover, distance=np.where(mover.weight > 0, mover.distance, guess))
        walls = _reach(surfaces[i], config), _reach(surfaces[0], config)
        grids[i] = mover = drawn_out(mover, surfaces[i], surfaces[0], T_base_mover, walls)
        room = np.minimum(room, distance_to(base, mover, T_base_mover))
    base = _filled(base, surfaces[0], config, bounded=True)
    taken = (config.clearance * base.voxel - room) / base.truncation
    grids[0] = replace(base, distance=np.maximum(base.distance, np.minimum(taken, 1)))
    return grids


def _fused_grid(views: list[DepthView], surface: np.ndarray, config: MeshConfig) -> DistanceGrid:
    """Depth fused on a grid around the surface (n, 3)."""
    voxel = float(np.ptp(surface, axis=0).max()) / config.resolution
    lower = surface.min(0) - 3 * voxel
    nx, ny, nz = (int(n) + 4 for n in np.ceil((surface.max(0) - lower) / voxel))
    return fuse_depth(views, lower, (nx, ny, nz), voxel, config.truncation * voxel)


def _filled(grid: DistanceGrid, surface: np.ndarray, config: MeshConfig, *, bounded: bool = False) -> DistanceGrid:
    """The rule for the unseen, and a little smoothing.

    If ``bounded``, nothing sticks out of the convex hull of what was seen: a bottom that no camera sees is flat between
    its edges. The wall of a drawer of which only the inside was seen does stick out, and so does a sheet seen from one
    side.
    """
    hull = _hull_distance(surface, grid.lower, grid.distance.shape, grid.voxel)
    solid = _solid_unseen(grid, hull <= 1, surface, _reach(surface, config))
    distance = np.where(grid.weight == 0, np.where(solid, -1, 1), grid.distance).astype(np.float32)
    if bounded:
        within = np.maximum(distance, np.clip(hull * (grid.voxel / grid.truncation), -1, 1))
        if (within < 0).sum() > MOST * (distance < 0).sum():
            distance = within
    return replace(grid, distance=ndimage.gaussian_filter(distance, 0.7))


def _reach(surface: np.ndarray, config: MeshConfig) -> float:
    """How thick the walls of a part count where nobody saw, scene units: its surface is (n, 3)."""
    return config.reach * float(np.ptp(surface, axis=0).max())


def _solid_unseen(grid: DistanceGrid, hull: np.ndarray, surface: np.ndarray, reach: float) -> np.ndarray:
    """Which unseen voxels belong to the part: those of its walls, and pockets that these close.

    Walls stand on the surface (n, 3) and, as what it stands on is rarely photographed, on its convex ``hull``. What
    lies deeper than ``reach`` behind them is a pocket. It is empty where it lies open towards space that was seen to be
    empty, and then it is as large as walls as thick as those seen from both sides leave it.
    """
    voxel, distance, unseen = grid.voxel, grid.distance, grid.weight == 0
    inside = unseen & hull
    index = np.argwhere(inside)
    places, threads = grid.lower + voxel * index, torch.get_num_threads()
    away, _ = KDTree(surface).query(places, distance_upper_bound=reach, workers=threads)

    def behind(thickness: float) -> np.ndarray:
        """The unseen voxels that lie deeper than walls of that thickness."""
        deep = inside & np.asarray(ndimage.binary_erosion(hull, iterations=max(round(thickness / voxel), 1)), bool)
        deep[tuple(index.T)] &= np.asarray(away) > thickness
        return deep

    deep = behind(reach)
    pocket = np.zeros(distance.shape, np.int32)
    ndimage.label(deep, output=pocket)
    count = int(pocket.max()) + 1
    free = ~unseen & ndimage.binary_erosion(hull, iterations=4) & (distance > 0)
    free = np.asarray(ndimage.binary_opening(free), bool)  # Specks are noise.

    def borders(side: np.ndarray) -> np.ndarray:
        """The number of voxel faces that each pocket shares with ``side``."""
        shifted = (np.roll(side, shift, axis) for axis in range(3) for shift in (1, -1))
        return np.sum([np.bincount(pocket[s], minlength=count) for s in shifted], axis=0)

    open_, closed = borders(free), borders((inside & ~deep) | (~unseen & (distance <= 0)))
    hollow = open_ > HOLLOW * (open_ + closed)
    hollow[0] = False
    wall, empty = usual_thickness(grid, len(surface), reach), hollow[pocket]
    more = round((reach - wall) / voxel)
    if more and empty.any():
        empty = np.asarray(ndimage.binary_dilation(empty, iterations=more, mask=behind(wall)), bool)
    return inside & ~empty


def hull_mesh(gaussians: Gaussians) -> trimesh.Trimesh:
    """The convex hull of the one-sigma ellipsoids; a box when there are too few or they are flat."""
    points = _ellipsoid_points(gaussians)
    try:
        mesh = trimesh.convex.convex_hull(points)
        if mesh.is_watertight and mesh.volume > 0:
            return mesh
    except (QhullError, ValueError, IndexError):
        pass
    size = np.ptp(points, axis=0)
    size = np.maximum(size, max(1e-3 * size.max(), 1e-6))
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix((points.max(0) + points.min(0)) / 2))


def _depth_views(
    gaussians: Gaussians,
    states: Sequence[tuple[Sequence[Camera], Mapping[int, np.ndarray]]],
    ids: list[int],
    config: MeshConfig,
    maps: Sequence[Sequence[DepthMap]],
) -> dict[int, list[DepthView]]:
    """Look from every camera once, at the whole scene, so that a surface that another part hides stays silent."""
    views: dict[int, list[DepthView]] = {i: [] for i in ids}
    span = gaussians.means.quantile(0.98, 0) - gaussians.means.quantile(0.02, 0)
    limit = config.spread * float(span.norm())
    for t, (cameras, poses) in enumerate(states):
        scene = posed(gaussians, poses)
        step = max(1.0, len(cameras) / config.views)
        for number in (int(k) for k in np.arange(0, len(cameras), step)):
            full = cameras[number]
            shrink = min(1.0, config.image_size / max(full.width, full.height))
            camera = full.scaled(max(1, round(full.width * shrink)), max(1, round(full.height * shrink)))
            if maps:
                camera = maps[t][number].camera
            depth, part, rgb = _rendered(scene, camera, ids, limit)
            if maps:
                _correct(depth, part, scene, maps[t], number, limit)
            planes = tangent_planes(camera, depth, limit)
            for i in ids:
                T_part_camera = np.linalg.inv(poses.get(i, np.eye(4))) @ camera.T_world_camera
                views[i].append(DepthView(replace(camera, T_world_camera=T_part_camera), depth, part == i, rgb, planes))
    return views


@torch.no_grad()
def _rendered(
    scene: Gaussians, camera: Camera, ids: list[int], limit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (h, w) as in ``DepthView``, part (h, w), -1 where it is not known, and colour (h, w, 3)."""
    T = torch.tensor(camera.T_camera_world, dtype=scene.means.dtype)
    z = scene.means @ T[2, :3] + T[2, 3]
    colours = (0.5 + SH_C0 * scene.sh[:, 0]).clamp(min=0)
    membership = (scene.part[:, None] == torch.tensor(ids)).float()
    out = rasterize(
        scene.means, scene.quats, scene.scales, scene.opacities, colours, camera,
        channels=torch.cat([membership, z[:, None] ** 2], 1),
    )  # fmt: skip
    alpha, channels = out.alpha.numpy(), out.channels.numpy()
    safe = np.maximum(alpha, 1e-6)
    mean = out.depth.numpy() / safe
    deviation = np.sqrt(np.maximum(channels[-1] / safe - mean**2, 0))
    solid = (alpha > 0.5) & (deviation < limit)
    depth = np.where(solid, mean, np.where(alpha < 0.5, np.inf, np.nan)).astype(np.float32)
    most = channels[:-1].argmax(0)
    sure = solid & (channels[:-1].max(0) > 0.8 * alpha)
    part = np.where(sure, np.asarray(ids)[most], -1)
    return depth, part, np.clip(out.rgb.numpy() / safe, 0, 1).transpose(1, 2, 0).astype(np.float32)


def _correct(
    depth: np.ndarray, part: np.ndarray, scene: Gaussians, maps: Sequence[DepthMap], number: int, limit: float
) -> None:
    """Put in, in place, what stereo knows: its depth where it has one, nothing where it sees through what is drawn."""
    camera, known = maps[number].camera, maps[number].depth
    y, x = np.nonzero(np.isfinite(depth) & (known == 0))
    lid = contradicted(camera.lifted(x, y, depth[y, x]), maps, limit)
    depth[y[lid], x[lid]], part[y[lid], x[lid]] = np.nan, -1
    # Where the two differ, whose surface it is has to be asked anew.
    y, x = np.nonzero((known > 0) & ((part < 0) | ~(np.abs(known - depth) < 0.5 * limit)))
    depth[known > 0] = known[known > 0]
    seen = scene[scene.opacities > 0.1]
    if len(y) and len(seen):
        nearest = KDTree(seen.means.numpy()).query(camera.lifted(x, y, known[y, x]))[1]
        part[y, x] = seen.part.numpy()[nearest]


def _surface_points(views: Sequence[DepthView], resolution: int) -> np.ndarray:
    """(n, 3) points on the part's surface, one for each cell of a voxel's size that at least three pixels see.

    A small part's cells are larger, or they would be seen three times only by chance.
    Stragglers are left out; without enough of them (16) there are none.
    """
    seen = []
    for view in views:
        y, x = np.nonzero(view.own & np.isfinite(view.depth))
        seen.append(view.camera.lifted(x, y, view.depth[y, x].astype(float)))
    points = np.concatenate(seen)
    if len(points) < 16:
        return points[:0]
    size = float((np.quantile(points, 0.99, axis=0) - np.quantile(points, 0.01, axis=0)).max()) / resolution
    size = max(size, 1e-9)
    while True:
        _, cell, count = np.unique(cubes(points, size), return_inverse=True, return_counts=True)
        if (count >= 3).mean() > DENSE:
            break
        size *= WIDER
    mean = np.stack([np.bincount(cell, a) for a in points.T], 1) / count[:, None]
    mean = mean[count >= 3]
    if len(mean) < 16:
        return mean[:0]
    gap = KDTree(mean).query(mean, k=9)[0][:, -1]
    return mean[gap <= 4 * np.median(gap)]


def _ellipsoid_points(gaussians: Gaussians) -> np.ndarray:
    """(6 n, 3) tips of the one-sigma ellipsoids."""
    R = wxyz_to_matrix(gaussians.quats.double())
    arms = (R * gaussians.scales.double()[:, None, :]).transpose(1, 2)
    centre = gaussians.means.double()[:, None]
    return torch.cat([centre + arms, centre - arms], 1).reshape(-1, 3).numpy()


def _hull_distance(cloud: np.ndarray, lower: np.ndarray, shape: tuple[int, int, int], voxel: float) -> np.ndarray:
    """``shape`` float32: how far, in voxels, the facets of a cloud's convex hull leave each voxel outside.

    Exact up to three voxels either way, and infinite beyond; -inf everywhere if there is no hull.
    """
    try:
        # Rounding first leaves few facets.
        equations = ConvexHull(np.unique(np.round(4 * (cloud - lower) / voxel), axis=0) / 4).equations
    except QhullError:
        return np.full(shape, -np.inf, np.float32)
    columns = np.stack(np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij"), -1)
    core, grown = (_within(equations + np.array([0, 0, 0, -margin]), columns, shape[2]) for margin in (-3, 3))
    rim = np.argwhere(grown & ~core)
    distance = np.where(core, -np.inf, np.inf).astype(np.float32)
    some = np.array_split(rim.astype(float), len(rim) // 4096 + 1)  # in the cache, all facets at once
    distance[tuple(rim.T)] = np.concatenate([(r @ equations[:, :3].T + equations[:, 3]).max(1) for r in some])
    return distance


def _within(equations: np.ndarray, columns: np.ndarray, height: int) -> np.ndarray:
    """Grid places where every ``a x + b y + c z + d`` of the equations (n, 4) is at most 0.

    Each facet cuts a column (x, y) at one height, so that is an interval.
    """
    top, bottom = np.full(columns.shape[:2], np.inf), np.full(columns.shape[:2], -np.inf)
    for a, b, c, d in equations:
        slack = -(columns @ np.array([a, b]) + d)
        if c > 1e-9:
            top = np.minimum(top, slack / c)
        elif c < -1e-9:
            bottom = np.maximum(bottom, slack / c)
        else:
            top = np.where(slack < 0, -np.inf, top)
    z = np.arange(height)
    return (z >= bottom[..., None]) & (z <= top[..., None])


def _pixels(points: np.ndarray, view: DepthView) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the points that fall into the image, their pixels u, v, and their depths."""
    uv, z = view.camera.project(points)
    u, v = np.floor(uv).astype(int).T
    index = np.flatnonzero((z > 0) & (u >= 0) & (v >= 0) & (u < view.camera.width) & (v < view.camera.height))
    return index, u[index], v[index], z[index]


def _vertex_colours(mesh: trimesh.Trimesh, part: Gaussians, views: list[DepthView], tolerance: float) -> np.ndarray:
    """(n, 4) uint8: the mean of the pixels that see a vertex; else the colour of the nearest Gaussian."""
    total, weight = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for view in views:
        index, u, v, z = _pixels(np.asarray(mesh.vertices), view)
        towards = view.camera.centre - mesh.vertices[index]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        facing = (mesh.vertex_normals[index] * towards).sum(1)
        with np.errstate(invalid="ignore"):
            sees = view.own[v, u] & (np.abs(view.depth[v, u] - z) < tolerance) & (facing > 0.1)
        w = np.where(sees, facing**2, 0)
        total[index] += w[:, None] * view.rgb[v, u]
        weight[index] += w
    nearest = KDTree(part.means.double().numpy()).query(mesh.vertices)[1]
    own = (0.5 + SH_C0 * part.sh[:, 0].double().numpy()[nearest]).clip(0, 1)
    rgb = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-9)[:, None], own)
    return np.column_stack([np.round(rgb * 255), np.full(len(rgb), 255)]).astype(np.uint8)
