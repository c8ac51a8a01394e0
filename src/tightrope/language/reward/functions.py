"""Scores of whole responses from Python functions, called as TRL calls them.

    def reward(prompts, completions, completion_ids, **columns) -> list[float | None]

A function may be plain or ``async``; all arguments are passed by keyword. It cannot spoil a run:
when it hangs, raises, or returns NaN or the wrong number of scores, the result is a `RewardError` that names
it, or samples that are masked and counted, never a wrong number.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.util
import inspect
import itertools
import math
import re
import sys
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tightrope.language.reward.call import (
    Caller,
    Fault,
    FaultKind,
    Outcome,
    RewardError,
    RewardFunction,
    Text,
    as_number,
    describe_error,
    samples_text,
)
from tightrope.runs import signals

# What is a mistake in the code raises by default; what the data or the world does masks the samples.
RAISES: tuple[FaultKind, ...] = ("exception", "length", "type")
EMPTY_BATCHES = 3
NOT_COLUMNS = ("prompt", "completion", "completion_ids")
ARGUMENTS = ("prompts", "completions", "trainer_state", "log_extra", "log_metric")


@dataclass(frozen=True, eq=False)
class Scores:
    """The scores of B responses.

    ``total`` [B] float64: sum over functions of weight times score, NaN where not ``valid`` [B] bool, so that
    a forgotten mask cannot pass for a score. ``parts``: each function's own scores [B], before its weight,
    NaN where it does not apply or failed. ``metrics``, under declared names: the mean of each part
    (``scores/NAME``), what log_metric got (``logged/NAME``), and how many samples a function failed to score
    (``rewards/NAME/errors``, ``rewards/NAME/timeouts``; absent: none). ``extras``:
    columns of B entries from log_extra. ``faults``: why samples are masked, one per function and kind.
    """

    total: np.ndarray
    valid: np.ndarray
    parts: dict[str, np.ndarray]
    metrics: dict[str, float]
    extras: dict[str, list[Any]]
    faults: list[Fault] = field(default_factory=list)


class Rewards:
    """Several reward functions with weights, as one.

    ``functions``: callables or (callable, weight) pairs. ``names``: one each; by default the functions' own.
    ``timeout``: seconds a function may take for a batch. One that takes longer is left in a thread
    (Python cannot kill one) and its samples are masked. None: no limit, and plain functions run in the
    caller's thread. ``on_error``: "mask" masks and counts the samples of every fault, "raise" raises
    RewardError for every fault; None raises for mistakes in the code (exceptions, wrong length, wrong type)
    and masks for what the data or the outside world does (NaN, infinity, timeouts). A score of None is no
    fault: the function does not apply to that sample. A sample that no function applies to is always masked.
    ``alone`` False: something else scores the responses too, and batches to which no function applies are no
    error.

    Raises ValueError for no function, something that cannot be called, a weight that is not finite, names
    that do not fit.
    """

    def __init__(
        self,
        functions: Sequence[RewardFunction | tuple[RewardFunction, float]],
        names: Sequence[str] | None = None,
        timeout: float | None = 300.0,
        on_error: Literal["mask", "raise"] | None = None,
        alone: bool = True,
    ) -> None:
        pairs = [item if isinstance(item, tuple) else (item, 1.0) for item in functions]
        for function, _ in pairs:
            if not callable(function):
                raise ValueError(
                    f"A reward function is the {type(function).__name__} {function!r}, expected a callable."
                )
        self.functions = [function for function, _ in pairs]
        self.weights = [checked_weight(weight) for _, weight in pairs]
        self.names = _checked_names(self.functions, names)
        if timeout is not None and not 0 < timeout < math.inf:
            raise ValueError(f"timeout is {timeout}, expected seconds above 0, or None for no limit.")
        if on_error not in (None, "mask", "raise"):
            raise ValueError(f"on_error is {on_error!r}, expected 'mask', 'raise' or None.")
        self.on_error, self.alone = on_error, alone
        self._caller = Caller(self.functions, self.names, timeout)
        self._empty_batches = 0

    def score(
        self,
        prompts: Sequence[Text],
        completions: Sequence[Text],
        completion_ids: Sequence[Sequence[int]],
        columns: Mapping[str, Sequence[object]] | None = None,
        trainer_state: object = None,
    ) -> Scores:
        """Score B responses. ``columns``: the data's other columns, B entries each.

        Functions may change the lists they are given: each gets copies. Raises RewardError as above,
        for a function that wants what is not offered, and when three batches in a row have not one valid
        sample: nothing would be learnt. Raises ValueError when lengths differ, or a column has the name of
        an argument.
        """
        columns = {name: list(v) for name, v in (columns or {}).items() if name not in NOT_COLUMNS}
        lists = {"completions": completions, "completion_ids": completion_ids, **columns}
        for name, values in lists.items():
            if len(values) != len(prompts):
                raise ValueError(
                    f"{name} has {len(values)} entries, expected {len(prompts)}, one per prompt."
                )
        taken = [name for name in columns if name in ARGUMENTS]
        if taken:
            raise ValueError(
                f"The data's column {taken[0]!r} has the name of an argument; rename the column."
            )
        offered = {
            "prompts": list(prompts),
            "completions": list(completions),
            "completion_ids": [list(ids) for ids in completion_ids],
            "trainer_state": trainer_state,
            **columns,
        }
        outcomes = self._caller.outcomes(offered, completions, self.weights) if len(prompts) else []
        scores = self._joined(outcomes, completions)
        self._refuse_to_learn_nothing(scores)
        return scores

    def _joined(self, outcomes: list[Outcome], completions: Sequence[Text]) -> Scores:
        """All functions' scores, weighted and added up. RewardError for a fault that the settings raise."""
        count = len(completions)
        total, applies, broken = np.zeros(count), np.zeros(count, bool), np.zeros(count, bool)
        found = Scores(total, applies, {name: np.full(count, np.nan) for name in self.names}, {}, {})
        for name, weight, outcome in zip(self.names, self.weights, outcomes, strict=False):
            for fault in outcome.faults:
                if self.on_error == "raise" or (self.on_error is None and fault.kind in RAISES):
                    raise RewardError(fault.text) from outcome.error
                broken[list(fault.samples)] = True
                counter = f"rewards/{name}/{'timeouts' if fault.kind == 'timeout' else 'errors'}"
                found.metrics[counter] = found.metrics.get(counter, 0.0) + len(fault.samples)
            found.faults.extend(outcome.faults)
            scored = ~np.isnan(outcome.scores)
            total[scored] += weight * outcome.scores[scored]
            applies |= scored
            found.parts[name] = outcome.scores
            if scored.any():
                found.metrics[f"scores/{name}"] = float(outcome.scores[scored].mean())
            found.metrics.update(outcome.metrics)
            for column, entries in outcome.extras.items():
                found.extras[f"{column} ({name})" if column in found.extras else column] = entries
        nobody = np.flatnonzero(~applies & ~broken)
        if len(nobody):
            text = f"No reward function applies to {samples_text(nobody, completions)}: all returned None."
            found.faults.append(Fault("", "none", tuple(nobody.tolist()), text))
        valid = applies & ~broken
        return dataclasses.replace(found, total=np.where(valid, total, np.nan), valid=valid)

    def _refuse_to_learn_nothing(self, scores: Scores) -> None:
        lost = self.alone or any(fault.kind != "none" for fault in scores.faults)
        if scores.valid.any():
            self._empty_batches = 0
        elif len(scores.valid) and lost:
            self._empty_batches += 1
        if self._empty_batches >= EMPTY_BATCHES:
            raise RewardError(
                f"Not one response of the last {self._empty_batches} batches has a score, so that nothing "
                f"can be learnt. The last reason: {scores.faults[-1].text}"
            )


