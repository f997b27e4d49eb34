"""Where a part is, by its texture: small patches of its surface matched over all photographs of all states.

Gaussians are fuzz about a pixel thick, and a joint follows where the fuzz leans. A patch is a plane with one texture:
its own depth and tilt and the part's joint are adjusted together until all photographs show the same texture there, up
to light: a patch's level, slopes and contrast are left out. That is bundle adjustment (Triggs et al., 2000) with
normalised intensities for residuals; the patches' own numbers are eliminated (Schur complement).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from scipy import ndimage
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.render import Rendering
from hingesplat.screw import axes_across
from hingesplat.simd import INLINE, KERNEL
from hingesplat.surface import thin
from hingesplat.threads import parallel

LEAST_FACING = 0.4
"""Cosine between a patch's normal and the way to a camera that may judge it."""
AGREES, DISAGREES = 0.8, 0.6
"""Correlation with its patch's texture from which a photograph counts fully, and below which it does not."""
FEWEST = 3
"""Photographs of a state that must show a patch."""
CONTRAST, NOISE = 0.005, 0.003
"""Least standard deviation of a patch's intensities; least variance of normalised ones about their texture."""
DEEP, TILTED = 1.2, 0.3
"""How far patches lie off the drawn surface, in pixels, and how much they tilt, as a slope: standard deviations."""
NEAR = 0.015
"""Extents from the drawn surface within which a patch is on it."""
COUNT_AS_ONE = 20.0
"""As many patches count as one in standard deviations."""
STEP = 1e-3
"""For derivatives of poses, radians and extents."""


@dataclass(frozen=True)
class PatchConfig:
    """Matching patches of the parts' surfaces."""

    per_part: int = 1000
    """Patches of each part, at most; 0 leaves joints as the Gaussians have them."""
    width: int = 9
    """Of a patch, in pixels."""
    views: int = 50
    """Photographs of each state that are matched, about."""
    rounds: int = 5
    """Of Gauss-Newton."""
    alike: float = 3.0
    """Patches side by side err alike, as a highlight lies on all of them: so many count as one beside what is known."""


@dataclass(frozen=True)
class Photograph:
    """A photograph, and what the model says is to be seen in it."""

    camera: Camera
    spline: np.ndarray
    """(h, w) float32: coefficients of the cubic spline through its grey values."""
    slope: np.ndarray
    """(2, h, w) float32: how grey values change along x and y, a pixel."""
    depth: np.ndarray
    """(h, w) of the model; 0 where nothing is."""
    part: np.ndarray
    """(h, w) part id that covers each pixel; −1 where none does."""

    @classmethod
    def of(cls, camera: Camera, image: Tensor, drawn: Rendering) -> "Photograph":
        """From a picture (rgb and more, h, w), and what the model draws there, channels being shares of movers."""
        grey = image[:3].mean(0).cpu().numpy()
        alpha, depth, shares = (x.cpu().numpy() for x in (drawn.alpha, drawn.depth, drawn.channels))
        shares = np.concatenate([(alpha - shares.sum(0))[None], shares])
        part = np.where((shares > 0.5).any(0), shares.argmax(0), -1)
        depth = np.where(alpha > 0.5, depth / np.maximum(alpha, 0.5), 0)
        down, right = np.gradient(grey)
        spline = ndimage.spline_filter(grey, order=3).astype(np.float32)
        return cls(camera, spline, np.stack([right, down]), depth, part.astype(np.int16))

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Of its camera, as kernels take them."""
        return self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy

    def there(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth and part at pixel positions (…, 2); part −1 outside."""
        (height, width), index = self.depth.shape, np.floor(at).astype(int)
        inside = ((index >= 2) & (index < [width - 2, height - 2])).all(-1)
        x, y = np.moveaxis(np.clip(index, 0, [width - 1, height - 1]), -1, 0)
        return self.depth[y, x], np.where(inside, self.part[y, x], -1)


