"""At most one writer for each run folder: a lock of the operating system, and a note of who holds it.

The system releases the lock when the process ends, also after a kill, so a dead process never blocks a run.
The note that it leaves shows that it did not finish.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import sys
import time
import warnings
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tightrope.errors import TightropeError
from tightrope.runs.durable import spare_standard_streams, write_all, writing

NAME = "writer.lock"
_HELD: weakref.WeakSet[WriterLock] = weakref.WeakSet()
_UNSUPPORTED = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


class RunInUse(TightropeError, RuntimeError):
    """Another process, or other code in this one, is writing this run; the message names it."""


class WriterLock:
    """The right to write into a run folder, held until `release` or the end of the process.

    ``left_by`` describes the last holder that ended without releasing it; empty if there is none. Raises
    RunInUse if another process holds it now, CannotWrite if the file cannot be created. On a file system
    without locks there is a warning instead.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._descriptor: int | None = None
        with writing(self._path):
            spare_standard_streams()
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
            self._descriptor = os.open(self._path, flags, 0o644)
            try:
                self._take(folder)
            except BaseException:
                self.forget()
                raise
            _HELD.add(self)

    def _take(self, folder: Path) -> None:
        assert self._descriptor is not None
        try:
            _lock(self._descriptor)
        except OSError as error:
            who = _described(_note(self._path))
            if error.errno not in _UNSUPPORTED:
                raise RunInUse(
                    f"{folder} is being written by {who or 'another process'}, and a run has one writer. "
                    "Wait until it ends, or end it; evaluate, record, sample and load read at any time."
                ) from error
            warnings.warn(
                f"{folder} is on a file system without locks ({error.strerror}): make sure that nothing "
                "else writes there.",
                stacklevel=4,
            )
        self.left_by = _described(_note(self._path), ended=True)
        here = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "started": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
        os.ftruncate(self._descriptor, 0)
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        write_all(self._descriptor, json.dumps(here).encode() + b"\n")

    def release(self) -> None:
        """Let another process write."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):  # a disk that has become read-only keeps the note
                os.ftruncate(self._descriptor, 0)
            os.close(self._descriptor)  # this releases the lock
            self._descriptor = None

    def __del__(self) -> None:
        self.release()

    def forget(self) -> None:
        """Only close the file: in a forked child, because the lock belongs to the parent."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _forget_all() -> None:
    for lock in list(_HELD):
        lock.forget()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)

if sys.platform == "win32":
    import msvcrt

    def _lock(descriptor: int) -> None:
        os.lseek(descriptor, 1 << 30, os.SEEK_SET)  # far after the note, which others read
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _note(path: Path) -> dict[str, Any]:
    """The content of the lock file; empty if it cannot be read."""
    try:
        note = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return note if isinstance(note, dict) else {}


def _described(note: Mapping[str, object], *, ended: bool = False) -> str:
    if "pid" not in note:
        return ""
    # in containers a process that ended often had the number that this one has
    who = "this process" if note["pid"] == os.getpid() and not ended else f"process {note['pid']}"
    return f"{who} on {note.get('host')} since {note.get('started')}"
