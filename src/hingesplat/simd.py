"""Explicit SIMD for Numba: a vector of float32 lanes, and the operations that the kernels are written with.

Nothing is left to the auto-vectoriser: every operation emits LLVM vector code, which LLVM lowers to AVX-512,
AVX2, SSE or NEON. ``LANES`` is 16 where the compiler's target has AVX-512, else 8.

The module also holds what every compiled kernel needs besides arithmetic: ``Build`` (a cache identity) and one line in
the log when a first call has to compile.
"""

import hashlib
import logging
import operator
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import llvmlite.ir as ir
import numba.extending
import numpy as np
from numba import njit
from numba.core import cgutils, event, types
from numba.core.registry import cpu_target
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import (
    NativeValue,
    lower_builtin,
    models,
    register_model,
    typeof_impl,
    unbox,
)
from numba.np.arrayobj import make_array

import hingesplat

logger = logging.getLogger("hingesplat")

intrinsic: Any = numba.extending.intrinsic  # it drops the first parameter, which a type checker cannot know


# ---- compiling, caching --------------------------------------------------------------------------------

# Without "nnan" and "ninf": comparisons must still reject what is not finite.
FAST_MATH = ("nsz", "arcp", "contract", "reassoc", "afn")

KERNEL: dict[str, Any] = dict(cache=True, nogil=True, error_model="numpy", fastmath=set(FAST_MATH))
"""Options of a kernel that Python calls: cached on disk, GIL released."""
INNER: dict[str, Any] = dict(_nrt=False, nogil=True, error_model="numpy", fastmath=set(FAST_MATH))
"""Options of a function that only kernels call. It must not allocate: without ``_nrt=False`` every call
would count references to its arrays with atomic operations, at more cost than most of them have."""
INLINE: dict[str, Any] = dict(INNER, forceinline=True)
"""Options of a small function that must melt into its caller."""


def _target_lanes() -> int:
    _, _, features = cpu_target.target_context.codegen().magic_tuple()  # pyright: ignore[reportAttributeAccessIssue]
    return 16 if "+avx512f" in features.split(",") else 8


LANES = _target_lanes()


class Build:
    """The identity of a compiled kernel, passed as its first argument and part of its type.

    Numba's disk cache sees neither changed globals nor edits of imported modules. The type of this token
    does: it names the package version, the number of lanes and a digest of the source files given, so code of
    another build is never loaded. ``planes`` is a compile-time number of image planes, for the kernels that
    are specialised on it.
    """

    def __init__(self, sources: Iterable[Path], planes: int = 0):
        digest = hashlib.sha256()
        for path in sorted([Path(__file__), *sources]):
            digest.update(path.read_bytes())
        identity = f"{hingesplat.__version__}, {LANES} lanes, source {digest.hexdigest()[:16]}"
        self.type = BuildType(identity, planes)

    def with_planes(self, planes: int) -> "Build":
        """The same build, specialised on another number of planes."""
        other = object.__new__(Build)
        other.type = BuildType(self.type.identity, planes)
        return other


class BuildType(types.Type):
    def __init__(self, identity: str, planes: int):
        self.identity, self.planes = identity, planes
        super().__init__(name=f"Build({identity}, {planes} planes)")


register_model(BuildType)(models.OpaqueModel)


@typeof_impl.register(Build)
def _typeof_build(value, context):
    return value.type


@unbox(BuildType)
def _unbox_build(typ, value, c):
    return NativeValue(c.context.get_dummy_value())


class _CompileNotice(event.Listener):
    """Says once that a kernel of this package is being compiled."""

    said = False

    def on_start(self, event):
        if not self.said and event.data["dispatcher"].py_func.__module__.startswith("hingesplat."):
            self.said = True
            logger.info("compiling for this processor (once, about 40 s in all) ...")

    def on_end(self, event):
        pass


event.register("numba:compile", _CompileNotice())


# ---- the vector type -----------------------------------------------------------------------------------

