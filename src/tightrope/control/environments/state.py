"""The state of environments that can give it, and what others keep from one episode to the next, as JSON;
nothing is pickled.

An environment takes part by two methods: ``get_state()`` returns what it is in the middle of, made of None,
numbers, strings, bytes, lists, dicts with string keys and numpy arrays; ``set_state(state)`` continues from
there. Its generator ``np_random`` and Gymnasium's time limit are saved for it. A wrapper with a state needs
both methods; they must then cover everything inside the wrapper.
"""

from __future__ import annotations

import base64
import copy
import math
import random
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

ARRAY_KINDS = "biufc"  # of arrays: bool, int, unsigned, float, complex
ARRAY, BYTES, NUMBER = "array", "bytes", "number"
# the methods by which an environment gives and takes its state
GET, SET = "get_state", "set_state"

EnvObject = gym.Env | gym.vector.VectorEnv  # one that has been made


def encode(value: object, place: str = "state") -> Any:
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


def decode(value: object) -> Any:
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


def alike(found: object, like: object) -> bool:
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
    if _is_cartpoles(env):
        return limits, _CartPoles(env.unwrapped)
    while not (callable(getattr(env, GET, None)) and callable(getattr(env, SET, None))):
        if isinstance(env, TimeLimit):
            limits.append(env)
        elif not isinstance(env, OrderEnforcing | PassiveEnvChecker):
            return None
        env = env.env
    return limits, env


def _is_cartpoles(env: object) -> bool:
    kind = type(getattr(env, "unwrapped", env))
    return (kind.__module__, kind.__name__) == (
        "gymnasium.envs.classic_control.cartpole",
        "CartPoleVectorEnv",
    )


def gives_state(env: EnvObject) -> bool:
    """Whether a single or a vector environment can give its state."""
    return _stateful(env) is not None


def saved_state(env: EnvObject) -> Any:
    """A copy of the state of an environment that gives one, for `encode`."""
    layers = _stateful(env)
    assert layers is not None
    limits, layer = layers
    found = {"own": layer.get_state(), "elapsed": [limit._elapsed_steps for limit in limits]}
    rng = getattr(env.unwrapped, "_np_random", None) if isinstance(env, gym.Env) else None
    if isinstance(rng, np.random.Generator):
        found["rng"] = rng.bit_generator.state
    return copy.deepcopy(found)


def restore_state(env: Any, state: Any) -> None:
    """Give an environment, which has been reset, the state that `saved_state` found."""
    layers = _stateful(env)
    assert layers is not None
    limits, layer = layers
    layer.set_state(state["own"])
    for limit, elapsed in zip(limits, state["elapsed"], strict=True):
        limit._elapsed_steps = elapsed
    if "rng" in state:
        env.unwrapped.np_random.bit_generator.state = state["rng"]


class _CartPoles:
    """The state of Gymnasium's vector version of CartPole: arrays and a generator."""

    NAMES = ("state", "steps", "prev_done", "low", "high")

    def __init__(self, env: Any) -> None:
        self.env = env

    def get_state(self) -> dict[str, Any]:
        """See `GET`."""
        arrays = {name: getattr(self.env, name) for name in self.NAMES}
        return {"arrays": arrays, "rng": self.env.np_random.bit_generator.state}

    def set_state(self, state: dict[str, Any]) -> None:
        """See `SET`."""
        for name in self.NAMES:
            setattr(self.env, name, state["arrays"][name])
        self.env.np_random.bit_generator.state = state["rng"]


# ------------------------------------------------------------------------------- from episode to episode

# Either the environment gives its state, or ``names`` lists attributes: "0.counter" of the outermost layer,
# "1.obs_rms" of the one inside it. `differing` finds them in a used copy beside a fresh one. Files hold
# values only; the objects that take them are those of the environment. An attribute that only one of the two
# copies has differs too: its name ends in "?", and that it is absent is carried like a value.

# layers that start over at every reset, and attributes that say nothing about an episode
RESET = (
    "OrderEnforcing",
    "PassiveEnvChecker",
    "TimeLimit",
    "FrameStackObservation",
    "RecordEpisodeStatistics",
)
SILENT = ("spec", "metadata", "action_space", "observation_space", "render_mode")
# what an attribute may hold: so many numbers and containers, of which so many bytes of an array count as one
MOST_ITEMS, ITEM_BYTES = 256, 64
KEPT_AS_IS = (type(None), bool, int, float, str, bytes)
BIT_GENERATORS = {
    kind.__name__: kind
    for kind in (
        np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64,
    )
}  # fmt: skip
ABSENT = object()


def nested(env: EnvObject) -> Iterator[Any]:
    """The environment, and those inside it."""
    while True:
        yield env
        if not isinstance(env, gym.Wrapper):
            return
        env = env.env


def clean(env: EnvObject, names: Sequence[str], seed: int) -> Any:
    """What an environment carries before its first episode. One that gives its state is reset for it, because
    some make their attributes in reset.
    """
    if not names:
        env.reset(seed=seed)
    return take(env, names)


def take(env: EnvObject, names: Sequence[str]) -> Any:
    """What an environment carries, as JSON. TypeError for what no file can hold as it is, or is too much."""
    if not names:
        return encode(saved_state(env))
    return encode({name: _portable(_attribute(env, name), name) for name in names})


