"""Faults of environments: how they are described, checked for, and answered by a restart.

An `EnvironmentFault` names the environment, its process, the step, the seed and the action, and includes the
traceback of the environment's own error. A `FaultPolicy` decides whether the run ends or the environment is
restarted. `Restarts` is the one loop that restarts, for single environments, processes and vector
environments.
"""

from __future__ import annotations

import dataclasses
import math
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tightrope.errors import TightropeError
from tightrope.runs import signals

FIRST_PAUSE = 0.05  # seconds before the first restart; doubled each time
LONGEST_PAUSE = 2.0
FLOAT32_MAX = float(np.finfo(np.float32).max)
_T = TypeVar("_T")


@dataclass(eq=False, repr=False)
class EnvironmentFault(TightropeError, RuntimeError):
    """An environment raised, hung or broke Gymnasium's API, or its process died.

    ``index``: which environment (-1: unknown). ``step``: since all were reset. ``worker``: its process (0:
    this one). ``seed``: of its last seeded reset. ``action``: its last one, as text. ``lost``: its process is
    gone or does not answer.
    """

    message: str
    index: int = -1
    step: int = -1
    env_id: str = ""
    worker: int = 0
    seed: int | None = None
    action: str | None = None
    lost: bool = False

    def __post_init__(self) -> None:
        super().__init__(self.message)

    def record(self) -> dict[str, Any]:
        """The arguments but ``lost``, as JSON, from which another process can build this fault again."""
        return {name: value for name, value in dataclasses.asdict(self).items() if name != "lost"}


class FailedEpisode(NamedTuple):
    """The episode of a copy that failed: the seed of its last seeded reset, how many episodes began since,
    what the copy carried there (and whether that is no longer known), and its actions since, as the
    environment got them, the failing one last: how many, and in terms of its action space's ``to_jsonable``;
    None where they are more than ``replay_limit``.
    """

    copy: int
    seed: int
    after: int
    carried: Any
    carried_lost: bool
    steps: int
    actions: Any


class ApiBreak(TightropeError):
    """An environment returned what Gymnasium's API does not allow; becomes an EnvironmentFault.

    ``index``: the row of a vector environment that did (-1: all, or unknown).
    """

    def __init__(self, message: str, index: int = -1) -> None:
        super().__init__(message)
        self.index = index


class EnvironmentTimeout(BaseException):
    """An environment of this process exceeded its time limit.

    A BaseException: an ``except Exception`` in the environment must not catch it.
    """


# what counts as a fault of an environment; `raise_signal` leaves out what is a signal to this process
RAISED = (Exception, SystemExit, GeneratorExit, KeyboardInterrupt, EnvironmentTimeout)


def raise_signal(error: BaseException) -> None:
    """Raise an error that is a signal to this process, or that took the place of one; another one is a fault
    of the environment, also a KeyboardInterrupt of its own.
    """
    if signals.is_signal(error):
        raise error
    signals.raise_if_stopped()


class FaultPolicy(NamedTuple):
    """What happens after a fault: the settings on_env_fault, max_env_restarts and env_timeout."""

    restart: bool = False
    max_restarts: int = 0
    timeout: float | None = 60.0


def policy_of(settings: Any) -> FaultPolicy:
    """The policy that a run's settings ask for."""
    return FaultPolicy(settings.on_env_fault == "restart", settings.max_env_restarts, settings.env_timeout)


# ------------------------------------------------------------------------------------------------- restarts


class Restarts:
    """Counts restarts, and restarts until it works or the policy's limit is reached."""

    def __init__(self, policy: FaultPolicy) -> None:
        self.policy = policy
        self.count = 0

    def until_it_works(
        self,
        fault: EnvironmentFault,
        attempt: Callable[[], _T],
        explain: Callable[[BaseException], EnvironmentFault],
    ) -> _T:
        """Return ``attempt()``, called again after each fault in it.

        ``explain`` turns what ``attempt`` raised into a fault, or raises. Raises the last fault when the
        limit is reached.
        """
        while True:
            if self.count >= self.policy.max_restarts:
                raise self.given_up(fault) from fault.__cause__
            self.count += 1
            try:
                return attempt()
            except RAISED as error:
                fault = explain(error)

    def given_up(self, fault: EnvironmentFault) -> EnvironmentFault:
        """The fault that ends the run when the limit is reached."""
        message = (
            f"{fault}\nEnvironments were restarted {self.count} times; max_env_restarts allows no more. Fix "
            "the environment, or allow more."
        )
        return dataclasses.replace(fault, message=message, lost=False)


