"""What makes the copies of a task: from an id, a factory, or an environment that the user gave as an object.

Nothing that was set on an object is lost. A copy of it comes from ``gym.make`` of the object's spec where
that builds the same, else from ``copy.deepcopy`` where everything survives it. Sameness is judged by plain
values (numbers, texts, arrays, containers and objects of them, functions), wrapper by wrapper; what can only
be told apart by its address is left out.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import random
import threading
import types
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from tightrope.control.environments.state import nested
from tightrope.control.environments.tasks import EnvSource, make_by_id, require_keywords, without_noise

# wrappers that gym.make adds or not, without effect on a task
BOOKKEEPING = ("OrderEnforcing", "PassiveEnvChecker")
# attributes of a layer that are no settings: the layer inside (walked by itself), how to build it, its
# generator
NOT_VALUES = ("env", "spec", "_cached_spec", "_np_random", "_np_random_seed")
PLAIN = (bool, int, float, complex, str, bytes, np.generic, np.dtype, types.NoneType)
CODE = (types.FunctionType, types.MethodType, types.BuiltinFunctionType, types.ModuleType, type)
# generators, and handles on things outside Python's memory
OPAQUE = (
    np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random,
    threading.Thread, io.IOBase,
)  # fmt: skip
SEED = 0  # of the resets before a comparison
LACKING = "<nothing>"  # in place of an attribute or a key that one side lacks
CONTENT = "(content)"  # in place of an attribute, for what an object of compiled code would pickle
Maker = Callable[[], gym.Env]
Found = dict[str, tuple[Any, Any]]


def makers_of(env: EnvSource, num_envs: int, keywords: Mapping[str, object] | None = None) -> list[Maker]:
    """One function per copy of an id, an instance (it is copy 0 itself) or a factory.

    ``keywords``: for the constructor; each call gets a copy of its own, which it may change.
    ValueError: something else, or keywords that cannot be given.
    """
    keywords = dict(keywords or {})
    if isinstance(env, gym.Env):
        if keywords:
            raise ValueError(
                f"env_kwargs are {keywords}, but env is an environment that has been made. Make it with "
                "them, or give an id, a class or a factory."
            )
        return replicas(env, num_envs)
    if isinstance(env, str):
        require_keywords(env, keywords)
        return [lambda: make_by_id(env, **copy.deepcopy(keywords))] * num_envs
    if callable(env):
        require_keywords(env, keywords)
        return [(lambda: env(**copy.deepcopy(keywords))) if keywords else env] * num_envs
    raise ValueError(
        f"env is a {type(env).__name__}; expected a Gymnasium id, an environment, a zero-argument "
        "factory or a vector environment."
    )


def replicas(env: gym.Env, num_envs: int) -> list[Maker]:
    """One maker per copy of a given instance; the instance itself is copy 0.

    An instance that has been used may be reset here. ValueError, with the factory to write: no copy would be
    the same.
    """
    makers: list[Maker] = [lambda: env]
    return makers if num_envs == 1 else makers + [replicator(env)] * (num_envs - 1)


def replicator(env: gym.Env) -> Maker:
    """A function that builds a copy of an instance at each call. ValueError as `replicas`."""
    with contextlib.suppress(Exception), _twins(env) as new:
        if not differences(env, new()):
            return lambda: _from_spec(env)
    reasons: list[str] = []
    kept: gym.Env | None = None
    subject = env  # what is reset and stepped for the comparisons: a copy, where there is a good one
    try:
        kept = copy.deepcopy(env)
        if not differences(env, kept) and not _same(env, kept):
            subject = copy.deepcopy(kept)
    except Exception as error:
        reasons.append(f"copy.deepcopy: {type(error).__name__}: {error}")
    lost: Found | None = None
    try:
        lost = _lost_by_spec(subject)
        if not lost:
            return lambda: _from_spec(env)
        reasons.insert(0, f"gym.make of its spec: it gives {_words(lost)}")
    except Exception as error:
        reasons.insert(0, f"gym.make of its spec: {type(error).__name__}: {error}")
    if kept is not None:
        reason = _why_no_copy(env, kept, subject is not env, lost or {})
        if reason is None:
            return lambda: copy.deepcopy(kept)
        reasons.append(f"copy.deepcopy: {reason}")
    if lost:
        left = _left_by_use(env)
        lost = {place: values for place, values in lost.items() if place not in left}
        if not lost:
            return lambda: _from_spec(env)
    raise ValueError(
        f"the environment {env} cannot be replicated ({'; '.join(reasons)}). Pass a zero-argument factory "
        f"that builds it, or num_envs=1:\n{_factory(env, lost or {})}"
    )


def _lost_by_spec(env: gym.Env) -> Found:
    """What gym.make of the spec would lose; empty: it builds the same."""
    with _twins(env) as new:
        lost = lasting(env, new())
        if lost:  # what differs between two new ones, too, is chance or a handle, not a setting
            chance = lasting(new(), new())
            lost = {place: values for place, values in lost.items() if place not in chance}
    return lost


def _left_by_use(env: gym.Env) -> Found:
    """What steps change and a reset does not put back: no setting, where it cannot be copied."""
    with _twins(env) as new, contextlib.suppress(Exception):
        used, fresh = new(), new()
        used.reset(seed=SEED + 1)
        for _ in range(10):
            if any(used.step(used.action_space.sample())[2:4]):
                break
        return lasting(used, fresh)
    return {}


@contextlib.contextmanager
def _twins(env: gym.Env) -> Iterator[Maker]:
    """A function that builds what gym.make of the spec gives; all are closed at the end."""
    made: list[gym.Env] = []

    def new() -> gym.Env:
        made.append(_from_spec(env))
        return made[-1]

    try:
        yield new
    finally:
        for twin in made:
            with contextlib.suppress(Exception):
                twin.close()


def _from_spec(env: gym.Env) -> gym.Env:
    spec = env.spec
    if spec is None:
        raise ValueError("it has no spec")
    with without_noise(spec):
        twin = gym.make(spec, disable_env_checker=True)
    theirs, ours = ([_name(layer) for layer in layers(x)] for x in (twin, env))
    if theirs != ours:
        twin.close()
        raise ValueError(f"gives {theirs}, the instance is {ours}")
    if twin.unwrapped is env.unwrapped:
        raise ValueError("returned the same object")
    return twin


def _same(env: gym.Env, other: gym.Env) -> bool:
    return other is env or other.unwrapped is env.unwrapped


def _why_no_copy(env: gym.Env, kept: gym.Env, alike: bool, changed: Found) -> str | None:
    """Why the deep copy ``kept`` is none; None: it is one. Copies of it are used; also for ``env`` if
    ``alike``."""
    if _same(env, kept):
        return "returned the same object"
    try:
        twin, subject = copy.deepcopy(kept), copy.deepcopy(kept) if alike else env
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    lost = lasting(subject, twin)
    if lost:
        return f"it gives {_words({place: lost[place] for place in lost if place in changed} or lost)}"
    if _disturbed(subject, twin) or any(
        _holds(value, env) for x in layers(kept) for value in vars(x).values()
    ):
        return "a step of the copy changes the original: they share a simulator"
    return None


def _holds(value: object, env: gym.Env) -> bool:
    """Whether a function reaches into an environment, to which it then belongs also where it was copied."""
    inside = [cell.cell_contents for cell in getattr(value, "__closure__", None) or ()]
    owners = [getattr(x, "__self__", x) for x in inside]
    return any(owner is layer for owner in owners for layer in (env, env.unwrapped, *layers(env)))


def _disturbed(env: gym.Env, twin: gym.Env) -> bool:
    """Whether resetting and stepping ``twin`` changes what a step of ``env`` returns."""
    action = env.action_space.sample()

    def step(*, beside: bool) -> Any:
        env.reset(seed=SEED)
        if beside:
            twin.reset(seed=SEED + 1)
            twin.step(action)
        return env.step(action)[:2]

    try:
        first, again, beside = step(beside=False), step(beside=False), step(beside=True)
    except Exception:  # training will meet it, and name it
        return False
    return not _compared(first, again) and bool(_compared(first, beside))


def _factory(env: gym.Env, changed: Found) -> str:
    """The factory to write for an instance, as far as it is known."""
    lines = [f"env = {type(env).__name__}(...)  # with everything that you set on it"]
    if env.spec is not None:
        keywords = "".join(f", {name}={value!r}" for name, value in env.spec.kwargs.items())
        lines = [f"env = gymnasium.make({env.spec.id!r}{keywords})"]
        for place, (ours, _) in list(changed.items())[:8]:
            known = isinstance(ours, PLAIN) and place.startswith("env.") and CONTENT not in place
            lines.append(
                f"{place} = {ours!r}" if known else f"# {place.partition('.' + CONTENT)[0]} as you set it"
            )
    return "\n    ".join(["def make():", *lines, "return env"])


def _words(found: Found) -> str:
    shown = [
        f"another {place.partition('.' + CONTENT)[0]}"
        if CONTENT in place
        else f"{place} = {_short(b)}, not {_short(a)}"
        for place, (a, b) in list(found.items())[:3]
    ]
    more = len(found) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


# ------------------------------------------------------------------------------------------------- comparing


def layers(env: gym.Env) -> list[gym.Env]:
    """The environment from its outermost wrapper to the task, bookkeeping left out."""
    return [layer for layer in nested(env) if type(layer).__name__ not in BOOKKEEPING]


def _name(layer: gym.Env) -> str:
    return f"{type(layer).__module__}.{type(layer).__qualname__}"


def lasting(one: gym.Env, other: gym.Env) -> Found:
    """The plain values in which two environments of the same layers differ, and still differ after both were
    reset with one seed: what a reset makes equal is the state of an episode.
    """
    before = differences(one, other)
    if not before:
        return before
    try:
        one.reset(seed=SEED)
        other.reset(seed=SEED)
    except Exception:  # training will meet it, and name it
        return before
    after = differences(one, other)
    return {place: values for place, values in before.items() if place in after}


def differences(one: gym.Env, other: gym.Env) -> Found:
    """The plain values in which two environments of the same layers differ: place -> (ours, theirs)."""
    found: Found = {}
    for ours, theirs in zip(layers(one), layers(other), strict=True):
        place = "env.unwrapped" if ours is one.unwrapped else f"{type(ours).__name__}"
        mine, his = (
            {name: value for name, value in _attributes(layer).items() if name not in NOT_VALUES}
            for layer in (ours, theirs)
        )
        found |= _compared(mine, his, place, attributes=True)
    return found


def _compared(a: object, b: object, place: str = "", *, attributes: bool = False) -> Found:
    """The places in which two values differ, those nearest to the top first."""
    found: Found = {}
    seen: dict[tuple[int, int], tuple[Any, Any]] = {}  # holds the values: an id must not be used again
    waiting = deque(_members(a, b, place, attributes) if attributes else [(place, a, b)])
    while waiting:
        where, x, y = waiting.popleft()
        if x is y or (id(x), id(y)) in seen or isinstance(x, OPAQUE) or isinstance(y, OPAQUE):
            continue
        if not (isinstance(x, PLAIN) or isinstance(y, PLAIN)):  # two attributes may well hold the same number
            seen[id(x), id(y)] = (x, y)
        parts = _parts(where, x, y)
        if parts is None:
            found[where] = (x, y)
        else:
            waiting.extend(parts)
    return found


def _parts(place: str, a: object, b: object) -> Iterator[tuple[str, Any, Any]] | None:
    """What is to be compared inside two values: nothing where they are equal or opaque; None: they differ."""
    nothing: Iterator[tuple[str, Any, Any]] = iter(())
    if isinstance(a, PLAIN) and isinstance(b, PLAIN):
        return nothing if _equal(a, b) else None
    if isinstance(a, gym.Space) and isinstance(b, gym.Space) and a == b:  # its text is made when it is shown
        return nothing
    if _is_array(a) and _is_array(b):
        return nothing if _equal_arrays(a, b) else None
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return _members(a, b, place, attributes=False)
    if isinstance(a, list | tuple | deque) and isinstance(b, list | tuple | deque):
        if len(a) != len(b):
            return None
        return ((f"{place}[{k}]", x, y) for k, (x, y) in enumerate(zip(a, b, strict=True)))
    if isinstance(a, set | frozenset) and isinstance(b, set | frozenset):
        plain = all(isinstance(x, PLAIN) for x in (*a, *b))
        return nothing if (a == b if plain else len(a) == len(b)) else None
    if isinstance(a, CODE) and isinstance(b, CODE):
        return _parts_of_code(place, a, b)
    mine, his = _inside(a), _inside(b)
    if mine is None or his is None:  # opaque
        return nothing
    if _name_of_type(a) != _name_of_type(b):
        return None
    return _members(mine, his, place, attributes=True)


def _members(a: Any, b: Any, place: str, attributes: bool) -> Iterator[tuple[str, Any, Any]]:
    """The values of two mappings by their keys; keys that are no plain values are matched by their order."""
    for key in dict.fromkeys([k for k in (*a, *b) if isinstance(k, PLAIN)]):
        where = f"{place}.{key!s}" if attributes else f"{place}[{key!r}]"
        yield where, a.get(key, LACKING), b.get(key, LACKING)
    mine, his = ([value for key, value in x.items() if not isinstance(key, PLAIN)] for x in (a, b))
    yield f"{place}[...]", mine, his


def _parts_of_code(place: str, a: object, b: object) -> Iterator[tuple[str, Any, Any]] | None:
    """Functions are equal when their code and what they close over are; classes and modules by their name."""
    if isinstance(a, types.MethodType) and isinstance(b, types.MethodType):
        return iter(
            [(f"{place}.__func__", a.__func__, b.__func__), (f"{place}.__self__", a.__self__, b.__self__)]
        )
    if not (isinstance(a, types.FunctionType) and isinstance(b, types.FunctionType)):
        return iter(()) if _name_of_type(a) == _name_of_type(b) else None
    if a.__code__ != b.__code__:
        return None
    parts = (
        (f"{place}.{name}", getattr(a, name), getattr(b, name)) for name in ("__defaults__", "__closure__")
    )
    return iter(parts)


def _name_of_type(value: object) -> str:
    named = value if isinstance(value, CODE) else type(value)
    return (
        f"{getattr(named, '__module__', '')}.{getattr(named, '__qualname__', getattr(named, '__name__', ''))}"
    )


def _inside(value: object) -> Mapping[str, Any] | None:
    """The values that make up an object: its attributes, else what it would pickle; None: neither."""
    if isinstance(value, PLAIN + CODE) or _is_array(value):
        return {"value": value}
    if isinstance(value, types.CellType):
        with contextlib.suppress(ValueError):  # it is empty
            return {"cell_contents": value.cell_contents}
        return None
    if isinstance(value, functools.partial):
        return {"func": value.func, "args": value.args, "keywords": value.keywords}
    found = _attributes(value)
    if found or hasattr(value, "__dict__"):
        return found
    if isinstance(value, Mapping | list | tuple | deque | set | frozenset):
        return {"value": value}
    try:
        reduced = value.__reduce_ex__(2)
    except Exception:
        return None
    return {CONTENT: reduced[1:3]} if isinstance(reduced, tuple) else None


def _attributes(value: object) -> dict[str, Any]:
    """The attributes of an object, in ``__dict__`` and in ``__slots__``."""
    found = dict(getattr(value, "__dict__", {}))
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                found[name] = getattr(value, name)
    return found


def _is_array(value: object) -> bool:
    return hasattr(type(value), "__array__") and not isinstance(value, np.generic)


def _equal_arrays(a: object, b: object) -> bool:
    try:
        x, y = np.asarray(a), np.asarray(b)
    except Exception:  # on a device, say
        return True
    if x.shape != y.shape:
        return False
    if x.dtype == object or y.dtype == object:
        return all(_equal(u, v) for u, v in zip(x.ravel(), y.ravel(), strict=True) if isinstance(u, PLAIN))
    return bool(((x == y) | ((x != x) & (y != y))).all())


def _equal(a: object, b: object) -> bool:
    return bool(a == b) or bool(a != a and b != b)
