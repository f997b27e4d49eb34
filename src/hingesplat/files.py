"""Files and folders that are written whole or not at all."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hingesplat.errors import HingesplatError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path to write to that takes the place of ``path`` when all went well, and is gone when not."""
    tmp = path.with_name(path.name + ".tmp")
    try:
        yield tmp
        tmp.replace(path)
    finally:
        tmp.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> Path:
    """Write a UTF-8 file, whole or not at all; returns its path."""
    with whole_file(path) as tmp:
        tmp.write_text(text, encoding="utf-8")
    return path


def read_json(path: Path, remedy: str = "", absent: dict[str, Any] | None = None) -> dict[str, Any]:
    """A JSON object; ``absent``, if that is given, where there is no such file.

    Raises:
        HingesplatError: missing or broken, with the line where it breaks, and what to do about it (``remedy``).
    """
    if absent is not None and not path.is_file():
        return absent
    remedy = f"; {remedy}" if remedy else ""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise HingesplatError(f"{path}: cannot be read ({e.strerror or e}){remedy}") from e
    except UnicodeDecodeError as e:
        raise HingesplatError(f"{path}: not valid JSON (not UTF-8 text){remedy}") from e
    except json.JSONDecodeError as e:
        raise HingesplatError(f"{path}: not valid JSON (line {e.lineno}, column {e.colno}: {e.msg}){remedy}") from e
    if not isinstance(data, dict):
        raise HingesplatError(f"{path}: must hold a JSON object, not a {type(data).__name__}{remedy}")
    return data


def write_json(path: Path, data: Any) -> Path:
    """Write a JSON file, whole or not at all; returns its path."""
    return write_text(path, json.dumps(data, indent=1))


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A folder to write into that takes the place of ``path`` when all went well, and is gone when not."""
    path = path.resolve()
    tmp = path.with_name(path.name + ".tmp")
    shutil.rmtree(tmp, ignore_errors=True)
    tmp.mkdir(parents=True)
    try:
        yield tmp
        shutil.rmtree(path, ignore_errors=True)
        tmp.replace(path)
    finally:
        shutil.rmtree(tmp, ignore_errors=True)