def give(env: EnvObject, carried: object, seed: int) -> None:
    """Let an environment carry what `take` found in another copy, or earlier in this one. What it carries
    already is left alone.
    """
    found = decode(carried)
    if "own" in found:
        if isinstance(env, gym.Env):
            env.reset(seed=seed)
        restore_state(env, found)
        return
    # what cannot be held any more has no text, and is replaced too
    other = {name: form for name, form in found.items() if _text(_attribute(env, name)) != str(encode(form))}
    if any(_attribute(env, name) is ABSENT for name in other):
        env.reset(seed=seed)
    for name, form in other.items():
        held, attribute = vars(_layer(env, name)), _attribute_name(name)
        held[attribute] = _built(held.get(attribute), form)
        if held[attribute] is ABSENT:
            del held[attribute]


def not_there(env: EnvObject, names: Sequence[str]) -> list[str]:
    """Those of ``names`` that an environment, which has been reset, should have and does not."""
    return [name for name in names if not name.endswith("?") and _attribute(env, name) is ABSENT]


def differing(used: EnvObject, fresh: EnvObject) -> list[str]:
    """Attributes of plain values in which two copies differ."""
    pairs = enumerate(zip(nested(used), nested(fresh), strict=True))
    return [
        f"{depth}.{name}" + "?" * ((name in vars(a)) != (name in vars(b)))
        for depth, (a, b) in pairs
        if type(a).__name__ not in RESET
        for name in vars(a) | vars(b)
        if name not in SILENT
        and (text := _text(vars(a).get(name, ABSENT)))
        and text != _text(vars(b).get(name, ABSENT))
    ]


def _text(value: object) -> str:
    """An attribute as text to compare; empty when it holds no plain values, or too many."""
    try:
        return str(encode(_portable(value, "")))
    except (TypeError, RecursionError):
        return ""


def _layer(env: EnvObject, name: str) -> Any:
    return list(nested(env))[int(name.partition(".")[0])]


def _attribute(env: EnvObject, name: str) -> Any:
    return vars(_layer(env, name)).get(_attribute_name(name), ABSENT)


def _attribute_name(name: str) -> str:
    return name.partition(".")[2].removesuffix("?")


def _portable(value: Any, place: str, left: list[int] | None = None) -> Any:
    """A value in terms of `encode`, every container and generator with its kind, so that `_built` gives the
    same value. TypeError for an object of another kind, subclasses included, and for too much.
    """
    left = [MOST_ITEMS] if left is None else left
    left[0] -= 1 + getattr(value, "nbytes", 0) // ITEM_BYTES
    if left[0] < 0:
        raise TypeError(f"{place} holds more than a task may keep from one episode to the next")
    kind = type(value)
    if value is ABSENT:
        return ["absent"]
    if kind in KEPT_AS_IS or (isinstance(value, np.generic) and value.dtype.kind in ARRAY_KINDS):
        return value
    if kind is np.ndarray and value.dtype.kind in ARRAY_KINDS:
        return value if value.ndim else ["scalar array", value.reshape(1)]
    if kind in (list, tuple, deque):
        items = [_portable(item, place, left) for item in value]
        return [kind.__name__, items, value.maxlen] if kind is deque else [kind.__name__, items]
    if kind is dict:
        return ["dict", [[_portable(part, place, left) for part in pair] for pair in value.items()]]
    if kind is np.random.Generator and type(value.bit_generator).__name__ in BIT_GENERATORS:
        return ["Generator", value.bit_generator.state]
    if kind is np.random.RandomState:
        return ["RandomState", value.get_state(legacy=False)]
    if kind is random.Random:
        version, numbers, gauss = value.getstate()
        return ["Random", [version, np.array(numbers, np.int64), gauss]]
    if kind.__name__ == "RunningMeanStd":  # Gymnasium's, and copies of it
        return ["RunningMeanStd", {name: _portable(item, place, left) for name, item in vars(value).items()}]
    raise TypeError(f"{place} holds a {kind.__name__}, which no file can hold without pickling it")


def _built(old: Any, form: Any) -> Any:
    """The value of a `_portable` form. A generator or RunningMeanStd takes it and stays the same object where
    ``old`` is one of its kind.
    """
    if not isinstance(form, list):
        return form
    match form:
        case ["absent"]:
            return ABSENT
        case ["scalar array", value]:
            return value.reshape(())
        case ["list", items]:
            return [_built(None, item) for item in items]
        case ["tuple", items]:
            return tuple(_built(None, item) for item in items)
        case ["deque", items, maxlen]:
            return deque((_built(None, item) for item in items), maxlen)
        case ["dict", pairs]:
            return {_built(None, key): _built(None, item) for key, item in pairs}
        case ["Generator", state]:
            bits = BIT_GENERATORS[state["bit_generator"]]
            if type(old) is not np.random.Generator or type(old.bit_generator) is not bits:
                old = np.random.Generator(bits())
            old.bit_generator.state = state
            return old
        case ["RandomState", state]:
            old = old if type(old) is np.random.RandomState else np.random.RandomState()
            old.set_state(state)
            return old
        case ["Random", [version, numbers, gauss]]:
            old = old if type(old) is random.Random else random.Random()
            old.setstate((version, tuple(numbers.tolist()), gauss))
            return old
        case ["RunningMeanStd", items] if type(old).__name__ == "RunningMeanStd":
            vars(old).update({name: _built(vars(old).get(name), item) for name, item in items.items()})
            return old
    raise ValueError(f"a saved attribute is {str(form)[:80]}, which cannot be put back here.")