_F32, _I32, _I64, _BIT = ir.FloatType(), ir.IntType(32), ir.IntType(64), ir.IntType(1)
_VECTOR, _INTS = ir.VectorType(_F32, LANES), ir.VectorType(_I32, LANES)
_MANTISSA_BITS, _EXPONENT_BIAS = 23, 127  # of a float32


class VectorType(types.Type):
    def __init__(self):
        super().__init__(name=f"float32x{LANES}")


class MaskType(types.Type):
    def __init__(self):
        super().__init__(name=f"boolx{LANES}")


vector, mask = VectorType(), MaskType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, typ):
        super().__init__(manager, typ, _VECTOR)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, typ):
        super().__init__(manager, typ, ir.VectorType(_BIT, LANES))


def _constant(values):
    return ir.Constant(_VECTOR, [float(v) for v in values])


def _int_constant(value):
    return ir.Constant(_INTS, [value] * LANES)


def _broadcast(builder, scalar):
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, _I32(0))
    return builder.shuffle_vector(first, undefined, _int_constant(0))


def _as_vector(context, builder, value, typ):
    return value if typ == vector else _broadcast(builder, context.cast(builder, value, typ, types.float32))


def _as_vectors(context, builder, args, sig):
    return [_as_vector(context, builder, v, t) for v, t in zip(args, sig.args, strict=True)]


def _emit_fma(builder, x, y, z):
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{LANES}f32")
    return builder.call(function, [x, y, z], fastmath=FAST_MATH)


def _index(context, builder, sig, args, k):
    return context.cast(builder, args[k], sig.args[k], types.intp)


def _pointer(context, builder, sig, args, k):
    """Address of element args[k + 1] of the flat array args[k]; no bounds check, no wraparound."""
    data = make_array(sig.args[k])(context, builder, args[k]).data
    return builder.gep(data, [_index(context, builder, sig, args, k + 1)])


def _emit_load(builder, pointer):
    return builder.load(builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)


def _emit_store(builder, value, pointer):
    builder.store(value, builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)


# ---- scalars -------------------------------------------------------------------------------------------


@intrinsic
def sload(typingctx, array, i):
    """array[i], unchecked."""

    def code(context, builder, sig, args):
        return builder.load(_pointer(context, builder, sig, args, 0))

    return array.dtype(array, i), code


@intrinsic
def sstore(typingctx, array, i, value):
    """array[i] = value, unchecked."""

    def code(context, builder, sig, args):
        converted = context.cast(builder, args[2], sig.args[2], sig.args[0].dtype)
        builder.store(converted, _pointer(context, builder, sig, args, 0))
        return context.get_dummy_value()

    return types.void(array, i, value), code


@intrinsic
def take_ticket(typingctx, counter):
    """Post-increment of counter[0] (int64), atomic: hands out work among threads."""

    def code(context, builder, sig, args):
        data = make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, _I64(1), "monotonic")

    return types.int64(counter), code


@intrinsic
def seen(typingctx, counter):
    """counter[0] (int64) as other threads have left it, and with it all that they wrote before."""

    def code(context, builder, sig, args):
        data = make_array(sig.args[0])(context, builder, args[0]).data
        return builder.load_atomic(data, "acquire", 8)

    return types.int64(counter), code


@intrinsic
def float_bits(typingctx, x):
    """The bits of a float32; as an integer they are ordered like the number where it is positive."""

    def code(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], _I32), _I64)

    return types.int64(types.float32), code


# ---- vectors -------------------------------------------------------------------------------------------


def _arithmetic(operation, instruction):
    """Let the Python operator work on (vector, vector), (vector, scalar) and (scalar, vector)."""
    kinds = ((vector, vector), (vector, types.float32), (types.float32, vector))

    @infer_global(operation)  # pyright: ignore[reportOptionalCall]
    class _Typing(ConcreteTemplate):
        cases = [signature(vector, *kind) for kind in kinds]  # noqa: RUF012

    def code(context, builder, sig, args):
        x, y = _as_vectors(context, builder, args, sig)
        return getattr(builder, instruction)(x, y, flags=FAST_MATH)

    for kind in kinds:
        lower_builtin(operation, *kind)(code)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")


