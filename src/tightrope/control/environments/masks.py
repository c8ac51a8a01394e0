"""Action masks: where an environment gives them, and reading them.

An environment gives masks in ``info["action_mask"]``, by a method ``action_masks()``, or inside a Dict
observation under "action_mask"; the first of these that it has is used. True allows a choice.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from tightrope.control.environments.faults import ApiBreak
from tightrope.control.spaces.actions import ActionLayout
from tightrope.control.spaces.observations import ObservationLayout
from tightrope.control.spaces.structure import MASK_KEY

METHOD = "action_masks"
MISSING = f"info has no {MASK_KEY!r} although reset gave one; give it at every reset and every step"
NOTHING_ALLOWED = "the action mask forbids every choice; allow at least one"


@dataclass(frozen=True)
class MaskSource:
    """Where the masks of one environment, or of a vector environment, come from."""

    kind: Literal["none", "info", "method", "observation"] = "none"
    method: Callable[[], Any] | None = None

    def read(self, observation: Any, info: dict[str, Any]) -> Any:
        """The mask as the environment gives it; None without any. ApiBreak: it is missing from the info."""
        if self.kind == "info":
            if MASK_KEY not in info:
                raise ApiBreak(MISSING)
            return info[MASK_KEY]
        if self.kind == "method":
            assert self.method is not None
            return self.method()
        return observation[MASK_KEY] if self.kind == "observation" else None


def find_source(
    env: Any, info: dict[str, Any], observations: ObservationLayout, actions: ActionLayout
) -> MaskSource:
    """The source of the masks of a single or a vector environment whose reset returned ``info``."""
    if not actions.num_logits:
        return MaskSource()  # there is nothing that a mask could forbid
    if MASK_KEY in info:
        return MaskSource("info")
    method = _method_of(env) if isinstance(env, gym.Env) else _method_of_vector(env.unwrapped)
    if method is not None:
        return MaskSource("method", method)
    return MaskSource("observation" if observations.has_mask else "none")


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


def flat_mask(mask: Any, rows: int, actions: ActionLayout) -> np.ndarray | None:
    """Masks in any form that `ActionLayout.flatten_mask` takes, as bool [rows, L]; None stays None.

    ValueError: another shape, or a row that allows no choice.
    """
    flat = actions.flatten_mask(mask, rows)
    if flat is not None and len(blocked := actions.blocked_rows(flat)):
        raise ValueError(f"action_masks forbid every choice in row {blocked[0]}; allow at least one.")
    return flat


def vector_masks(
    source: MaskSource,
    observations: Any,
    infos: dict[str, Any],
    idle: np.ndarray | None,
    actions: ActionLayout,
    rows: int,
) -> np.ndarray | None:
    """The masks [B, L] of a vector environment; ``idle`` rows, whose next action is not used, allow all.

    ApiBreak: masks are missing, have another shape, or allow no choice.
    """
    if source.kind == "none":
        return None
    needed = np.ones(rows, bool) if idle is None else ~idle
    masks = np.ones((rows, actions.num_logits), bool)
    if not needed.any():
        return masks
    raw = source.read(observations, infos)
    given = infos.get(f"_{MASK_KEY}") if source.kind == "info" else None  # which rows have one
    if given is not None and not np.asarray(given)[needed].all():
        raise ApiBreak(MISSING)
    if given is not None and isinstance(raw, np.ndarray) and raw.dtype == object:
        for row in np.flatnonzero(given):
            masks[row] = actions.flatten_mask(raw[row], 1)
    else:
        flat = actions.flatten_mask(raw, rows)
        assert flat is not None
        masks = flat
    masks[~needed] = True
    if len(blocked := actions.blocked_rows(masks)):
        raise ApiBreak(NOTHING_ALLOWED, int(blocked[0]))
    return masks
