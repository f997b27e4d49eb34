"""Measure the cold start: ``hingesplat --help``, and compilation at the first run.

    python benchmarks/start.py [--page docs/performance.md]

Compilation is what Numba spends in a reconstruction of a small made capture with an empty cache, stage by stage of it;
a second process then has to find everything compiled. Writes benchmarks/results/start.json.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from common import machine, markdown, save, set_between

REPEATS = 9
LIMITS = {"hingesplat --help": 0.4, "first compilation": 45.0, "compilation in a second process": 0.0}
"""Seconds."""
SHORT = [
    *("--preset", "fast", "--fit.steps", "300", "--articulate.steps", "100", "--joints.steps", "40"),
    *("--fit.max-sh-degree", "0", "--quiet", "--overwrite"),
]


@dataclass(frozen=True)
class Options:
    """What to do with what was measured."""

    page: Path | None = None
    """Page whose table is set."""


def compiled_here(command: list[str]) -> dict[str, float]:
    """Seconds of CPU time that each kernel's compilation takes while a command of the program runs."""
    from numba.core import event

    import hingesplat.cli

    spent: dict[str, float] = {}
    open_: list[tuple[str, float]] = []

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            function = event.data["dispatcher"].py_func
            open_.append((f"{function.__module__}.{function.__name__}", time.process_time()))

        def on_end(self, event: Any) -> None:
            name, start = open_.pop()
            if not open_:  # Those that it calls are its own.
                spent[name] = spent.get(name, 0) + time.process_time() - start

    event.register("numba:compile", Listener())
    if hingesplat.cli.main(command):
        raise SystemExit(f"{' '.join(command)}: failed")
    return spent


def help_seconds() -> float:
    """Median, by the clock, of starting the program to read its help."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "hingesplat", "--help"], stdout=subprocess.DEVNULL, check=True)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def compilations() -> list[dict[str, float]]:
    """What a first and a second process compile."""
    with tempfile.TemporaryDirectory(prefix="hingesplat-start-") as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": f"{folder}/cache"}
        capture, out = f"{folder}/capture", f"{folder}/run"
        made = ["synth", "cabinet", "--out", capture, "--size", "96", "--views", "24", "--test-views", "2", "--quiet"]
        subprocess.run([sys.executable, "-m", "hingesplat", *made], env=environment, check=True)
        found = []
        for _ in range(2):
            command = [sys.executable, __file__, "--child", "reconstruct", capture, "--out", out, *SHORT]
            done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
            found.append(json.loads(done.stdout.splitlines()[-1]))
        return found


def table(found: dict[str, Any]) -> str:
    """For the page."""
    rows = [(what, f"{found['seconds'][what]:.2f}", f"{limit:g}") for what, limit in LIMITS.items()]
    kernels = [(name, f"{seconds:.1f}") for name, seconds in found["kernels"].items()]
    tables = [markdown(("", "seconds", "at most"), rows), "", markdown(("kernel", "seconds of CPU time"), kernels)]
    return "\n".join([*tables, "", f"Machine: {found['machine']}."])


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        sys.stdout.write("\n" + json.dumps(compiled_here(sys.argv[2:])) + "\n")
        return
    options = tyro.cli(Options, description=__doc__)
    first, second = compilations()
    seconds = dict(zip(LIMITS, (help_seconds(), sum(first.values()), sum(second.values())), strict=True))
    found = {"machine": machine(), "seconds": seconds, "kernels": {k: round(v, 2) for k, v in first.items()}}
    save("start", found)
    if options.page is not None:
        set_between(options.page, "start", table(found))
    over = [f"{what}: {seconds[what]:.2f} s" for what, limit in LIMITS.items() if seconds[what] > limit]
    if over:
        raise SystemExit("over the limit: " + "; ".join(over))


if __name__ == "__main__":
    main()
