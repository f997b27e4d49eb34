"""Part meshes: fuse rendered depth of both states into one signed distance grid a part, then close it.

Truncated signed distance fusion (Curless and Levoy 1996) with point-to-plane distances. What no view ever saw
counts as inside only near the part's own Gaussians, so a sheet seen from one side closes into a thin solid,
not into a brick.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import manifold3d
import numba
import numpy as np
import torch
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial import ConvexHull, KDTree, QhullError
from skimage.measure import marching_cubes
from trimesh.visual import ColorVisuals

from hingesplat.camera import Camera
from hingesplat.gaussians import SH_C0, Gaussians, posed
from hingesplat.render import rasterize
from hingesplat.se3 import wxyz_to_matrix


@dataclass(frozen=True)
class MeshConfig:
    """How part meshes are made."""

    image_size: int = 240
    """Longest side of the depth maps, pixels."""
    views: int = 48
    """Views a state at most, evenly picked."""
    resolution: int = 128
    """Voxels along the longest side of each part's own box."""
    truncation: float = 2.5
    """Depth of the band behind a surface, voxels; at most half of the thinnest wall."""
    reach: float = 0.04
    """How far from its Gaussians unseen space belongs to a movable part; fraction of its longest side."""
    spread: float = 0.02
    """Pixels whose blended depths deviate by more than this (fraction of the scene) are not used."""
    floater: float = 0.02
    """Components with less than this share of the part's surface are dropped."""
    max_triangles: int = 50_000
    """Triangles a part at most."""


@dataclass(frozen=True)
class DepthView:
    """What one view says of one part."""

    camera: Camera
    """In the frame of the part."""
    depth: np.ndarray
    """(height, width) float32 z-depth of the first surface; inf: the ray meets nothing; nan: not known."""
    own: np.ndarray
    """(height, width) bool: that surface belongs to the part."""
    rgb: np.ndarray
    """(height, width, 3) float32 in [0, 1]."""
    planes: np.ndarray
    """(height, width, 5) float32, what ``tangent_planes`` gives."""


def mesh_parts(
    gaussians: Gaussians,
    states: Sequence[tuple[Sequence[Camera], Mapping[int, np.ndarray]]],
    config: MeshConfig | None = None,
) -> dict[int, trimesh.Trimesh]:
    """Closed, coloured triangle meshes of every part, in the frame of state 0.

    Args:
        gaussians: in state 0, with ``part`` ids.
        states: for each state its cameras (world frame) and its part poses ``{part id: T_state_part0}``
            (4×4), as ``Twin.at_state`` gives them.
        config: defaults when None.

    Returns:
        ``{part id: mesh}``: watertight 2-manifolds with vertex colours; the convex hull of a part's Gaussians
        where nothing closes.
    """
    config = config or MeshConfig()
    ids = [int(i) for i in gaussians.part.unique()]
    views = _depth_views(gaussians.detached(), states, ids, config)
    return {i: _mesh_part(gaussians[gaussians.part == i].detached(), views[i], i == 0, config) for i in ids}


