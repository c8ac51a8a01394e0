"""Faults of a rollout, said before anything is learned from it: numbers that are not finite, probabilities
that are not those of sampling, memory.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch

from tightrope.algorithms.memory import OutOfMemory, free, is_out_of_memory
from tightrope.algorithms.nonfinite import NonFiniteError, first_bad
from tightrope.algorithms.optimise import SamplingMismatch
from tightrope.language.roles import Roles
from tightrope.language.sampling import log_ratio_limit

if TYPE_CHECKING:
    from tightrope.language.collect import Experience

F = TypeVar("F", bound=Callable[..., Any])


def advising_on_memory(function: F) -> F:
    """``function(roles, ...)``, which where memory runs out does without ``keep``; without it an OutOfMemory
    says which setting to lower.
    """

    @functools.wraps(function)
    def advising(roles: Roles, *args: Any, **how: Any) -> Any:
        try:
            return function(roles, *args, **how)
        except (RuntimeError, MemoryError) as error:
            if isinstance(error, OutOfMemory) or not is_out_of_memory(error):
                raise
            if not how.get("keep"):
                raise _advice(roles, error) from error
        # outside the except clause, which keeps the failed pass's tensors alive
        free()
        found = advising(roles, *args, **{**how, "keep": False})
        found.short_of_memory = True
        return found

    return cast(F, advising)


def _advice(roles: Roles, error: BaseException) -> OutOfMemory:
    reason = (str(error).splitlines() or [""])[0][:200]
    return OutOfMemory(
        f"Memory is not enough to sample {roles.settings.batch_size} responses at once ({reason}). Choose a "
        "smaller --batch-size, --max-new-tokens or --max-prompt-tokens; --micro-batch-size makes the pass "
        "over the finished responses smaller."
    )


def refuse_bad_numbers(experience: Experience, roles: Roles) -> None:
    """NonFiniteError when a role gave a number that is not finite; a bad weight is named."""
    said: tuple[tuple[str, torch.Tensor], ...] = (
        ("log-probability of sampling", experience.responses.logp),
        ("log-probability", experience.logp),
        ("log-probability of the reference", experience.ref_logp),
        ("entropy", experience.entropy),
        ("KL to the reference", experience.exact),
        ("value", experience.values),
    )
    mask = experience.responses.mask
    found = first_bad((f"The {name} of response, token ", torch.where(mask, x, 0.0)) for name, x in said)
    if found is None:
        return
    weight = first_bad((f"the weight {name}", p) for name, p in roles.named_parameters())
    raise NonFiniteError(
        f"{found}; expected a finite number, but {weight or 'every weight is one: sums overflow'}. Nothing "
        "was learned from this batch. Look for a learning rate that is too high."
    )


def refuse_mismatch(gap: float, dtype: str, *, first: bool) -> None:
    """SamplingMismatch when log-probabilities of sampling and of the pass that trains are further apart, in
    nats, than rounding can be. ``first``: nothing was learned yet.
    """
    limit = log_ratio_limit(dtype)
    # rounding has a tail that grows with the tokens of a run: in bfloat16 the beginning is judged
    judged = dtype == "float32" or first or not math.isfinite(gap)
    if judged and not gap <= limit:
        raise SamplingMismatch(
            f"The log-probabilities of sampling and of the forward pass that trains differ by {gap:.3g} "
            f"nats (limit {limit:g} in {dtype}). Likely causes: the model says something else with its KV "
            "cache than without, layers that look back over a window or were shared wrongly, a module that "
            "draws random numbers, or too coarse a precision. See tightrope doctor --model, and try --dtype "
            "float32, or lora_layers left out."
        )
