"""How the engine's functions are compiled: flags, and the few instructions numba has no words for.

Never ``fastmath=True``: it promises the compiler that no NaN exists and makes every isnan and isfinite
false. ``reassoc`` alone already turns x - x into 0, and np.isfinite, which numba builds on it, into True:
in code with these flags ``dense.finite``, which reads the bits, is the only way to ask.
"""

# mypy: ignore-errors
# (numba's options and modules are not all in its types)
from __future__ import annotations

import contextlib
import ctypes
import importlib.machinery
import importlib.util
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils, codegen
from numba.extending import get_cython_function_address, intrinsic

from tightrope.control.engine.compiled.cache import (
    SWITCH,
    cache_folder,
    compilation_due,
    load,
    mark_complete,
    store,
)

__all__ = ["SWITCH", "cache_folder", "compilation_due", "mark_complete"]  # and what is defined here

FLAGS = {"contract", "reassoc", "arcp", "nsz", "afn"}

OPTIONS = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
    "_nrt": False,
}  # nothing is allocated

_INNER: set[str] = set()  # names of functions that compiled functions alone call
_LATE: set[str] = set()  # names of those that are optimised within their callers alone


def kernel(function: Any) -> Any:
    """Compile loops over rows; the compiler may reorder their sums and products (always in the same way)."""
    _INNER.add(function.__name__)
    return numba.njit(fastmath=FLAGS, no_cpython_wrapper=True, **OPTIONS)(function)


def glue(function: Any) -> Any:
    """Compile a function that mostly calls others."""
    _LATE.add(function.__name__)
    return kernel(function)


def element(function: Any) -> Any:
    """Compile a function of one number whose rounding steps carry its accuracy: no reordering, fused
    multiply-add only."""
    _INNER.add(function.__name__)
    _LATE.add(function.__name__)
    return numba.njit(fastmath={"contract"}, forceinline=True, no_cpython_wrapper=True, **OPTIONS)(function)


def _sgemm_address() -> int:
    """Where scipy's sgemm lies: its module is loaded alone, as all of scipy.linalg is 11 MB and a quarter of
    a second. Later imports of scipy.linalg take over this module."""
    name = "scipy.linalg.cython_blas"
    if "scipy.linalg" not in sys.modules:
        with contextlib.suppress(Exception):
            import scipy

            folder = str(Path(scipy.__file__).parent / "linalg")
            found = importlib.machinery.PathFinder.find_spec(name, [folder])
            module = importlib.util.module_from_spec(found)
            found.loader.exec_module(module)
            capsule = ctypes.py_object(module.__pyx_capi__["sgemm"])
            get_name, get_pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
            get_name.restype, get_pointer.restype = ctypes.c_void_p, ctypes.c_void_p
            return get_pointer(capsule, ctypes.c_void_p(get_name(capsule)))
    return get_cython_function_address(name, "sgemm")


llvm.add_symbol("tightrope_sgemm", _sgemm_address())
_LIBRARY = ctypes.WinDLL("kernel32") if sys.platform == "win32" else ctypes.CDLL(None)
_YIELD = _LIBRARY.SwitchToThread if sys.platform == "win32" else _LIBRARY.sched_yield
llvm.add_symbol("tightrope_yield", ctypes.cast(_YIELD, ctypes.c_void_p).value)


@contextlib.contextmanager
def _whole_programs() -> Iterator[None]:
    """Make machine code of entries alone, and leave glue and element functions as they are until they stand
    in their callers.

    numba optimises each function and makes machine code of it, and does both again with all it calls within
    each caller: most of the compile time. That code would be worse than useless: of functions with one name
    the process takes the first, and a process that compiles would round otherwise than one that loads the
    entries. So these see only functions of their own. Where a version of numba has other insides, it goes
    its own way.
    """
    library = codegen.CPUCodeLibrary
    names = ("_optimize_final_module", "_finalize_final_module")
    originals = [getattr(library, name, None) for name in names]
    if None in originals:
        yield
        return
    optimise, finalise = originals

    def optimise_late(self: Any) -> None:
        if self.name not in _LATE:
            optimise(self)

    def finalise_entries(self: Any) -> None:
        if self.name not in _INNER:
            for function in self._final_module.functions:
                if function.linkage == llvm.Linkage.linkonce_odr:
                    function.linkage = llvm.Linkage.internal
            finalise(self)
            return
        module = self._final_module  # what the callers link
        shared = [x.name for x in module.global_variables if x.linkage == llvm.Linkage.common]
        # numba writes into these variables (an environment per function), so they must lie somewhere
        self._final_module = llvm.parse_assembly("\n".join(f'@"{x}" = common global i64 0' for x in shared))
        finalise(self)
        self._final_module = module

    library._optimize_final_module, library._finalize_final_module = optimise_late, finalise_entries
    try:
        yield
    finally:
        library._optimize_final_module, library._finalize_final_module = originals


