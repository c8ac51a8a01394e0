"""The settings of the update rules: frozen data, checked where they are made, imported without torch.

Each field carries its own one-line help and its range; the command line, the validation and the docs read
them here.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args, get_type_hints

Schedule = Literal["constant", "linear", "cosine"]


def setting(
    default: Any,
    doc: str,
    *,
    at_least: float | None = None,
    at_most: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A dataclass field with its help text and its range.

    ``at_least`` and ``at_most`` are inclusive, ``above`` is exclusive, ``choices`` lists the words allowed.
    A default of None means the setting is optional and ``none`` on the command line switches it off.
    """
    metadata = {"doc": doc, "at_least": at_least, "at_most": at_most, "above": above, "choices": choices}
    return dataclasses.field(default=default, metadata=metadata)


def range_text(metadata: Any) -> str:
    """The range of a field in words: ``0 < x <= 1``, ``a | b``, or an empty string when anything goes."""
    if metadata.get("choices"):
        return " | ".join(metadata["choices"])
    low = (
        f"{metadata['above']:g} < "
        if metadata.get("above") is not None
        else f"{metadata['at_least']:g} <= "
        if metadata.get("at_least") is not None
        else ""
    )
    high = f" <= {metadata['at_most']:g}" if metadata.get("at_most") is not None else ""
    return f"{low}x{high}" if low or high else ""


def check_types(settings: Any) -> None:
    """Raise ValueError for a value of the wrong kind; a whole number is taken for a float, a list for a
    tuple.
    """
    for name, hint in get_type_hints(type(settings)).items():
        if name not in getattr(settings, "__dataclass_fields__", {}):
            continue
        value, kinds = getattr(settings, name), set(get_args(hint)) | {hint}
        words = str(hint).replace("typing.", "").removeprefix("<class '").removesuffix("'>")
        if value is None:
            good = type(None) in kinds
        elif float in kinds and isinstance(value, int) and not isinstance(value, bool):
            object.__setattr__(settings, name, float(value))
            good = True
        elif "tuple" in words:
            good = isinstance(value, list | tuple) and all(type(x) is int for x in value)
            object.__setattr__(settings, name, tuple(value) if good else value)
        else:
            plain = {kind for kind in kinds if kind in (bool, int, float, str)}
            good = not plain or (type(value) in plain) or (isinstance(value, str) and "Literal" in words)
        if not good:
            raise ValueError(f"{name} is {value!r} ({type(value).__name__}); expected {words}.")


