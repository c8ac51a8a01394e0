"""The environments of a run: B copies of one task behind ``reset`` and ``step``, whoever steps them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, final

import gymnasium as gym
import numpy as np

from tightrope.control.environments import tasks
from tightrope.control.environments.faults import EnvironmentFault, FaultPolicy
from tightrope.control.environments.guarded import GuardedVector, is_vector_env
from tightrope.control.environments.pool import EnvCopies
from tightrope.control.environments.processes import available_cores
from tightrope.control.environments.step import Step
from tightrope.control.environments.vectorised import VectorCopies
from tightrope.control.spaces import Inputs

__all__ = [
    "Backend",
    "EnvironmentFault",
    "Environments",
    "Step",
    "available_cores",
    "choose_backend",
    "make_environments",
]

BACKENDS = ("auto", "serial", "workers", "vector", "envpool")
# A step of these takes tens of microseconds, so that waking a worker pays.
SLOW_MODULES = ("gymnasium.envs.mujoco", "gymnasium.envs.box2d")
# Numpy, 43 us a step for any small number of copies, against about 7.5 us a copy one by one.
NUMPY_VECTOR_IDS = ("CartPole-v0", "CartPole-v1")
NUMPY_VECTOR_FROM = 6


class Backend(NamedTuple):
    """Who steps the copies, and in how many processes (this one included)."""

    name: str  # "serial" | "workers" | "vector" | "envpool" | "given"
    num_workers: int


def choose_backend(
    env_id: str | None, num_envs: int, num_workers: int | None = None, cores: int = 1
) -> Backend:
    """The backend that ``auto`` means: a function of these arguments alone, never of a timing.

    ``env_id`` None stands for a factory or an instance without a spec. Asking for more than one worker means
    workers. Jax versions of a task are never chosen: they would be compiled first.
    """
    if num_workers is not None and num_workers > 1 and num_envs > 1:
        return Backend("workers", min(num_workers, num_envs))
    if env_id is None:
        return Backend("serial", 1)
    if env_id.startswith("ALE/") or (env_id in NUMPY_VECTOR_IDS and num_envs >= NUMPY_VECTOR_FROM):
        return Backend("vector", 1)
    groups = min(cores, num_envs) if num_workers is None else 1
    if groups > 1 and tasks.entry_module(tasks.find_spec(env_id)).startswith(SLOW_MODULES):
        return Backend("workers", groups)
    return Backend("serial", 1)


@final
class Environments:
    """B copies of one task. Made by ``make_environments``; close it, or use it in a ``with`` statement.

    After an EnvironmentFault only ``close`` is allowed.
    """

    def __init__(
        self,
        copies: EnvCopies | GuardedVector,
        num_envs: int,
        *,
        backend: Backend,
        spec_id: str,
        max_episode_steps: int | None,
        squash: bool,
    ) -> None:
        self._copies = copies
        self.num_envs = num_envs
        self.observation_layout = copies.observation_layout
        self.action_layout = copies.action_layout
        self.spec_id = spec_id
        self.backend = backend.name
        self.num_workers = backend.num_workers
        self.max_episode_steps = max_episode_steps
        self.squash = squash
        self.restartable = copies.policy.restart
        self.waves = (
            copies.waves
        )  # rows in the order to act in: choosing the next overlaps with stepping the last

    def reset(self, seed: int) -> tuple[Inputs, np.ndarray | None]:
        """Reset every copy, copy i with ``seed + i`` (a vector environment: with ``seed``): inputs,
        action mask.
        """
        return self._copies.reset(int(seed))

    @property
    def gives_state(self) -> bool:
        """Whether the copies can give their state (see states.py)."""
        return self._copies.gives_state

    def get_state(self) -> dict[str, Any]:
        """What the copies are in the middle of, as JSON can hold it; EnvironmentFault when it cannot."""
        return self._copies.get_state()

    def set_state(self, found: dict[str, Any]) -> tuple[Inputs, np.ndarray | None]:
        """Reset every copy, and go on from what `get_state` gave; returns what the reset did. ValueError for
        a seed that no run has.
        """
        seed = found["seed"]
        if not isinstance(seed, int) or not 0 <= seed < 2**63:
            raise ValueError(f"the seed of the episodes is {str(seed)[:80]}")
        return self._copies.set_state(found)

    def step(self, actions: np.ndarray) -> Step:
        """Act in every copy; ``actions`` [B, A] float32 as sampled, bounds are taken care of here."""
        for rows in self.waves:
            self.begin(rows, actions[rows])
        return self.finish()

    def begin(self, rows: slice, actions: np.ndarray) -> None:
        """Act in the copies of one wave; those in worker processes begin to step at once."""
        self._copies.begin(rows, self.action_layout.squashed(actions) if self.squash else actions)

    def finish(self) -> Step:
        """Step what has not begun and wait for the rest; every wave must have begun, in order."""
        return self._copies.finish()

    @property
    def restarts(self) -> int:
        """How often an environment, or a process of them, was made anew after a fault."""
        return self._copies.restarts

    def count_from(self, restarts: int) -> None:
        """Count restarts from ``restarts`` on: those of the run before it was gone on with."""
        self._copies.count_from(restarts)

    def worker_of(self, row: int) -> int:
        """The worker process that steps a row; 0: this one."""
        return self._copies.worker_of(row)

    def seed_of(self, row: int) -> int:
        """The seed of a row's last seeded reset."""
        return self._copies.seed_of(row)

    def close(self) -> None:
        """Close every copy that was made here and end the workers."""
        self._copies.close()

    def __enter__(self) -> Environments:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def make_environments(
    env: str | gym.Env | Callable[[], gym.Env] | gym.vector.VectorEnv,
    num_envs: int | None = None,
    *,
    backend: str = "auto",
    num_workers: int | None = None,
    squash: bool = False,
    policy: FaultPolicy = FaultPolicy(),  # noqa: B008 - it cannot be changed
) -> Environments:
    """``num_envs`` copies of a Gymnasium id, an instance, a zero-argument factory, or a vector environment
    as it is.

    ``num_envs`` None: 1, or what the vector environment has. A given instance or vector environment is
    stepped but never closed. ``policy``: what a fault of theirs leads to. ValueError: an unknown id, a
    backend the task does not have, an instance that cannot be replicated, spaces that are not supported.
    """
    if backend not in BACKENDS:
        raise ValueError(f"vector backend is {backend!r}; expected one of: {', '.join(BACKENDS)}.")
    if is_vector_env(env):
        return _given(env, num_envs, backend, squash, policy)
    num_envs = 1 if num_envs is None else num_envs
    if num_envs < 1:
        raise ValueError(f"num_envs is {num_envs}; expected at least 1.")
    if not isinstance(env, str | gym.Env) and not callable(env):
        raise ValueError(
            f"env is a {type(env).__name__}; expected a Gymnasium id, an environment, a zero-argument "
            "factory or a "
            "vector environment."
        )
    chosen = _resolve(env, num_envs, backend, num_workers)
    copies: EnvCopies | GuardedVector
    if isinstance(env, str) and chosen.name in ("vector", "envpool"):
        copies = _vector_copies(env, num_envs, chosen, policy)
        return _finish(copies, num_envs, chosen, env, tasks.find_spec(env), squash)
    makers: list[Callable[[], gym.Env]]
    if isinstance(env, str):
        name, makers = env, [lambda: tasks.make_by_id(env)] * num_envs
    elif isinstance(env, gym.Env):
        name, makers = _name(env), tasks.replicas(env, num_envs)
    else:
        name, makers = getattr(env, "__name__", type(env).__name__), [env] * num_envs
    keep_first = isinstance(env, gym.Env)
    copies = EnvCopies(makers, chosen.num_workers, name, keep_first=keep_first, policy=policy)
    return _finish(
        copies, num_envs, chosen, name if isinstance(env, str) else copies.spec_id, copies.spec, squash
    )


