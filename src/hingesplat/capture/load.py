"""From a folder to a checked ``Capture``."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from hingesplat.camera import Camera
from hingesplat.capture import artgs, colmap, paris, transforms
from hingesplat.capture.check import check_states
from hingesplat.capture.frames import Frame, StateFrames
from hingesplat.capture.images import find_mask, load_view
from hingesplat.capture.types import Capture, State, View
from hingesplat.errors import HingesplatError

READERS = {"artgs": artgs, "paris": paris, "transforms": transforms, "colmap": colmap}
"""In the order in which they are tried: the more particular first."""
MIN_STATES, MIN_VIEWS = 2, 3


def load_capture(
    path: Path, *, max_size: int | None = None, masks: Path | None = None, with_depth: bool = False
) -> Capture:
    """Load photographs of an object in two or more states; the layout is recognised.

    Images longer than ``max_size`` pixels are downsampled, intrinsics following. ``masks`` is a folder of
    masks (``masks/STATE/IMAGE.png``) that wins over alpha and over masks found beside the images. Depth is
    read only ``with_depth``. Raises HingesplatError, one line, for anything missing, broken or inconsistent.
    """
    if not path.is_dir():
        raise HingesplatError(f"{path}: {'is not a folder' if path.exists() else 'does not exist'}")
    if masks is not None and not masks.is_dir():
        raise HingesplatError(f"{masks}: the mask folder does not exist")
    if max_size is not None and max_size < 1:
        raise HingesplatError(f"max_size must be at least 1 pixel, not {max_size}")
    layout = recognise(path)
    found = READERS[layout].read(path)
    _check_counts(path, found)
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:

        def load(state: StateFrames, frames: Sequence[Frame]) -> tuple[View, ...]:
            def one(frame: Frame) -> View:
                mask = find_mask(frame, path, state.name, state.folder, masks)
                if masks is not None and mask is None:
                    raise HingesplatError(f"{frame.name}: has no mask in {masks / state.name}")
                forced = masks is not None or frame.mask is not None
                return load_view(frame, mask if masks else frame.mask or mask, forced, max_size, with_depth)

            return tuple(pool.map(one, frames))

        states = tuple(State(s.name, load(s, s.train), load(s, s.test)) for s in found)
    for state in states:
        if not any((view.rgba[..., 3] >= 128).any() for view in state.train):
            raise HingesplatError(f"{path / state.name}: the masks of all {len(state.train)} views are empty")
    check_states(states, layout)
    return Capture(path, layout, states)


def load_cameras(path: Path) -> tuple[Camera, ...]:
    """The cameras of all training photographs, without decoding these. Raises HingesplatError as ``load_capture``."""
    return tuple(frame.camera for state in READERS[recognise(path)].read(path) for frame in state.train)


def recognise(path: Path) -> str:
    """The name of the layout; raises HingesplatError listing what was looked for."""
    for layout, reader in READERS.items():
        if reader.recognises(path):
            return layout
    if (path / "transforms.json").is_file() or (path / "transforms_train.json").is_file():
        raise HingesplatError(
            f"{path}: holds a single state; put each state in a folder of its own (start/, end/) and give their parent"
        )
    looked_for = "; ".join(reader.LOOKED_FOR for reader in READERS.values())
    raise HingesplatError(f"{path}: no capture found here; looked for {looked_for}")


def _check_counts(path: Path, found: Sequence[StateFrames]) -> None:
    if len(found) < MIN_STATES:
        names = ", ".join(s.name for s in found) or "none"
        raise HingesplatError(f"{path}: needs photographs of at least {MIN_STATES} states, found {names}")
    for state in found:
        if len(state.train) < MIN_VIEWS:
            raise HingesplatError(
                f"{path}: {state.name} has {len(state.train)} training views; needs at least {MIN_VIEWS}"
            )
