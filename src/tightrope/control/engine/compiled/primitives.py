"""What the kernels are made of: numba's options, instructions that numba lacks, and exp, log and tanh.

Never ``fastmath=True``: it promises the compiler that no NaN exists and makes every isnan and isfinite
false. ``reassoc`` by itself turns x - x into 0, and np.isfinite, which numba builds on it, into True. Code
with these flags must use ``finite``, which reads the bits.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.machinery
import importlib.util
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numba.extending
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

FLAGS = {"contract", "reassoc", "arcp", "nsz", "afn"}
COMPILE_OPTIONS: dict[str, Any] = {  # of every function
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
    "_nrt": False,  # no reference counts: kernels allocate nothing
}
INNER: set[str] = set()  # functions that only compiled functions call: no machine code of their own
LATE: set[str] = set()  # functions that are optimised only as part of their callers

# numba's types do not know all options, and for an intrinsic ask for the typing context at each call
intrinsic: Any = numba.extending.intrinsic
njit: Any = numba.njit


def kernel(function: Callable[..., Any]) -> Any:
    """Compile loops over rows; the compiler may reorder their sums and products (always in the same way)."""
    INNER.add(function.__name__)
    return njit(fastmath=FLAGS, no_cpython_wrapper=True, **COMPILE_OPTIONS)(function)


def composite(function: Callable[..., Any]) -> Any:
    """Compile a function that mostly calls kernels."""
    LATE.add(function.__name__)
    return kernel(function)


def scalar(function: Callable[..., Any]) -> Any:
    """Compile a function of one number whose accuracy depends on the order of its roundings: nothing is
    reordered, and only multiply-add is fused."""
    INNER.add(function.__name__)
    LATE.add(function.__name__)
    return njit(fastmath={"contract"}, forceinline=True, no_cpython_wrapper=True, **COMPILE_OPTIONS)(function)


def _sgemm_address() -> int:
    """Address of scipy's sgemm. Only its module is loaded: all of scipy.linalg is 11 MB and a quarter of a
    second. A later import of scipy.linalg takes over this module."""
    name = "scipy.linalg.cython_blas"
    if "scipy.linalg" not in sys.modules:
        with contextlib.suppress(Exception):
            import scipy

            found: Any = importlib.machinery.PathFinder.find_spec(
                name, [str(Path(scipy.__file__).parent / "linalg")]
            )
            module = importlib.util.module_from_spec(found)
            found.loader.exec_module(module)
            capsule = ctypes.py_object(module.__pyx_capi__["sgemm"])
            get_name, get_pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
            get_name.restype = get_pointer.restype = ctypes.c_void_p
            return get_pointer(capsule, ctypes.c_void_p(get_name(capsule)))
    return numba.extending.get_cython_function_address(name, "sgemm")


llvm.add_symbol("tightrope_sgemm", _sgemm_address())
if sys.platform == "win32":
    _yield = ctypes.WinDLL("kernel32").SwitchToThread
else:
    _yield = ctypes.CDLL(None).sched_yield
llvm.add_symbol("tightrope_yield", ctypes.cast(_yield, ctypes.c_void_p).value)

# --- instructions


def _pointer(context, builder, kind, array, offset):
    return builder.gep(context.make_array(kind)(context, builder, array).data, [offset])


@intrinsic
def runtime(typing, constant):
    """A constant as a value known only at run time: numba compiles a function again for each literal
    argument."""

    def generate(context, builder, signature, arguments):
        return context.cast(builder, arguments[0], signature.args[0], signature.return_type)

    return types.unliteral(constant)(constant), generate


@intrinsic
def row(typing, array, offset, count):
    """``array[offset : offset + count]`` of a contiguous vector: no checks, wraparound or reference
    counts."""
    kind = types.Array(array.dtype, 1, "C")

    def generate(context, builder, signature, arguments):
        from numba.np import arrayobj  # needed to compile only: a start from the cache does not load it

        array, offset, count = arguments
        view = context.make_array(kind)(context, builder)
        size = context.get_constant(types.intp, 4 if signature.args[0].dtype == types.float32 else 8)
        data = _pointer(context, builder, signature.args[0], array, offset)
        arrayobj.populate_array(view, data, (count,), (size,), size, meminfo=None)
        return view._getvalue()

    return kind(array, types.intp, types.intp), generate


@intrinsic
def gemm(typing, ta, tb, m, n, k, a, b, beta, c):
    """BLAS sgemm, column-major: C [m, n] = op(A) op(B) + beta C.

    ``a``, ``b``, ``c`` are (vector, offset, leading dimension); ``ta``, ``tb``: whether A, B are transposed.
    """
    signature = types.void(
        types.boolean, types.boolean, types.intp, types.intp, types.intp, a, b, types.float32, c
    )

    def generate(context, builder, signature, arguments):
        integer, real, byte = ir.IntType(32), ir.FloatType(), ir.IntType(8)
        ta, tb, m, n, k, a, b, beta, c = arguments

        def address(value):
            slot = cgutils.alloca_once(builder, value.type)
            builder.store(value, slot)
            return slot

        def matrix(value, kind):
            vector, offset, leading = cgutils.unpack_tuple(builder, value)
            offset = context.cast(builder, offset, kind[1], types.intp)
            leading = context.cast(builder, leading, kind[2], types.intp)
            data = _pointer(context, builder, kind[0], vector, offset)
            return data, address(builder.trunc(leading, integer))

        def letter(flag):
            return address(builder.select(flag, ir.Constant(byte, ord("T")), ir.Constant(byte, ord("N"))))

        kinds = signature.args
        (pa, lda), (pb, ldb), (pc, ldc) = matrix(a, kinds[5]), matrix(b, kinds[6]), matrix(c, kinds[8])
        sizes = [address(builder.trunc(value, integer)) for value in (m, n, k)]
        one = address(ir.Constant(real, 1.0))
        actual = [letter(ta), letter(tb), *sizes, one, pa, lda, pb, ldb, address(beta), pc, ldc]
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in actual])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, "tightrope_sgemm"), actual)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def float_of_bits(typing, bits):
    """The float32 that has these 32 bits."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@intrinsic
