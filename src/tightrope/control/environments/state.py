"""The state of environments that can give it, as JSON; nothing is pickled.

An environment takes part by two methods: ``get_state()`` returns what it is in the middle of, made of None,
numbers, strings, bytes, lists, dicts with string keys and numpy arrays; ``set_state(state)`` continues from
there. Its generator ``np_random`` and Gymnasium's time limit are saved for it. A wrapper with a state needs
both methods; they must then cover everything inside the wrapper.
"""

from __future__ import annotations

import base64
import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

ARRAY_KINDS = "biufc"  # of arrays: bool, int, unsigned, float, complex
ARRAY, BYTES, NUMBER = "array", "bytes", "number"
# the methods by which an environment gives and takes its state
GET, SET = "get_state", "set_state"


def encode(value: Any, place: str = "state") -> Any:
    """``value`` as JSON, without loss. TypeError for what a file could hold only by pickling it."""
    if (
        value is None
        or isinstance(value, bool | int | str)
        or (type(value) is float and math.isfinite(value))
    ):
        return value
    if isinstance(value, float) and not isinstance(value, np.floating):
        return {NUMBER: repr(value)}  # JSON has no NaN and no infinities
    if isinstance(value, bytes):
        return {BYTES: base64.b64encode(value).decode()}
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in ARRAY_KINDS:
        whole = np.ascontiguousarray(value)
        text = base64.b64encode(whole.tobytes()).decode()
        return {ARRAY: [whole.dtype.str, list(np.shape(value)), text]}
    if isinstance(value, list | tuple):
        return [encode(item, f"{place}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: encode(item, f"{place}[{key!r}]") for key, item in value.items()}}
    raise TypeError(
        f"{place} is a {type(value).__name__}, which no file can hold without pickling it; give None, "
        "numbers, strings, bytes, lists, dicts with string keys and numpy arrays of numbers"
    )


def decode(value: Any) -> Any:
    """The inverse of `encode`; tuples become lists. ValueError for anything else."""
    if isinstance(value, list):
        return [decode(item) for item in value]
    if not isinstance(value, dict):
        return value
    match value:
        case {"dict": dict(inner)}:
            return {key: decode(item) for key, item in inner.items()}
        case {"number": str(text)}:
            return float(text)
        case {"bytes": str(text)}:
            return base64.b64decode(text)
        case {"array": [str(kind), list(shape), str(text)]} if np.dtype(kind).kind in ARRAY_KINDS:
            found = np.frombuffer(base64.b64decode(text), np.dtype(kind)).reshape(shape).copy()
            return found if shape else found[()]
    raise ValueError(f"a saved state holds {str(value)[:80]}, which this version does not read.")


def alike(found: Any, like: Any) -> bool:
    """Whether two arrays, or dicts of them, agree in names, dtypes and shapes; None agrees with None."""
    if isinstance(found, dict) and isinstance(like, dict):
        return found.keys() == like.keys() and all(alike(found[name], like[name]) for name in like)
    if isinstance(found, np.ndarray) and isinstance(like, np.ndarray):
        return found.shape == like.shape and found.dtype == like.dtype
    return found is None and like is None


def _stateful(env: Any) -> tuple[list[TimeLimit], Any] | None:
    """The time limits around the layer that gives a state, and that layer; None where there is none, or where
    a wrapper outside it may have a state.
    """
    limits: list[TimeLimit] = []
    while not (callable(getattr(env, GET, None)) and callable(getattr(env, SET, None))):
        if isinstance(env, TimeLimit):
            limits.append(env)
        elif not isinstance(env, OrderEnforcing | PassiveEnvChecker):
            return None
        env = env.env
    return limits, env


def gives_state(env: Any) -> bool:
    """Whether a single or a vector environment can give its state."""
    return _stateful(env) is not None


def saved_state(env: Any) -> Any:
    """The encoded state of an environment that gives one. TypeError as `encode`."""
    layers = _stateful(env)
    assert layers is not None
    limits, layer = layers
    found = {"own": layer.get_state(), "elapsed": [limit._elapsed_steps for limit in limits]}
    rng = getattr(env.unwrapped, "_np_random", None) if isinstance(env, gym.Env) else None
    if isinstance(rng, np.random.Generator):
        found["rng"] = rng.bit_generator.state
    return encode(found)


def restore_state(env: Any, encoded: Any) -> None:
    """Give an environment, which has been reset, the state that `saved_state` found."""
    layers, state = _stateful(env), decode(encoded)
    assert layers is not None
    limits, layer = layers
    layer.set_state(state["own"])
    # "elapsed" is missing for vector environments of older runs
    for limit, elapsed in zip(limits, state.get("elapsed", ()), strict=True):
        limit._elapsed_steps = elapsed
    if "rng" in state:
        env.unwrapped.np_random.bit_generator.state = state["rng"]
