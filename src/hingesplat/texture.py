"""Whether texture goes where a motion takes it: what tells look-alikes apart.

Of two drawers of a kind, one is open in each state. That the open one went to where the other's is, is a good
explanation: points meet, colours agree, and nothing hides. But each has a grain of its own. Small squares of what a
motion carries are laid on the photographs of both states, the motion is corrected a little until they fit, and their
textures are compared (``patches``).
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from hingesplat.capture import View
from hingesplat.capture.images import downsampled
from hingesplat.gaussians import Gaussians
from hingesplat.labelling import Choices
from hingesplat.patches import CONTRAST, FEWEST, NEAR, Patches, Photograph, adjust, in_common, looks, without_light
from hingesplat.render import render
from hingesplat.screw import axes_across
from hingesplat.se3 import from_Rt, moved, rotvec_to_matrix
from hingesplat.search import BASE, Motion
from hingesplat.surface import Labels, Pair, Surface
from hingesplat.training import evenly, training_view

WIDTH, ROUNDS = 9, 4
"""Of a patch, in pixels; of the correction."""
OFF = np.array([0.03, 0.03, 0.03, 0.008, 0.008, 0.008])
"""How far motions are off that a search has found, radians and extents: standard deviations."""
AGREED = 0.6
"""Correlation that speaks neither for a motion nor against it."""
ENOUGH, GOES_ALONG = 5, 0.85
"""Patches, and the median of their correlations, that make a motion theirs."""
COST = 1.5
"""What a point that is short of it by 1 adds to a motion's description length."""
LEAST, MOST = 0.5, 3.0
"""Shares of a motion's price to which texture may lower it, and raise it; what is not asked about yet has the first."""
OTHERWISE = 0.3
"""Share of the patches that were compared under a motion; fewer may go along with any other."""
DOUBT = 0.5
"""Share of the price that texture must say against a motion for others to be looked for."""


@dataclass(frozen=True)
class TextureConfig:
    """Comparing the texture of what a motion carries."""

    patches: int = 100
    """Of what a motion carries from each state to the other, at most; 0 leaves look-alikes to points and colours."""
    corrected: int = 300
    """Of what a motion carries from each state to the other, at most, when the motion found is corrected by them."""
    views: int = 40
    """Photographs of each state that are compared, at most."""
    size: int = 500
    """Longest side of what they show of the object, pixels, at most."""


def told_apart(
    choices: Choices,
    verdict: Callable[[int, Pair], float],
    price: ArrayLike,
    parts: int | None,
    plain: ArrayLike | None = None,
) -> dict[int, float]:
    """The motions that explain both states at the least description length, texture counting, and their prices.

    It is asked about those chosen. If it speaks against one of them, prices are by what it says, and it is asked about
    all that might be chosen instead; else it has no say. If none is worth its price, one is had for half of it:
    something moved.

    Args:
        verdict: what texture says, in points, against the motion of this number, which owns these points (n,) bool of
            each state.
        price: of each motion, in points, or of every one.
        parts: choose no more than this many.
        plain: price of each if nothing were odd about it, where they differ.
    """
    usual = np.broadcast_to(np.asarray(price, float), choices.number)
    even = np.broadcast_to(usual.min(initial=np.inf) if plain is None else np.asarray(plain, float), choices.number)
    if not choices.best(usual, parts):
        usual, even, parts = LEAST * usual, LEAST * even, 1
    said: dict[int, float] = {}
    prices = usual
    while True:
        kept = sorted(choices.best(prices, parts))
        new = [k for k in kept if k not in said]
        if not new:
            return {k: float(prices[k]) for k in kept}
        first, second = choices.labels(kept)
        for k in new:
            mine = kept.index(k) + 1
            said[k] = verdict(k, (first == mine, second == mine))
        # What is odd for a joint is in doubt by that much already.
        if all(usual[k] + against <= (1 + DOUBT) * even[k] for k, against in said.items()):
            return {k: float(usual[k]) for k in kept}
        # What has not been asked about may be as good as any.
        prices = LEAST * usual
        for k, against in said.items():
            prices[k] = np.clip(usual[k] + against, LEAST * usual[k], MOST * usual[k])


