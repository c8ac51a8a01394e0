"""The environments of a run, made from whatever the user names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import gymnasium as gym

from tightrope.control.environments import copies, tasks
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import FaultPolicy
from tightrope.control.environments.pool import EnvironmentPool
from tightrope.control.environments.processes import available_cores, first_look
from tightrope.control.environments.vector import VectorEnvironments, is_vector_env
from tightrope.control.spaces.structure import Reading

BACKENDS = ("auto", "serial", "mixed", "workers", "vector", "envpool")
# Ids from these are trusted not to end the process.
KNOWN_MODULES = ("gymnasium.", "ale_py", "minigrid")
# A step of these takes tens of microseconds: long enough for a worker process to save time.
SLOW_MODULES = ("gymnasium.envs.mujoco", "gymnasium.envs.box2d")
# Numpy: 43 us a step for any small number of environments, against about 7.5 us each one by one.
NUMPY_VECTOR_IDS = ("CartPole-v0", "CartPole-v1")
NUMPY_VECTOR_FROM = 6


class Backend(NamedTuple):
    """What steps the environments, and in how many processes (with "mixed" this one is one of them)."""

    name: str  # "serial" | "mixed" | "workers" | "vector" | "envpool" | "given"
    num_workers: int = 1


def look_first(env_id: str, keywords: Mapping[str, object] | None = None) -> None:
    """EnvironmentFault for an id of an unknown package whose environment ends its process; see
    `first_look`."""
    if not tasks.entry_module(tasks.find_spec(env_id)).startswith(KNOWN_MODULES):
        first_look(env_id, lambda: tasks.make_by_id(env_id, **(keywords or {})))


def choose_backend(
    env_id: str | None, num_envs: int, num_workers: int | None = None, cores: int = 1
) -> Backend:
    """The backend that ``auto`` means. It depends only on these arguments, never on a timing.

    ``env_id`` None: a factory, or an instance without a spec. Asking for workers means workers; without that,
    this process shares in the work, because the cores would wait for it otherwise. Jax versions of a task are
    never chosen, because they must be compiled first.
    """
    if num_workers is not None and num_workers > 1 and num_envs > 1:
        return Backend("workers", min(num_workers, num_envs))
    if env_id is None:
        return Backend("serial")
    if env_id.startswith("ALE/") or (env_id in NUMPY_VECTOR_IDS and num_envs >= NUMPY_VECTOR_FROM):
        return Backend("vector")
    groups = min(cores, num_envs) if num_workers is None else 1
    if groups > 1 and tasks.entry_module(tasks.find_spec(env_id)).startswith(SLOW_MODULES):
        return Backend("mixed", groups)
    return Backend("serial")


def make_environments(
    env: tasks.EnvSource,
    num_envs: int | None = None,
    *,
    backend: str = "auto",
    num_workers: int | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    policy: FaultPolicy = FaultPolicy(),  # noqa: B008 - it cannot be changed
    reading: Reading = Reading(),  # noqa: B008
    reseed_after: int | None = None,
    carried: str | None = None,
) -> Environments:
    """``num_envs`` environments from a Gymnasium id, an instance, a factory, or a vector environment.

    ``num_envs`` None: 1, or what the vector environment has. ``env_kwargs``: for the constructor. A given
    instance or vector environment is stepped but never closed. ``policy``: what happens after a fault.
    ``reseed_after``, ``carried``: see Seeding.
    ValueError: an unknown id, a backend that the task does not have, an instance that cannot be replicated,
    spaces that are not supported or cannot be read as ``reading`` asks.
    """
    if backend not in BACKENDS:
        raise ValueError(f"vector backend is {backend!r}; expected one of: {', '.join(BACKENDS)}.")
    if is_vector_env(env):
        chosen = Backend("given")
        environments: Environments
        environments = _given(env, num_envs, backend, policy, reading)
        if env_kwargs:
            raise ValueError(
                "env_kwargs are for an id, a class or a factory; a vector environment is made already."
            )
    else:
        num_envs = 1 if num_envs is None else num_envs
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; expected at least 1.")
        chosen = _resolve(env, num_envs, backend, num_workers)
        if isinstance(env, str) and chosen.name in ("vector", "envpool"):
            environments = _vector_version(env, num_envs, chosen.name, env_kwargs, policy, reading)
        else:
            makers = copies.makers_of(env, num_envs, env_kwargs)
            environments = EnvironmentPool(
                makers,
                chosen.num_workers,
                tasks.name_of(env),
                here=chosen.name != "workers",
                keep_first=isinstance(env, gym.Env),
                reading=reading,
                policy=policy,
            )
            environments.spec_id = env if isinstance(env, str) else environments.spec_id
    environments.backend, environments.num_workers = chosen
    names = (carried or "").split()
    try:
        _require_layers(names, environments.layers)
    except ValueError:
        environments.close()
        raise
    environments.reseed_after, environments.carried_names = reseed_after, names
    return environments


def _require_layers(names: list[str], layers: int) -> None:
    """ValueError for a name in ``carried`` that is no LAYER.ATTRIBUTE of an environment of so many layers."""
    for name in names:
        layer, _, attribute = name.partition(".")
        if not (layer.isdecimal() and attribute.removesuffix("?").isidentifier() and int(layer) < layers):
            here = f"there are {layers} here" if layers else "vector environments have none"
            raise ValueError(
                f"carried has {name!r}; expected LAYER.ATTRIBUTE, where layer 0 is the outermost wrapper and "
                f"{here}. A run looks for these names by itself where the setting is left out."
            )


def _resolve(env: tasks.EnvSource, num_envs: int, backend: str, num_workers: int | None) -> Backend:
    """The backend to use: the one asked for where it is possible, else ``choose_backend``'s."""
    cores = available_cores()
    if backend in ("vector", "envpool"):
        if not isinstance(env, str):
            raise ValueError(
                f"vector backend {backend!r} needs a Gymnasium id; {tasks.name_of(env)} is an object. "
                "Use auto."
            )
        return Backend(backend)
    if backend == "serial":
        return Backend("serial")
    if backend in ("mixed", "workers"):
        return Backend(backend, min(num_envs, num_workers or cores))
    if isinstance(env, str):
        return choose_backend(env, num_envs, num_workers, cores)
    env_id = env.spec.id if isinstance(env, gym.Env) and env.spec else None
    chosen = choose_backend(env_id, num_envs, num_workers, cores)
    # an instance may have been made with other arguments than its vector version would be
    return Backend("serial") if chosen.name == "vector" else chosen


