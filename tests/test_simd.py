"""The vector operations against NumPy, and the identity that keeps stale machine code out of the cache."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

import hingesplat.simd as simd
from hingesplat.simd import (
    INNER,
    LANES,
    Build,
    psplat,
    pstore_sums,
    sload,
    vand,
    vany,
    vceil,
    vexponent,
    vfloor,
    vfma,
    vgather,
    vgt,
    viota,
    vload,
    vmantissa,
    vmax,
    vmin,
    vscatter,
    vselect,
    vsplat,
    vsqrt,
    vstore,
    vsum,
)

HASWELL = {
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma,+sse4.2,+popcnt,+bmi,+bmi2,+f16c",
}


@njit(**INNER)
def _arithmetic(a, b, out):
    x, y = vload(a, 0), vload(b, 0)
    one = np.float32(1)
    results = (
        x + y,
        x - one,
        one / y,
        x * y,
        vfma(x, y, one),
        vmin(x, y),
        vmax(x, np.float32(0)),
        vselect(vand(vgt(x, y), vgt(y, np.float32(0))), x, y),
        vsqrt(y * y),
        vfloor(x),
        vceil(x),
        vexponent(y),
        vmantissa(y),
        viota(),
        vsplat(sload(a, 3)),
    )
    for k in range(len(results)):
        vstore(out, k * LANES, results[k])
    return vsum(x), vany(vgt(x, np.float32(1e9)))


def test_operations_agree_with_numpy():
    rng = np.random.default_rng(0)
    x = rng.normal(size=LANES).astype(np.float32) * 3
    y = rng.uniform(0.01, 9, LANES).astype(np.float32)
    out = np.empty(15 * LANES, np.float32)
    total, large = _arithmetic(x, y, out)
    expected = [
        x + y,
        x - 1,
        1 / y,
        x * y,
        x * y + 1,
        np.minimum(x, y),
        np.maximum(x, 0),
        np.where(x > y, x, y),
    ]
    expected += [y, np.floor(x), np.ceil(x), np.floor(np.log2(y)), 2 * np.frexp(y)[0], np.arange(LANES)]
    expected += [np.full(LANES, x[3])]
    np.testing.assert_allclose(out.reshape(15, LANES), expected, rtol=1e-6, atol=1e-6)
    assert total == pytest.approx(x.sum(), rel=1e-5)
    assert not large


def test_comparisons_reject_what_is_not_a_number():
    @njit(**INNER)
    def any_greater(a):
        return vany(vgt(vload(a, 0), np.float32(0))), vany(vgt(np.float32(0), vload(a, 0)))

    assert any_greater(np.full(LANES, np.nan, np.float32)) == (False, False)


def test_gather_scatter_and_plane_sums():
    @njit(**INNER)
    def run(build, a, out, ints, sums):
        vscatter(out, 0, 3, vgather(a, 1, 2))
        vscatter(ints, 0, 1, vgather(a, 1, 2))
        pstore_sums(psplat(build, a, 0), sums, 0)

    a = np.arange(2 * LANES + 1, dtype=np.float32) + 0.5
    out, ints, sums = (
        np.zeros(3 * LANES, np.float32),
        np.zeros(LANES, np.int32),
        np.full(LANES, 7, np.float32),
    )
    run(Build([]).with_planes(5), a, out, ints, sums)
    np.testing.assert_array_equal(out[::3], a[1::2])
    np.testing.assert_array_equal(ints, a[1::2].astype(int))
    np.testing.assert_array_equal(sums[:5], LANES * a[:5])
    np.testing.assert_array_equal(sums[5:8], 0)


def test_builds_differ_by_source_and_planes(tmp_path):
    source = tmp_path / "kernel.py"
    source.write_text("one")
    first = Build([source], 3)
    assert first.type == Build([source], 3).type
    assert first.type != first.with_planes(4).type
    source.write_text("two")
    assert first.type != Build([source], 3).type


def _environment(extra):
    source = str(Path(simd.__file__).parents[1])
    return {**os.environ, "PYTHONPATH": source, "OMP_NUM_THREADS": "1", **extra}


_CACHE_PROGRAM = """
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(message)s")
import torch
before = torch.get_num_threads()
from hingesplat.losses.photometric import Target, photometric
from hingesplat.simd import LANES
image = torch.linspace(0, 1, 400).reshape(1, 20, 20)
assert torch.get_num_threads() == before
print(LANES, photometric(image, Target.of(image.flip(1))).item())
"""


@pytest.mark.skipif(LANES != 16, reason="needs a machine with AVX-512, to have two widths")
def test_one_cache_serves_two_vector_widths_and_only_the_first_run_compiles(tmp_path):
    def run(extra):
        env = _environment({"NUMBA_CACHE_DIR": str(tmp_path), **extra})
        done = subprocess.run(
            [sys.executable, "-c", _CACHE_PROGRAM],
            check=True,
            capture_output=True,
            text=True,
            timeout=300,
            env=env,
        )
        lanes, loss = done.stdout.split()
        return int(lanes), float(loss), done.stderr.count("compiling")

    wide, narrow, again = run({}), run(HASWELL), run({})
    assert (wide[0], narrow[0], again[0]) == (16, 8, 16)
    assert (wide[2], narrow[2], again[2]) == (1, 1, 0)
    assert wide[1] == pytest.approx(narrow[1], rel=1e-5)
    assert wide[1] == pytest.approx(again[1], rel=1e-6)
