"""The metrics of a rollout, and what is refused before anything is learned from it: numbers that are not
finite, and probabilities that are not those of sampling.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.descent import SamplingMismatch
from tightrope.algorithms.nonfinite import NonFiniteError, first_bad
from tightrope.language.generation.sample import GapLimits
from tightrope.language.policy.policy_model import Experience
from tightrope.language.policy.roles import Roles
from tightrope.language.reward.functions import Scores
from tightrope.maths import divergence
from tightrope.maths.statistics import masked_mean, masked_sum


def rollout_metrics(
    experience: Experience, scores: Scores, rewards: Tensor, kl_share: Tensor, valid: Tensor
) -> dict[str, float]:
    """The metrics of a rollout: sums over a response, and means over tokens where the name says so.
    ``rewards`` and the share of the KL in them, before any scaling, are [B, R].

    Scores and rewards are those of the responses that count, everything else is of all of them; NaN for a
    score where none counts.
    """
    mask, ended = experience.responses.mask, experience.responses.ended
    stopped = experience.responses.stopped
    log_ratio = torch.where(mask, experience.ref_logp - experience.logp, 0.0)
    total = scores.total[scores.valid]
    nan = float("nan")
    estimators = {
        "objective/kl": divergence.k1,
        "objective/kl_k2": divergence.k2,
        "objective/kl_k3": divergence.k3,
    }
    kls = {name: estimate(log_ratio) for name, estimate in estimators.items()}
    per_token = {
        "objective/kl_token_mean": kls["objective/kl"],
        "objective/entropy_token_mean": -experience.logp,
    }
    per_response = {
        **kls,
        "objective/kl_exact": experience.exact,
        "objective/entropy": -experience.logp,
        "objective/entropy_exact": experience.entropy,
    }
    counting = mask & valid[:, None]
    sums = {name: (x, mask, len(mask)) for name, x in per_response.items()} | {
        "objective/rlhf_reward": (rewards, counting, len(total)),
        "objective/non_score_reward": (kl_share, counting, len(total)),
    }
    gap = (experience.responses.logp - experience.logp)[mask].abs()
    return {
        **{name: float(masked_sum(x, of)) / count if count else nan for name, (x, of, count) in sums.items()},
        **{name: float(masked_mean(x, mask)) for name, x in per_token.items()},
        "objective/scores": float(np.mean(total)) if len(total) else nan,
        "objective/scores_std": float(np.std(total)) if len(total) else nan,
        "objective/response_length": float(mask.sum()) / len(mask),
        "objective/eos_fraction": float((ended if stopped is None else ended & ~stopped).float().mean()),
        **({} if stopped is None else {"objective/stop_fraction": float(stopped.float().mean())}),
        "objective/truncated_fraction": float((~ended).float().mean()),
        "objective/masked_samples": float((~valid).sum()),
        "objective/distinct_2": distinct_ngrams(experience.ids),
        "objective/sampling_gap": float(gap.max()) if gap.numel() else 0.0,
        "time/generate_seconds": experience.seconds,
        "time/tokens_per_second": float(mask.sum()) / max(experience.seconds, 1e-9),
    }


def distinct_ngrams(rows: list[list[int]], n: int = 2) -> float:
    """Distinct n-grams / all n-grams over a batch: falls towards 0 when responses repeat themselves."""
    grams = [tuple(row[k : k + n]) for row in rows for k in range(len(row) - n + 1)]
    return len(set(grams)) / len(grams) if grams else 1.0


def refuse_bad_numbers(experience: Experience, roles: Roles) -> None:
    """NonFiniteError when a role computed a number that is not finite; the message names the first bad
    weight, where there is one.
    """
    figures = (
        ("log-probability of sampling", experience.responses.logp),
        ("log-probability", experience.logp),
        ("log-probability of the reference", experience.ref_logp),
        ("entropy", experience.entropy),
        ("KL to the reference", experience.exact),
        ("value", experience.values),
    )
    mask = experience.responses.mask
    found = first_bad([(f"The {name} of response, token ", torch.where(mask, x, 0.0)) for name, x in figures])
    if found is None:
        return
    weight = first_bad((f"the weight {name}", p) for name, p in roles.named_parameters())
    raise NonFiniteError(
        f"{found}; expected a finite number, but {weight or 'every weight is one: sums overflow'}. Nothing "
        "was learned from this batch. Look for a learning rate that is too high."
    )


def warn_of_mismatch(
    metrics: dict[str, float],
    roles: Roles,
    warned: set[tuple[str, str]],
    warn: Callable[[str], None],
    *,
    first: bool,
) -> None:
    """`check_mismatch` of a rollout; its warning is given once a run, and is then in ``warned``."""
    gap = metrics["objective/sampling_gap"]
    words = check_mismatch(gap, roles.gap_limits, roles.settings.dtype, first=first)
    if words is not None and ("sampling", "gap") not in warned:
        warned.add(("sampling", "gap"))
        warn(words)


def check_mismatch(gap: float, limits: GapLimits, dtype: str, *, first: bool) -> str | None:
    """Whether log-probabilities of sampling and of the pass that trains differ by more than rounding
    explains: None, or words for a warning. ``gap`` in nats; ``first``: nothing was learned yet.

    SamplingMismatch where the gap is above what ends a run.
    """
    # the tail of rounding errors grows with the tokens of a run: in bfloat16 only the beginning is checked
    checked = dtype == "float32" or first or not math.isfinite(gap)
    if not checked or gap <= limits.rounding:
        return None
    seen = (
        f"The log-probabilities of sampling and of the forward pass that trains differ by {gap:.3g} nats, "
        f"more than rounding explains in {dtype} in a model of this size ({limits.rounding:.2g})"
    )
    if gap <= limits.stop:
        return f"{seen}. The run ends above {limits.stop:.2g}. See tightrope doctor --model."
    raise SamplingMismatch(
        f"{seen}, and above the limit {limits.stop:.2g}. Likely causes: the model computes other numbers "
        "with its KV cache, layers that look back over a window or were shared wrongly, a module that draws "
        "random numbers, or too coarse a precision. See tightrope doctor --model, and try --dtype float32, "
        "or lora_layers left out."
    )
