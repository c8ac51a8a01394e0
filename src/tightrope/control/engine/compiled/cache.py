"""Where compiled code is kept between processes, and how it comes back without numba's compiler.

numba's own cache loads all that a compilation might need before it reads an entry: 40 MB, and as much time
as the rest of the engine takes. An entry here is the same state, read as it is, behind a digest: code that
was damaged on the disk would crash the process.
"""

# mypy: ignore-errors
# (numba's insides are not in its types)
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import compiler, compiler_lock, serialize
from numba.core.registry import cpu_target

SWITCH = "TIGHTROPE_NUMBA_CACHE"
KEPT_DAYS = 90

_COMPLETE = "complete"  # the file that says that a folder holds every entry; its time is that of the last use
_DIGEST = 32


def cache_folder() -> Path | None:
    """Where compiled code is kept, 0700 below the user's cache directory; None when switched off or not safe.

    The name of the last folder stands for everything the machine code depends on: these sources, numba, the
    CPU.
    """
    if os.environ.get(SWITCH, "").lower() in ("off", "0", "no", "none"):
        return None
    state = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        state.update(source.read_bytes())
    machine = (llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), platform.machine())
    config = (numba.config.OPT, numba.config.CPU_NAME, numba.config.CPU_FEATURES)
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
                return None  # what lies there was not written by this user and would be executed
            part.chmod(0o700)
    except (OSError, RuntimeError):  # RuntimeError: no home directory is known
        return None
    return folder if os.access(folder, os.W_OK) else None


def compilation_due() -> bool:
    """Whether loading the engine will compile it (many seconds) and not read it from the cache (under
    one)."""
    folder = cache_folder()
    if folder is None or not (folder / _COMPLETE).exists():
        return True
    return not all((folder / name).exists() for name in (folder / _COMPLETE).read_text().split())


def mark_complete() -> None:
    """Note in the cache that everything has been compiled and is in use; throw away what long was not."""
    folder = cache_folder()
    if folder is None:
        return
    with contextlib.suppress(OSError):
        (folder / _COMPLETE).touch(mode=0o600)
        entries = sorted(path.name for path in folder.iterdir() if path.name.startswith("tightrope."))
        (folder / _COMPLETE).write_text("\n".join(entries))
        _prune(folder)


def _prune(folder: Path) -> None:
    """Remove the folders beside this one that nobody used for KEPT_DAYS (other versions, other CPUs)."""
    for other in folder.parent.iterdir():
        ours = len(other.name) == len(folder.name) and not set(other.name) - set("0123456789abcdef")
        if not ours or other == folder or other.is_symlink() or not other.is_dir():
            continue
        mark = other / _COMPLETE
        last_use = (mark if mark.exists() else other).stat().st_mtime
        if time.time() - last_use > KEPT_DAYS * 86400:
            shutil.rmtree(other, ignore_errors=True)


def load(folder: Path, function: Any, make: Callable[[Any], Any]) -> Any:
    """``function`` with its compiled code out of the folder, ready to be called; None when there is none that
    fits. ``make`` turns it into a numba dispatcher that has compiled nothing yet.
    """
    try:
        data = _file(folder, function).read_bytes()
        if hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
            return None
        with compiler_lock.global_compiler_lock:
            state = pickle.loads(data[_DIGEST:])
            result = compiler.CompileResult._rebuild(cpu_target.target_context, *state)
            dispatcher = make(function)
            dispatcher.add_overload(result)
            dispatcher.disable_compile()
    except Exception:  # no entry, or one of another numba: to be compiled
        return None
    return dispatcher


def store(folder: Path, function: Any, dispatcher: Any) -> None:
    """Keep the compiled code of ``function``; without a word when that fails, as it only saves time."""
    with contextlib.suppress(Exception):
        (result,) = dispatcher.overloads.values()
        if result.library.has_dynamic_globals:
            return  # addresses of this process
        data = serialize.dumps(_without_bitcode(result._reduce()))
        number, name = tempfile.mkstemp(dir=folder)  # 0600; other processes see all of the file or none
        try:
            with open(number, "wb") as file:
                file.write(hashlib.sha256(data).digest() + data)
            os.replace(name, _file(folder, function))
        except BaseException:
            os.unlink(name)
            raise


def _without_bitcode(state: Any) -> Any:
    """The same with a module of names alone in place of the one that other functions would be linked with:
    none ever is, and as LLVM reads it anew in each process it takes more memory than all our code.
    """
    name, kind, (code, bitcode) = state[0]
    module = llvm.parse_bitcode(bitcode)
    defined = [x.name for x in (*module.functions, *module.global_variables) if not x.is_declaration]
    names = llvm.parse_assembly("\n".join(f'@"{x}" = global i64 0' for x in defined))
    return ((name, kind, (code, names.as_bitcode())), *state[1:])


def _file(folder: Path, function: Any) -> Path:
    return folder / f"{function.__module__}.{function.__qualname__}"
