"""One iteration's experience: prompts -> responses -> scores -> rewards per token -> advantages -> Batch."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch
from tightrope.language.alignment.kl import kl_rewards
from tightrope.language.data.batching import length_groups, pad_left
from tightrope.language.data.examples import Prompt
from tightrope.language.generation.distribution import token_statistics
from tightrope.language.generation.sample import Completions, Responses, sample
from tightrope.language.memory.exhausted import advising_on_memory
from tightrope.language.policy.policy_model import Said
from tightrope.language.policy.roles import Roles
from tightrope.language.reward.functions import Scores
from tightrope.language.settings import AlignSettings
from tightrope.maths import divergence, returns
from tightrope.maths.statistics import masked_mean, masked_sum, masked_variance


@dataclass
class Experience(Completions):
    """Responses and what the roles say of them.

    ``logp``, ``ref_logp``, ``entropy``, ``exact`` (KL of the state), ``values``: [B, R]. ``final_values``
    [B]: V of the state after the last token. ``lower`` and ``ref_hidden`` are kept for the epochs that
    follow, ``said`` for the first one: the same numbers with their gradients; ``short_of_memory`` where they
    did not fit.
    """

    logp: Tensor
    ref_logp: Tensor
    entropy: Tensor
    exact: Tensor
    values: Tensor
    final_values: Tensor
    ref_hidden: Tensor | None
    said: Said | None
    short_of_memory: bool = False

    @property
    def last(self) -> Tensor:
        """[B]: the column of each response's last real token."""
        return self.responses.mask.sum(1) - 1