@intrinsic
def vsplat(typingctx, x):
    """All lanes x."""

    def code(context, builder, sig, args):
        return _as_vector(context, builder, args[0], sig.args[0])

    return vector(x), code


@intrinsic
def viota(typingctx):
    """0, 1, 2, …"""

    def code(context, builder, sig, args):
        return _constant(range(LANES))

    return vector(), code


@intrinsic
def vload(typingctx, array, i):
    """array[i : i + LANES]."""

    def code(context, builder, sig, args):
        return _emit_load(builder, _pointer(context, builder, sig, args, 0))

    return vector(array, i), code


@intrinsic
def vstore(typingctx, array, i, value):
    """array[i : i + LANES] = value."""

    def code(context, builder, sig, args):
        _emit_store(builder, args[2], _pointer(context, builder, sig, args, 0))
        return context.get_dummy_value()

    return types.void(array, i, vector), code


@intrinsic
def vgather(typingctx, array, base, stride):
    """Lane l is array[base + l·stride]."""

    def code(context, builder, sig, args):
        pointer, stride = _pointer(context, builder, sig, args, 0), _index(context, builder, sig, args, 2)
        result = ir.Constant(_VECTOR, ir.Undefined)
        for lane in range(LANES):
            result = builder.insert_element(result, builder.load(pointer), _I32(lane))
            pointer = builder.gep(pointer, [stride])
        return result

    return vector(array, base, stride), code


@intrinsic
def vscatter(typingctx, array, base, stride, value):
    """array[base + l·stride] = lane l, truncated where the array holds integers."""

    def code(context, builder, sig, args):
        pointer, stride = _pointer(context, builder, sig, args, 0), _index(context, builder, sig, args, 2)
        lanes, element = args[3], sig.args[0].dtype
        if isinstance(element, types.Integer):
            lanes = builder.fptosi(lanes, ir.VectorType(context.get_value_type(element), LANES))
        for lane in range(LANES):
            builder.store(builder.extract_element(lanes, _I32(lane)), pointer)
            pointer = builder.gep(pointer, [stride])
        return context.get_dummy_value()

    return types.void(array, base, stride, vector), code


@intrinsic
def vfma(typingctx, x, y, z):
    """x·y + z, rounded once where the machine can."""

    def code(context, builder, sig, args):
        return _emit_fma(builder, *_as_vectors(context, builder, args, sig))

    return vector(x, y, z), code


@intrinsic
def vmin(typingctx, x, y):
    """The smaller, lane by lane; y where x is not a number."""

    def code(context, builder, sig, args):
        x, y = _as_vectors(context, builder, args, sig)
        return builder.select(builder.fcmp_ordered("<", x, y), x, y)

    return vector(x, y), code


@intrinsic
def vmax(typingctx, x, y):
    """The larger, lane by lane; y where x is not a number."""

    def code(context, builder, sig, args):
        x, y = _as_vectors(context, builder, args, sig)
        return builder.select(builder.fcmp_ordered(">", x, y), x, y)

    return vector(x, y), code


@intrinsic
def vgt(typingctx, x, y):
    """Mask of x > y; false where either is not a number."""

    def code(context, builder, sig, args):
        x, y = _as_vectors(context, builder, args, sig)
        return builder.fcmp_ordered(">", x, y)

    return mask(x, y), code


@intrinsic
def vand(typingctx, m, n):
    """Both masks."""

    def code(context, builder, sig, args):
        return builder.and_(*args)

    return mask(mask, mask), code


@intrinsic
def vselect(typingctx, m, x, y):
    """x where the mask holds, else y."""

    def code(context, builder, sig, args):
        x, y = (_as_vector(context, builder, v, t) for v, t in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], x, y)

    return vector(mask, x, y), code