def pause(restarts: int, timeout: float | None) -> float:
    """Seconds to wait before the n-th restart; well below the time limit."""
    longest = LONGEST_PAUSE if timeout is None else min(LONGEST_PAUSE, timeout / 4)
    return min(longest, FIRST_PAUSE * 2.0 ** min(restarts - 1, 20))


def wait_before_restart(restarts: int, policy: FaultPolicy) -> None:
    """Sleep for `pause`."""
    time.sleep(pause(restarts, policy.timeout))


# ------------------------------------------------------------------------------------------------- messages


def explained(
    error: BaseException,
    who: str,
    index: int,
    step: int,
    *,
    env_id: str,
    worker: int,
    seed: int | None,
    action: str | None,
    advice: str = "",
) -> EnvironmentFault:
    """The fault for an error of ``who``; the environment's own errors come with their traceback. A signal is
    raised again.
    """
    raise_signal(error)
    api = isinstance(error, ApiBreak)
    if isinstance(error, EnvironmentTimeout):
        what = f"was {error}"
    elif api or raised_here(error):
        what = f"does not follow Gymnasium's API: {error}"
    else:
        what = f"raised {type(error).__name__}: {error}"
    message = f"{who} at step {step} {what}{circumstances(worker, seed, action)}{advice}"
    if not api:
        message += "\n" + "".join(traceback.format_exception(error)).rstrip()
    fault = EnvironmentFault(message, index, step, env_id=env_id, worker=worker, seed=seed, action=action)
    fault.__cause__ = error
    return fault


def fault_while(doing: str, index: int, error: BaseException) -> EnvironmentFault:
    """The fault for an error of an environment's own code in its constructor or in ``close``. A signal is
    raised again.
    """
    raise_signal(error)
    late = isinstance(error, EnvironmentTimeout)
    what = f"was {error}" if late else f"raised {type(error).__name__}: {error}"
    who = f"environment {index}" if index >= 0 else "the vector environment"
    trace = "".join(traceback.format_exception(error)).rstrip()
    return EnvironmentFault(f"{doing} {who} {what}. Mend it there.\n{trace}", index)


def circumstances(worker: int, seed: int | None, action: str | None) -> str:
    """`` (worker 2, seed 7, last action 1)``."""
    who = f"worker {worker}" if worker else "in this process"
    return f" ({who}, seed {seed}, {'no action yet' if action is None else f'last action {action}'})"


def action_text(action: object) -> str:
    """An action in at most 80 characters."""
    text = " ".join(str(action).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def raised_here(error: BaseException) -> bool:
    """Whether this library raised it, because it could not use what an environment returned."""
    frames = traceback.extract_tb(error.__traceback__)
    control = Path(__file__).parents[1]
    return bool(frames) and control in Path(frames[-1].filename).parents


def kind_of(value: object) -> str:
    """A value in a few words for an error message."""
    if isinstance(value, tuple):
        return f"a tuple of {len(value)} values"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return f"a {type(value).__name__}"


# --------------------------------------------------------------------------------------------------- checks


def float_parts(inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
    """The inputs that can hold a NaN, each with its rows' numbers in one axis: [N, K]."""
    return [x.reshape(len(x), math.prod(x.shape[1:])) for x in inputs.values() if x.dtype.kind == "f"]


def first_unusable(numbers: ArrayLike) -> tuple[int, ...] | None:
    """The index of the first number that is NaN, infinite or beyond float32, in which the networks learn;
    None when every number can be used.
    """
    good = np.abs(numbers) <= FLOAT32_MAX  # False for NaN
    return None if good.all() else tuple(int(i) for i in np.argwhere(~good)[0])


def require_finite(inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The inputs as they are. ValueError for a NaN or an infinity, from which any action could follow."""
    for numbers in float_parts(inputs):
        found = first_unusable(numbers)
        if found is not None:
            row, index = found
            raise ValueError(
                f"observation {row} holds {numbers[row, index]} at index {index}; expected finite numbers of "
                f"at most {FLOAT32_MAX:.2g}."
            )
    return inputs


def check_finite(what: str, numbers: ArrayLike) -> None:
    """ApiBreak for the first number that cannot be used (see `first_unusable`)."""
    index = first_unusable(numbers)
    if index is not None:
        place = f" at index {', '.join(map(str, index))}" if index else ""
        raise ApiBreak(f"{what} = {np.asarray(numbers)[index]}{place}, expected finite numbers")