class PromptOrder:
    """Prompts in a fresh random order for every pass over them: a function of seed and position alone."""

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.seed, self.position = count, seed, 0

    def take(self, number: int) -> list[int]:
        """The indices of the next prompts; ``position`` says how many were taken so far."""
        taken = []
        for place in range(self.position, self.position + number):
            order = np.random.default_rng([self.seed, 7, place // self.count]).permutation(self.count)
            taken.append(int(order[place % self.count]))
        self.position += number
        return taken


@advising_on_memory
def respond(roles: Roles, prompts: Sequence[Prompt], seed: int, iteration: int, samples: int) -> Completions:
    """``samples`` responses of the policy to each prompt; rows of one prompt are neighbours."""
    settings, begin = roles.settings, time.perf_counter()
    device = next(roles.model.parameters()).device
    tokens, real = (x.to(device) for x in pad_left([prompt.tokens for prompt in prompts]))
    shape = len(prompts) * samples, settings.max_new_tokens
    uniforms = torch.from_numpy(np.random.default_rng([seed, 8, iteration]).random(shape)).to(device)
    with roles.frozen_policy():
        responses = sample(
            roles.model, tokens, real, roles.sampling, uniforms, roles.eos, samples_per_prompt=samples
        )
    tokens = torch.cat([tokens.repeat_interleave(samples, 0), responses.tokens], 1)
    real = torch.cat([real.repeat_interleave(samples, 0), responses.mask], 1)
    return Completions(tokens, real, responses, time.perf_counter() - begin, lower=None)


@advising_on_memory
def gather(
    roles: Roles, prompts: Sequence[Prompt], seed: int, iteration: int, samples: int, *, keep: bool = False
) -> Experience:
    """``samples`` responses to each prompt, and what policy, reference and critic say of them.

    No gradients; with ``keep``, and where responses of about one length need no groups, what is said keeps
    its own for an update whose first pass is over all rows: that would say the same again. OutOfMemory, with
    advice, when memory runs out without ``keep`` as well.
    """
    settings, answers = roles.settings, respond(roles, prompts, seed, iteration, samples)
    tokens, real, responses = answers.tokens, answers.real, answers.responses
    rows = len(tokens)
    keep = keep and len(length_groups(real, responses.mask)) == 1
    size = rows if keep else settings.update.micro_batch_size or rows
    # a folded weight rounds otherwise than weight and adapter apart, which is what trains: in float32 within
    # the tolerance, in bfloat16 far beyond it
    folded = settings.dtype == "float32" and not keep
    with roles.frozen_policy() if folded else contextlib.nullcontext(), torch.set_grad_enabled(keep):
        pieces = [_look(roles, tokens, real, responses, slice(k, k + size)) for k in range(0, rows, size)]
    said = tuple(pieces[0][name] for name in ("logp", "entropy", "exact", "values")) if keep else None
    pieces = [{name: None if x is None else x.detach() for name, x in piece.items()} for piece in pieces]
    joined = {name: _joined([piece[name] for piece in pieces]) for name in pieces[0]}
    return Experience(tokens, real, responses, answers.seconds, said=said, **joined)


def _joined(parts: list[Any]) -> Any:
    return None if parts[0] is None else torch.cat(parts)


def _look(roles: Roles, tokens: Tensor, real: Tensor, responses: Responses, rows: slice) -> dict[str, Any]:
    """What the roles say of some rows."""
    tokens, real, mask = tokens[rows], real[rows], responses.mask[rows]
    first = tokens.shape[1] - mask.shape[1] - 1
    lower = roles.trunk.lower(tokens, real)
    policy = roles.policy_hidden(tokens, real, lower)
    reference = roles.reference_hidden(tokens, real, lower)[:, first:-1]
    support = None if responses.support is None else responses.support[rows][mask]
    own = token_statistics(
        policy[:, first:-1][mask], roles.trunk.parts.head, responses.tokens[rows][mask], roles.sampling,
        support=support, reference=reference[mask], reference_head=roles.head_of_reference(),
        ahead=roles.settings.logp_alone,
    )  # fmt: skip
    zeros = torch.zeros(mask.shape, device=tokens.device)
    values, final = zeros, zeros[:, 0]
    if roles.critic_head is not None:
        hidden = roles.critic_hidden(policy, tokens, real, lower)[:, first:]
        every = roles.critic_head(hidden.float())[:, :, 0]
        values = torch.where(mask, every[:, :-1], 0.0)
        final = every.gather(1, mask.sum(1, keepdim=True))[:, 0]
    found = {
        name: zeros.masked_scatter(mask, x)
        for name, x in (
            ("logp", own.logp),
            ("entropy", own.entropy),
            ("exact", own.kl),
            ("ref_logp", own.reference_logp),
        )
    }
    kept = torch.where(mask[..., None], reference, 0.0) if roles.settings.exact_in_loss else None
    return {**found, "values": values, "final_values": final, "lower": lower, "ref_hidden": kept}


def kl_share(experience: Experience, settings: AlignSettings, kl_beta: float) -> Tensor:
    """What the KL to the reference adds to the reward of each token, [B, R]; 0 where it is all in the loss.

    Its log-probabilities are those of the pass that trains, for policy and reference alike: before the first
    step they are equal to the bit, where those of sampling differ by rounding, which normalised advantages
    would blow up to full strength.
    """
    steps = (experience.ref_logp, experience.exact, experience.responses.mask, settings.update.gamma)
    return kl_rewards(settings.kl, kl_beta, experience.logp, *steps)


def rewards_of(
    experience: Experience, scores: Scores, settings: AlignSettings, kl_beta: float
) -> tuple[Tensor, float]:
    """Rewards per token [B, R]: what the KL costs, and the score on the last real token.

    With them what they were multiplied by: 1, or with ``whiten_rewards`` one over their deviation.
    """
    mask, rows = experience.responses.mask, torch.arange(len(experience.tokens))
    total = torch.from_numpy(np.nan_to_num(scores.total)).to(experience.logp) * settings.reward_scale
    if settings.reward_clip is not None:
        total = total.clamp(-settings.reward_clip, settings.reward_clip)
    if settings.missing_eos_penalty is not None:
        total = torch.where(experience.responses.ended, total, total - settings.missing_eos_penalty)
    found = kl_share(experience, settings, kl_beta)
    found[rows, experience.last] += total
    if not settings.whiten_rewards:
        return found, 1.0
    counting = mask & torch.from_numpy(scores.valid).to(mask.device)[:, None]
    scale = 1.0 / (float(masked_variance(found, counting).sqrt()) + 1e-8) if bool(counting.any()) else 1.0
    return torch.where(mask, found * scale, 0.0), scale


def to_batch(experience: Experience, rewards: Tensor, valid: Tensor, settings: AlignSettings) -> Batch:
    """Advantages and returns of the responses whose score counts (``valid`` [B]), as ppo.update takes
    them.
    """
    mask, rows = experience.responses.mask, torch.arange(len(experience.tokens))
    ended = torch.zeros_like(mask)
    ended[rows, experience.last] = True
    terminated = ended.clone()
    if settings.truncation == "bootstrap":
        terminated[rows, experience.last] = experience.responses.ended
    update, values = settings.update, experience.values
    if settings.critic == "none":
        advantages = leave_one_out(rewards, mask, valid, settings.samples_per_prompt, settings.update.gamma)
        targets = torch.zeros_like(rewards)
    else:
        following = torch.cat([values[:, 1:], torch.zeros_like(values[:, :1])], 1)
        following = torch.where(ended, experience.final_values[:, None], following)
        policy_lambda: Any = update.gae_lambda
        if settings.lambda_alpha is not None:
            policy_lambda = length_lambda(mask.sum(1), settings.lambda_alpha)
        critic_lambda = update.gae_lambda if settings.critic_lambda is None else settings.critic_lambda
        steps = (rewards, values, following, terminated, ended, update.gamma)
        advantages = returns.gae(*steps, policy_lambda, mask)
        targets = returns.gae(*steps, critic_lambda, mask) + values
    old = experience.responses.logp if settings.dtype == "float32" else experience.logp
    inputs = {"tokens": experience.tokens, "real": experience.real, "ref_logp": experience.ref_logp}
    inputs["row"] = torch.arange(len(mask), device=mask.device)
    optional = {
        "lower": experience.lower, "ref_hidden": experience.ref_hidden,
        "support": experience.responses.support,
    }  # fmt: skip
    inputs |= {name: x for name, x in optional.items() if x is not None}
    batch = Batch(inputs, experience.responses.tokens, old, values, advantages, targets, mask)
    return batch.select(valid.nonzero()[:, 0])


def length_lambda(lengths: Tensor, alpha: float) -> Tensor:
    """VAPO's length-adaptive lambda [B]: max(0, 1 - 1 / (alpha l)) of a response of l tokens."""
    return (1.0 - 1.0 / (alpha * lengths.float())).clamp(min=0.0)


def comparable(valid: np.ndarray, samples: int) -> np.ndarray:
    """Of responses whose score counts [B], those that another response to the same prompt, whose score counts
    too, can be compared with.
    """
    together = valid.reshape(-1, samples)
    return (together & (together.sum(1, keepdims=True) > 1)).reshape(-1)


def leave_one_out(rewards: Tensor, mask: Tensor, valid: Tensor, samples: int, gamma: float = 1.0) -> Tensor:
    """Advantages without a critic: reward to go minus the mean return of the prompt's *other* responses.

    The baseline does not depend on the response it is subtracted from, so it adds no bias (Kool et al. 2019).
    Rows of one prompt are neighbours; a response whose score does not count is nobody's baseline.
    """
    ended = torch.zeros_like(mask)
    to_go = returns.discounted_returns(rewards, ended, gamma, mask=mask)
    total = torch.where(valid & mask[:, 0], to_go[:, 0], 0.0).view(-1, samples)
    count = valid.view(-1, samples).to(total)
    others = (total.sum(1, keepdim=True) - total) / (count.sum(1, keepdim=True) - count).clamp(min=1)
    return torch.where(mask, to_go - others.view(-1, 1), 0.0)


def describe(
    experience: Experience, scores: Scores, rewards: Tensor, kl_share: Tensor, valid: Tensor
) -> dict[str, float]:
    """The metrics of a rollout: sums over a response, and token means under names that say so. ``rewards``
    and the share of the KL in them, before any scaling, are [B, R].

    Scores and rewards are those of the responses that count, everything else is of all of them; NaN for a
    score where none counts.
    """
    mask = experience.responses.mask
    count = len(mask)
    log_ratio = torch.where(mask, experience.ref_logp - experience.logp, 0.0)

    def per_response(x: Tensor) -> float:
        return float(masked_sum(x, mask)) / count

    total, ended = scores.total[scores.valid], experience.responses.ended
    score = float(np.mean(total)) if len(total) else float("nan")

    def of_valid(x: Tensor) -> float:
        return float(masked_sum(x, mask & valid[:, None])) / len(total) if len(total) else float("nan")

    gap = (experience.responses.logp - experience.logp)[mask].abs()
    return {
        "objective/kl": per_response(divergence.k1(log_ratio)),
        "objective/kl_k2": per_response(divergence.k2(log_ratio)),
        "objective/kl_k3": per_response(divergence.k3(log_ratio)),
        "objective/kl_exact": per_response(experience.exact),
        "objective/kl_token_mean": float(masked_mean(divergence.k1(log_ratio), mask)),
        "objective/scores": score,
        "objective/scores_std": float(np.std(total)) if len(total) else float("nan"),
        "objective/rlhf_reward": of_valid(rewards),
        "objective/non_score_reward": of_valid(kl_share),
        "objective/entropy": per_response(-experience.logp),
        "objective/entropy_exact": per_response(experience.entropy),
        "objective/entropy_token_mean": float(masked_mean(-experience.logp, mask)),
        "objective/response_length": float(mask.sum()) / count,
        "objective/eos_fraction": float(ended.float().mean()),
        "objective/truncated_fraction": float((~ended).float().mean()),
        "objective/masked_samples": float((~valid).sum()),
        "objective/distinct_2": distinct(experience.ids()),
        "objective/sampling_gap": float(gap.max()) if gap.numel() else 0.0,
        "time/generate_seconds": experience.seconds,
        "time/tokens_per_second": float(experience.responses.mask.sum()) / max(experience.seconds, 1e-9),
    }


def distinct(rows: list[list[int]], n: int = 2) -> float:
    """Distinct n-grams / all n-grams over a batch: falls towards 0 when responses repeat themselves."""
    grams = [tuple(row[k : k + n]) for row in rows for k in range(len(row) - n + 1)]
    return len(set(grams)) / len(grams) if grams else 1.0
