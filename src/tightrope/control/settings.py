"""The settings of the control story: one frozen dataclass for ``tightrope train``, the algorithm's own as a
field.
"""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tightrope.algorithms.settings import (
    A2CSettings,
    PPOSettings,
    ReinforceSettings,
    UpdateSettings,
    check_ranges,
    setting,
)
from tightrope.settings.peer_names import PEER_NAMES

Algorithm = Literal["ppo", "a2c", "reinforce"]
ALGORITHM_SETTINGS: dict[str, type[UpdateSettings]] = {
    "ppo": PPOSettings,
    "a2c": A2CSettings,
    "reinforce": ReinforceSettings,
}


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """Train a policy on a Gymnasium task."""

    env: str = setting("CartPole-v1", "Gymnasium id of the task.")
    algorithm: Algorithm = setting("ppo", "The update rule.", choices=tuple(ALGORITHM_SETTINGS))
    update: UpdateSettings = dataclasses.field(
        default_factory=PPOSettings, metadata={"doc": "The update rule's."}
    )

    total_steps: int = setting(100_000, "Agent steps to train for; never exceeded.", at_least=1)
    seed: int = setting(
        0, "Seed of everything random; same seed and settings on one machine: same bits.", at_least=0
    )
    num_envs: int = setting(8, "Copies of the task that run side by side.", at_least=1)
    num_steps: int = setting(256, "Steps of each copy per rollout.", at_least=1)

    hidden: tuple[int, ...] = setting(
        (64, 64), "Widths of the hidden layers of actor and critic.", at_least=1
    )
    activation: str = setting("tanh", "Between the layers.", choices=("tanh", "relu", "elu", "silu"))
    shared: bool = setting(False, "Actor and critic share their hidden layers.")
    std: str = setting(
        "independent",
        "Box actions' deviation: one number a dimension, a function of the state, or gSDE noise.",
        choices=("independent", "state", "gsde"),
    )
    log_std_init: float = setting(0.0, "Log of the first deviation of Box actions.", at_least=-10, at_most=3)
    gsde_steps: int = setting(8, "With gSDE: steps for which one exploration matrix is held.", at_least=1)
    squash: bool = setting(
        False, "Box actions pass through tanh onto the bounds; off: clipped to the bounds."
    )

    normalise_observations: bool = setting(
        False, "Observations to mean 0, deviation 1 by running statistics."
    )
    normalise_rewards: bool = setting(
        False, "Rewards divided by the running deviation of the discounted return."
    )

    vector_backend: str = setting(
        "auto",
        "Who steps the copies: this process, worker processes, the task's own vector version, or EnvPool.",
        choices=("auto", "serial", "workers", "vector", "envpool"),
    )
    num_workers: int | None = setting(
        None,
        "With workers: processes to spread the copies over; none: one a core, this process included.",
        at_least=1,
    )
    engine: str = setting(
        "auto",
        "Who computes the update: the compiled CPU engine or torch.",
        choices=("auto", "fused", "torch"),
    )
    device: str = setting("cpu", "Torch device of the networks: cpu, cuda, cuda:1, mps.")
    threads: int | None = setting(
        None,
        "CPU threads of torch and BLAS; none: 1 for MLPs (more only spin), every core for images.",
        at_least=1,
    )
    compile: bool = setting(False, "Torch path: compile the model with torch.compile.")

    on_env_fault: str = setting(
        "raise",
        "When an environment raises, hangs, dies or gives NaN: end the run, or make it anew and go on.",
        choices=("raise", "restart"),
    )
    max_env_restarts: int = setting(
        10,
        "With on_env_fault restart: environments made anew at most, in all; then the run ends.",
        at_least=1,
    )
    env_timeout: float | None = setting(
        60.0, "Seconds a step or a reset of an environment may take before it counts as hung; none: any.",
        above=0,
    )  # fmt: skip

    evaluate_every: float | None = setting(
        0.05,
        "Fraction of the run between evaluations; none: no evaluation while training.",
        above=0,
        at_most=1,
    )
    evaluation_episodes: int = setting(
        10, "Episodes per evaluation, deterministic, on seeds of their own.", at_least=1
    )
    checkpoint_every: float | None = setting(
        0.05,
        "Fraction of the run between checkpoints, where most environments begin anew; none: only the last.",
        above=0,
        at_most=1,
    )
    keep_checkpoints: int | None = setting(
        3, "Checkpoints that are kept, the newest ones; the best policy always is. none: all.", at_least=2
    )
    max_rollbacks: int = setting(
        0,
        "After a NaN or an infinity: go back to the newest checkpoint this often; 0: end the run.",
        at_least=0,
    )
    tensorboard: bool = setting(False, "Also write TensorBoard event files into the run folder.")

    def __post_init__(self) -> None:
        """Check ranges, and the settings that must fit each other."""
        check_ranges(self)
        expected = ALGORITHM_SETTINGS[self.algorithm]
        if not isinstance(self.update, expected):
            raise ValueError(
                f"update is {type(self.update).__name__}; algorithm {self.algorithm} needs "
                f"{expected.__name__}."
            )
        size, rollout = getattr(self.update, "minibatch_size", None), self.num_envs * self.num_steps
        if size is not None and size > rollout:
            raise ValueError(
                f"minibatch_size is {size}, larger than a rollout of num_envs * num_steps = {self.num_envs} "
                f"* {self.num_steps} = {rollout} steps. Choose minibatch_size <= {rollout} or collect more "
                "steps."
            )

    def risks(self) -> list[str]:
        """What is unusual about these settings and why it is risky; they are trained as asked all the
        same.
        """
        update, found = self.update, []
        if isinstance(update, PPOSettings):
            if update.kl_beta is None and max(update.clip, update.clip_high or 0.0) > 0.3:
                found.append(
                    f"clip {max(update.clip, update.clip_high or 0.0):g} is above 0.3: the clip hardly acts "
                    "and the policy can collapse. Usual: 0.1 to 0.3."
                )
            if update.num_epochs > 15:
                found.append(
                    f"num_epochs {update.num_epochs} is above 15: ratios drift and nearly every step is "
                    "clipped. Usual: 4 to 10, or set target_kl 0.015."
                )
        if not update.normalise_advantages:
            found.append(
                "advantages are not normalised: the learning rate then depends on the scale of the rewards."
            )
        if update.max_grad_norm is None:
            found.append(
                "gradients are not clipped: one bad minibatch can destroy the policy. Usual: max_grad_norm "
                "0.5."
            )
        return found

    def with_values(self, **values: Any) -> TrainSettings:
        """The same settings with these changed; names of the update rule's fields are found there."""
        names = {f.name for f in dataclasses.fields(self)}
        algorithm = values.get("algorithm", self.algorithm)
        kind = ALGORITHM_SETTINGS[algorithm]
        update_names = {f.name for f in dataclasses.fields(kind)}
        own = {k: v for k, v in values.items() if k in names}
        inner = {k: v for k, v in values.items() if k not in names}
        unknown = sorted(set(inner) - update_names)
        if unknown:
            near = [PEER_NAMES.get(unknown[0]), *difflib.get_close_matches(unknown[0], names | update_names)]
            hint = next((f" Did you mean {name}?" for name in near if name), "")
            raise ValueError(f"{algorithm} has no setting named {', '.join(unknown)}.{hint}")
        update = own.get("update", self.update)
        own["update"] = dataclasses.replace(update, **inner) if isinstance(update, kind) else kind(**inner)
        return dataclasses.replace(self, **own)


