"""A time limit for environments of this process: it costs nothing while they answer, and raises otherwise.

A thread checks regularly whether the same call is still running. If it takes too long, a signal interrupts
it: the signal's handler raises in the main thread, where the environment runs. This works wherever Python can
be interrupted: sleeping, waiting, computing in Python. Compiled code that never returns cannot be stopped
from inside its process; then a line on stderr names it. Worker processes have their own limit (processes.py).
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from types import FrameType

from tightrope.control.environments.faults import EnvironmentTimeout

SIGNAL = getattr(signal, "SIGALRM", None)  # none on Windows: no limit in this process there
_watching: list[Watchdog] = []  # training's and evaluation's, under one handler


class Watchdog:
    """Watches the method ``under_way() -> a number that changes with every call, None when there is none``.

    It begins with `start` and ends with `stop`, or when the object of the method is deleted. ``name`` appears
    in the message about a call that cannot be interrupted.
    It does nothing outside the main thread, or where other code handles the signal.
    """

    def __init__(self, under_way: Callable[[], int | None], timeout: float, name: str) -> None:
        self._under_way = weakref.WeakMethod(under_way)  # it must not keep forgotten environments alive
        self._timeout, self._name = timeout, name
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._late: int | None = None

    def start(self) -> None:
        """Begin to watch; once is enough."""
        main = threading.current_thread() is threading.main_thread()
        if self._thread is not None or SIGNAL is None or not main:
            return
        if not _watching:
            if signal.getsignal(SIGNAL) not in (signal.SIG_DFL, _interrupt):
                return
            signal.signal(SIGNAL, _interrupt)
        _watching.append(self)
        self._thread = threading.Thread(target=self._watch, daemon=True, name="tightrope-watchdog")
        self._thread.start()

    def stop(self) -> None:
        """End the thread and give the signal back; stopping twice is fine."""
        self._over.set()
        if self._thread is None or SIGNAL is None:
            return
        self._thread.join()
        self._thread = None
        if self in _watching:
            _watching.remove(self)
        if not _watching and threading.current_thread() is threading.main_thread():
            signal.signal(SIGNAL, signal.SIG_DFL)

    def _watch(self) -> None:
        seen, since, reported = None, time.monotonic(), False
        while not self._over.wait(min(1.0, self._timeout / 4)):
            if self._under_way() is None:
                _watching.remove(self)
                return
            now, clock = self._now(), time.monotonic()
            if now is None or now != seen:
                seen, since, reported = now, clock, False
            elif clock - since >= 2 * self._timeout and not reported:
                reported = True
                print(
                    f"{self._name} has not answered for {clock - since:.0f} s and cannot be interrupted: it "
                    "is in compiled code of this process, or swallows what interrupts it. End the process; "
                    "vector_backend workers steps copies where they can be stopped.",
                    file=sys.stderr,
                )
            elif clock - since >= self._timeout and self._late is None:
                self._late = now
                assert SIGNAL is not None
                signal.pthread_kill(threading.main_thread().ident or 0, SIGNAL)

    def _now(self) -> int | None:
        under_way = self._under_way()
        return None if under_way is None else under_way()

    def interrupt(self) -> None:
        """Raise EnvironmentTimeout in the main thread, unless the call came back in the meantime."""
        late, self._late = self._late, None
        if late is not None and late == self._now():
            raise EnvironmentTimeout(f"not back after {self._timeout:g} s (env_timeout)")


class _Call:
    """One call that is under way; its number is None once it is over."""

    number: int | None = 1

    def under_way(self) -> int | None:
        return self.number


@contextlib.contextmanager
def limited(name: str, timeout: float | None) -> Iterator[None]:
    """Raise EnvironmentTimeout in what runs inside, if it takes longer than ``timeout`` seconds (None:
    never)."""
    if timeout is None:
        yield
        return
    call = _Call()
    watchdog = Watchdog(call.under_way, timeout, name)
    watchdog.start()
    try:
        yield
    finally:
        call.number = None
        watchdog.stop()


def _interrupt(number: int, frame: FrameType | None) -> None:
    for watchdog in tuple(_watching):
        watchdog.interrupt()
