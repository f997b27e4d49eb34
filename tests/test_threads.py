"""Kernels on several threads."""

import os
import subprocess
import sys
import threading
import time
import weakref

import numpy as np
import pytest
from numba import njit

from hingesplat.simd import sload, sstore, take_ticket
from hingesplat.threads import parallel


def test_parallel_hands_out_every_ticket_once_even_from_several_threads():
    @njit(nogil=True)
    def work(tickets, marks, t, threads):
        while True:
            k = take_ticket(tickets)
            if k >= marks.shape[0]:
                break
            sstore(marks, k, sload(marks, k) + 1)

    def caller(marks):
        parallel(work, 3, np.zeros(1, np.int64), marks)

    arrays = [np.zeros(5000, np.int64) for _ in range(4)]
    callers = [threading.Thread(target=caller, args=(marks,)) for marks in arrays]
    for thread in callers:
        thread.start()
    for thread in callers:
        thread.join()
    for marks in arrays:
        np.testing.assert_array_equal(marks, 1)


def test_parallel_passes_errors_on():
    def fail(t, threads):
        if t == 1:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        parallel(fail, 2)


def test_parallel_waits_for_the_others_where_one_fails():
    ended = []

    def fail(t, threads):
        if t == 1:
            raise ZeroDivisionError
        time.sleep(0.05 * t)
        ended.append(t)

    with pytest.raises(ZeroDivisionError):
        parallel(fail, 3)
    assert sorted(ended) == [0, 2]
    parallel(lambda t, threads: ended.append(t), 3)
    assert sorted(ended) == [0, 0, 1, 2, 2]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_parallel_works_after_a_fork():
    parallel(lambda t, threads: None, 2)
    program = "import os, sys; from hingesplat.threads import parallel\n"
    program += "f = lambda t, threads: None\nparallel(f, 2)\npid = os.fork()\nparallel(f, 2)\n"
    program += "sys.exit(os.waitpid(pid, 0)[1] if pid else 0)"
    subprocess.run([sys.executable, "-W", "ignore", "-c", program], check=True, timeout=60)


def test_parallel_wakes_threads_that_have_gone_to_sleep():
    marks = np.zeros(3, np.int64)

    def mark(t, threads):
        marks[t] += 1

    for pause in (0, 0.01, 0, 0.01):
        parallel(mark, 3)
        time.sleep(pause)
    np.testing.assert_array_equal(marks, 4)


def test_nested_calls_do_not_wait_for_each_other():
    marks = np.zeros((2, 2), np.int64)

    def inner(row, t, threads):
        marks[row, t] += 1

    parallel(lambda t, threads: parallel(inner, 2, t), 2)
    np.testing.assert_array_equal(marks, 1)


def test_a_call_keeps_nothing_of_what_it_was_given():
    class Big:
        pass

    big = Big()
    gone = weakref.ref(big)
    parallel(lambda given, t, threads: None, 2, big)
    del big
    assert gone() is None
