"""SIGINT and SIGTERM: a run is saved as it was after its newest update, and ends.

A signal raises `Stopped` at once. Where work is under way that must not be left half done (`uninterrupted`:
an update, a save), it does so at the end. What can be left at any moment inside such work (a rollout) is
`interruptible`. A second signal never waits; a third ends the process without cleaning up.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import NamedTuple

BOTH = (signal.SIGINT, signal.SIGTERM)
PATIENCE = 10.0  # seconds: work that takes longer is left, where it can be undone


class Stopped(KeyboardInterrupt):
    """A signal asked the run to stop. ``code``: the exit code of the command, 130 or 143. ``position``: the
    steps or responses that the run had done by then.
    """

    position = 0

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number


class _Work(NamedTuple):
    """What is not interrupted: in words (empty: it is soon over), how many seconds it takes (None: not
    known), whether it can be undone, and when it began by `time.monotonic`.
    """

    what: str
    seconds: float | None
    can_undo: bool
    begin: float

    def left(self) -> float | None:
        """Seconds until the end."""
        return None if self.seconds is None else max(0.0, self.begin + self.seconds - time.monotonic())


class _Answer:
    """How this process handles signals: one object a process, because signals go to processes."""

    def __init__(self) -> None:
        self.begin(active=False)

    def begin(self, *, active: bool) -> None:
        """Forget the signals so far. ``active``: the object is the handler."""
        self.active = active
        self.came: list[int] = []
        self.answered = False  # the first one was: the run is being saved
        self.work: list[_Work] = []  # nested calls of `uninterrupted`

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.came.append(number)
        if len(self.came) > 2:  # something swallows the second, or hangs while it cleans up
            os._exit(128 + number)
        if len(self.came) > 1 or not self.waits():
            raise Stopped(number)

    def waits(self) -> bool:
        """Whether the work under way is finished first, after the first signal; it is told."""
        if not self.work:
            return False
        what, left = self.work[-1].what, self.work[-1].left()
        if self.work[-1].can_undo and (left is None or left > PATIENCE):
            return False
        self._tell(self.came[-1], what, left)
        return True

    def _tell(self, number: int, what: str, left: float | None) -> None:
        if not what or (left is not None and left < 1):
            return
        about = "" if left is None else f", about {left:,.0f} s more"
        with contextlib.suppress(OSError, RuntimeError, ValueError):  # a stream that is closed, or in use
            print(
                f"{signal.Signals(number).name}: {what} is finished first{about}. A second signal leaves at "
                "once, without it.",
                file=sys.stderr,
                flush=True,
            )


_answer = _Answer()


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def stoppable(*, only_ctrl_c: bool = False) -> Iterator[None]:
    """Inside, SIGINT and SIGTERM raise `Stopped` as the head of this file says. Also a decorator.

    Only the main thread can handle signals. In another thread, or inside another `stoppable`, nothing
    changes. ``only_ctrl_c``: for a call in Python without a run folder. SIGTERM stays as it is, and so does
    SIGINT where the program has a handler of its own.
    """
    if _answer.active or not _in_main_thread():
        yield
        return
    if only_ctrl_c and signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    numbers = BOTH[:1] if only_ctrl_c else BOTH
    _answer.begin(active=True)
    before = {number: signal.signal(number, _answer) for number in numbers}
    try:
        yield
    except Exception:
        raise_if_stopped()  # an import that a signal ends may raise something else
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
        _answer.active = False


@contextlib.contextmanager
def uninterrupted(what: str = "", seconds: float | None = None, *, can_undo: bool = False) -> Iterator[None]:
    """Around work that must not be left half done: a signal inside takes effect at the end.

    ``what``: the work, for people who wait for it; ``seconds``: how long it takes, by what earlier ones
    took. ``can_undo``: the caller undoes the work on `Stopped`, which is raised at once where it takes more
    than PATIENCE, or nobody knows how long.
    """
    raise_if_stopped()
    _answer.work.append(_Work(what, seconds, can_undo, time.monotonic()))
    try:
        if _answer.active and _answer.came and not (_answer.answered or _answer.waits()):
            raise Stopped(_answer.came[-1])  # it came in what is around
        yield
    finally:
        _answer.work.pop()
    raise_if_stopped()


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Inside `uninterrupted`, around what can be left at any moment: a signal takes effect at once. The work
    around it begins, or begins again, at the end.
    """
    outer, _answer.work = _answer.work, []
    try:
        raise_if_stopped()
        yield
    finally:
        _answer.work = [work._replace(begin=time.monotonic()) for work in outer]


def raise_if_stopped() -> None:
    """Raise `Stopped` for a signal that came in `uninterrupted`, or whose exception some code has caught."""
    if _answer.active and _answer.came and not _answer.answered and not _answer.work:
        raise Stopped(_answer.came[-1])


def answer() -> bool:
    """Begin to save after a signal: it is not raised again, the next one is at once. False: a second one has
    come already.
    """
    first = len(_answer.came) < 2
    _answer.answered = True
    return first


def is_signal(error: BaseException) -> bool:
    """Whether an error is a signal to this process. Where signals raise `Stopped`, or SIGINT is ignored, any
    other KeyboardInterrupt is an error of the code that raised it.
    """
    if not isinstance(error, KeyboardInterrupt):
        return False
    handler = signal.getsignal(signal.SIGINT)
    return isinstance(error, Stopped) or (_in_main_thread() and handler not in (_answer, signal.SIG_IGN))


def take_back() -> list[str]:
    """Put the handlers back that other code has replaced since; the names of their signals."""
    if not (_answer.active and _in_main_thread()):
        return []
    return [number.name for number in BOTH if signal.signal(number, _answer) is not _answer]
