"""What environments tell beside observations and rewards: action masks, and whether an episode succeeded.

An environment gives masks in ``info["action_mask"]``, by a method ``action_masks()``, or inside a Dict
observation under "action_mask"; the first of these that it has is used. True allows a choice. Whether an
episode reached its goal stands in ``info["is_success"]`` of its last step, where a task gives it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from tightrope.control.environments.faults import ApiBreak
from tightrope.control.spaces.structure import MASK_KEY

METHOD, SUCCESS_KEY = "action_masks", "is_success"
MISSING = f"info has no {MASK_KEY!r} although reset gave one; give it at every reset and every step"
NOTHING_ALLOWED = "the action mask forbids every choice; allow at least one"


@dataclass(frozen=True)
class MaskSource:
    """Where the masks of one environment, or of a vector environment, come from."""

    kind: Literal["none", "info", "method", "observation"] = "none"
    method: Callable[[], Any] | None = None

    def read(self, observation: Any, info: Mapping[str, object]) -> Any:
        """The mask as the environment gives it; None without any. ApiBreak: it is missing from the info."""
        if self.kind == "info":
            if MASK_KEY not in info:
                raise ApiBreak(MISSING)
            return given(info[MASK_KEY], f"info[{MASK_KEY!r}]")
        if self.kind == "method":
            assert self.method is not None
            return given(self.method(), f"{METHOD}()")
        return observation[MASK_KEY] if self.kind == "observation" else None


def given(mask: Any, where: str) -> Any:
    """The mask; ApiBreak for None."""
    if mask is None:
        raise ApiBreak(f"{where} is None, expected 1 or 0 a choice; give ones where everything is allowed")
    return mask


def find_source(
    env: gym.Env | gym.vector.VectorEnv, info: Mapping[str, object], observed: bool, num_logits: int
) -> MaskSource:
    """The source of the masks of a single or a vector environment whose reset returned ``info``.

    ``observed``: a Dict observation has one; ``num_logits``: choices of the actions that a mask could forbid.
    """
    if not num_logits:
        return MaskSource()  # there is nothing that a mask could forbid
    if MASK_KEY in info:
        return MaskSource("info")
    method = _method_of(env) if isinstance(env, gym.Env) else _method_of_vector(env.unwrapped)
    if method is not None:
        return MaskSource("method", method)
    return MaskSource("observation" if observed else "none")


def _method_of(env: gym.Env) -> Callable[[], Any] | None:
    method = env.get_wrapper_attr(METHOD) if env.has_wrapper_attr(METHOD) else None
    return method if callable(method) else None


def _method_of_vector(env: Any) -> Callable[[], Any] | None:
    """Its own method, or one that asks the single environments inside Gymnasium's vector environments."""
    if callable(getattr(env, METHOD, None)):
        return env.action_masks
    copies = getattr(env, "envs", None)
    if copies:
        found = callable(getattr(copies[0].unwrapped, METHOD, None))
    else:
        # they live in other processes, where asking one without the method breaks it: ask a fresh one
        makers = getattr(env, "env_fns", None)
        if not makers:
            return None
        with contextlib.closing(makers[0]()) as probe:
            found = callable(getattr(probe.unwrapped, METHOD, None))
    return (lambda: np.stack([np.asarray(mask) for mask in env.call(METHOD)])) if found else None


def success_of(info: dict[str, Any]) -> float:
    """The number in the info of an episode's last step, 1 for True; NaN: it says nothing. ApiBreak for what
    is no number.
    """
    value = info.get(SUCCESS_KEY)
    if value is None:
        return math.nan
    try:
        return float(value.item() if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError):
        raise ApiBreak(f"info[{SUCCESS_KEY!r}] is {value!r}, expected True or False") from None


def vector_success(infos: dict[str, Any], ended: np.ndarray) -> np.ndarray | None:
    """float64 [B]: `success_of` for the rows that ``ended`` in this step, NaN elsewhere; None: none tells.

    Where the row is reset in the same step, its last info is in ``final_info``.
    """
    finals = infos.get("final_info", infos)
    if isinstance(finals, dict) and SUCCESS_KEY not in finals:
        return None
    found = np.full(len(ended), np.nan)
    for row in np.flatnonzero(ended):
        if not isinstance(finals, dict):  # an array with an info a row
            info = finals[row] or {}
        else:
            info = (
                {SUCCESS_KEY: finals[SUCCESS_KEY][row]} if finals.get(f"_{SUCCESS_KEY}", ended)[row] else {}
            )
        found[row] = success_of(info)
    return found
