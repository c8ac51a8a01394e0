"""Functions that Python calls: compiled once, kept on disk, and loaded without numba's compiler.

numba's own ``cache=True`` loads all that a compilation might need before it reads an entry. Measured, a short
run from a warm cache then takes 14 % more CPU time and 40 MB more memory; and its key holds only the file of
the function itself, so that a change in another file of this folder goes unnoticed. An entry here is the same
state behind a digest: code that was damaged on the disk would crash the process.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import codegen, compiler, compiler_lock, serialize
from numba.core.registry import cpu_target

from tightrope.control.engine.compiled.primitives import COMPILE_OPTIONS, FLAGS, INNER, LATE, njit

SWITCH = "TIGHTROPE_NUMBA_CACHE"
KEPT_DAYS = 90

_COMPLETE = "complete"  # this file lists a folder's entries once all are there; its time is the last use
_DIGEST = 32


@contextlib.contextmanager
def _whole_programs() -> Iterator[None]:
    """Make machine code of entries only, and optimise composite and scalar functions only within their
    callers.

    numba optimises each function and makes machine code of it, and does both again with all it calls within
    each caller: most of the compile time (13 seconds in place of 8). That code would also do harm: of
    functions with one name the process takes the first, and a process that compiles would round differently
    from one that loads the entries. So the patched methods treat only functions of this folder specially. A
    version of numba without these methods compiles everything.
    """
    library: Any = codegen.CPUCodeLibrary
    names = ("_optimize_final_module", "_finalize_final_module")
    if not all(hasattr(library, name) for name in names):
        yield
        return
    optimise, finalise = (getattr(library, name) for name in names)

    def optimise_late(self: Any) -> None:
        if self.name not in LATE:
            optimise(self)

    def finalise_entries(self: Any) -> None:
        if self.name not in INNER:
            for function in self._final_module.functions:
                if function.linkage == llvm.Linkage.linkonce_odr:
                    function.linkage = llvm.Linkage.internal
            finalise(self)
            return
        module = self._final_module  # what callers are linked with
        shared = [x.name for x in module.global_variables if x.linkage == llvm.Linkage.common]
        # numba writes into these variables (an environment per function), so they must exist
        self._final_module = llvm.parse_assembly("\n".join(f'@"{x}" = common global i64 0' for x in shared))
        finalise(self)
        self._final_module = module

    library._optimize_final_module, library._finalize_final_module = optimise_late, finalise_entries
    try:
        yield
    finally:
        library._optimize_final_module, library._finalize_final_module = optimise, finalise


def entry(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """A function that Python calls, for this one signature: loaded from the cache, or else compiled now."""

    def load_or_compile(function: Callable[..., Any]) -> Any:
        folder = cache_folder()
        found = None if folder is None else load_entry(folder, function)
        if found is not None:
            return found
        with _whole_programs():
            made = njit(signature, fastmath=FLAGS, **COMPILE_OPTIONS)(function)
        if folder is not None:
            store_entry(folder, function, made)
        return made

    return load_or_compile


def cache_folder() -> Path | None:
    """The folder of compiled code, 0700 below the user's cache directory; None when switched off or not safe.

    Its name is a digest of everything that the machine code depends on: these sources, the versions, the CPU.
    """
    if os.environ.get(SWITCH, "").lower() in ("off", "0", "no", "none"):
        return None
    state = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        state.update(source.read_bytes())
    machine = (llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), platform.machine())
    numbas: Any = numba.config
    config = (numbas.OPT, numbas.CPU_NAME, numbas.CPU_FEATURES)
    versions = (numba.__version__, llvmlite.__version__, np.__version__, sys.version)
    state.update(repr((*versions, *config, *machine)).encode())
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        root = base / "tightrope" / "numba"
        folder = root / state.hexdigest()[:16]
        base.mkdir(parents=True, exist_ok=True)
        for part in (base / "tightrope", root, folder):
            part.mkdir(mode=0o700, exist_ok=True)
        for part in (root, folder):
            if hasattr(os, "getuid") and part.stat().st_uid != os.getuid():
                return None  # another user's files, which would be executed
            part.chmod(0o700)
    except (OSError, RuntimeError):  # RuntimeError: no home directory is known
        return None
    return folder if os.access(folder, os.W_OK) else None


def compilation_due() -> bool:
    """Whether importing the engine will compile it (many seconds) instead of reading the cache (under
    one)."""
    folder = cache_folder()
    try:
        return folder is None or not all(
            (folder / name).exists() for name in (folder / _COMPLETE).read_text().split()
        )
    except (OSError, ValueError):  # it is not there, or it is no list of names
        return True


def when_compiled() -> str:
    """How often the engine is compiled, in words for a message."""
    return "in every process, as its cache is off" if cache_folder() is None else "once for this installation"


def mark_complete() -> None:
    """Record that the cache holds every entry and is in use; delete folders unused for KEPT_DAYS."""
    folder = cache_folder()
    if folder is None:
        return
    with contextlib.suppress(OSError):
        (folder / _COMPLETE).touch(mode=0o600)
        entries = sorted(path.name for path in folder.iterdir() if path.name.startswith("tightrope."))
        (folder / _COMPLETE).write_text("\n".join(entries))
        _prune(folder)


def _prune(folder: Path) -> None:
    """Delete the folders of other versions and other CPUs that were not used for KEPT_DAYS."""
    for other in folder.parent.iterdir():
        ours = len(other.name) == len(folder.name) and not set(other.name) - set("0123456789abcdef")
        if not ours or other == folder or other.is_symlink() or not other.is_dir():
            continue
        mark = other / _COMPLETE
        last_use = (mark if mark.exists() else other).stat().st_mtime
        if time.time() - last_use > KEPT_DAYS * 86400:
            shutil.rmtree(other, ignore_errors=True)


def load_entry(folder: Path, function: Callable[..., Any]) -> Any:
    """``function`` with its compiled code from the folder, ready to be called; None when no entry fits."""
    try:
        data = _file(folder, function).read_bytes()
        if hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
            return None
        with compiler_lock.global_compiler_lock:
            state = pickle.loads(data[_DIGEST:])
            result = compiler.CompileResult._rebuild(cpu_target.target_context, *state)
            dispatcher = njit(fastmath=FLAGS, **COMPILE_OPTIONS)(function)
            dispatcher.add_overload(result)
            dispatcher.disable_compile()
    except Exception:  # no entry, or one of another numba: to be compiled
        return None
    return dispatcher


def store_entry(folder: Path, function: Callable[..., Any], dispatcher: Any) -> None:
    """Keep the compiled code of ``function``. A failure is ignored: the cache only saves time."""
    with contextlib.suppress(Exception):
        (result,) = dispatcher.overloads.values()
        if result.library.has_dynamic_globals:
            return  # it holds addresses that are valid in this process only
        data = serialize.dumps(result._reduce())
        number, name = tempfile.mkstemp(dir=folder)  # 0600; other processes see all of the file or nothing
        try:
            with open(number, "wb") as file:
                file.write(hashlib.sha256(data).digest() + data)
            os.replace(name, _file(folder, function))
        except BaseException:
            os.unlink(name)
            raise


def _file(folder: Path, function: Callable[..., Any]) -> Path:
    return folder / f"{function.__module__}.{function.__qualname__}"
