"""One call of a reward function: what it is given, and what came back, before anything is believed."""

from __future__ import annotations

import asyncio
import difflib
import inspect
import itertools
import math
import numbers
import traceback
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

Text = str | list[dict[str, Any]]
RewardFunction = Callable[..., Any]
FaultKind = Literal["exception", "length", "type", "not finite", "timeout", "none"]
LARGEST = 1e30  # above it a score, or a sum of weighted ones, would be infinite in float32


class RewardError(ValueError):
    """A reward function cannot be used as it is; the message names it, and says what to do."""


@dataclass(frozen=True)
class Fault:
    """Why samples are masked: ``function`` did not score ``samples``, ``text`` says how.

    ``kind`` "none": every function returned None for them; ``function`` is then empty.
    """

    function: str
    kind: FaultKind
    samples: tuple[int, ...]
    text: str


class NoScores(Exception):
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
        found = number(value)
        if found is None:
            raise TypeError(f"log_metric({name!r}) got None, expected a number.")
        self._metrics.setdefault(str(name), []).append(found)

    def means(self) -> dict[str, float]:
        """The mean of each metric."""
        return {name: math.fsum(values) / len(values) for name, values in self._metrics.items()}


@dataclass(frozen=True)
class Answer:
    """What came back in time: ``values``, one entry per response, or the ``error`` that was raised."""

    log: Log
    values: list[Any] | None = None
    error: BaseException | None = None


def answer_of(call: Callable[[], Any], log: Log, count: int) -> Answer:
    """The answer of a plain function, whatever it does; reading its values is part of the call."""
    try:
        return Answer(log, values=_listed(call(), count))
    except (Exception, SystemExit) as error:  # user code: what it raises is reported by whoever asked
        return Answer(log, error=error)


def awaiting(
    call: Callable[[], Awaitable[Any]], log: Log, count: int
) -> Callable[[], Coroutine[Any, Any, Answer]]:
    """The same for an async function, as a coroutine function without arguments."""

    async def answer() -> Answer:
        try:
            return Answer(log, values=_listed(await call(), count))
        except (Exception, SystemExit, asyncio.CancelledError) as error:
            return Answer(log, error=error)

    return answer


def is_async(function: RewardFunction) -> bool:
    """Whether calling it gives a coroutine: an ``async def``, a partial of one, an object called by one."""
    return inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(
        getattr(function, "__call__", None)  # noqa: B004 - the method itself is asked for
    )


def accepted(name: str, function: RewardFunction, offered: dict[str, Any]) -> dict[str, Any]:
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


def own_copy(text: Text) -> Text:
    """A prompt or response that its reader may change."""
    return text if isinstance(text, str) else [dict(message) for message in text]


def number(value: Any) -> float | None:
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


def told(error: BaseException) -> str:
    """``KeyError: 'answer' (line 12 of rewards.py)``: the innermost line of the user's own file."""
    message = (str(error).splitlines() or [""])[0][:200]
    text = type(error).__name__ + (f": {message}" if message else "")
    ours = (str(Path(__file__).parent), "<frozen")  # and those of the import machinery
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(ours)]
    if not frames:
        return text
    line = [frame.lineno for frame in frames if frame.filename == frames[0].filename][-1]
    return f"{text} (line {line} of {Path(frames[0].filename).name})"


def _listed(result: Any, count: int) -> list[Any]:
    """What a function returned, as a list of ``count`` entries that are still to be judged."""
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


def judged(
    name: str, weight: float, values: list[Any], completions: Sequence[Text]
) -> tuple[np.ndarray, list[Fault]]:
    """The usable scores of one function, [B] float64 with NaN for the others, and the faults, one a kind.

    None gives NaN without a fault: the function does not apply. ``weight`` matters for the size alone.
    """
    part = np.full(len(values), np.nan)
    bad: dict[FaultKind, list[int]] = {}
    for sample, value in enumerate(values):
        try:
            score = number(value)
        except TypeError:
            bad.setdefault("type", []).append(sample)
            continue
        if score is None:
            continue
        if abs(weight * score) <= LARGEST:  # False for NaN and infinity, under the weight 0, too
            part[sample] = score
        else:
            bad.setdefault("not finite", []).append(sample)
    faults = []
    for kind, samples in bad.items():
        first = values[samples[0]]
        shown = f"the {type(first).__name__} {str(first)[:60]!r}" if kind == "type" else f"{first}"
        text = f"returned {shown} for {place(samples, completions)}, expected a finite number or None."
        faults.append(Fault(name, kind, tuple(samples), text))
    return part, faults


def place(samples: Sequence[int] | np.ndarray, completions: Sequence[Text]) -> str:
    """``sample 3 of 64 and 5 more (response 'The film ...')``; counted from 0."""
    text = completions[samples[0]]
    shown = repr((text if isinstance(text, str) else str(text))[:60])
    more = f" and {len(samples) - 1} more" if len(samples) > 1 else ""
    return f"sample {samples[0]} of {len(completions)}{more} (response {shown})"
