"""SIGINT and SIGTERM: a run stops at once; a save that has begun is finished first.

A signal causes no save. Checkpoints are written only where the settings put them, so a run that was
stopped and resumed ends exactly like one that was not. A second signal does not wait for the save.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType


class Stopped(KeyboardInterrupt):
    """A signal asked the run to stop. ``code`` is the exit code of the command: 130 or 143."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number


class _Answer:
    """How this process handles signals: one object a process, because signals go to processes."""

    def __init__(self) -> None:
        self.active = False
        self.asked: int | None = None  # the number of the signal that came
        self.saves = 0  # nested calls of `uninterrupted`

    def __call__(self, number: int, frame: FrameType | None) -> None:
        first, self.asked = self.asked is None, number
        if not (first and self.saves):
            raise Stopped(number)


_answer = _Answer()


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Inside, SIGINT and SIGTERM raise `Stopped`: at once, or at the end of `uninterrupted`. A second signal
    always raises it at once.

    Only the main thread can handle signals. In another thread, or inside another `stoppable`, nothing
    changes.
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
def uninterrupted() -> Iterator[None]:
    """Around a save: a signal that comes inside takes effect when the save is complete."""
    raise_if_stopped()
    _answer.saves += 1
    try:
        yield
    finally:
        _answer.saves -= 1
    raise_if_stopped()


def raise_if_stopped() -> None:
    """Raise `Stopped` for a signal that came in `uninterrupted`, or whose exception some code has caught."""
    if _answer.active and _answer.asked is not None and not _answer.saves:
        raise Stopped(_answer.asked)
