"""Faults of a rollout, said before anything is learned from it: numbers that are not finite, probabilities
that are not those of sampling, memory.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from tightrope.algorithms.nonfinite import NonFiniteError, first_bad
from tightrope.algorithms.optimise import SamplingMismatch
from tightrope.language.generation.sample import log_ratio_limit
from tightrope.language.policy.roles import Roles

if TYPE_CHECKING:
    from tightrope.language.alignment.experience import Experience


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
