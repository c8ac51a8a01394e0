"""Complete settings for a task: defaults < preset of the task < settings file < flags; and their memory."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from tightrope.control.presets import BY_TASK, KINDS, preset
from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings
from tightrope.runs import signals

if TYPE_CHECKING:
    from tightrope.control.environments.base import Environments
    from tightrope.control.environments.tasks import EnvSource
    from tightrope.control.spaces.actions import ActionLayout
    from tightrope.control.spaces.observations import ObservationLayout

STEP_BYTES = 48  # of a step beside its observation and action: rewards, values, advantages, flags, twice
# the settings that decide what the task looks like
DESCRIBE = ("encoder", "env_kwargs", "observation_keys", "vector_backend", "env_timeout")


def resolve(env: EnvSource, algorithm: str = "ppo", overrides: dict[str, Any] | None = None) -> TrainSettings:
    """The settings for a task (a Gymnasium id, an environment, a factory or a vector environment).

    Raises ValueError for values out of range and for names that the algorithm does not know.
    """
    return resolve_with_preset(env, algorithm, overrides)[0]


def resolve_with_preset(
    env: EnvSource, algorithm: str = "ppo", overrides: dict[str, Any] | None = None
) -> tuple[TrainSettings, dict[str, Any]]:
    """The settings as `resolve` gives them, and what the task's preset would set where nothing is given."""
    from tightrope.control.environments.tasks import name_of, time_limit
    from tightrope.control.environments.vector import is_vector_env

    values = dict(overrides or {})
    algorithm = values.pop("algorithm", algorithm)
    if algorithm not in ALGORITHM_SETTINGS:
        raise ValueError(f"algorithm is {algorithm!r}; expected one of: {', '.join(ALGORITHM_SETTINGS)}.")
    env_id = name_of(env)
    if env_id in BY_TASK[algorithm]:
        chosen, limit = preset(env_id, algorithm), time_limit(env, values.get("env_kwargs"))
    else:
        kind, limit = _describe(env, {name: values[name] for name in DESCRIBE if name in values})
        chosen = preset(env_id, algorithm, kind, limit)
    if is_vector_env(env):  # it has its own number of copies
        chosen["num_envs"] = int(env.num_envs)
    merged = {"num_envs": 8, "num_steps": 256, **chosen, **values}
    sizes = (merged["num_envs"], merged["num_steps"])
    if algorithm == "ppo" and "minibatch_size" not in values and all(type(size) is int for size in sizes):
        chosen["minibatch_size"] = max(1, min(chosen.get("minibatch_size", 64), sizes[0] * sizes[1]))
    settings = TrainSettings(env=env_id).with_values(algorithm=algorithm, **{**chosen, **values})
    return settings, chosen


def anywhere(settings: TrainSettings, env: EnvSource, **values: Any) -> TrainSettings:
    """The settings for another environment: who steps it is chosen again, and what was built with the
    arguments of the old one is not built with them.
    """
    import gymnasium as gym

    from tightrope.control.environments.tasks import name_of, require_keywords
    from tightrope.control.environments.vector import is_vector_env

    made = isinstance(env, gym.Env) or is_vector_env(env)
    kept = settings.env_kwargs if name_of(env) == settings.env and not made else None
    if kept and settings.env == "<lambda>":  # they share a name: one that does not take them is another
        try:
            require_keywords(env, kept)
        except ValueError:
            kept = None
    return dataclasses.replace(settings, vector_backend="auto", num_workers=None, env_kwargs=kept, **values)