def bits_of_float(typing, number):
    """The 32 bits of a float32."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), generate


@intrinsic
def load_shared(typing, array, index):
    """Read an int64 that another thread writes; what it wrote before is visible after (acquire)."""

    def generate(context, builder, signature, arguments):
        return builder.load_atomic(_pointer(context, builder, signature.args[0], *arguments), "acquire", 8)

    return types.int64(array, types.intp), generate


@intrinsic
def store_shared(typing, array, index, value):
    """Write an int64 that another thread reads, after everything written before it (release)."""

    def generate(context, builder, signature, arguments):
        array, index, value = arguments
        builder.store_atomic(value, _pointer(context, builder, signature.args[0], array, index), "release", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), generate


@intrinsic
def spin_pause(typing):
    """Tell the core that this loop waits (x86; does nothing elsewhere)."""

    def generate(context, builder, signature, arguments):
        if platform.machine().lower() in ("x86_64", "amd64", "i386", "i686"):
            kind = ir.FunctionType(ir.VoidType(), [])
            builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.sse2.pause"), [])
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def yield_thread(typing):
    """Let another thread run on this core."""

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.IntType(32), [])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, "tightrope_yield"), [])
        return context.get_dummy_value()

    return types.void(), generate


# --- numbers and functions of one number

f = np.float32
ZERO, ONE = f(0), f(1)


@scalar
def exp(x):
    """e^x within 2 ulp (Cephes); inf above 88.72, 0 below -87.3, NaN for NaN."""
    y = f(-87.3) if x < f(-87.3) else x
    y = f(88.72) if y > f(88.72) else y
    shifted = y * f(1.44269504088896341) + f(12582912.0)  # adding 1.5 * 2^23 rounds to an integer
    whole = shifted - f(12582912.0)
    r = y - whole * f(0.693359375)
    r = r + whole * f(2.12194440e-4)
    p = f(1.9875691500e-4) * r + f(1.3981999507e-3)
    p = p * r + f(8.3334519073e-3)
    p = p * r + f(4.1665795894e-2)
    p = p * r + f(1.6666665459e-1)
    p = p * r + f(5.0000001201e-1)
    p = p * r * r + r + ONE
    # two halves of the exponent, as 2^128 is not a float32
    bits = np.int32(bits_of_float(shifted) - np.int32(0x4B400000))
    half = np.int32(bits >> np.int32(1))
    p = p * float_of_bits(np.int32((half + np.int32(127)) << np.int32(23)))
    p = p * float_of_bits(np.int32((bits - half + np.int32(127)) << np.int32(23)))
    p = f(np.inf) if x > f(88.72) else p
    return ZERO if x < f(-87.3) else p


@scalar
def log(x):
    """Natural logarithm of a normal positive x within 2 ulp; NaN for NaN and inf (Cephes)."""
    bits = bits_of_float(x)
    whole = f(np.int32((bits >> np.int32(23)) - np.int32(126)))
    m = float_of_bits(np.int32((bits & np.int32(0x007FFFFF)) | np.int32(0x3F000000)))
    low = m < f(0.707106781186547524)
    whole = whole - ONE if low else whole
    r = (m + m if low else m) - ONE
    p = f(7.0376836292e-2) * r + f(-1.1514610310e-1)
    p = p * r + f(1.1676998740e-1)
    p = p * r + f(-1.2420140846e-1)
    p = p * r + f(1.4249322787e-1)
    p = p * r + f(-1.6668057665e-1)
    p = p * r + f(2.0000714765e-1)
    p = p * r + f(-2.4999993993e-1)
    p = p * r + f(3.3333331174e-1)
    square = r * r
    y = p * r * square + whole * f(-2.12194440e-4) - f(0.5) * square
    return r + y + whole * f(0.693359375) + (x - x)


@scalar
def tanh(x):
    """Hyperbolic tangent within 4 ulp, NaN for NaN: a rational function on [-7.9, 7.9], +-1 beyond."""
    y = f(7.90531110763549805) if x > f(7.90531110763549805) else x
    y = f(-7.90531110763549805) if y < f(-7.90531110763549805) else y
    s = y * y
    p = f(-2.76076847742355e-16) * s + f(2.00018790482477e-13)
    p = p * s + f(-8.60467152213735e-11)
    p = p * s + f(5.12229709037114e-08)
    p = p * s + f(1.48572235717979e-05)
    p = p * s + f(6.37261928875436e-04)
    p = p * s + f(4.89352455891786e-03)
    q = f(1.19825839466702e-06) * s + f(1.18534705686654e-04)
    q = q * s + f(2.26843463243900e-03)
    q = q * s + f(4.89352518554385e-03)
    return y * p / q


@scalar
def finite(x):
    """Whether a float32 is neither NaN nor infinite, read from its bits (why: see the top of this file)."""
    return (bits_of_float(x) & np.int32(0x7F800000)) != np.int32(0x7F800000)