def checked_weight(weight: object) -> float:
    """The weight as a float. ValueError for what is not a finite number."""
    value = None if isinstance(weight, str) else as_number(weight)
    if value is None or not math.isfinite(value):
        raise ValueError(f"The weight of a reward function is {weight!r}, expected a finite number.")
    return value


def _checked_names(functions: list[RewardFunction], names: Sequence[str] | None) -> list[str]:
    """The names given, or those of the functions; equal ones are numbered."""
    if not functions:
        raise ValueError("There is no reward function. Give at least one callable.")
    if names is not None:
        if len(names) != len(functions) or len(set(names)) != len(names) or not all(names):
            raise ValueError(f"The reward names are {list(names)}, expected {len(functions)} different ones.")
        return list(names)
    found: list[str] = []
    for function in functions:
        plain = function.func if isinstance(function, partial) else function
        word = re.sub(r"\W+", "_", getattr(plain, "__name__", type(plain).__name__)).strip("_") or "reward"
        found.append(unique_name(found, word))
    return found


def unique_name(taken: Container[str], word: str) -> str:
    """The word, with a number where it is taken."""
    names = itertools.chain([word], (f"{word}_{count}" for count in itertools.count(2)))
    return next(name for name in names if name not in taken)


def length(completion_ids: list[list[int]], **_: object) -> list[float]:
    """The reward for trying things out: tokens of each response."""
    return [float(len(ids)) for ids in completion_ids]


def load_reward_function(word: str) -> RewardFunction:
    """The reward function that the user named: ``length``, or ``FILE.py:function``, whose file is run.

    Only ever call this with what the user typed now, never with a word from a file: it runs code.
    RewardError for a word of another form, no such file, one that cannot be run, or no such function in it.
    """
    if word == "length":
        return length
    file, colon, name = word.rpartition(":")
    if not colon or not file.endswith(".py") or not name:
        near = " Did you mean 'length'?" if difflib.get_close_matches(word, ["length"]) else ""
        raise RewardError(
            f"There is no reward {word!r}. Looked for: 'length', FILE.py:function, as in judge.py:score, and "
            f"the folder of a reward model (none of that name).{near}"
        )
    path = Path(file)
    if not path.is_file():
        raise RewardError(f"The reward {word!r}: there is no file {file}.")
    # a separate name, so that a file called json.py does not take the place of a module in use
    spec = importlib.util.spec_from_file_location(f"reward_file_{path.stem}", path.resolve())
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.resolve().parent))  # files beside it can be imported, also later
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        del sys.modules[spec.name]
        if signals.is_signal(error):
            raise
        raise RewardError(f"The reward {word!r}: the file cannot be run, {describe_error(error)}.") from error
    function = getattr(module, name, None)
    if not callable(function):
        there = [key for key, value in vars(module).items() if inspect.isfunction(value) and key[0] != "_"]
        raise RewardError(
            f"The reward {word!r}: {path.name} has no function {name!r}; it has {', '.join(there) or 'none'}."
        )
    return function
