"""One batch for every reward function: what each is given, how long it may take, and what came back.

Python cannot kill a thread. A call that is not back at its deadline is left behind in a daemon thread, which
stops neither the program nor the end of the process; what it returns later is thrown away. A plain function
is not called again before it is back, so that at most one thread per function is lost.
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
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tightrope.errors import TightropeError
from tightrope.runs import signals

Text = str | list[dict[str, Any]]
RewardFunction = Callable[..., Any]
FaultKind = Literal["exception", "length", "type", "not finite", "timeout", "none"]
LARGEST = 1e30  # above it a score, or a sum of weighted ones, would be infinite in float32


IN_MAIN_THREAD = (
    " It uses a signal (signal.alarm), which Python allows in the main thread alone, and a function with a "
    "time limit runs in another one: give reward_timeout=None (--reward-timeout none), or leave its own out."
)


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
    """What a function returned is not a list of scores; the message follows the function's name."""

    def __init__(self, kind: FaultKind, text: str) -> None:
        super().__init__(text)
        self.kind = kind


@dataclass(eq=False)
class Outcome:
    """What one function gave for a batch: ``scores`` [B] float64, NaN where it gave none; why it failed
    (``faults``, one per kind, and the ``error`` that was raised); and what it logged.
    """

    scores: np.ndarray
    faults: list[Fault] = field(default_factory=list)
    error: BaseException | None = None
    metrics: dict[str, float] = field(default_factory=dict)
    extras: dict[str, list[Any]] = field(default_factory=dict)


class JobThread:
    """A daemon thread that runs one piece of work after the other; it starts with the first one."""

    def __init__(self, name: str, at_end: Callable[[], None] = lambda: None) -> None:
        self._name, self._at_end = name, at_end
        self._jobs: queue.SimpleQueue[tuple[Future[None], Callable[[], None]] | None] | None = None

    def run(self, work: Callable[[], None], timeout: float | None) -> None:
        """Wait until ``work()`` is done, at most ``timeout`` seconds, earlier work included.

        Work that has not begun by then never begins. Raises what ``work`` raises.
        """
        if self._jobs is None:
            self._jobs = queue.SimpleQueue()
            arguments = (self._jobs, self._at_end)
            threading.Thread(target=_serve, args=arguments, name=self._name, daemon=True).start()
            weakref.finalize(self, self._jobs.put, None)
        future: Future[None] = Future()
        self._jobs.put((future, work))
        _, late = wait([future], timeout)
        if not late or not (future.cancel() or future.running()):
            future.result()


def _serve(
    jobs: queue.SimpleQueue[tuple[Future[None], Callable[[], None]] | None], at_end: Callable[[], None]
) -> None:
    while (job := jobs.get()) is not None:
        future, work = job
        if future.set_running_or_notify_cancel():
            try:
                future.set_result(work())
            except BaseException as error:  # the caller gets it
                future.set_exception(error)
        del job, future, work  # a waiting thread must not keep a batch in memory
    at_end()


class Caller:
    """Calls several functions for the same batch, each within ``timeout`` seconds (None: no limit)."""

    def __init__(
        self, functions: Sequence[RewardFunction], names: Sequence[str], timeout: float | None
    ) -> None:
        self.functions, self.names, self.timeout = functions, names, timeout
        self._workers = [JobThread(f"reward {name}") for name in names]
        # one event loop for all batches: a client that user code keeps belongs to the loop it was made in
        self._loop = asyncio.Runner()
        self._loop_worker = JobThread("async rewards", self._loop.close)

    def outcomes(
        self, offered: dict[str, object], completions: Sequence[Text], weights: Sequence[float]
    ) -> list[Outcome]:
        """Call the plain functions in order, then the async ones together.

        ``offered``: the arguments that a function may take; each gets copies. RewardError for a function that
        wants another one. A score counts when it is finite, as is its product with the function's weight.
        """
        pairs = zip(self.names, self.functions, strict=True)
        calls = [_Call(name, function, offered, len(completions)) for name, function in pairs]
        together = []
        for call, worker in zip(calls, self._workers, strict=True):
            if is_async(call.function):
                together.append(call)
            elif self.timeout is None:
                call.run()
            else:
                worker.run(call.run, self.timeout)
        if together:
            self._loop_worker.run(lambda: self._loop.run(_all(together, self.timeout)), self.timeout)
        return [
            call.outcome(weight, completions, self.timeout)
            for call, weight in zip(calls, weights, strict=True)
        ]


