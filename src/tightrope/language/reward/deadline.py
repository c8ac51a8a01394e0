"""Calls that cannot hang their caller: a thread for plain functions, an event loop for coroutines.

Python cannot kill a thread. A call that is not back at its deadline is left behind in a daemon thread, which
keeps neither the program from going on nor the process from ending; what it returns later is thrown away. A
plain function is not entered again before it is back, so that at most one thread a function is lost.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import weakref
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future, wait
from typing import Any, TypeVar

T = TypeVar("T")


class Overdue(Exception):
    """A call was not back at its deadline."""


class Worker:
    """A daemon thread that calls functions one after the other; it begins with the first call."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._jobs: queue.SimpleQueue[Any] | None = None

    def call(self, function: Callable[[], T], timeout: float) -> T:
        """What ``function()`` returns, or raises. Raises Overdue after ``timeout`` seconds, waiting for an
        earlier call included; a call that has not begun by then never begins.
        """
        if self._jobs is None:
            self._jobs = queue.SimpleQueue()
            threading.Thread(target=_work, args=(self._jobs,), name=self._name, daemon=True).start()
            weakref.finalize(self, self._jobs.put, None)
        future: Future[T] = Future()
        self._jobs.put((future, function))
        _, late = wait([future], timeout)
        if late and (future.cancel() or future.running()):
            raise Overdue
        return future.result()


def _work(jobs: queue.SimpleQueue[Any]) -> None:
    while True:
        job = jobs.get()
        if job is None:
            return
        future, function = job
        if future.set_running_or_notify_cancel():
            try:
                future.set_result(function())
            except BaseException as error:  # whatever it is belongs to the caller
                future.set_exception(error)
        del job, future, function  # a waiting thread must not keep a batch in memory


class Loop:
    """An event loop in a daemon thread, the same one for every call; it begins with the first call.

    The loop lives on between calls, because clients that user code keeps (HTTP sessions) belong to the loop
    they were made in. It also works where the caller is inside an event loop already, as in a notebook.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._loop: asyncio.AbstractEventLoop | None = None

    def call(
        self, functions: Sequence[Callable[[], Coroutine[Any, Any, T]]], timeout: float | None
    ) -> list[T | None]:
        """What the coroutines of all functions return, run together; None for each that is not back in time.

        A late one is cancelled. One that blocks the loop makes all the others late, too: Python runs them in
        one thread. Raises what a coroutine raises.
        """
        if self._loop is None:
            self._loop = asyncio.new_event_loop()
            threading.Thread(target=_run_loop, args=(self._loop,), name=self._name, daemon=True).start()
            weakref.finalize(self, self._loop.call_soon_threadsafe, self._loop.stop)
        futures = [asyncio.run_coroutine_threadsafe(function(), self._loop) for function in functions]
        wait(futures, timeout)
        return [None if future.cancel() else future.result() for future in futures]


def _run_loop(loop: asyncio.AbstractEventLoop) -> None:
    asyncio.set_event_loop(loop)
    loop.run_forever()
    left = asyncio.all_tasks(loop)
    for task in left:
        task.cancel()
    if left:
        loop.run_until_complete(asyncio.wait(left, timeout=1.0))
    loop.run_until_complete(loop.shutdown_asyncgens())
    loop.close()