def _vector_version(
    env_id: str,
    num_envs: int,
    backend: str,
    keywords: Mapping[str, object] | None,
    policy: FaultPolicy,
    reading: Reading,
) -> VectorEnvironments:
    """The task's own vector version, or EnvPool's."""
    if backend == "vector":
        make = lambda seed: tasks.make_vector_by_id(env_id, num_envs, keywords)  # noqa: E731
        vector = make(0)
        environments = VectorEnvironments(lambda seed: vector, env_id, policy, make, reading=reading)
    else:
        threads, more = min(num_envs, available_cores()), dict(keywords or {})
        make = lambda seed: tasks.make_envpool(env_id, num_envs, seed, threads, **more)  # noqa: E731
        environments = VectorEnvironments(make, env_id, policy, make, int32_actions=True, reading=reading)
    environments.max_episode_steps = tasks.time_limit(env_id, keywords)
    return environments


def _given(
    env: gym.vector.VectorEnv, num_envs: int | None, backend: str, policy: FaultPolicy, reading: Reading
) -> VectorEnvironments:
    """A vector environment that the user gave as an object."""
    if num_envs not in (None, int(env.num_envs)):
        raise ValueError(
            f"num_envs is {num_envs}, but the vector environment given has {env.num_envs} copies."
        )
    if backend != "auto":
        raise ValueError(
            f"vector backend {backend!r} asked for, but a vector environment was given. Use auto."
        )
    envpool = not isinstance(env, gym.vector.VectorEnv)
    environments = VectorEnvironments(
        lambda seed: env, tasks.name_of(env), policy, keep=True, int32_actions=envpool, reading=reading
    )
    environments.max_episode_steps = tasks.time_limit(env)
    return environments
