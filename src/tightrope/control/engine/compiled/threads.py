"""Two threads in one minibatch: each owns half of the parameters, and they meet at the joint gradient norm.

A meeting is a counter per thread, written with release and read with acquire. A thread that waits spins for a
while and then yields its core; it stops waiting when the other has left. Nothing here can change a bit of the
result.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import weakref
from collections.abc import Callable

import numpy as np

from tightrope.control.engine.compiled.primitives import (
    composite,
    load_shared,
    spin_pause,
    store_shared,
    yield_thread,
)  # fmt: skip

# entries of ``control`` (int64), each on its own cache line; role 0 is the actor's thread, role 1 the
# critic's
ARRIVED, LEFT, EPOCH = 0, 32, 48
LINE = 16
CONTROL_SIZE = 64
SPINS = 2000


@composite
def wait(control, index, count):
    """Wait until ``control[index]`` has reached ``count``; False when the other thread has left for good."""
    spins = 0
    while load_shared(control, index) < count:
        if load_shared(control, LEFT) != 0 and load_shared(control, index) < count:
            return False
        spins += 1
        if spins < SPINS:
            spin_pause()
        else:
            yield_thread()
    return True


@composite
def meet(control, role):
    """Arrive, and wait for the other; False when the other has left."""
    count = load_shared(control, ARRIVED + LINE * role) + 1
    store_shared(control, ARRIVED + LINE * role, count)
    return wait(control, ARRIVED + LINE * (1 - role), count)


class Helper:
    """A thread that runs the critic's half of updates; made when first needed, also again after a fork.

    It ends with this object, and before the interpreter does: a thread that returns from compiled code while
    the interpreter shuts down aborts the process.
    """

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._end: weakref.finalize | None = None

    def start(self, job: Callable[[], object], control: np.ndarray) -> bool:
        """Run ``job`` beside the caller; ``control[LEFT]`` becomes 1 when it ends. False: no thread
        available."""
        if self._thread is None or not self._thread.is_alive():
            jobs: queue.SimpleQueue = queue.SimpleQueue()
            thread = threading.Thread(target=_serve, args=(jobs,), name="tightrope-critic", daemon=True)
            try:
                thread.start()
            except RuntimeError:  # the system allows no more threads
                return False
            self._thread, self._jobs = thread, jobs
            self._end = weakref.finalize(self, _end, thread, jobs)
        self._jobs.put((job, control))
        return True

    def wait(self) -> None:
        """Wait until it has nothing to do."""
        if self._thread is not None and self._thread.is_alive():
            idle = threading.Event()
            self._jobs.put((idle.set, np.zeros(CONTROL_SIZE, np.int64)))
            idle.wait(timeout=10)

    def stop(self) -> None:
        """End the thread."""
        if self._end is not None:
            self._end()
        self._thread = self._end = None


def _serve(jobs: queue.SimpleQueue) -> None:
    while (task := jobs.get()) is not None:
        job, control = task
        with contextlib.suppress(BaseException):  # the other thread sees LEFT and does both halves
            job()
        control[LEFT] = 1
        del task, job, control


def _end(thread: threading.Thread, jobs: queue.SimpleQueue) -> None:
    jobs.put(None)
    if thread is not threading.current_thread():
        thread.join(timeout=10)


class ThreadChoice:
    """Whether to use the second thread: on a machine whose cores are busy it costs more than it saves.

    Both ways are timed, and the quicker one is used; every ``RETRY`` updates the other is tried again.
    Timings may decide this because both give the same bits.
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

    def record(self, together: bool, seconds: float, minibatches: int) -> None:
        """Note how long an update took."""
        self.updates += 1
        if minibatches > 0:
            self.seconds[together] = seconds / minibatches
