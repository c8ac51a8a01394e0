"""One call of a reward function: what it is given, how long it may take, and what came back.

Python cannot kill a thread. A call that is not back at its deadline is left behind in a daemon thread, which
stops neither the program nor the end of the process; what it returns later is thrown away. A plain function
is not called again before it is back, so that at most one thread a function is lost.
"""

from __future__ import annotations

import asyncio
import difflib
import inspect
import itertools
import math
import numbers
import queue
import threading
import traceback
import weakref
from collections.abc import Callable, Coroutine, Iterable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from tightrope.errors import TightropeError

T = TypeVar("T")
Text = str | list[dict[str, Any]]
RewardFunction = Callable[..., Any]
FaultKind = Literal["exception", "length", "type", "not finite", "timeout", "none"]
LARGEST = 1e30  # above it a score, or a sum of weighted ones, would be infinite in float32


class RewardError(TightropeError, ValueError):
    """A reward function cannot be used as it is; the message names it and what to do."""


@dataclass(frozen=True)
class Fault:
    """Why samples are masked: ``function`` did not score ``samples``, ``text`` is the reason.

    ``kind`` "none": every function returned None for them; ``function`` is then empty.
    """

    function: str
    kind: FaultKind
    samples: tuple[int, ...]
    text: str


class NoScores(TightropeError):
    """What a function returned is no list of scores; the message follows the function's name."""

    def __init__(self, kind: FaultKind, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class Log:
    """What one call of a function on ``count`` responses passes to log_extra and log_metric."""

    def __init__(self, count: int) -> None:
        self._count = count
        self.extras: dict[str, list[Any]] = {}
        self._metrics: dict[str, list[float]] = {}

    def extra(self, column: str, values: Sequence[Any]) -> None:
        """Add a column to the samples. ValueError unless there is one entry per response."""
        values = list(values)
        if len(values) != self._count:
            raise ValueError(
                f"log_extra({column!r}) got {len(values)} entries, expected {self._count}, one per response."
            )
        self.extras[str(column)] = values

    def metric(self, name: str, value: float) -> None:
        """Add one value of a metric; values of one name are averaged. TypeError unless it is a number."""
        found = as_number(value)
        if found is None:
            raise TypeError(f"log_metric({name!r}) got None, expected a number.")
        self._metrics.setdefault(str(name), []).append(found)

    def means(self) -> dict[str, float]:
        """The mean of each metric."""
        return {name: math.fsum(values) / len(values) for name, values in self._metrics.items()}


@dataclass(frozen=True)
class Result:
    """What came back in time: ``values``, one entry per response, or the ``error`` that was raised."""

    values: list[Any] | None = None
    error: BaseException | None = None


class Call:
    """One function, called for one batch.

    ``offered``: the arguments it may take, of which it gets copies that it may change. RewardError when it
    wants one that is not offered.
    """

    def __init__(self, name: str, function: RewardFunction, offered: dict[str, Any], count: int) -> None:
        self.log, self._function, self._count = Log(count), function, count
        copies = {key: _copied(value) for key, value in offered.items()}
        copies |= {"log_extra": self.log.extra, "log_metric": self.log.metric}
        self._arguments = _accepted(name, function, copies)

    def run(self) -> Result:
        """Call a plain function, whatever it does; reading its values is part of the call."""
        try:
            return Result(values=_as_list(self._function(**self._arguments), self._count))
        except (Exception, SystemExit) as error:  # user code: what it raises is reported by the caller
            return Result(error=error)

    async def run_async(self) -> Result:
        """The same for an async function."""
        try:
            return Result(values=_as_list(await self._function(**self._arguments), self._count))
        except (Exception, SystemExit, asyncio.CancelledError) as error:
            return Result(error=error)


def is_async(function: RewardFunction) -> bool:
    """Whether calling it gives a coroutine: an ``async def``, a partial of one, an object called by one."""
    return inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(
        getattr(function, "__call__", None)  # noqa: B004 - the method itself is asked for
    )


def as_number(value: Any) -> float | None:
    """A score as a float, None for None. TypeError for what is no real number.

    Whole numbers, truth values and scalars of numpy and torch are numbers; text is none, also "0.5".
    """
    if value is None:
        return None
    if hasattr(value, "item") and getattr(value, "shape", None) == ():
        value = value.item()
    if not isinstance(value, numbers.Real):
        raise TypeError(f"{value!r} is no number")
    try:
        return float(value)
    except OverflowError:
        return math.inf  # too large for a float, of whichever sign: unusable all the same


def describe_error(error: BaseException) -> str:
    """``KeyError: 'answer' (line 12 of rewards.py)``: the innermost line of the user's own file."""
    message = (str(error).splitlines() or [""])[0][:200]
    text = type(error).__name__ + (f": {message}" if message else "")
    ours = (str(Path(__file__).parent), "<frozen")  # and those of the import machinery
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(ours)]
    if not frames:
        return text
    line = [frame.lineno for frame in frames if frame.filename == frames[0].filename][-1]
    return f"{text} (line {line} of {Path(frames[0].filename).name})"


