"""Threads for kernels that release the GIL: awake for a moment after each call, since the next is often near."""

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np
from numba import njit

from hingesplat.simd import seen

_LOOKS = 100_000
"""Looks, about a nanosecond each, for which a thread stays awake: to be woken takes it longer than most kernels need
between one call and the next, and longer spinning would keep others from the core."""
_HEAD_START = 3_000
"""Looks that a helper lets pass when it is called: meanwhile the caller enters its kernel and lets go of the GIL."""


@njit(cache=True, nogil=True)
def _awaits(counter, value, looks, more):  # pragma: no cover - compiled
    """Whether the counter gets to the value within so many looks; ``more`` pass after that."""
    for _ in range(looks):
        if seen(counter) >= value:
            for _ in range(more):
                seen(counter)
            return True
    return False


class _Helper:
    """A thread that runs one call after the other. Both counters are only ever raised."""

    def __init__(self) -> None:
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._answers: SimpleQueue[BaseException | None] = SimpleQueue()
        self._called, self._done = np.zeros(1, np.int64), np.zeros(1, np.int64)
        threading.Thread(target=self._serve, name="hingesplat", daemon=True).start()

    def call(self, function: Callable[[], None]) -> None:
        self._calls.put(function)
        self._called[0] += 1

    def finish(self) -> BaseException | None:
        """Wait for the call; what it raised."""
        _awaits(self._done, self._called[0], _LOOKS, 0)
        return self._answers.get()

    def _serve(self) -> None:
        while True:
            _awaits(self._called, self._done[0] + 1, _LOOKS, _HEAD_START)
            function, answer = self._calls.get(), None
            try:
                function()
            except BaseException as error:
                answer = error
            del function  # what it was called with is not kept while there is nothing to do
            self._answers.put(answer)
            del answer
            self._done[0] += 1


_idle: list[_Helper] = []
"""Helpers nobody has called; the last was busy last, so it may be awake."""

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)  # a forked child has the helpers but not their threads


def parallel(kernel: Callable[..., Any], threads: int, *args: Any) -> None:
    """Run ``kernel(*args, t, threads)`` for t = 0 … threads - 1 at once; the kernel must release the GIL.

    Plain Python threads instead of a Numba threading layer: they do not spin for long, may be entered from several
    threads, survive a fork, and leave torch's thread count alone. Returns when all have ended; raises what one raised.
    """
    helpers: list[_Helper] = []
    try:
        for t in range(1, threads):
            try:
                helper = _idle.pop()
            except IndexError:
                helper = _Helper()
            helper.call(lambda t=t: kernel(*args, t, threads))
            helpers.append(helper)
        kernel(*args, 0, threads)
    finally:
        errors = [helper.finish() for helper in helpers]
        _idle.extend(helpers)
    for error in errors:
        if error is not None:
            raise error
