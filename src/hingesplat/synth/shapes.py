"""Textured closed solids, put together from patches: small maps of a rectangle into space."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh

Texture = Callable[[np.ndarray, int], np.ndarray]
"""(points (n, 3) in the part's zero frame, face number) to sRGB colours (n, 3) in [0, 1]."""


@dataclass(frozen=True)
class Patch:
    """A piece of surface: the rectangle [0, size[0]] × [0, size[1]] mapped into the part's frame.

    ``at(s, t)`` takes arrays (n,) in model units to points (n, 3); ∂s × ∂t points outward.
    """

    at: Callable[[np.ndarray, np.ndarray], np.ndarray]
    size: tuple[float, float]
    """Lengths along s and t, model units."""
    lines: tuple[np.ndarray, np.ndarray]
    """Where the mesh has its lines, along s and t: from 0 to ``size``, nothing between where the patch is flat."""
    texture: Texture
    face: int = 0
    """Given to the texture, so that the faces of one solid differ."""
    gloss: float = 0.0
    """How much of a clear coat reflects, 0 (matt) to 1."""

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (n, 3), their (s, t) (n, 2), and triangles (m, 3)."""
        s, t = np.meshgrid(*self.lines, indexing="ij")
        st = np.stack([s.ravel(), t.ravel()], 1)
        i = np.arange(s.size).reshape(s.shape)
        p00, p10, p11, p01 = (q.ravel() for q in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
        faces = np.concatenate([np.stack([p00, p10, p11], 1), np.stack([p00, p11, p01], 1)])
        return self.at(st[:, 0], st[:, 1]), st, faces

    def normals(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Outward unit normals (n, 3), by central differences."""
        e = 1e-4 * np.asarray(self.size)
        s, t = np.clip(s, 2 * e[0], self.size[0] - 2 * e[0]), np.clip(t, 2 * e[1], self.size[1] - 2 * e[1])
        ds = self.at(s + e[0], t) - self.at(s - e[0], t)
        dt = self.at(s, t + e[1]) - self.at(s, t - e[1])
        n = np.cross(ds, dt)
        return n / np.linalg.norm(n, axis=1, keepdims=True)


Solid = tuple[Patch, ...]
"""Patches that together close a volume."""


def solid_mesh(solid: Solid) -> trimesh.Trimesh:
    """The solid as one watertight mesh, model units."""
    vertices, _, faces = zip(*(p.mesh() for p in solid), strict=True)
    first = np.cumsum([0, *map(len, vertices)])
    numbered = np.concatenate([f + n for f, n in zip(faces, first, strict=False)])
    mesh = trimesh.Trimesh(np.concatenate(vertices), numbered, process=False)
    mesh.merge_vertices(digits_vertex=7)
    mesh.update_faces(mesh.nondegenerate_faces(height=1e-9))
    mesh.remove_unreferenced_vertices()
    return mesh


def box(
    low: tuple[float, float, float], high: tuple[float, float, float], texture: Texture, radius: float = 0.0
) -> Solid:
    """An axis-aligned box between two opposite corners, its edges rounded by ``radius``.

    Its faces are numbered −x, +x, −y, +y, −z, +z.
    """
    lo, hi = np.minimum(low, high, dtype=float), np.maximum(low, high, dtype=float)
    bend = radius * (1 - np.tan(np.linspace(np.pi / 4, 0, 4)))  # Equal angles from the edge to the flat.

    def lines(size: float) -> np.ndarray:
        return np.concatenate([bend, size - bend[::-1]]) if radius else np.array([0, size])

    patches = []
    for face in range(6):
        axis, positive = divmod(face, 2)
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        corner = lo.copy()
        if positive:
            corner[axis] = hi[axis]
        else:
            u, v = v, u

        def at(s: np.ndarray, t: np.ndarray, corner: np.ndarray = corner, u=u, v=v) -> np.ndarray:
            x = corner + s[:, None] * u + t[:, None] * v
            if not radius:
                return x
            core = np.clip(x, lo + radius, hi - radius)
            out = x - core
            return core + radius * out / np.linalg.norm(out, axis=1, keepdims=True)

        size = (float((hi - lo) @ u), float((hi - lo) @ v))
        patches.append(Patch(at, size, (lines(size[0]), lines(size[1])), texture, face))
    return tuple(patches)


def capsule(
    start: tuple[float, float, float], end: tuple[float, float, float], radius: float, texture: Texture
) -> Solid:
    """A rod with round ends; ``start`` and ``end`` are the centres of the two half spheres."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(b - a))
    w = (b - a) / length
    u = np.cross(w, np.eye(3)[np.argmin(np.abs(w))])
    u /= np.linalg.norm(u)
    v = np.cross(w, u)
    quarter = radius * np.pi / 2

    def at(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        around = s / radius
        cap = np.clip(quarter - t, 0, None) - np.clip(t - quarter - length, 0, None)  # Arc length into a cap.
        r = radius * np.cos(cap / radius)
        along = np.clip(t - quarter, 0, length) - radius * np.sin(cap / radius)
        ring = np.cos(around)[:, None] * u + np.sin(around)[:, None] * v
        return a + along[:, None] * w + r[:, None] * ring

    # Rows of the mesh have to meet the seams between rod and caps, or it would cut them off.
    rows = max(1, round(length / quarter * 5))
    knots = np.concatenate(
        [
            np.linspace(0, quarter, 6),
            quarter + np.linspace(0, length, rows + 1)[1:],
            quarter + length + np.linspace(0, quarter, 6)[1:],
        ]
    )
    total = 2 * quarter + length
    even = np.linspace(0, total, len(knots))
    return (
        Patch(
            lambda s, t: at(s, np.interp(t, even, knots)),
            (2 * np.pi * radius, total),
            (np.linspace(0, 2 * np.pi * radius, 21), even),
            texture,
        ),
    )


def tube(
    path: np.ndarray,
    normal: tuple[float, float, float],
    radius: float | tuple[float, float],
    texture: Texture,
    closed: bool = False,
) -> Solid:
    """A bent rod along a plane polyline (n, 3) with round ends; ``closed`` joins last to first.

    ``normal`` is that of the plane; two radii are those along it and across it.
    """
    a, b = radius if isinstance(radius, tuple) else (radius, radius)
    p, up = np.asarray(path, float), np.asarray(normal, float)
    if closed:
        tangents = np.roll(p, -1, 0) - np.roll(p, 1, 0)
        p, tangents, size = np.vstack([p, p[:1]]), np.vstack([tangents, tangents[:1]]), np.ones(len(p) + 1)
    else:
        tangents = np.gradient(p, axis=0)
        bend = np.radians([0, 30, 60])
        ends = [tangents[i] / np.linalg.norm(tangents[i]) * min(a, b) for i in (0, -1)]
        p = np.vstack([p[0] - np.cos(bend)[:, None] * ends[0], p, p[-1] + np.cos(bend[::-1])[:, None] * ends[1]])
        tangents = np.vstack([tangents[[0] * 3], tangents, tangents[[-1] * 3]])
        size = np.concatenate([np.sin(bend), np.ones(len(path)), np.sin(bend[::-1])])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    girth = np.pi * (a + b)

    def at(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        turn = 2 * np.pi * s / girth
        along = _interp(t, length, tangents)
        ring = a * np.cos(turn)[:, None] * up + b * np.sin(turn)[:, None] * np.cross(along, up)
        return _interp(t, length, p) + np.interp(t, length, size)[:, None] * ring

    return (Patch(at, (girth, float(length[-1])), (np.linspace(0, girth, 17), length), texture),)


def lathe(
    profile: Sequence[tuple[float, float]],
    origin: tuple[float, float, float],
    axis: tuple[float, float, float],
    texture: Texture,
    around: int = 32,
) -> Solid:
    """Turns a polyline of (radius, height) about ``axis`` (a unit vector), its outside to the right of its course.

    It starts and ends on the axis (a vase), or where it started (a ring).
    """
    rz, o, w = np.asarray(profile, float), np.asarray(origin, float), np.asarray(axis, float)
    u = np.cross(w, np.eye(3)[np.argmin(np.abs(w))])
    u /= np.linalg.norm(u)
    v = np.cross(w, u)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(rz, axis=0), axis=1))])
    girth = 2 * np.pi * float(rz[:, 0].max())

    def at(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        turn, q = 2 * np.pi * s / girth, _interp(t, length, rz)
        return o + q[:, 1:] * w + q[:, :1] * (np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v)

    return (Patch(at, (girth, float(length[-1])), (np.linspace(0, girth, around + 1), length), texture),)


def cylinder(
    origin: tuple[float, float, float],
    axis: tuple[float, float, float],
    radius: float,
    height: float,
    texture: Texture,
    around: int = 32,
) -> Solid:
    """A disc, a knob or a post on ``origin``, its rim a little bevelled."""
    b = 0.15 * min(radius, height)
    profile = [(0, 0), (radius - b, 0), (radius, b), (radius, height - b), (radius - b, height), (0, height)]
    return lathe(profile, origin, axis, texture, around)


def rod(
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    radius: float,
    texture: Texture,
    around: int = 12,
) -> Solid:
    """A wire or leg whose bevelled ends lie at ``start`` and ``end``; far fewer triangles than ``capsule``."""
    way = np.asarray(end, float) - np.asarray(start)
    length = float(np.linalg.norm(way))
    return cylinder(start, _point(way / length), radius, length, texture, around)


def extrude(
    outline: np.ndarray, axis: int, low: float, high: float, texture: Texture, hole: np.ndarray | None = None
) -> Solid:
    """A plate between two coordinates of ``axis`` (0, 1, 2), with an optional hole.

    ``outline`` (n, 2), counter-clockwise in the two axes that follow ``axis`` cyclically, is seen as a whole
    from its middle; ``hole`` has as many points, each seen from its fellow of the outline. Faces: 2 · axis is
    the low end, 2 · axis + 1 the high end, 6 the rim, 7 the wall of the hole.
    """
    fellow = np.tile((outline.min(0) + outline.max(0)) / 2, (len(outline), 1)) if hole is None else hole
    outer, inner = (np.vstack([line, line[:1]]) for line in (outline, fellow))
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(outer, axis=0), axis=1))])
    # Short steps: within a cell of a ruled surface, mesh and texture agree only nearly.
    steps = np.union1d(length, np.linspace(0, length[-1], 49)[1:-1])
    outer, inner, length = _interp(steps, length, outer), _interp(steps, length, inner), steps
    width = float(np.linalg.norm(outer - inner, axis=1).max())

    def patch(a: np.ndarray, za: float, b: np.ndarray, zb: float, size: float, face: int) -> Patch:
        """The ruled surface from the closed line a at height za to b at zb."""

        def at(s: np.ndarray, t: np.ndarray) -> np.ndarray:
            w = (t / size)[:, None]
            flat = (1 - w) * _interp(s, length, a) + w * _interp(s, length, b)
            x = np.column_stack([(1 - w) * za + w * zb, flat])
            return np.roll(x, axis, axis=1)

        return Patch(at, (float(length[-1]), size), (length, np.array([0.0, size])), texture, face)

    patches = [
        patch(outer, low, outer, high, high - low, 6),
        patch(outer, high, inner, high, width, 2 * axis + 1),
        patch(inner, low, outer, low, width, 2 * axis),
    ]
    if hole is not None:
        patches.append(patch(inner, high, inner, low, high - low, 7))
    return tuple(patches)


def round_hole(low: tuple[float, float], high: tuple[float, float], radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Outline of a rectangle and of a round hole in its middle, point for point, for ``extrude``."""
    half = (np.asarray(high) - np.asarray(low)) / 2
    corner = np.arctan2(half[1], half[0])
    corners = np.array([corner, np.pi - corner, np.pi + corner, 2 * np.pi - corner])
    turn = np.unique(np.concatenate([np.linspace(0, 2 * np.pi, 64, endpoint=False), corners]))
    ray = np.stack([np.cos(turn), np.sin(turn)], 1)
    middle = half + np.asarray(low)
    return middle + ray / np.abs(ray / half).max(1, keepdims=True), middle + radius * ray


def open_box(
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    wall: float,
    outside: Texture,
    inside: Texture,
    face: int = 5,
) -> tuple[Solid, ...]:
    """Five boards round a hollow that is open at ``face`` (numbered as by ``box``; 5 is the top)."""
    lo, hi = np.asarray(low, float), np.asarray(high, float)
    boards = []
    for f in sorted(set(range(6)) - {face}, key=lambda f: f // 2 != face // 2):  # First the one across.
        axis, positive = divmod(f, 2)
        a, b = lo.copy(), hi.copy()
        if positive:
            a[axis] = hi[axis] = hi[axis] - wall
        else:
            b[axis] = lo[axis] = lo[axis] + wall
        boards.append(box(_point(a), _point(b), lambda x, g, f=f: (inside if g == f ^ 1 else outside)(x, g)))
    return tuple(boards)


def moved(solids: Sequence[Solid], T: np.ndarray) -> tuple[Solid, ...]:
    """The solids after a rigid motion 4×4, their textures with them."""
    R, p = T[:3, :3], T[:3, 3]

    def one(q: Patch) -> Patch:
        return replace(
            q,
            at=lambda s, t: q.at(s, t) @ R.T + p,
            texture=lambda x, face: q.texture((x - p) @ R, face),
        )

    return tuple(tuple(one(q) for q in solid) for solid in solids)


def glossy(solids: Sequence[Solid], gloss: float = 1.0) -> tuple[Solid, ...]:
    """The solids under a clear coat."""
    return tuple(tuple(replace(patch, gloss=gloss) for patch in solid) for solid in solids)


def _interp(t: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Piecewise linear, for values (n, k)."""
    return np.stack([np.interp(t, knots, column) for column in values.T], 1)


def _point(x: np.ndarray) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])