class _Call:
    """One function, called for one batch of ``count`` responses."""

    def __init__(self, name: str, function: RewardFunction, offered: dict[str, object], count: int) -> None:
        self.name, self.function, self._count = name, function, count
        self._extras: dict[str, list[Any]] = {}
        self._metrics: dict[str, list[float]] = {}
        self._back: list[object] | BaseException | None = None  # what came back: None, as long as nothing has
        self.late = False
        copies = {key: _copied(value) for key, value in offered.items()}
        copies |= {"log_extra": self._log_extra, "log_metric": self._log_metric}
        self._arguments = _accepted(name, function, copies)

    def _log_extra(self, column: str, values: Sequence[object]) -> None:
        """Add a column to the samples. ValueError unless there is one entry per response."""
        values = list(values)
        if len(values) != self._count:
            raise ValueError(
                f"log_extra({column!r}) got {len(values)} entries, expected {self._count}, one per response."
            )
        self._extras[str(column)] = values

    def _log_metric(self, name: str, value: float) -> None:
        """Add one value of a metric; values of one name are averaged. TypeError unless it is a number."""
        found = as_number(value)
        if found is None:
            raise TypeError(f"log_metric({name!r}) got None, expected a number.")
        self._metrics.setdefault(str(name), []).append(found)

    def run(self) -> None:
        """Call a plain function and keep what it returns or raises; its values are read in the call too."""
        try:
            self._keep(_as_list(self.function(**self._arguments), self._count))
        except (Exception, SystemExit, KeyboardInterrupt) as error:  # user code: what it raises is a fault
            if signals.is_signal(error):
                raise
            self._keep(error)

    async def run_async(self) -> None:
        """The same for an async function."""
        try:
            self._keep(_as_list(await self.function(**self._arguments), self._count))
        except (Exception, SystemExit, KeyboardInterrupt, asyncio.CancelledError) as error:
            if signals.is_signal(error):
                raise
            self._keep(error)

    def _keep(self, back: list[object] | BaseException) -> None:
        if not self.late:  # a late call may return something when it is cancelled
            self._back = back

    def outcome(self, weight: float, completions: Sequence[Text], timeout: float | None) -> Outcome:
        """What came back in time, checked. A score of None is NaN without a fault: the function does not
        apply. ``weight`` is read only for the size of a score.
        """
        back, found = self._back, Outcome(np.full(self._count, np.nan))

        def fault(kind: FaultKind, samples: Iterable[int], text: str) -> None:
            text = f"Reward function {self.name!r} {text}"
            found.faults.append(Fault(self.name, kind, tuple(samples), text))

        if back is None:
            late = f"was not back after {timeout:g} s. Make it faster, or allow it a longer timeout."
            fault("timeout", range(self._count), late)
        elif isinstance(back, NoScores):
            fault(back.kind, range(self._count), str(back))
        elif isinstance(back, BaseException):
            advice = IN_MAIN_THREAD if timeout is not None and _wants_main_thread(back) else ""
            fault("exception", range(self._count), f"raised {describe_error(back)}.{advice}")
        if not isinstance(back, list):
            found.error = back
            return found
        for kind, samples in _read_scores(back, weight, found.scores).items():
            first = back[samples[0]]
            shown = f"the {type(first).__name__} {str(first)[:60]!r}" if kind == "type" else f"{first}"
            place = samples_text(samples, completions)
            fault(kind, samples, f"returned {shown} for {place}, expected a finite number or None.")
        found.metrics = {
            f"logged/{name}": math.fsum(values) / len(values) for name, values in self._metrics.items()
        }
        found.extras = self._extras
        return found


async def _all(calls: Sequence[_Call], timeout: float | None) -> None:
    """Run async functions together and cancel those that are late. One that blocks the loop makes all others
    late too: Python runs them in one thread.
    """
    tasks = {asyncio.ensure_future(call.run_async()): call for call in calls}
    _, late = await asyncio.wait(tasks, timeout=timeout)
    for task in late:
        tasks[task].late = True
        task.cancel()


def is_async(function: RewardFunction) -> bool:
    """Whether calling it gives a coroutine: an ``async def``, a partial of one, an object called by one."""
    return inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(
        getattr(function, "__call__", None)  # noqa: B004 - the method itself is asked for
    )


def as_number(value: object) -> float | None:
    """A score as a float, None for None. TypeError for what is not a real number.

    Whole numbers, truth values and scalars of numpy and torch are numbers; text is none, also "0.5".
    """
    if value is None:
        return None
    if hasattr(value, "item") and getattr(value, "shape", None) == ():
        value = value.item()
    if not isinstance(value, numbers.Real):
        raise TypeError(f"{value!r} is not a number")
    try:
        return float(value)
    except OverflowError:
        return math.inf  # too large for a float, of either sign: not usable


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


def _wants_main_thread(error: BaseException | None) -> bool:
    """Whether this error, or one that led to it, is that of a signal in another thread."""
    while error is not None:
        if "signal" in str(error) and "thread" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def samples_text(samples: Sequence[int] | np.ndarray, completions: Sequence[Text]) -> str:
    """Samples in words, counted from 0: ``sample 3 of 64 and 5 more (response 'The film ...')``."""
    shown = repr(str(completions[samples[0]])[:60])
    more = f" and {len(samples) - 1} more" if len(samples) > 1 else ""
    return f"sample {samples[0]} of {len(completions)}{more} (response {shown})"


def _read_scores(values: Sequence[object], weight: float, scores: np.ndarray) -> dict[FaultKind, list[int]]:
    """Write the usable values into ``scores``; returns which are not, by the kind of fault."""
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
            scores[sample] = score
        else:
            bad.setdefault("not finite", []).append(sample)
    return bad


def _accepted(name: str, function: RewardFunction, offered: dict[str, object]) -> dict[str, object]:
    """The arguments among those offered that the function's signature takes; all of them with ``**columns``.

    RewardError when it wants one that is not offered.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # some functions written in C have no signature
        return offered
    named = [p for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    for parameter in named:
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
    taken = {parameter.name for parameter in named if parameter.kind is not parameter.POSITIONAL_ONLY}
    return {key: value for key, value in offered.items() if key in taken}


def _as_list(result: object, count: int) -> list[object]:
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


def _copied(value: object) -> object:
    """Lists and the messages in them, copied; anything else as it is."""
    if type(value) is list:
        return [_copied(item) for item in value]
    return dict(value) if type(value) is dict else value