def usable_scores(
    name: str, weight: float, result: Result | None, completions: Sequence[Text], timeout: float | None
) -> tuple[np.ndarray, list[Fault]]:
    """The usable scores of one function, [B] float64 with NaN for the others, and the faults, one a kind.

    ``result`` None: it was not back in time. A score of None gives NaN without a fault: the function does not
    apply. ``weight`` is read only for the size of a score.
    """
    part, everything = np.full(len(completions), np.nan), tuple(range(len(completions)))

    def fault(kind: FaultKind, samples: Sequence[int], text: str) -> Fault:
        return Fault(name, kind, tuple(samples), f"Reward function {name!r} {text}")

    if result is None:
        text = f"was not back after {timeout:g} s. Make it faster, or allow it a longer timeout."
        return part, [fault("timeout", everything, text)]
    if isinstance(result.error, NoScores):
        return part, [fault(result.error.kind, everything, str(result.error))]
    if result.error is not None:
        return part, [fault("exception", everything, f"raised {describe_error(result.error)}.")]
    values = result.values or []
    bad: dict[FaultKind, list[int]] = {}
    for sample, value in enumerate(values):
        try:
            score = as_number(value)
        except TypeError:
            bad.setdefault("type", []).append(sample)
            continue
        if score is None:
            continue
        if abs(weight * score) <= LARGEST:  # False for NaN and infinity, also under the weight 0
            part[sample] = score
        else:
            bad.setdefault("not finite", []).append(sample)
    faults = []
    for kind, samples in bad.items():
        first = values[samples[0]]
        shown = f"the {type(first).__name__} {str(first)[:60]!r}" if kind == "type" else f"{first}"
        text = f"returned {shown} for {where(samples, completions)}, expected a finite number or None."
        faults.append(fault(kind, samples, text))
    return part, faults


def where(samples: Sequence[int] | np.ndarray, completions: Sequence[Text]) -> str:
    """``sample 3 of 64 and 5 more (response 'The film ...')``; counted from 0."""
    text = completions[samples[0]]
    shown = repr((text if isinstance(text, str) else str(text))[:60])
    more = f" and {len(samples) - 1} more" if len(samples) > 1 else ""
    return f"sample {samples[0]} of {len(completions)}{more} (response {shown})"


def _accepted(name: str, function: RewardFunction, offered: dict[str, Any]) -> dict[str, Any]:
    """The arguments among those offered that the function's signature takes; all of them with ``**columns``.

    RewardError when it wants one that is not offered.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # some functions written in C have no signature
        return offered
    for parameter in parameters:
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        by_position = parameter.kind is parameter.POSITIONAL_ONLY
        if parameter.default is parameter.empty and (by_position or parameter.name not in offered):
            near = difflib.get_close_matches(parameter.name, offered, n=1)
            raise RewardError(
                f"Reward function {name!r} wants {parameter.name!r}"
                + (", by position, and arguments are passed by keyword." if by_position else ".")
                + (f" Did you mean {near[0]!r}?" if near and not by_position else "")
                + f" It may take: {', '.join(offered)}; columns of the data are among them."
            )
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return offered
    by_name = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    taken = {parameter.name for parameter in parameters if parameter.kind in by_name}
    return {key: value for key, value in offered.items() if key in taken}


def _as_list(result: Any, count: int) -> list[Any]:
    """What a function returned, as a list of ``count`` entries that are not checked yet."""
    expected = f"expected a list of {count}, one number or None per response, in their order."
    if inspect.isawaitable(result):
        if inspect.iscoroutine(result):
            result.close()  # or Python warns that it was never awaited
        raise NoScores("type", f"returned an awaitable, {expected} Declare it with async def.")
    if hasattr(result, "tolist") and hasattr(result, "shape"):
        if len(result.shape) != 1:
            raise NoScores("type", f"returned an array of shape {tuple(result.shape)}, {expected}")
        result = result.tolist()
    unordered = isinstance(result, str | bytes | dict | set | frozenset)
    if unordered or not isinstance(result, Iterable):
        raise NoScores("type", f"returned {type(result).__name__} {str(result)[:60]!r}, {expected}")
    values = result if isinstance(result, list) else list(itertools.islice(result, count + 1))
    if len(values) != count:
        raise NoScores("length", f"returned {len(values)} scores, {expected}")
    return values


def _copied(value: Any) -> Any:
    """A list, and the lists and messages directly in it, copied; anything else as it is."""
    if type(value) is not list:
        return value
    return [[_message_copied(part) for part in item] if type(item) is list else item for item in value]


def _message_copied(part: Any) -> Any:
    return dict(part) if type(part) is dict else part


class Overdue(TightropeError):
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
            except BaseException as error:  # whatever it is, the caller gets it
                future.set_exception(error)
        del job, future, function  # a waiting thread must not keep a batch in memory


class EventLoop:
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
            threading.Thread(target=_run_event_loop, args=(self._loop,), name=self._name, daemon=True).start()
            weakref.finalize(self, self._loop.call_soon_threadsafe, self._loop.stop)
        futures = [asyncio.run_coroutine_threadsafe(function(), self._loop) for function in functions]
        wait(futures, timeout)
        return [None if future.cancel() else future.result() for future in futures]


def _run_event_loop(loop: asyncio.AbstractEventLoop) -> None:
    asyncio.set_event_loop(loop)
    loop.run_forever()
    left = asyncio.all_tasks(loop)
    for task in left:
        task.cancel()
    if left:
        loop.run_until_complete(asyncio.wait(left, timeout=1.0))
    loop.run_until_complete(loop.shutdown_asyncgens())
    loop.close()
