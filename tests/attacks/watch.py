"""An audit hook that distinguishes code from a hostile file from code of installed libraries.

Every hostile file names one module, MARK, which Python would find. The hook records every import of it, every
compilation or execution of a text with that name, every file run below the place of the test, every unpickled
object, every started program and every connection. Libraries import their own modules late and execute code
that they generate; neither contains the name.

Strict mode, for lives in which every command does its work: code may only come from files that are installed
or named on the command line, or be a text that an installed library wrote. That text and the imports must not
contain a word of the data, each of which contains MARK.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import resource
import sys
import traceback
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest import mock

MARK = "attackmark"
TEMPLATE = "<template>"  # of a chat, in jinja2's sandbox
PROGRAMS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect", "ctypes.dlopen")
LIBRARIES = "['/sbin/ldconfig', '-p']"  # ctypes.util.find_library, of packages that look for the C library
# numba's compile cache: an exception
CACHE = str(Path("tightrope", "control", "engine", "compiled", "cache.py"))
SPAWN, BEGUN = str(Path("multiprocessing", "spawn.py")), str(Path("multiprocessing", "process.py"))
TESTS = Path(__file__).parents[1]
SOURCE = str(TESTS.parent / "src")
INSTALLED = (sys.prefix, sys.base_prefix, str(Path(os.__file__).parent), str(TESTS), SOURCE, "<frozen ")


class Watch:
    """Records what must not happen while it is armed; ``place``: no file below it may run but ``allowed``.

    ``excepted`` holds what fell under one of the two exceptions. What is heard in a worker process goes to
    the file ``from_workers``.
    """

    def __init__(
        self, place: Path, allowed: tuple[str, ...] = (), *, strict: bool = False, worker: bool = False
    ) -> None:
        self.place, self.allowed, self.strict = str(place), allowed, strict
        self.armed, self.events, self.excepted = False, list[str](), list[str]()
        self.home = None if worker else os.getpid()
        self.from_workers = place / "events-of-workers"
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.armed:
            return
        self.armed = False  # this is not audited
        try:
            if event == "pickle.find_class" and (exception := _exception()):
                self._note(self.excepted, f"{exception}: {'.'.join(map(str, arguments))}")
            elif found := self._judge(event, arguments):
                self._note(self.events, f"{event}: {found}")
        finally:
            self.armed = True

    def record(self, text: str) -> None:
        """Record what no audit event covers."""
        armed, self.armed = self.armed, False
        self._note(self.events, text)
        self.armed = armed

    def _note(self, where: list[str], text: str) -> None:
        if os.getpid() == self.home:
            where.append(text)
        else:
            with open(self.from_workers, "a") as file:
                file.write(text + "\n")

    def forbid_pickle(self) -> contextlib.AbstractContextManager[None]:
        """Inside, every pickle that is read or sent between processes is recorded."""

        def noted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
            def call(*arguments: Any, **more: Any) -> Any:
                if not _called_by(CACHE):
                    self.record(f"{name} was called")
                return function(*arguments, **more)

            return call

        stack = contextlib.ExitStack()
        for owner, names in ((pickle, ("load", "loads")), (Connection, ("send", "recv"))):
            for name in names:
                new = noted(f"{owner.__name__}.{name}", getattr(owner, name))
                stack.enter_context(mock.patch.object(owner, name, new))
        return stack

    def _judge(self, event: str, arguments: tuple[Any, ...]) -> str:
        if event == "pickle.find_class":
            return ".".join(map(str, arguments))
        if event == "import":
            return str(arguments[0]) if MARK in str(arguments[0]) else ""
        if event == "exec":
            return self._executed(arguments[0])
        if event == "compile":
            source, name = arguments
            text = source.decode(errors="replace") if isinstance(source, bytes) else str(source)
            allowed = str(name) in self.allowed or (not self.strict and str(name) == TEMPLATE)
            return f"{name}" if MARK in text and not allowed else ""
        if event in PROGRAMS:
            harmless = event == "ctypes.dlopen" and self.place not in str(arguments)
            harmless |= len(arguments) > 1 and str(arguments[1]) == LIBRARIES
            return "" if harmless else str(arguments)[:200]
        return ""

    def _executed(self, code: Any) -> str:
        """The problem with code that begins to run."""
        file = code.co_filename
        if file in self.allowed:
            return ""
        if file.startswith(self.place) or MARK in repr(code.co_consts):
            return str(file)
        if not self.strict or file.startswith(INSTALLED):
            return ""
        runner = _runner()
        library = runner.startswith(INSTALLED) and not runner.startswith(SOURCE)
        generated = library and not os.path.isabs(file) and MARK not in repr(code.co_names)
        return "" if generated else f"{file} by {runner}"


def _runner() -> str:
    """The file of the caller behind an event."""
    frame = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename == __file__:
        frame = frame.f_back
    return "" if frame is None else frame.f_code.co_filename


def _exception() -> str:
    """Which of the two exceptions of the design is at work: numba's compile cache, or the transport of the
    user's factory to a worker that has not begun; none: empty.
    """
    if _called_by(CACHE):
        return "cache"
    return "transport" if _called_by(SPAWN) and not _called_by(BEGUN) else ""


def _called_by(file: str) -> bool:
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code.co_filename.endswith(file):
            return True
        frame = frame.f_back
    return False


def outcome(watch: Watch, call: Callable[[], Any]) -> dict[str, Any]:
    """What came of a call: ``code`` (None: an exception), ``text`` on stderr or of the exception, ``kind`` of
    the exception, ``events``, and by how many MB the peak of the process's memory rose.
    """
    before, heard = _peak(), len(watch.events)
    stream, code, kind = io.StringIO(), None, ""
    with (
        contextlib.redirect_stderr(stream),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("always")
        watch.armed = True
        try:
            code = call()
        except BaseException as error:
            watch.armed = False
            kind = type(error).__name__
            stream.write("\n".join(traceback.format_exception(error)))
            text = str(error)
        else:
            watch.armed = False
            text = stream.getvalue()
    return {
        "code": code if isinstance(code, int) else 0 if kind == "" else None,
        "kind": kind,
        "text": text[-2000:],
        "trace": stream.getvalue()[-3000:] if kind else "",
        "events": watch.events[heard:],
        "megabytes": _peak() - before,
        "canary": os.path.exists(os.environ["TIGHTROPE_CANARY"]),
    }


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