def entry(signature: str) -> Callable[[Any], Any]:
    """A function that Python calls, with this signature alone: from the cache, or else compiled now."""
    options = {"fastmath": FLAGS, **OPTIONS}

    def load_or_compile(function: Any) -> Any:
        folder = cache_folder()
        found = None if folder is None else load(folder, function, numba.njit(**options))
        if found is not None:
            return found
        with _whole_programs():
            made = numba.njit(signature, **options)(function)
        if folder is not None:
            store(folder, function, made)
        return made

    return load_or_compile


def _pointer(context: Any, builder: Any, kind: Any, array: Any, offset: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [offset])


@intrinsic
def plain(typing: Any, constant: Any) -> Any:
    """A constant handed on as a variable: numba compiles a function anew for every literal argument."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.cast(builder, arguments[0], signature.args[0], signature.return_type)

    return types.unliteral(constant)(constant), generate


@intrinsic
def row(typing: Any, array: Any, offset: Any, count: Any) -> Any:
    """``array[offset : offset + count]`` of a contiguous vector, without checks, wraparound or reference
    counts."""
    kind = types.Array(array.dtype, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        from numba.np import arrayobj  # part of the compiler, which a start from the cache does without

        array, offset, count = arguments
        view = context.make_array(kind)(context, builder)
        size = context.get_constant(types.intp, 4 if signature.args[0].dtype == types.float32 else 8)
        data = _pointer(context, builder, signature.args[0], array, offset)
        arrayobj.populate_array(view, data, (count,), (size,), size, meminfo=None)
        return view._getvalue()

    return kind(array, types.intp, types.intp), generate


@intrinsic
def gemm(typing: Any, ta: Any, tb: Any, m: Any, n: Any, k: Any, a: Any, b: Any, beta: Any, c: Any) -> Any:
    """BLAS sgemm, column-major: C [m, n] = op(A) op(B) + beta C; a, b, c are (vector, offset, leading
    dimension)."""
    signature = types.void(
        types.boolean, types.boolean, types.intp, types.intp, types.intp, a, b, types.float32, c
    )

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer, real, byte = ir.IntType(32), ir.FloatType(), ir.IntType(8)
        ta, tb, m, n, k, a, b, beta, c = arguments

        def address(value: Any) -> Any:
            slot = cgutils.alloca_once(builder, value.type)
            builder.store(value, slot)
            return slot

        def matrix(value: Any, kind: Any) -> tuple[Any, Any]:
            vector, offset, leading = cgutils.unpack_tuple(builder, value)
            offset = context.cast(builder, offset, kind[1], types.intp)
            leading = context.cast(builder, leading, kind[2], types.intp)
            data = _pointer(context, builder, kind[0], vector, offset)
            return data, address(builder.trunc(leading, integer))

        def letter(flag: Any) -> Any:
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
def float_of_bits(typing: Any, bits: Any) -> Any:
    """The float32 that has these 32 bits."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@intrinsic
def bits_of_float(typing: Any, number: Any) -> Any:
    """The 32 bits of a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), generate


@intrinsic
def load_shared(typing: Any, array: Any, index: Any) -> Any:
    """Read an int64 that another thread writes; what it wrote before is visible after (acquire)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(_pointer(context, builder, signature.args[0], *arguments), "acquire", 8)

    return types.int64(array, types.intp), generate


@intrinsic
def store_shared(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write an int64 that another thread reads, after everything written before it (release)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, index, value = arguments
        builder.store_atomic(value, _pointer(context, builder, signature.args[0], array, index), "release", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), generate


@intrinsic
def pause(typing: Any) -> Any:
    """Tell the core that this is a waiting loop (x86; elsewhere nothing)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if platform.machine().lower() in ("x86_64", "amd64", "i386", "i686"):
            kind = ir.FunctionType(ir.VoidType(), [])
            builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.sse2.pause"), [])
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def give_way(typing: Any) -> Any:
    """Let another thread have this core."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(32), [])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, "tightrope_yield"), [])
        return context.get_dummy_value()

    return types.void(), generate