@dataclass(frozen=True)
class Patches:
    """Planes on a part's surface, in the frame of state 0."""

    part: int
    points: np.ndarray
    """(n, 3)."""
    normals: np.ndarray
    """(n, 3) outward."""
    pixel: float
    """Its size on the part, scene units."""
    grid: np.ndarray
    """(n, cells, 3) from each centre to its cells, in the plane."""
    slant: np.ndarray
    """(cells, 3) how a cell moves along the normal with its patch's offset and two tilts."""

    @classmethod
    def at(cls, part: int, points: np.ndarray, normals: np.ndarray, pixel: float, width: int) -> "Patches":
        """Squares of ``width`` cells of ``pixel`` scene units about points (n, 3) with outward normals (n, 3)."""
        reach = width // 2
        a, b = (cell.ravel() for cell in np.meshgrid(*[np.arange(-reach, reach + 1) * pixel] * 2))
        u, v = np.moveaxis(np.stack([axes_across(n) for n in normals]), 1, 0)
        grid = a[:, None] * u[:, None] + b[:, None] * v[:, None]
        points, normals = (np.ascontiguousarray(x, dtype=float) for x in (points, normals))
        return cls(part, points, normals, pixel, grid, np.stack([np.ones_like(a), a, b], 1))


def patches_of(
    part: int, photographs: Sequence[Photograph], config: PatchConfig, rng: np.random.Generator
) -> Patches | None:
    """Patches all over what photographs of state 0 show of a part; None where they show none of it.

    Normals are those of the drawn depth.
    """
    reach = config.width // 2
    points, normals, pixels = [np.zeros((0, 3))], [np.zeros((0, 3))], []
    for photo in photographs:
        y, x = np.nonzero(ndimage.binary_erosion(photo.part == part, iterations=reach + 1))
        some = rng.permutation(len(x))[: 2 * config.per_part]
        x, y = x[some], y[some]

        def at(dx: int, dy: int, photo: Photograph = photo, x: np.ndarray = x, y: np.ndarray = y) -> np.ndarray:
            return photo.camera.lifted(x + dx, y + dy, photo.depth[y + dy, x + dx])

        across = np.cross(at(reach, 0) - at(-reach, 0), at(0, reach) - at(0, -reach))
        normal = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        towards = photo.camera.centre - at(0, 0)
        normal *= np.sign((normal * towards).sum(1, keepdims=True))
        faces = (normal * towards).sum(1) > LEAST_FACING * np.linalg.norm(towards, axis=1)
        points.append(at(0, 0)[faces])
        normals.append(normal[faces])
        pixels.append(photo.depth[y, x][faces] / photo.camera.fx)
    everything = np.concatenate(points)
    if len(everything) == 0:
        return None
    pixel = float(np.median(np.concatenate(pixels)))
    rows = thin(everything, reach * pixel, rng)[: config.per_part]
    return Patches.at(part, everything[rows], np.concatenate(normals)[rows], pixel, config.width)


def shown(patches: Patches, T: np.ndarray, photograph: Photograph, tolerance: float) -> np.ndarray:
    """(n,) bool: patches, moved by T, that face a photograph and lie on what the model draws there, up to corners."""
    answer = np.empty(len(patches.points), bool)
    parallel(
        _shown,
        torch.get_num_threads(),
        *(patches.points, patches.normals, patches.grid),
        *(photograph.camera.T_camera_world[:3] @ T, photograph.intrinsics),
        *(photograph.depth, photograph.part, patches.part, tolerance, answer),
    )
    return answer