@intrinsic
def vany(typingctx, m):
    """Whether any lane of the mask holds."""

    def code(context, builder, sig, args):
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), bits(0))

    return types.boolean(mask), code


@intrinsic
def vsum(typingctx, x):
    """Sum of the lanes, float32."""

    def code(context, builder, sig, args):
        kind = ir.FunctionType(_F32, [_F32, _VECTOR])
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [_F32(0.0), args[0]], fastmath=FAST_MATH)

    return types.float32(vector), code


def _unary(name):
    @intrinsic
    def function(typingctx, x):
        def code(context, builder, sig, args):
            kind = ir.FunctionType(_VECTOR, [_VECTOR])
            callee = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
            return builder.call(callee, args, fastmath=FAST_MATH)

        return vector(vector), code

    return function


vsqrt, vfloor, vceil = _unary("sqrt"), _unary("floor"), _unary("ceil")


@intrinsic
def vexponent(typingctx, x):
    """floor(log2(x)) of positive normal numbers."""

    def code(context, builder, sig, args):
        bits = builder.lshr(builder.bitcast(args[0], _INTS), _int_constant(_MANTISSA_BITS))
        return builder.sitofp(builder.sub(bits, _int_constant(_EXPONENT_BIAS)), _VECTOR)

    return vector(vector), code


@intrinsic
def vmantissa(typingctx, x):
    """x / 2^floor(log2(x)), in [1, 2), of positive normal numbers."""

    def code(context, builder, sig, args):
        fraction = builder.and_(builder.bitcast(args[0], _INTS), _int_constant((1 << _MANTISSA_BITS) - 1))
        one = _int_constant(_EXPONENT_BIAS << _MANTISSA_BITS)
        return builder.bitcast(builder.or_(fraction, one), _VECTOR)

    return vector(vector), code


# 2^u ≈ E0 + E1·u + … on [-1, 0], minimax fit, error below 1e-7.
_E0, _E1, _E2, _E3, _E4, _E5 = (
    np.float32(e)
    for e in (
        0.9999999250634352,
        0.6931422525893657,
        0.24017218921989097,
        0.05527972250486135,
        0.009188611646813588,
        0.000938788304101934,
    )
)


@njit(**INLINE)
def vexp2(e):
    """2^e for -8 ≤ e ≤ 0, as (2^(e/8))^8; no vector maths library is needed."""
    u = e * np.float32(0.125)
    p = vfma(vfma(vfma(vfma(vfma(u, _E5, _E4), u, _E3), u, _E2), u, _E1), u, _E0)
    p = p * p
    p = p * p
    return p * p


# ---- several planes at once: tuples of ``build.planes`` vectors, kept in registers ---------------------


def _planes(context, builder, sig, args, k):
    """Addresses of the vectors at args[k + 1] + j·args[k + 2] of the flat array args[k], j = 0, 1, …"""
    pointer, stride = _pointer(context, builder, sig, args, k), _index(context, builder, sig, args, k + 2)
    while True:
        yield pointer
        pointer = builder.gep(pointer, [stride])


@intrinsic
def planes_of(typingctx, build):
    """The compile-time number ``planes``."""

    def code(context, builder, sig, args):
        return _I64(build.planes)

    return types.int64(build), code


@intrinsic
def pzeros(typingctx, build):
    """``planes`` zero vectors."""
    result = types.UniTuple(vector, build.planes)

    def code(context, builder, sig, args):
        return context.make_tuple(builder, result, [_constant([0] * LANES)] * build.planes)

    return result(build), code


@intrinsic
def psplat(typingctx, build, array, i):
    """``planes`` vectors, the j-th filled with array[i + j]."""
    result = types.UniTuple(vector, build.planes)

    def code(context, builder, sig, args):
        pointer = _pointer(context, builder, sig, args, 1)
        scalars = [builder.load(builder.gep(pointer, [_I64(j)])) for j in range(build.planes)]
        return context.make_tuple(builder, result, [_broadcast(builder, s) for s in scalars])

    return result(build, array, i), code


