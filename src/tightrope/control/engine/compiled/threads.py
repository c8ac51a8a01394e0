"""Two threads in one minibatch: each owns half of the parameters, and they meet at the joint gradient norm.

A meeting is a counter per thread, written with release and read with acquire. A thread that waits spins for
a while and then gives its core away; it stops waiting when the other has left. Nothing here can change a bit
of the result.
"""

# mypy: ignore-errors
# (what numba makes of these functions is not what mypy sees)
from __future__ import annotations

import contextlib
import queue
import threading
import weakref
from collections.abc import Callable

import numpy as np

from tightrope.control.engine.compiled.numba_tools import give_way, glue, load_shared, pause, store_shared

# entries of ``control`` (int64), each on a cache line of its own; role 0 is the actor's thread, role 1 the
# critic's
ARRIVED, LEFT, EPOCH = 0, 32, 48
LINE = 16
CONTROL_SIZE = 64
SPINS = 2000


@glue
def wait(control, index, count):
    """Wait until ``control[index]`` has reached ``count``; False when the other thread has left for good."""
    spins = 0
    while load_shared(control, index) < count:
        if load_shared(control, LEFT) != 0 and load_shared(control, index) < count:
            return False
        spins += 1
        if spins < SPINS:
            pause()
        else:
            give_way()
    return True


@glue
def meet(control, role):
    """Arrive, and wait for the other; False when the other has left."""
    count = load_shared(control, ARRIVED + LINE * role) + 1
    store_shared(control, ARRIVED + LINE * role, count)
    return wait(control, ARRIVED + LINE * (1 - role), count)


class Helper:
    """A thread that runs the critic's half of updates; made when first needed, also again after a fork.

    It ends with this object, and before the interpreter does: a thread that comes back from compiled code
    while
    the interpreter is being taken down aborts the process.
    """

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._end: weakref.finalize | None = None

    def start(self, job: Callable[[], object], control: np.ndarray) -> bool:
        """Run ``job`` beside the caller; False if there is no thread to be had. ``control[LEFT]`` tells
        the end."""
        if self._thread is None or not self._thread.is_alive():
            jobs: queue.SimpleQueue = queue.SimpleQueue()
            thread = threading.Thread(target=_serve, args=(jobs,), name="tightrope-critic", daemon=True)
            try:
                thread.start()
            except RuntimeError:  # the system grants no more threads
                return False
            self._thread, self._jobs = thread, jobs
            self._end = weakref.finalize(self, _end, thread, jobs)
        self._jobs.put((job, control))
        return True

    def stop(self) -> None:
        """End the thread."""
        if self._end is not None:
            self._end()
        self._thread = self._end = None


def _serve(jobs: queue.SimpleQueue) -> None:
    while (task := jobs.get()) is not None:
        job, control = task
        with contextlib.suppress(BaseException):  # the other thread sees it, and does both halves
            job()
        control[LEFT] = 1
        del task, job, control


def _end(thread: threading.Thread, jobs: queue.SimpleQueue) -> None:
    jobs.put(None)
    if thread is not threading.current_thread():
        thread.join(timeout=10)


class Pace:
    """Whether the second thread helps: on a machine whose cores are busy it costs more than it brings.

    Both ways are timed, and the quicker one is taken; every ``RETRY`` updates the other is tried again. The
    result is the same bit for bit, or a timing would have no business here.
    """

    RETRY = 16

    def __init__(self, both: bool) -> None:
        self.both, self.updates = both, 0
        self.seconds: dict[bool, float] = {}

    def choose(self) -> bool:
        """True: two threads in the next update."""
        if not self.both or len(self.seconds) < 2:
            return self.both and True not in self.seconds
        quicker = self.seconds[True] <= self.seconds[False]
        return not quicker if self.updates % self.RETRY == 0 else quicker

    def book(self, together: bool, seconds: float, minibatches: int) -> None:
        """Note how long an update took."""
        self.updates += 1
        if minibatches > 0:
            self.seconds[together] = seconds / minibatches