def vouched_for(
    choices: Choices,
    prices: dict[int, float],
    heeded: Callable[[int, float, Collection[int], Pair], bool],
    likeness: Callable[[int | None, Pair], np.ndarray],
    price: float,
    parts: int | None,
) -> dict[int, float]:
    """Motions and their prices, with others that explain this price and that texture vouches for, where it is heeded.

    Texture goes along with the motion of its own alone. Not everywhere is that proof of a part: handles of a kind go
    along with look-alikes, too.

    Args:
        prices: the motions that there are for certain.
        heeded: whether texture's word counts for a motion that gains so many points besides these, and owns such, (n,)
            bool of each state.
        likeness: correlations (m,) of patches of such points, moved so; None is to stay.
        price: of what texture vouches for, in points.
        parts: choose no more than this many.
    """
    kept = frozenset(prices)
    if parts is not None and len(kept) >= parts:
        return prices
    for k, gain in choices.gains(kept).items():
        if gain <= price + 1:  # Less would not be chosen for that.
            break
        more = sorted(kept | {k})
        first, second = choices.labels(more)
        mine = first == more.index(k) + 1, second == more.index(k) + 1
        if not heeded(k, gain, kept, mine) or not _goes_along(own := likeness(k, mine)):
            continue
        if all((likeness(j, mine) > AGREED).sum() < OTHERWISE * len(own) for j in (None, *kept)):
            return vouched_for(choices, {**prices, k: price}, heeded, likeness, price, parts)
    return prices


def unless_still(
    T_1_0: Sequence[np.ndarray], owned: Labels, more: Labels, likeness: Callable[[np.ndarray, Pair], np.ndarray]
) -> Labels:
    """Labels after points of the base went to parts, but for those of a part whose texture is, mostly, where it was.

    A speckled case looks much the same all along its slide, and the knife's thumb piece took half of it along.

    Args:
        T_1_0: (4, 4) motion of each part from state 0 to state 1.
        owned: label of each point before, 0 for the base.
        more: after.
        likeness: correlations (m,) of the texture of such points, (n,) bool of each state, moved so (4, 4).
    """
    labels = (more[0].copy(), more[1].copy())
    for k, T in enumerate(T_1_0, 1):
        gained = (owned[0] == 0) & (more[0] == k), (owned[1] == 0) & (more[1] == k)
        here = likeness(BASE, gained)
        still = int((here > GOES_ALONG).sum())
        if still >= max(ENOUGH, len(here) / 2) and still > (likeness(T, gained) > GOES_ALONG).sum():
            for label, mine in zip(labels, gained, strict=True):
                label[mine] = 0
    return labels


def _goes_along(likeness: np.ndarray) -> bool:
    """Whether correlations (m,) say that this is the motion."""
    return len(likeness) >= ENOUGH and float(np.median(likeness)) > GOES_ALONG


@torch.no_grad()
def photographs_of(gaussians: Gaussians, views: Sequence[View], config: TextureConfig) -> list[Photograph]:
    """Some photographs of a state, and what the Gaussians fitted to it draw there, as one part 0."""
    result = []
    for i in evenly(len(views), config.views):
        whole = training_view(views[i])
        cut = replace(views[i], camera=whole.camera, rgba=whole.rgba, depth=None)
        small = training_view(downsampled(cut, config.size))
        result.append(Photograph.of(small.camera, small.image, render(gaussians, small.camera)))
    return result


def carried(
    points: np.ndarray,
    normals: np.ndarray,
    T_1_0: np.ndarray,
    photographs: tuple[Sequence[Photograph], Sequence[Photograph]],
    extent: float,
) -> np.ndarray:
    """(m,) correlation between the textures that both states show of a surface, for each patch that has any in both.

    Args:
        points, normals: (n, 3) of the surface in state 0, where the patches are; unit, either side of it.
        T_1_0: (4, 4) where it goes in state 1, up to ``OFF``.
        photographs: of state 0 and of state 1, of part 0.
        extent: of the object, scene units.
    """
    if len(points) == 0:
        return np.zeros(0)
    centre = moved(points, T_1_0).mean(0)

    def place(theta: np.ndarray) -> np.ndarray:
        turn, shift = torch.from_numpy(theta).split(3)
        about = from_Rt(rotvec_to_matrix(turn), shift * extent).numpy()
        about[:3, 3] += centre - about[:3, :3] @ centre
        return np.stack([np.eye(4), about @ T_1_0])

    return _adjusted(points, normals, place, OFF, photographs, extent)[1]


def fitted(motion: Motion, surface: Surface, photographs: Sequence[Sequence[Photograph]], extent: float) -> Motion:
    """The motion, corrected so that the texture of this part of a surface goes along, if then it does.

    The surface is that of the state where the motion begins, whose photographs come first.
    """
    across, turns = axes_across(motion.axis), motion.kind == "revolute"

    def joint(theta: np.ndarray) -> Motion:
        axis = motion.axis + theta[:2] @ across
        pivot = motion.pivot + extent * theta[2:4] @ across
        value = motion.value + theta[4] * (1 if turns else extent)
        return replace(motion, axis=axis / np.linalg.norm(axis), pivot=pivot, value=value, by_texture=True)

    def place(theta: np.ndarray) -> np.ndarray:
        return np.stack([np.eye(4), joint(theta).T])

    spread = np.array([0.05, 0.05, 0.02, 0.02, 0.05 if turns else 0.02])
    theta, likeness = _adjusted(surface.points, surface.normals, place, spread, photographs, extent)
    return joint(theta) if _goes_along(likeness) else motion