def _describe(env: EnvSource, values: dict[str, Any]) -> tuple[str, int | None]:
    """``discrete``, ``continuous`` or ``images``, and the time limit, of a task that no preset lists."""
    from tightrope.control.environments.copies import makers_of
    from tightrope.control.environments.faults import RAISED, fault_while
    from tightrope.control.environments.tasks import (
        close_environment,
        make_all,
        make_vector_by_id,
        time_limit,
    )
    from tightrope.control.environments.vector import is_vector_env
    from tightrope.control.environments.watchdog import limited
    from tightrope.control.spaces.actions import action_layout
    from tightrope.control.spaces.observations import observation_layout

    given = TrainSettings(**values)
    made: list[Any] = []
    limit = functools.partial(limited, timeout=given.env_timeout)
    # a constructor may move away, and a KeyboardInterrupt of its own is no Ctrl-C
    with contextlib.chdir("."), signals.stoppable(only_ctrl_c=True), contextlib.ExitStack() as stack:
        if isinstance(env, str) and env.startswith("ALE/") and given.vector_backend in ("auto", "vector"):
            made.append(make_vector_by_id(env, 1, given.env_kwargs))
        elif not is_vector_env(env):
            make_all(makers_of(env, 1, given.env_kwargs), made, limit=limit)
        if made and made[0] is not env:
            stack.callback(close_environment, made[0], 0, limit)
        task: Any = made[0] if made else env
        prefix = "single_" if is_vector_env(task) else ""
        try:  # properties are code of the environment too
            found = [getattr(task, f"{prefix}{name}_space") for name in ("observation", "action")]
        except RAISED as error:
            raise fault_while("Asking for the spaces of", 0, error) from error
        observations = observation_layout(found[0], given.encoder, given.observation_keys)
        actions = action_layout(found[1])
        steps = time_limit(env if isinstance(env, str) else task, given.env_kwargs)
    if observations.images:
        return "images", steps
    continuous = any(component.kind == "gaussian" for component in actions.components)  # mixed ones too
    return ("continuous" if continuous else "discrete"), steps


def require_room(
    settings: TrainSettings,
    observations: ObservationLayout | None = None,
    actions: ActionLayout | None = None,
    *,
    own_policy: bool = False,
) -> None:
    """DoesNotFit when rollout and networks need more memory than there is. Without layouts, before an
    environment is made, observation and action count as one number each.
    """
    from tightrope.training.memory import SHARE, DoesNotFit, available_memory

    size = 1 if observations is None else observations.size
    one = {} if observations is None else observations.allocate(1)
    pixels = sum(x.nbytes for name, x in one.items() if name.startswith("image"))
    columns = 1 if actions is None else actions.num_columns + actions.num_logits
    steps = settings.num_envs * settings.num_steps
    rollout = steps * (STEP_BYTES + (8 + 4) * size + 4 * columns + pixels)  # raw and seen
    weights = 0
    if not own_policy:
        half = sum((n + 1) * m for n, m in pairwise([size, *settings.hidden, columns]))
        weights = 16 * (half if settings.shared else 2 * half)  # with gradients and Adam's moments
    available = available_memory("cpu")
    if available is None or rollout + weights <= SHARE * available:
        return
    large = max(rollout, weights)
    advice = "num_envs or num_steps" if large == rollout else "hidden"
    raise DoesNotFit(
        f"A rollout of num_envs {settings.num_envs:,} * num_steps {settings.num_steps:,} steps takes "
        f"{_gigabytes(rollout)}, the networks of hidden {' '.join(map(str, settings.hidden))} with Adam's "
        f"moments {_gigabytes(weights)}; {_gigabytes(available)} of memory are available. Choose a smaller "
        f"{advice}."
    )


def _gigabytes(size: float) -> str:
    return f"{size / 1e9:,.1f} GB"


def resolved(
    settings: TrainSettings, environments: Environments, engine: str, threads: int | None
) -> TrainSettings:
    """The settings with every choice that was made, as settings.json holds them."""
    given, workers = environments.backend == "given", environments.backend in ("mixed", "workers")
    return dataclasses.replace(
        settings,
        num_envs=environments.num_envs,
        vector_backend="auto" if given else environments.backend,
        num_workers=environments.num_workers if workers else None,
        engine=engine,
        threads=threads,
    )


def without_effect(settings: TrainSettings, actions: ActionLayout, *, own_policy: bool) -> list[str]:
    """Which settings were changed, other than by a preset, and do nothing for these actions, or for a policy
    module of the user's own.
    """
    usual = [vars(TrainSettings()), *(preset(settings.env, settings.algorithm, kind) for kind in KINDS)]
    reasons: dict[str, str] = {}
    if not actions.gaussian.any():
        reasons |= dict.fromkeys(("std", "log_std_init", "action_bounds"), "the task has no Box action")
    if own_policy:
        reasons |= dict.fromkeys(("hidden", "activation", "shared"), "the policy is a module of your own")
    return settings.without_effect(usual) + [
        f"{name} has no effect: {reason}."
        for name, reason in reasons.items()
        if all(getattr(settings, name) != values.get(name, ...) for values in usual)
    ]
