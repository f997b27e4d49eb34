"""Comparison of surfaces: cleaning, Chamfer distance, overlap for the matching of parts, penetration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

SAMPLES = 10_000
MIN_OVERLAP = 0.2
"""Parts that overlap less are not the same part."""


def clean(mesh: trimesh.Trimesh, smallest: float = 0.1) -> trimesh.Trimesh:
    """Drop the connected components whose area is below ``smallest`` of the largest one's (as DTA, ArtGS)."""
    _, vertex = np.unique(np.round(mesh.vertices / max(mesh.scale, 1e-12), 7), axis=0, return_inverse=True)
    f = vertex.reshape(-1)[mesh.faces]
    edges = np.concatenate([f[:, :2], f[:, 1:]])
    n = int(f.max()) + 1
    _, label = connected_components(coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (n, n)), False)
    label_of_face = label[f[:, 0]]
    area = np.bincount(label_of_face, weights=mesh.area_faces)
    keep = (area >= smallest * area.max())[label_of_face]
    return trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False)


def sample(meshes: Sequence[trimesh.Trimesh], count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` points (count, 3) uniform on the surfaces of all meshes together."""
    triangles = np.concatenate([m.triangles for m in meshes])
    area = np.concatenate([m.area_faces for m in meshes])
    chosen = triangles[rng.choice(len(triangles), count, p=area / area.sum())]
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0])


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Mean squared distance from a (n, 3) to b (m, 3) plus that from b to a, ×1000."""
    return 1000 * float((KDTree(b).query(a)[0] ** 2).mean() + (KDTree(a).query(b)[0] ** 2).mean())


def overlap(a: np.ndarray, b: np.ndarray, radius: float) -> float:
    """Harmonic mean of the shares of a and of b that have a point of the other within ``radius``, 0 … 1."""
    near_a = np.isfinite(KDTree(b).query(a, distance_upper_bound=radius)[0]).mean()
    near_b = np.isfinite(KDTree(a).query(b, distance_upper_bound=radius)[0]).mean()
    return float(2 * near_a * near_b / max(near_a + near_b, 1e-12))


def match(overlaps: np.ndarray) -> dict[int, int]:
    """One-to-one row → column with the largest sum of overlaps (n, m); drops pairs below ``MIN_OVERLAP``."""
    rows, columns = linear_sum_assignment(-overlaps)
    return {int(r): int(c) for r, c in zip(rows, columns, strict=True) if overlaps[r, c] >= MIN_OVERLAP}


def inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Which points (n, 3) lie inside, (n,) bool: ray parity, the majority of three directions.

    Three, so that a small hole or a ray along an edge does not decide alone.
    """
    votes = np.zeros(len(points), int)
    for d in np.random.default_rng(0).normal(size=(3, 3)):
        directions = np.tile(d, (len(points), 1))
        ray = mesh.ray.intersects_id(points, directions, multiple_hits=True, max_hits=100)[1]
        votes += np.bincount(np.asarray(ray, int), minlength=len(points)) % 2
    return votes >= 2


def sample_volume(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Up to ``count`` points (n, 3) uniform in the volume; few or none where the mesh encloses little."""
    low, high = mesh.bounds
    points = rng.uniform(low, high, (40 * count, 3))
    found: list[np.ndarray] = []
    for batch in np.array_split(points, 20):
        found.append(batch[inside(mesh, batch)])
        if sum(map(len, found)) >= count:
            break
    return np.concatenate(found)[:count]


def surface_distance(mesh: trimesh.Trimesh, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Distance (n,) of points (n, 3) from the surface: exact to the triangles that nearby samples lie on."""
    triangles, area = mesh.triangles, mesh.area_faces
    chosen = rng.choice(len(triangles), 30_000, p=area / area.sum())
    weights = rng.dirichlet((1, 1, 1), len(chosen))
    on_surface = (weights[:, :, None] * triangles[chosen]).sum(1)
    _, near = KDTree(on_surface).query(points, k=12)
    pairs = chosen[near]
    best = trimesh.triangles.closest_point(triangles[pairs.ravel()], np.repeat(points, pairs.shape[1], axis=0))
    return np.linalg.norm(best.reshape(*pairs.shape, 3) - points[:, None], axis=-1).min(1)


@dataclass(frozen=True)
class Penetration:
    """How far one part goes into the base, over the steps of its motion."""

    volume_fraction: float
    """The largest share of the part's volume inside the base at any step."""
    depth: float
    """The largest distance of such a point from the base's surface, scene units."""


def penetration(
    base: trimesh.Trimesh, part: trimesh.Trimesh, poses: Sequence[np.ndarray], seed: int = 0
) -> Penetration:
    """Follow volume samples of ``part`` through ``poses`` (4×4) and see which come to lie in ``base``."""
    rng = np.random.default_rng(seed)
    points = sample_volume(part, 2000, rng)
    fraction = depth = 0.0
    for T in poses if len(points) else ():
        moved = points @ T[:3, :3].T + T[:3, 3]
        within = moved[inside(base, moved)]
        fraction = max(fraction, len(within) / len(points))
        if len(within):
            depth = max(depth, float(surface_distance(base, within, rng).max()))
    return Penetration(fraction, depth)