def fuse_depth(
    views: Sequence[DepthView],
    lower: np.ndarray,
    shape: tuple[int, int, int],
    voxel: float,
    truncation: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Fuse depth maps into a grid of signed distances.

    Args:
        views: cameras in the grid's frame.
        lower: (3,) centre of voxel (0, 0, 0).
        shape: voxels along each axis.
        voxel: edge of a voxel, scene units.
        truncation: scene units.

    Returns:
        ``distance`` in [-1, 1] (units of the truncation, positive outside) and ``weight`` (0 where no view
        saw free space or a surface), both float32 of ``shape``.
    """
    total, weight, behind = (np.zeros(shape, np.float32) for _ in range(3))
    for view in views:
        T = view.camera.T_camera_world
        K = np.array([view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy])
        _integrate(total, weight, behind, T, K, lower, voxel, truncation, view.depth, view.own, view.planes)
    # Lying behind the part's own surface is weak evidence of being inside: many such views outvote one stray
    # ray, and a few good ones see into a hollow.
    behind *= np.float32(0.03)
    distance = (total - behind) / np.maximum(weight + behind, 1e-6)
    return np.where(weight > 0, distance, -1).astype(np.float32), weight


def tangent_planes(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """The plane at each pixel of a depth map: (height, width, 5) float32, normal, offset, weight.

    ``n·x + offset`` is the signed distance of the camera-frame point x, positive towards the camera; the
    weight is the cosine of incidence, and 0 where a neighbour is missing or the surface turns edge-on.
    """
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    points = rays * np.where(np.isfinite(depth), depth, np.nan)[..., None]
    out = np.zeros((camera.height, camera.width, 5), np.float32)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(down, across)  # image y points down, so this one faces the camera
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    inner, ray = points[1:-1, 1:-1], rays[1:-1, 1:-1]
    cosine = -(normal * ray).sum(-1) / np.linalg.norm(ray, axis=-1)
    good = np.isfinite(cosine) & (cosine > 0.15)
    out[1:-1, 1:-1, :3] = normal
    out[1:-1, 1:-1, 3] = -(normal * inner).sum(-1)
    out[1:-1, 1:-1, 4] = cosine
    out[1:-1, 1:-1][~good] = 0
    return out


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
    solid = manifold3d.Manifold.compose(pieces) if len(pieces) > 1 else pieces[0]
    out = solid.to_mesh()
    mesh = trimesh.Trimesh(np.asarray(out.vert_properties)[:, :3], np.asarray(out.tri_verts), process=False)
    return mesh if mesh.is_watertight and mesh.volume > 0 else None


def _mesh_part(part: Gaussians, views: list[DepthView], is_base: bool, config: MeshConfig) -> trimesh.Trimesh:
    """One part: distance grid, rule for the unseen, closed surface, colours."""
    solid = _solid_gaussians(part, views)
    corners = _ellipsoid_points(solid)
    extent = float(np.ptp(corners, axis=0).max())
    voxel = extent / config.resolution
    truncation = config.truncation * voxel
    lower = corners.min(0) - 3 * voxel
    nx, ny, nz = (int(n) + 4 for n in np.ceil((corners.max(0) - lower) / voxel))
    shape = (nx, ny, nz)
    distance, weight = fuse_depth(views, lower, shape, voxel, truncation)

    unseen = weight == 0
    inside = unseen & _hull_grid(corners, lower, shape, voxel)
    if not is_base:
        # A brick must not grow behind a door; hollows that stay enclosed are filled by close_surface.
        index = np.argwhere(inside)
        tree = KDTree(solid.means.double().numpy())
        away, _ = tree.query(lower + voxel * index, distance_upper_bound=config.reach * extent)
        inside[tuple(index.T)] = np.isfinite(away)
    distance[unseen] = np.where(inside, -1, 1)[unseen]
    mesh = close_surface(gaussian_filter(distance, 0.5), lower, voxel, config)
    if mesh is None:
        mesh = hull_mesh(solid)
    mesh.visual = ColorVisuals(mesh, vertex_colors=_vertex_colours(mesh, part, views, truncation))
    return mesh


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
) -> dict[int, list[DepthView]]:
    """Render every view once, the whole scene, so that a surface that another part hides stays silent."""
    views: dict[int, list[DepthView]] = {i: [] for i in ids}
    span = gaussians.means.quantile(0.98, 0) - gaussians.means.quantile(0.02, 0)
    limit = config.spread * float(span.norm())
    membership = (gaussians.part[:, None] == torch.tensor(ids)).float()
    for cameras, poses in states:
        scene = posed(gaussians, poses)
        step = max(1.0, len(cameras) / config.views)
        for full in (cameras[int(k)] for k in np.arange(0, len(cameras), step)):
            shrink = min(1.0, config.image_size / max(full.width, full.height))
            camera = full.scaled(max(1, round(full.width * shrink)), max(1, round(full.height * shrink)))
            T = torch.tensor(camera.T_camera_world, dtype=scene.means.dtype)
            z = scene.means @ T[2, :3] + T[2, 3]
            colours = (0.5 + SH_C0 * scene.sh[:, 0]).clamp(min=0)
            with torch.no_grad():
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
            rgb = np.clip(out.rgb.numpy() / safe, 0, 1).transpose(1, 2, 0).astype(np.float32)
            planes = tangent_planes(camera, depth)
            for k, i in enumerate(ids):
                T_part_camera = np.linalg.inv(poses.get(i, np.eye(4))) @ camera.T_world_camera
                own = solid & (channels[k] > 0.8 * alpha)
                views[i].append(DepthView(replace(camera, T_world_camera=T_part_camera), depth, own, rgb, planes))
    return views


@numba.njit(cache=True, nogil=True, fastmath=False)
def _integrate(total, weight, behind, T, K, lower, voxel, truncation, depth, own, planes):
    """Add one view to the grid, in place."""
    height, width = depth.shape
    nx, ny, nz = total.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                px, py, pz = lower[0] + i * voxel, lower[1] + j * voxel, lower[2] + k * voxel
                z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
                if z <= 1e-6:
                    continue
                x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
                y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
                a, b = K[0] * x / z + K[2], K[1] * y / z + K[3]
                if a < 0 or b < 0 or a >= width or b >= height:
                    continue
                u, v = int(a), int(b)
                d = depth[v, u]
                if np.isnan(d):
                    continue
                if z < d - 4 * truncation or (not own[v, u] and z < d - truncation):
                    total[i, j, k] += 1
                    weight[i, j, k] += 1
                elif own[v, u] and planes[v, u, 4] > 0:
                    s = planes[v, u, 0] * x + planes[v, u, 1] * y + planes[v, u, 2] * z + planes[v, u, 3]
                    s /= truncation
                    if s < -1:
                        behind[i, j, k] += 1
                    else:
                        w = planes[v, u, 4] * (1 + min(s, 0.0))
                        total[i, j, k] += w * min(s, 1.0)
                        weight[i, j, k] += w


def _solid_gaussians(part: Gaussians, views: list[DepthView]) -> Gaussians:
    """The part's Gaussians on surfaces that views see; strays and the never seen would bloat its box."""
    points = part.means.double().numpy()
    spread = np.sqrt((part.scales.double().numpy() ** 2).sum(1))
    seen = np.zeros(len(points), int)
    for view in views:
        inside, u, v, z = _pixels(points, view)
        at = view.depth[v, u]
        seen[inside] += view.own[v, u] & (np.abs(z - at) < 2 * spread[inside])
    keep = (seen >= min(2, len(views))) & (part.opacities.numpy() > 0.1)
    if keep.sum() < 16:
        keep[:] = True
    index = np.flatnonzero(keep)
    if len(index) > 16:
        gap = KDTree(points[index]).query(points[index], k=9)[0][:, -1]
        index = index[gap <= 6 * np.median(gap) + 1e-12]
    return part[torch.from_numpy(index)]


def _ellipsoid_points(gaussians: Gaussians) -> np.ndarray:
    """(6 n, 3) tips of the one-sigma ellipsoids."""
    R = wxyz_to_matrix(gaussians.quats.double())
    arms = (R * gaussians.scales.double()[:, None, :]).transpose(1, 2)
    centre = gaussians.means.double()[:, None]
    return torch.cat([centre + arms, centre - arms], 1).reshape(-1, 3).numpy()


def _hull_grid(cloud: np.ndarray, lower: np.ndarray, shape: tuple[int, int, int], voxel: float) -> np.ndarray:
    """``shape`` bool: voxels in the convex hull of a cloud, grown by one voxel; all if it has no hull.

    Each facet cuts every column of voxels at one height, so a column is an interval.
    """
    try:
        # Rounding to the grid first leaves few facets.
        equations = ConvexHull(np.unique(np.round((cloud - lower) / voxel), axis=0)).equations
    except QhullError:
        return np.ones(shape, bool)
    x, y = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    top, bottom = np.full(shape[:2], np.inf), np.full(shape[:2], -np.inf)
    for a, b, c, d in equations:
        slack = 1 - (a * x + b * y + d)
        if c > 1e-9:
            top = np.minimum(top, slack / c)
        elif c < -1e-9:
            bottom = np.maximum(bottom, slack / c)
        else:
            top = np.where(slack < 0, -np.inf, top)
    z = np.arange(shape[2])
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
