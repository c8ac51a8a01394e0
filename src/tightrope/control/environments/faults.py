"""What an environment may do wrong, how it is named, and what is done about it.

An `EnvironmentFault` says which copy, in which process, at which step, under which seed and action; the
traceback of the environment's own error is part of it. A `FaultPolicy` says whether the run ends with it or
the copy is made anew.
"""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tightrope.control.spaces import MASK_KEY

FIRST_PAUSE, LONGEST_PAUSE = 0.05, 2.0  # seconds before a copy is made anew; doubled each time


class EnvironmentFault(RuntimeError):
    """An environment raised, hung, broke Gymnasium's API, or its process died; the message says all of it.

    ``index`` of the copy (-1: not known which), ``step`` since the last reset of all, ``env_id``, ``worker``
    (0: this process), ``seed`` of the copy's last seeded reset, ``action``: the last one, as text. ``lost``:
    the process that stepped the copy is gone or does not answer.
    """

    def __init__(
        self,
        message: str,
        index: int = -1,
        step: int = -1,
        *,
        env_id: str = "",
        worker: int = 0,
        seed: int | None = None,
        action: str | None = None,
        lost: bool = False,
    ) -> None:
        super().__init__(message)
        self.index, self.step, self.env_id, self.worker = index, step, env_id, worker
        self.seed, self.action, self.lost = seed, action, lost

    def record(self) -> dict[str, Any]:
        """What JSON needs to build it again in another process."""
        facts = {name: getattr(self, name) for name in ("env_id", "worker", "seed", "action")}
        return {"message": str(self), "index": self.index, "step": self.step, **facts}


class ApiBreak(Exception):
    """What an environment gave that Gymnasium's API does not allow; becomes an EnvironmentFault."""


class Overdue(BaseException):
    """An environment of this process was not back in time; no ``except Exception`` of its own holds it."""


# what counts as an environment's fault: a signal to this process does not
RAISED = (Exception, SystemExit, GeneratorExit, Overdue)


class FaultPolicy(NamedTuple):
    """What happens after a fault: the settings on_env_fault, max_env_restarts and env_timeout."""

    restart: bool = False
    max_restarts: int = 0
    timeout: float | None = 60.0


def policy_of(settings: Any) -> FaultPolicy:
    """The policy that a run's settings ask for."""
    return FaultPolicy(settings.on_env_fault == "restart", settings.max_env_restarts, settings.env_timeout)


def renewed_seed(seed: int, renewals: int, index: int) -> int:
    """The seed of a copy that was made anew: of the seed of all, how often, and which copy; nothing else."""
    return int(np.random.SeedSequence([seed, renewals, index]).generate_state(1)[0])


def pause(renewals: int, timeout: float | None) -> float:
    """Seconds to wait before making a copy anew for the n-th time; well below the time limit."""
    longest = LONGEST_PAUSE if timeout is None else min(LONGEST_PAUSE, timeout / 4)
    return min(longest, FIRST_PAUSE * 2.0 ** min(renewals - 1, 20))


def given_up(fault: EnvironmentFault, restarts: int) -> EnvironmentFault:
    """The fault at which restarting ends."""
    text = (
        f"{fault}\nEnvironments were made anew {restarts} times; max_env_restarts allows no more. Mend the "
        "environment, or allow more."
    )
    return EnvironmentFault(text, **{k: v for k, v in fault.record().items() if k != "message"})


def circumstances(worker: int, seed: int | None, action: str | None) -> str:
    """`` (worker 2, seed 7, last action 1)``."""
    who = f"worker {worker}" if worker else "in this process"
    return f" ({who}, seed {seed}, {'no action yet' if action is None else f'last action {action}'})"


def action_text(action: Any) -> str:
    """An action in at most 80 characters."""
    text = " ".join(str(action).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def raised_here(error: BaseException) -> bool:
    """True when the innermost frame is this library's: an answer could not be used, no environment raised."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = Path(__file__).parent
    return bool(frames) and Path(frames[-1].filename).parent == ours


def check_reset(result: Any) -> tuple[Any, dict[str, Any]]:
    """The pair (observation, info) that ``reset`` gave; ApiBreak when it is something else."""
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
        raise ApiBreak(
            f"reset returned {describe(result)}, expected the pair (observation, info dict). "
            "Environments of the old gym API must be ported to Gymnasium 1.x"
        )
    return result


def check_step(result: Any, has_masks: bool) -> None:
    """A close look at the first step of a copy; ApiBreak names what came and what was expected."""
    if not isinstance(result, tuple) or len(result) != 5:
        raise ApiBreak(
            f"step returned {describe(result)}, expected five values: observation, reward, terminated, "
            "truncated, "
            "info. Environments of the old gym API (four values) must be ported to Gymnasium 1.x"
        )
    _, reward, terminated, truncated, info = result
    if isinstance(reward, str | bytes | None) or np.ndim(reward) != 0:
        raise ApiBreak(f"the reward is {reward!r}, expected one number")
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(flag, bool | np.bool_ | int):
            raise ApiBreak(f"{name} is {flag!r}, expected True or False")
    if not isinstance(info, dict):
        raise ApiBreak(f"info is {describe(info)}, expected a dict")
    if MASK_KEY in info and not has_masks:
        raise ApiBreak(
            f"step gives info[{MASK_KEY!r}] but reset did not; give it at every reset and every step"
        )


def check_finite(what: str, numbers: Any) -> None:
    """ApiBreak for the first NaN or infinity."""
    good = np.isfinite(numbers)
    if not good.all():
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        place = f" at index {', '.join(map(str, index))}" if index else ""
        raise ApiBreak(f"{what} = {np.asarray(numbers)[index]}{place}, expected finite numbers")


def describe(value: Any) -> str:
    """A value in a few words for an error message."""
    if isinstance(value, tuple):
        return f"a tuple of {len(value)} values"
    return (
        f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
    )
