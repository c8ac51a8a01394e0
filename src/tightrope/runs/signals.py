"""SIGINT and SIGTERM: a run stops at once, but for a save under way, which is finished first.

Nothing is saved because of a signal: checkpoints lie where the settings put them, so a stopped and resumed
run ends exactly like an uninterrupted one. A second signal does not wait for the save either.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType


class Stopped(KeyboardInterrupt):
    """A signal asked the run to stop; ``code`` is the exit code that says so: 130 or 143."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number


class _Answer:
    """What this process does about a signal; signals belong to the process, and so does this."""

    def __init__(self) -> None:
        self.active = False
        self.asked: int | None = None  # the signal that came
        self.saves = 0  # how many saves are inside each other

    def __call__(self, number: int, frame: FrameType | None) -> None:
        first, self.asked = self.asked is None, number
        if not (first and self.saves):
            raise Stopped(number)


_answer = _Answer()


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Inside, SIGINT and SIGTERM raise `Stopped`, in `whole` at its end; a second one raises it at once.

    Only the main thread may handle signals: in another one nothing changes, and neither inside another
    `stoppable`.
    """
    if _answer.active or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, _answer) for number in (signal.SIGINT, signal.SIGTERM)}
    _answer.active, _answer.asked, _answer.saves = True, None, 0
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
        _answer.active = False


@contextlib.contextmanager
def whole() -> Iterator[None]:
    """Around a save: a signal that comes inside is answered when the save is complete."""
    check()
    _answer.saves += 1
    try:
        yield
    finally:
        _answer.saves -= 1
    check()


def check() -> None:
    """Raise `Stopped` when a signal has come that someone's code has swallowed, or that came in `whole`."""
    if _answer.active and _answer.asked is not None and not _answer.saves:
        raise Stopped(_answer.asked)
