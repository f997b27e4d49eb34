"""The layout of ArtGS: ``transforms_{train,test}.json`` at the root, for both states or one file each."""

from dataclasses import replace
from pathlib import Path

from hingesplat.capture.frames import Frame, StateFrames, natural_key, number, state_folders
from hingesplat.capture.transforms import frame_dicts, read_frame
from hingesplat.files import read_json

LOOKED_FOR = "transforms_train.json or transforms_train_start.json at the root (ArtGS)"
MIN_DEPTH = 0.1
"""Depths below this are invalid in their captures, metres."""


def recognises(root: Path) -> bool:
    """Whether a transforms file lies at the root, beside the state folders."""
    return bool(_per_state(root, "train")) or ((root / "transforms_train.json").is_file() and bool(state_folders(root)))


def read(root: Path) -> list[StateFrames]:
    """The frames grouped by state; ``transforms_{split}_{state}.json`` are preferred to the joint file."""
    train, test = _split(root, "train"), _split(root, "test")
    names = sorted(train.keys() | test.keys(), key=natural_key)
    return [StateFrames(n, root / n, train.get(n, []), test.get(n, [])) for n in names]


def _per_state(root: Path, split: str) -> dict[str, Path]:
    """State name to its own transforms file."""
    files = {f.name: root / f"transforms_{split}_{f.name}.json" for f in state_folders(root)}
    return {name: path for name, path in files.items() if path.is_file()}


def _split(root: Path, split: str) -> dict[str, list[Frame]]:
    files = _per_state(root, split)
    if files:
        return {name: [frame for _, frame in _frames(path, root)] for name, path in files.items()}
    path = root / f"transforms_{split}.json"
    states: dict[str, list[Frame]] = {}
    for name, frame in _frames(path, root) if path.is_file() else []:
        states.setdefault(name, []).append(frame)
    return states


def _frames(path: Path, root: Path) -> list[tuple[str, Frame]]:
    """(state, frame) of one file; the image's first folder names the state, else ``time`` does."""
    data = read_json(path)
    folders = {f.name for f in state_folders(root)}
    found = []
    for i, entry in enumerate(frame_dicts(data, path)):
        frame = read_frame(entry, i, data, path, root)
        name = frame.image.relative_to(root).parts[0] if frame.image.is_relative_to(root) else ""
        if name not in folders:
            name = "start" if number(entry.get("time", 0.0), f"{path}: frame {i}: time") == 0 else "end"
        if frame.depth is None and frame.image.parent.name == "rgba":
            depth = frame.image.parent.with_name("depth") / frame.image.name
            frame = replace(frame, depth=depth if depth.is_file() else None)
        found.append((name, replace(frame, min_depth=MIN_DEPTH)))
    return found