def check_ranges(settings: Any) -> None:
    """Raise ValueError naming the first field of a wrong kind or outside its declared range."""
    check_types(settings)
    for field in dataclasses.fields(settings):
        value, metadata = getattr(settings, field.name), field.metadata
        if value is None:
            continue
        if metadata.get("choices") and value not in metadata["choices"]:
            raise ValueError(f"{field.name} is {value!r}; expected one of: {', '.join(metadata['choices'])}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            too_low = metadata.get("at_least") is not None and number < metadata["at_least"]
            at_edge = metadata.get("above") is not None and number <= metadata["above"]
            too_high = metadata.get("at_most") is not None and number > metadata["at_most"]
            if too_low or at_edge or too_high or not math.isfinite(number):
                expected = range_text(metadata) or "a finite number"
                raise ValueError(
                    f"{field.name} is {value!r}; expected {expected}. Choose a value in that range."
                )


def scheduled(value: float | None, schedule: Schedule, progress: float) -> float | None:
    """The value of a schedule at ``progress`` in [0, 1]; linear and cosine fall from the value to 0.

    linear: value * (1 - progress);  cosine: value * (1 + cos(pi * progress)) / 2;  None stays None.
    """
    if value is None or schedule == "constant":
        return value
    factor = 1.0 - progress if schedule == "linear" else 0.5 * (1.0 + math.cos(math.pi * progress))
    return value * factor


SCHEDULES = get_args(Schedule)


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """What every update rule of the family reads."""

    gamma: float = setting(
        0.99, "Discount per step: a reward k steps ahead counts gamma^k.", above=0, at_most=1
    )
    gae_lambda: float = setting(
        0.95, "GAE's lambda: 0 = one-step TD error (bias), 1 = Monte Carlo (variance).", at_least=0, at_most=1
    )
    value_weight: float = setting(0.5, "Weight of the value loss in the total loss.", at_least=0)
    entropy_weight: float = setting(
        0.0, "Weight of the entropy bonus; more keeps the policy exploring for longer.", at_least=0
    )
    entropy_weight_schedule: Schedule = setting(
        "constant", "How entropy_weight falls over the run.", choices=SCHEDULES
    )
    learning_rate: float = setting(
        3e-4, "Adam's step size (actor, and critic unless it has its own).", above=0
    )
    critic_learning_rate: float | None = setting(
        None, "Adam's step size for the critic; none: the same.", above=0
    )
    learning_rate_schedule: Schedule = setting(
        "linear", "How both learning rates fall over the run.", choices=SCHEDULES
    )
    adam_eps: float = setting(
        1e-5, "Adam's epsilon; 1e-5 is PPO's habit, torch's own default is 1e-8.", above=0
    )
    max_grad_norm: float | None = setting(
        0.5, "One joint limit on the norm of all gradients; none: gradients are not clipped.", above=0
    )
    normalise_advantages: bool = setting(True, "Advantages to mean 0 and deviation 1 within each minibatch.")
    micro_batch_size: int | None = setting(
        None,
        "Rows per forward pass; splits a minibatch to save memory, the gradient stays the same.",
        at_least=1,
    )

    def __post_init__(self) -> None:
        """Check every field against its range."""
        check_ranges(self)

    def at(self, progress: float) -> Self:
        """The settings in force at ``progress`` in [0, 1]: each scheduled number at its present value."""
        names = [f.name for f in dataclasses.fields(self) if f.name.endswith("_schedule")]
        bases = {name.removesuffix("_schedule"): getattr(self, name) for name in names}
        bases["critic_learning_rate"] = self.learning_rate_schedule
        return self.unchecked(
            **{base: scheduled(getattr(self, base), schedule, progress) for base, schedule in bases.items()}
        )

    def unchecked(self, **values: Any) -> Self:
        """A copy with these values, not checked: what is in force may lie at the edge of what a user may
        ask.
        """
        copy = object.__new__(type(self))
        for field in dataclasses.fields(self):
            object.__setattr__(copy, field.name, values.get(field.name, getattr(self, field.name)))
        return copy


@dataclass(frozen=True, kw_only=True)
class PPOSettings(UpdateSettings):
    """Proximal policy optimisation (Schulman et al. 2017)."""

    num_epochs: int = setting(10, "Passes over each rollout; above 15 ratios drift far from 1.", at_least=1)
    minibatch_size: int = setting(64, "Steps per optimiser step (language: responses).", at_least=1)
    clip: float = setting(
        0.2, "The ratio new/old probability may move this far from 1 before its gradient is cut.", above=0
    )
    clip_schedule: Schedule = setting("constant", "How clip falls over the run.", choices=SCHEDULES)
    clip_high: float | None = setting(
        None, "Another upper side for the clip (1 + clip_high); none: clip.", above=0
    )
    dual_clip: float | None = setting(
        None, "Bound the loss of bad actions at dual_clip * |advantage|; none: off, 3 is usual.", above=1
    )
    value_clip: float | None = setting(
        None,
        "Also keep value updates within +- this (returns' units after reward scaling); none: off.",
        above=0,
    )
    target_kl: float | None = setting(
        None, "Stop the whole update before a step whose minibatch KL exceeds this; 0.015 is usual.", above=0
    )
    kl_beta: float | None = setting(
        None, "Use the KL-penalised surrogate with this weight in place of the clip; none: clip.", above=0
    )
    kl_adapt: float | None = setting(
        None,
        "With kl_beta: the KL per update aimed at, kl_beta doubles or halves to reach it; none: fixed.",
        above=0,
    )
    recompute_advantages: bool = setting(
        False, "Estimate values and advantages anew before each later epoch."
    )


@dataclass(frozen=True, kw_only=True)
class A2CSettings(UpdateSettings):
    """Synchronous advantage actor-critic (Mnih et al. 2016): one step per rollout."""


@dataclass(frozen=True, kw_only=True)
class ReinforceSettings(UpdateSettings):
    """REINFORCE (Williams 1992): Monte Carlo returns, one step per rollout."""

    gae_lambda: float = setting(1.0, "REINFORCE is lambda 1: whole returns.", at_least=1, at_most=1)
    baseline: bool = setting(True, "Subtract the critic's value; off: plain returns of finished episodes.")