def settings_to_json(settings: TrainSettings) -> dict[str, Any]:
    """The settings as settings.json holds them: plain JSON types, the update rule's under ``update``."""

    def plain(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        return {name: list(value) if isinstance(value, tuple) else value for name, value in pairs}

    return dataclasses.asdict(settings, dict_factory=plain)


def settings_from_json(data: Any) -> TrainSettings:
    """The settings that `settings_to_json` wrote; a name left out has its default. Raises ValueError."""
    return TrainSettings().with_values(**values_from_json(data))


def values_from_json(data: Any) -> dict[str, Any]:
    """The values a settings.json names, flat, for `TrainSettings.with_values`: names and types checked.

    Raises ValueError for an unknown name (with the nearest one) and for a value of another type.
    """
    if not isinstance(data, dict):
        raise ValueError(f"Settings are {type(data).__name__}, expected an object with names and values.")
    algorithm = data.get("algorithm", "ppo")
    if algorithm not in ALGORITHM_SETTINGS:
        raise ValueError(f"algorithm is {algorithm!r}; expected one of: {', '.join(ALGORITHM_SETTINGS)}.")
    inner = data.get("update", {})
    if not isinstance(inner, dict):
        raise ValueError(f"update is {inner!r}; expected an object with the settings of {algorithm}.")
    outer = {name: value for name, value in data.items() if name != "update"}
    return typed_values(outer, TrainSettings) | typed_values(inner, ALGORITHM_SETTINGS[algorithm])


def typed_values(values: dict[str, Any], kind: type) -> dict[str, Any]:
    """Values of a settings class as JSON holds them, by name, as the types of its fields.

    Raises ValueError for an unknown name (with the nearest one) and for a value of another type.
    """
    hints = get_type_hints(kind)
    for name in values:
        if name not in hints:
            near = difflib.get_close_matches(name, hints, n=1)
            raise ValueError(
                f"{kind.__name__} has no setting named {name!r}."
                + (f" Did you mean {near[0]!r}?" if near else "")
            )
    return {name: _typed(name, value, hints[name]) for name, value in values.items()}


def _typed(name: str, value: Any, hint: Any) -> Any:
    """``value`` as the type of the field: a list becomes a tuple, an int a float; ValueError for anything
    else.
    """
    kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    if value is None and NoneType in kinds:
        return None
    kind = str if get_origin(kinds[0]) is Literal else kinds[0]
    if get_origin(kind) is tuple and isinstance(value, list) and all(type(item) is int for item in value):
        return tuple(value)
    if kind is float and type(value) in (int, float):
        return float(value)
    if type(value) is kind:
        return value
    expected = "whole numbers in a list" if get_origin(kind) is tuple else kind.__name__
    raise ValueError(f"{name} is {value!r}; expected {expected}{' or null' if NoneType in kinds else ''}.")