def _resolve(env: Any, num_envs: int, backend: str, num_workers: int | None) -> Backend:
    """The backend to use: the forced one where it is possible, else ``choose_backend``'s."""
    cores = available_cores()
    if backend in ("vector", "envpool") and not isinstance(env, str):
        raise ValueError(
            f"vector backend {backend!r} needs a Gymnasium id; {_name(env)} is an object. Use auto."
        )
    if backend == "serial":
        return Backend("serial", 1)
    if backend == "workers":
        return Backend("workers", min(num_envs, num_workers or cores))
    if backend in ("vector", "envpool"):
        return Backend(backend, 1)
    if isinstance(env, str):
        return choose_backend(env, num_envs, num_workers, cores)
    chosen = choose_backend(
        env.spec.id if isinstance(env, gym.Env) and env.spec else None, num_envs, num_workers, cores
    )
    return (
        Backend("serial", 1) if chosen.name == "vector" else chosen
    )  # an instance may have been made otherwise


def _vector_copies(env_id: str, num_envs: int, chosen: Backend, policy: FaultPolicy) -> GuardedVector:
    make: Callable[[int], Any]
    if chosen.name == "vector":
        make = lambda seed: tasks.make_vector_by_id(env_id, num_envs)  # noqa: E731
        vector = make(0)
        return GuardedVector(VectorCopies(lambda seed: vector, env_id), policy, make)
    threads = min(num_envs, available_cores())
    make = lambda seed: tasks.make_envpool(env_id, num_envs, seed, threads)  # noqa: E731
    return GuardedVector(VectorCopies(make, env_id, int32_actions=True), policy, make)


def _given(env: Any, num_envs: int | None, backend: str, squash: bool, policy: FaultPolicy) -> Environments:
    """A vector environment of the user's own."""
    if num_envs not in (None, int(env.num_envs)):
        raise ValueError(
            f"num_envs is {num_envs}, but the vector environment given has {env.num_envs} copies."
        )
    if backend != "auto":
        raise ValueError(
            f"vector backend {backend!r} asked for, but a vector environment was given. Use auto."
        )
    envpool = not isinstance(env, gym.vector.VectorEnv)
    copies = GuardedVector(
        VectorCopies(lambda seed: env, _name(env), keep=True, int32_actions=envpool), policy
    )
    spec = getattr(env, "spec", None)
    return _finish(copies, int(env.num_envs), Backend("given", 1), _name(env), spec, squash)


def _name(env: Any) -> str:
    spec = getattr(env, "spec", None)
    return getattr(spec, "id", None) or type(getattr(env, "unwrapped", env)).__name__


def _finish(
    copies: EnvCopies | GuardedVector, num_envs: int, backend: Backend, spec_id: str, spec: Any, squash: bool
) -> Environments:
    if squash:
        try:
            copies.action_layout.check_squash()
        except ValueError:
            copies.close()
            raise
    limit = getattr(spec, "max_episode_steps", None)
    return Environments(
        copies, num_envs, backend=backend, spec_id=spec_id, max_episode_steps=limit, squash=squash
    )
