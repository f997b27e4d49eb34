"""What the benchmarks share: where results go, the machine they are of, tables set into pages."""

import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hingesplat  # it says how torch's threads wait, so it precedes torch

# isort: split
import numba
import torch

from hingesplat.simd import LANES

RESULTS = Path(__file__).resolve().parent / "results"
PAGE = Path(__file__).resolve().parents[1] / "docs" / "performance.md"


def save(name: str, data: Any) -> Path:
    """Write ``benchmarks/results/NAME.json``, whole or not at all."""
    RESULTS.mkdir(exist_ok=True)
    draft = RESULTS / f"{name}.json.tmp"
    draft.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n")
    return draft.replace(RESULTS / f"{name}.json")


def recorded(name: str) -> Any:
    """What ``save`` wrote, or None."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text()) if path.is_file() else None


def machine() -> str:
    """Processor and versions, in one line."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.is_file() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    what = f"{os.cpu_count()} × {model}, {LANES} lanes"
    versions = f"Python {platform.python_version()}, torch {torch.__version__}, numba {numba.__version__}"
    return f"{what}; {versions}, hingesplat {hingesplat.__version__}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table: the first column to the left, numbers to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def set_between(page: Path, mark: str, text: str) -> None:
    """Replace what stands between ``<!-- mark -->`` and ``<!-- /mark -->``."""
    start, end, old = f"<!-- {mark} -->", f"<!-- /{mark} -->", page.read_text()
    if start not in old or end not in old:
        raise SystemExit(f"{page}: lacks the marks {start} and {end}")
    draft = page.with_name(page.name + ".tmp")
    draft.write_text(f"{old.split(start)[0]}{start}\n{text}\n{end}{old.split(end)[1]}")
    draft.replace(page)