def _adjusted(
    points: np.ndarray,
    normals: np.ndarray,
    place: Callable[[np.ndarray], np.ndarray],
    spread: np.ndarray,
    photographs: Sequence[Sequence[Photograph]],
    extent: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (p,) of the ``place`` (2, 4, 4) in which texture agrees best, about 0 by ``spread`` (p,); and how well.

    That is the correlation (m,) of each patch that has texture in both states.
    """
    if len(points) == 0 or not all(photographs):
        return 0 * spread, np.zeros(0)
    normals = normals * _outward(points, normals, photographs[0], NEAR * extent)[:, None]
    pixel = np.median([np.linalg.norm(p.camera.centre - points.mean(0)) / p.camera.fx for p in photographs[0]])
    patches = Patches.at(0, points, normals, float(pixel), WIDTH)
    theta, _ = adjust(patches, photographs, place, 0 * spread, np.diag(spread**-2.0), extent, ROUNDS)
    still = np.zeros((len(points), 3))
    patch, moves, texture, _ = looks(patches, still, photographs, place(theta), np.zeros((2, 0, 4, 4)), NEAR * extent)
    if len(patch) == 0:
        return theta, np.zeros(0)
    # A patch's photographs lie together, and of these, those of a state.
    first = np.flatnonzero(np.diff(2 * patch + moves, prepend=-1))
    count = np.diff(first, append=len(patch))
    texture, contrast = without_light(texture, np.linalg.qr(patches.slant)[0])
    common, trust = in_common(texture, first, np.repeat(np.arange(len(first)), count))
    # Where photographs of one state do not agree among themselves, it is gloss, or noise.
    sure = (np.add.reduceat(trust, first) >= np.maximum(FEWEST, 0.5 * count)) & (
        np.add.reduceat(contrast, first) > CONTRAST * count
    )
    there = np.flatnonzero((patch[first][:-1] == patch[first][1:]) & sure[:-1] & sure[1:])
    a, b = common[there], common[there + 1]
    return theta, (a * b).mean(1) / (a.std(1) * b.std(1))


def compared(
    surfaces: tuple[Surface, Surface],
    photographs: Sequence[Sequence[Photograph]],
    T_1_0: np.ndarray,
    owned: Pair,
    extent: float,
    config: TextureConfig,
    seed: int,
) -> list[tuple[np.ndarray, float]]:
    """For each state, what ``carried`` says of some of the points owned, (n,) bool, and how many each stands for."""
    found, rng = [], np.random.default_rng(seed)
    for s, T in enumerate((T_1_0, np.linalg.inv(T_1_0))):
        rows = rng.permutation(np.flatnonzero(owned[s]))
        some = surfaces[s].rows(rows[: config.patches])
        likeness = carried(some.points, some.normals, T, (photographs[s], photographs[1 - s]), extent)
        found.append((likeness, len(rows) / max(len(some.points), 1)))
    return found


def against(found: Sequence[tuple[np.ndarray, float]]) -> float:
    """What texture ``compared`` says against a motion, in points; below 0: for it."""
    return sum(COST * float((AGREED - likeness).sum()) * points for likeness, points in found)


def likeness(found: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """(m,) the correlations of all patches that were ``compared``."""
    return np.concatenate([correlations for correlations, _ in found])


def _outward(points: np.ndarray, normals: np.ndarray, photographs: Sequence[Photograph], near: float) -> np.ndarray:
    """(n,) the sign with which normals (n, 3) face the cameras that see the points (n, 3)."""
    facing = np.zeros(len(points))
    for photo in photographs:
        at, depth = photo.camera.project(points)
        drawn, part = photo.there(at)
        towards = photo.camera.centre - points
        cosine = (normals * towards).sum(1) / np.linalg.norm(towards, axis=1)
        facing += np.where((part == 0) & (np.abs(drawn - depth) < near), cosine, 0)
    return np.where(facing < 0, -1.0, 1.0)


__all__ = [
    "ENOUGH",
    "GOES_ALONG",
    "LEAST",
    "TextureConfig",
    "against",
    "carried",
    "compared",
    "fitted",
    "likeness",
    "photographs_of",
    "told_apart",
    "unless_still",
    "vouched_for",
]