@njit(**KERNEL)
def _shown(
    points, normals, grid, T_camera_part, intrinsics, depth, part, wanted, tolerance, answer, thread, threads
):  # pragma: no cover - compiled
    T, (fx, fy, cx, cy), (height, width), count = T_camera_part, intrinsics, depth.shape, grid.shape[1]
    side = int(np.sqrt(np.float64(count)) + 0.5)
    for i in range(thread, points.shape[0], threads):
        x, y, z = _through(T, points[i, 0], points[i, 1], points[i, 2])
        nx, ny, nz = _turned(T, normals[i])
        answer[i] = -(nx * x + ny * y + nz * z) > LEAST_FACING * np.sqrt(x * x + y * y + z * z)
        for cell in (0, side - 1, count // 2, count - side, count - 1):
            if answer[i]:
                at = points[i, 0] + grid[i, cell, 0], points[i, 1] + grid[i, cell, 1], points[i, 2] + grid[i, cell, 2]
                x, y, z = _through(T, *at)
                u, v = int(np.floor(fx * x / z + cx)), int(np.floor(fy * y / z + cy))
                inside = z > 0 and u >= 2 and v >= 2 and u < width - 2 and v < height - 2
                answer[i] = inside and part[v, u] == wanted and abs(depth[v, u] - z) < tolerance


@njit(**INLINE)
def _through(T, x, y, z):  # pragma: no cover - compiled
    """A point under the transform (3, 4)."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(**INLINE)
def _turned(T, normal):  # pragma: no cover - compiled
    """A direction (3,) under the transform (3, 4)."""
    return (
        T[0, 0] * normal[0] + T[0, 1] * normal[1] + T[0, 2] * normal[2],
        T[1, 0] * normal[0] + T[1, 1] * normal[1] + T[1, 2] * normal[2],
        T[2, 0] * normal[0] + T[2, 1] * normal[1] + T[2, 2] * normal[2],
    )


def adjust(
    patches: Patches,
    photographs: Sequence[Sequence[Photograph]],
    place: Callable[[np.ndarray], np.ndarray],
    expected: np.ndarray,
    precision: np.ndarray,
    extent: float,
    rounds: int,
    alike: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of a part's joint that make its patches look alike in all photographs, by Gauss-Newton.

    Args:
        photographs: of every state.
        place: numbers (p,) to T_state_0 (states, 4, 4) of the part.
        expected: (p,) what is known of the numbers without patches, and where to start.
        precision: (p, p) how well that is known: an inverse covariance.
        extent: of the object.
        rounds: of Gauss-Newton.
        alike: so many patches count as one beside what is known.

    Returns:
        The numbers, and their covariance (p, p) by how far patches disagree.
    """
    theta, size = expected.copy(), len(expected)
    local = np.zeros((len(patches.points), 3))
    prior = 1 / np.array([DEEP * patches.pixel, TILTED, TILTED]) ** 2
    shade = np.linalg.qr(patches.slant)[0].astype(np.float32)
    covariance = np.linalg.inv(precision)
    for _ in range(rounds):
        at = place(theta)
        shift = STEP * np.eye(size)
        slopes = np.stack([(place(theta + d) - place(theta - d)) / (2 * STEP) for d in shift], 1)
        # What is seen is asked again every time: chosen once, at a pose that is off, it would hold the part there.
        patch, moves, texture, jacobian = looks(patches, local, photographs, at, slopes, NEAR * extent)
        if len(patch) == 0:
            break
        first = np.flatnonzero(np.diff(patch, prepend=-1))
        which, group = patch[first], np.repeat(np.arange(len(first)), np.diff(first, append=len(patch)))
        r, J, weight = _residuals(texture, jacobian, shade, first, group, moves)
        weighted = (J * weight[:, None, None]).transpose(0, 2, 1)
        H = np.add.reduceat(weighted @ J, first).astype(float)
        g = np.add.reduceat((weighted @ r[..., None])[..., 0], first).astype(float)
        used = H[:, 0, 0] > 0
        H[:, range(3), range(3)] += prior
        g[:, :3] += prior * local[which]
        back = np.linalg.solve(H[:, :3, :3], np.concatenate([g[:, :3, None], H[:, :3, 3:]], 2))
        pull = g[:, 3:] - (H[:, 3:, :3] @ back[..., :1])[..., 0]
        stiff = H[:, 3:, 3:] - H[:, 3:, :3] @ back[..., 1:]
        change, covariance = _agreed(pull[used], stiff[used], theta - expected, precision, alike)
        step = -(back[..., 0] + back[..., 1:] @ change)
        step[:, 0] = step[:, 0].clip(-3 * patches.pixel, 3 * patches.pixel)
        local[which[used]] += step[used]
        theta = theta + change
    return theta, covariance


def looks(
    patches: Patches,
    local: np.ndarray,
    photographs: Sequence[Sequence[Photograph]],
    at: np.ndarray,
    slopes: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of a patch and a photograph that shows it, those of a patch together, in the order of the states.

    Args:
        local: (n, 3) offset and tilts of the patches.
        at: (states, 4, 4) where their part is in each state.
        slopes: (states, p, 4, 4) how that changes with the numbers of the joint.
        tolerance: how far off what the model draws a patch may be, scene units.

    Returns:
        The patch (pairs,) of each, whether it is of a state but the first (pairs,), its grey values (pairs, cells), and
        their derivatives (pairs, cells, 3 + p) by local numbers and by those of the joint.
    """
    pairs = [
        (state, photo, rows)
        for state, T in enumerate(at)
        for photo in photographs[state]
        if len(rows := np.flatnonzero(shown(patches, T, photo, tolerance)))
    ]
    patch = np.concatenate([np.zeros(0, int), *(rows for _, _, rows in pairs)])
    order = np.argsort(patch, kind="stable")
    ends = np.cumsum([len(rows) for _, _, rows in pairs])
    texture = np.zeros((len(order), len(patches.slant)), np.float32)
    jacobian = np.zeros((*texture.shape, local.shape[1] + slopes.shape[1]), np.float32)
    moves = np.zeros(len(order), bool)
    for (state, photo, rows), slot in zip(pairs, np.split(np.argsort(order), ends[:-1]), strict=False):
        parallel(
            _seen,
            torch.get_num_threads(),
            *(patches.points, patches.normals, patches.grid, patches.slant, local, rows, slot),
            *(photo.camera.T_camera_world[:3] @ at[state], photo.camera.T_camera_world[:3, :3] @ slopes[state, :, :3]),
            *(photo.intrinsics, photo.spline, photo.slope, texture, jacobian),
        )
        moves[slot] = state > 0
    return patch[order], moves, texture, jacobian


@njit(**KERNEL)
def _seen(
    points, normals, grid, slant, local, rows, slot, T_camera_part, slopes, intrinsics, spline, slope, texture,
    jacobian, thread, threads,
):  # fmt: skip  # pragma: no cover - compiled
    """Grey values of the patches ``rows`` in a photograph, and how they change with local and joint numbers.

    Both go to the rows ``slot`` of ``texture`` and ``jacobian``; ``slopes`` (p, 3, 4) is how T_camera_part does.
    """
    T, (fx, fy, cx, cy), (height, width) = T_camera_part, intrinsics, spline.shape
    across, down = np.empty(4, np.float32), np.empty(4, np.float32)
    for k in range(thread, rows.shape[0], threads):
        i, row = rows[k], slot[k]
        normal = normals[i]
        nx, ny, nz = _turned(T, normal)
        for c in range(grid.shape[1]):
            off = local[i, 0] * slant[c, 0] + local[i, 1] * slant[c, 1] + local[i, 2] * slant[c, 2]
            px, py, pz = (
                points[i, 0] + grid[i, c, 0] + off * normal[0],
                points[i, 1] + grid[i, c, 1] + off * normal[1],
                points[i, 2] + grid[i, c, 2] + off * normal[2],
            )
            x, y, z = _through(T, px, py, pz)
            # Pixel (0, 0) has its centre at 0.5, the coefficients theirs at 0; at an edge the last one goes on.
            u = min(max(fx * x / z + cx - 0.5, 1.0), width - 2.001)
            v = min(max(fy * y / z + cy - 0.5, 1.0), height - 2.001)
            left, top = int(u), int(v)
            s, t = np.float32(u - left), np.float32(v - top)
            _cubic(s, across)
            _cubic(t, down)
            value = np.float32(0)
            for b in range(4):
                for a in range(4):
                    value += down[b] * across[a] * spline[top + b - 1, left + a - 1]
            texture[row, c] = value
            gx, gy = _between(slope[0], left, top, s, t) * fx / z, _between(slope[1], left, top, s, t) * fy / z
            gz = -(gx * x + gy * y) / z
            by_normal = gx * nx + gy * ny + gz * nz
            for a in range(3):
                jacobian[row, c, a] = by_normal * slant[c, a]
            for j in range(slopes.shape[0]):
                dx, dy, dz = _through(slopes[j], px, py, pz)
                jacobian[row, c, 3 + j] = gx * dx + gy * dy + gz * dz


@njit(**INLINE)
def _cubic(t, weights):  # pragma: no cover - compiled
    """Weights of the cubic B-spline's four coefficients around a place, ``t`` behind the second."""
    sixth, s = np.float32(1 / 6), np.float32(1) - t
    weights[0] = s * s * s * sixth
    weights[1] = np.float32(2 / 3) - t * t * (np.float32(2) - t) * np.float32(0.5)
    weights[2] = np.float32(2 / 3) - s * s * (np.float32(2) - s) * np.float32(0.5)
    weights[3] = t * t * t * sixth


@njit(**INLINE)
def _between(image, left, top, s, t):  # pragma: no cover - compiled
    """The image, bilinear, ``s`` and ``t`` behind a pixel."""
    upper = image[top, left] + s * (image[top, left + 1] - image[top, left])
    lower = image[top + 1, left] + s * (image[top + 1, left + 1] - image[top + 1, left])
    return upper + t * (lower - upper)


def _residuals(
    texture: np.ndarray,
    jacobian: np.ndarray,
    shade: np.ndarray,
    first: np.ndarray,
    group: np.ndarray,
    moves: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normalised grey values (pairs, cells) less the texture of their patch, their derivatives, and weights (pairs,).

    Pairs are sorted by patch; ``first`` is where each begins, ``group`` the patch of each, ``moves`` whether it is one
    of a state but the first. ``shade`` (cells, 3) spans what light does to a patch: level and slopes are no texture.
    """
    texture, contrast = without_light(texture, shade)
    jacobian = (jacobian - shade @ (shade.T @ jacobian)) / contrast[:, None, None]
    common, trust = in_common(texture, first, group)
    residual = texture - common[group]
    noise = mean_of((residual**2).mean(1), trust, first)[group]
    both = np.minimum(np.add.reduceat(trust * moves, first), np.add.reduceat(trust * ~moves, first)) >= FEWEST
    good = (both & (mean_of(contrast, np.ones_like(contrast), first) > CONTRAST))[group]
    return residual, jacobian - mean_of(jacobian, trust, first)[group], trust * good / np.maximum(noise, NOISE)


def without_light(texture: np.ndarray, shade: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey values (n, cells) less what ``shade`` (cells, 3) spans, of unit variance; their contrast (n,) before."""
    texture = texture - texture @ shade @ shade.T
    contrast = texture.std(1) + 1e-4
    return texture / contrast[:, None], contrast


def in_common(texture: np.ndarray, first: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What normalised textures (n, cells) of a group have in common (groups, cells); how far each is that, (n,).

    Groups lie together: ``first`` is where each begins, ``group`` that of each texture.
    """
    trust = np.ones(len(texture), np.float32)
    for _ in range(3):
        common = mean_of(texture, trust, first)
        likeness = (texture * common[group]).mean(1) / np.maximum(common.std(1), 1e-6)[group]
        trust = np.clip((likeness - DISAGREES) / (AGREES - DISAGREES), 1e-6, 1).astype(np.float32)
    return mean_of(texture, trust, first), trust


def mean_of(x: np.ndarray, weight: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Weighted means (groups, …) of x (n, …), whose groups lie together and begin at ``first``."""
    weight = weight.reshape(-1, *[1] * (x.ndim - 1))
    return np.add.reduceat(x * weight, first) / np.add.reduceat(weight, first)


def _agreed(
    pull: np.ndarray, stiff: np.ndarray, off: np.ndarray, precision: np.ndarray, alike: float
) -> tuple[np.ndarray, np.ndarray]:
    """The step (p,) on which patches agree with each other and with what was known, and the covariance after it.

    Patches that pull far harder than most count less (a Cauchy-like weight on their Mahalanobis distance), and all
    count less the more they disagree (a sandwich's mean inflation).

    Args:
        pull: (n, p) gradients of the patches.
        stiff: (n, p, p) their curvatures.
        off: (p,) from what was expected, which was known with ``precision`` (p, p).
        alike: patches that count as one.
    """
    weight, inverse = np.ones(len(pull)), np.linalg.pinv(stiff, rcond=1e-9, hermitian=True)
    for _ in range(5):
        H, g = np.tensordot(weight, stiff, 1), weight @ pull
        step = -np.linalg.solve(H + precision, g + precision @ off)
        left = pull + stiff @ step
        # Rounding leaves curvatures a little negative where a patch feels nothing.
        distance = np.maximum(np.einsum("nk,nkl,nl->n", left, inverse, left), 0)
        weight = 1 / np.sqrt(1 + distance / (3 * np.median(distance) + 1e-12)) if len(pull) else weight
    H, g = np.tensordot(weight, stiff, 1), weight @ pull
    value, vector = np.linalg.eigh(H)
    felt = value > 1e-9 * max(value.max(), 1e-300)
    rank = int(felt.sum())
    best = (vector[:, felt] / value[felt]) @ vector[:, felt].T
    left = weight[:, None] * (pull - stiff @ (best @ g))
    spread = np.trace(best @ (left.T @ left)) / max(rank, 1)
    inflation = max(1.0, spread * len(pull) / max(len(pull) - rank, 1))
    step = -np.linalg.solve(H / (inflation * alike) + precision, g / (inflation * alike) + precision @ off)
    return step, np.linalg.inv(H / (inflation * COUNT_AS_ONE) + precision)