@intrinsic
def pdot(typingctx, start, values, array, i, stride):
    """start + Σ_j values[j]·array[i + j·stride : … + LANES]."""

    def code(context, builder, sig, args):
        total = args[0]
        factors = cgutils.unpack_tuple(builder, args[1], len(values))
        for factor, pointer in zip(factors, _planes(context, builder, sig, args, 2), strict=False):
            total = _emit_fma(builder, factor, _emit_load(builder, pointer), total)
        return total

    return vector(vector, values, array, i, stride), code


@intrinsic
def paccumulate(typingctx, sums, weight, array, i, stride):
    """sums[j] + weight·array[i + j·stride : … + LANES], for every j."""

    def code(context, builder, sig, args):
        olds = cgutils.unpack_tuple(builder, args[0], len(sums))
        pointers = _planes(context, builder, sig, args, 2)
        news = [
            _emit_fma(builder, args[1], _emit_load(builder, pointer), old)
            for old, pointer in zip(olds, pointers, strict=False)
        ]
        return context.make_tuple(builder, sums, news)

    return sums(sums, vector, array, i, stride), code


@intrinsic
def pblend(typingctx, values, weight, array, i, stride):
    """array[i + j·stride : … + LANES] += weight·values[j], for every j."""

    def code(context, builder, sig, args):
        factors = cgutils.unpack_tuple(builder, args[0], len(values))
        planes = list(zip(factors, _planes(context, builder, sig, args, 2), strict=False))
        # All loads before the first store: LLVM cannot know that the planes are apart.
        sums = [_emit_fma(builder, args[1], factor, _emit_load(builder, p)) for factor, p in planes]
        for value, (_, pointer) in zip(sums, planes, strict=True):
            _emit_store(builder, value, pointer)
        return context.get_dummy_value()

    return types.void(values, vector, array, i, stride), code


@intrinsic
def pconcat(typingctx, first, second):
    """The tuple first + second."""
    result = types.UniTuple(vector, len(first) + len(second))

    def code(context, builder, sig, args):
        heads = cgutils.unpack_tuple(builder, args[0], len(first))
        return context.make_tuple(builder, result, heads + cgutils.unpack_tuple(builder, args[1], len(second)))

    return result(first, second), code


def _sum_of_eight(builder, vectors):
    """Eight vectors of eight lanes to one vector of their eight sums: a tree of shuffles and additions."""

    def merged(x, y, left, right):
        picks = (ir.Constant(ir.VectorType(_I32, 8), side) for side in (left, right))
        return builder.fadd(*(builder.shuffle_vector(x, y, pick) for pick in picks), flags=FAST_MATH)

    level = (
        ([0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15]),
        ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]),
        ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]),
    )
    for left, right in level:
        vectors = [merged(x, y, left, right) for x, y in zip(vectors[::2], vectors[1::2], strict=True)]
    return vectors[0]


def _halves_added(builder, x):
    halves = (ir.Constant(ir.VectorType(_I32, 8), list(range(start, start + 8))) for start in (0, 8))
    return builder.fadd(*(builder.shuffle_vector(x, x, half) for half in halves), flags=FAST_MATH)


@intrinsic
def pstore_sums(typingctx, values, array, i):
    """array[i + j] = sum of the lanes of values[j]; zeros up to the next multiple of LANES."""

    def code(context, builder, sig, args):
        vectors = cgutils.unpack_tuple(builder, args[0], len(values))
        if LANES == 16:
            vectors = [_halves_added(builder, x) for x in vectors]
        eight = ir.VectorType(_F32, 8)
        vectors += [ir.Constant(eight, [0.0] * 8)] * (-len(values) % LANES)
        pointer = _pointer(context, builder, sig, args, 1)
        for j in range(0, len(vectors), 8):
            target = builder.bitcast(builder.gep(pointer, [_I64(j)]), eight.as_pointer())
            builder.store(_sum_of_eight(builder, vectors[j : j + 8]), target, align=4)
        return context.get_dummy_value()

    return types.void(values, array, i), code
