"""One iteration's experience: prompts -> responses -> scores -> rewards per token -> advantages -> Batch."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from tightrope.algorithms.batch import Batch, moved_scale
from tightrope.algorithms.descent import OutOfMemory, free, is_out_of_memory
from tightrope.language.alignment.kl import kl_rewards
from tightrope.language.data.batching import length_groups, pad_left
from tightrope.language.data.examples import Prompt
from tightrope.language.generation.sample import Completions, meets_stop, sample
from tightrope.language.policy.policy_model import Experience, FirstPass, ResponseInputs
from tightrope.language.policy.roles import Roles
from tightrope.language.reward.functions import Scores
from tightrope.language.settings import AlignSettings
from tightrope.maths import returns
from tightrope.maths.statistics import masked_variance
from tightrope.maths.values import ReturnScale

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase


class PromptOrder:
    """Prompts in a new random order for every pass over them: a function of only seed and position."""

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.seed, self.position = count, seed, 0

    def take(self, count: int) -> list[int]:
        """The indices of the next ``count`` prompts; ``position`` is the number taken so far."""
        taken = []
        for index in range(self.position, self.position + count):
            order = np.random.default_rng([self.seed, 7, index // self.count]).permutation(self.count)
            taken.append(int(order[index % self.count]))
        self.position += count
        return taken


@contextlib.contextmanager
def _advice_on_memory(roles: Roles) -> Iterator[None]:
    """Inside, an error of memory becomes an OutOfMemory that names the settings to lower."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, OutOfMemory) or not is_out_of_memory(error):
            raise
        reason = (str(error).splitlines() or [""])[0][:200]
        raise OutOfMemory(
            f"Memory is not enough to sample {roles.settings.batch_size} responses at once ({reason}). "
            "Choose a smaller --batch-size, --max-new-tokens or --max-prompt-tokens; --micro-batch-size "
            "makes the pass over the finished responses smaller."
        ) from error


def stops_of(
    tokenizer: PreTrainedTokenizerBase, settings: AlignSettings
) -> Callable[[list[list[int]]], list[bool]] | None:
    """What ends a response beside an EOS, as `sample` takes it; None where nothing does."""
    return meets_stop(tokenizer, settings.stop) if settings.stop else None


def respond(roles: Roles, prompts: Sequence[Prompt], seeds: Sequence[int], samples: int) -> Completions:
    """``samples`` responses of the policy to each prompt; rows of one prompt are neighbours. ``seeds`` decide
    every token.

    Raises OutOfMemory, with advice.
    """
    settings, begin = roles.settings, time.perf_counter()
    device = next(roles.model.parameters()).device
    tokens, real = (x.to(device) for x in pad_left([prompt.tokens for prompt in prompts]))
    shape = len(prompts) * samples, settings.max_new_tokens
    uniforms = torch.from_numpy(np.random.default_rng(seeds).random(shape)).to(device)
    with _advice_on_memory(roles):
        with roles.frozen_policy():
            responses = sample(
                roles.model, tokens, real, roles.sampling, uniforms, roles.eos, samples_per_prompt=samples,
                stops_at=stops_of(roles.tokenizer, settings),
            )  # fmt: skip
        return Completions(
            tokens=torch.cat([tokens.repeat_interleave(samples, 0), responses.tokens], 1),
            real=torch.cat([real.repeat_interleave(samples, 0), responses.mask], 1),
            responses=responses,
            ids=[row[mask].tolist() for row, mask in zip(responses.tokens, responses.mask, strict=True)],
            seconds=time.perf_counter() - begin,
        )


def gather(
    roles: Roles, prompts: Sequence[Prompt], seed: int, iteration: int, samples: int, *, keep: bool = False
) -> Experience:
    """``samples`` responses to each prompt, and what policy, reference and critic compute for them.

    Without gradients. With ``keep`` the pass keeps its graph, so that the first epoch can reuse it: where the
    responses are of about one length, need no groups, and memory is enough. Raises OutOfMemory, with advice,
    when memory runs out without ``keep`` as well.
    """
    answers = respond(roles, prompts, [seed, 8, iteration], samples)
    short = False
    if keep and len(length_groups(answers.real, answers.responses.mask)) == 1:
        try:
            return _evaluated(roles, answers, keep=True)
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
        # outside the except clause, which keeps the failed pass's tensors alive
        free()
        short = True
    with _advice_on_memory(roles):
        return _evaluated(roles, answers, short_of_memory=short)


def _evaluated(
    roles: Roles, answers: Completions, *, keep: bool = False, short_of_memory: bool = False
) -> Experience:
    settings, rows = roles.settings, len(answers.tokens)
    size = rows if keep else settings.update.micro_batch_size or rows
    # a folded weight rounds differently from weight and adapter apart, which is what trains: in float32 this
    # is within the tolerance, in bfloat16 far beyond it
    folded = settings.dtype == "float32" and not keep
    with roles.frozen_policy() if folded else contextlib.nullcontext(), torch.set_grad_enabled(keep):
        pieces = [_evaluate(roles, answers, slice(k, k + size)) for k in range(0, rows, size)]
    first_pass = None
    if keep:
        (found,) = pieces
        first_pass = FirstPass(found["logp"], found["entropy"], found["values"], found["exact"])
    joined: dict[str, Any] = {
        name: None if first is None else torch.cat([piece[name] for piece in pieces]).detach()
        for name, first in pieces[0].items()
    }
    return Experience(**{**vars(answers), **joined}, first_pass=first_pass, short_of_memory=short_of_memory)


def _evaluate(roles: Roles, answers: Completions, rows: slice) -> dict[str, Any]:
    """What the roles compute for some rows, by the names of `Experience`'s fields."""
    tokens, real, responses = answers.tokens[rows], answers.real[rows], answers.responses
    mask = responses.mask[rows]
    first = tokens.shape[1] - mask.shape[1] - 1
    lower = roles.policy.trunk.lower(tokens, real)
    # the reference trains nothing, so that its pass keeps no graph
    policy, reference = (role.hidden(tokens, real, lower) for role in (roles.policy, roles.reference))
    reference = reference[:, first:-1]
    found = roles.statistics(
        policy[:, first:-1][mask],
        tokens=responses.tokens[rows][mask],
        support=None if responses.support is None else responses.support[rows][mask],
        reference=reference[mask],
    )
    zeros = torch.zeros(mask.shape, device=tokens.device)
    values, final = zeros, zeros[:, 0]
    if roles.critic_head is not None:
        hidden = policy if roles.critic is None else roles.critic.hidden(tokens, real, lower)
        every = roles.critic_head(hidden[:, first:].float())[:, :, 0]
        values = torch.where(mask, every[:, :-1], 0.0)
        final = every.gather(1, mask.sum(1, keepdim=True))[:, 0]
    return {
        "logp": zeros.masked_scatter(mask, found.logp),
        "entropy": zeros.masked_scatter(mask, found.entropy),
        "exact": zeros.masked_scatter(mask, found.kl),
        "ref_logp": zeros.masked_scatter(mask, found.reference_logp),
        "values": values,
        "final_values": final,
        "lower": lower,
        "ref_hidden": torch.where(mask[..., None], reference, 0.0) if roles.settings.exact_in_loss else None,
    }


@dataclass
class TokenRewards:
    """``rewards`` [B, R] of a rollout, and what the KL adds to them (``kl_share``). They were multiplied by
    ``scale``, the share was not: 1, or with ``whiten_rewards`` one over their deviation.
    """

    rewards: Tensor
    kl_share: Tensor
    scale: float = 1.0


def rewards_of(
    experience: Experience, scores: Scores, settings: AlignSettings, kl_beta: float
) -> TokenRewards:
    """What the KL to the reference costs at each token, and the score on the last real one.

    The KL is that of the pass that trains, for policy and reference alike: before the first step their
    log-probabilities are identical. Those of sampling differ by rounding, which normalised advantages would
    amplify to full strength.
    """
    mask, rows = experience.responses.mask, torch.arange(len(experience.tokens))
    total = torch.from_numpy(np.nan_to_num(scores.total)).to(experience.logp) * settings.reward_scale
    if settings.reward_clip is not None:
        total = total.clamp(-settings.reward_clip, settings.reward_clip)
    if settings.missing_eos_penalty is not None:
        total = torch.where(experience.responses.ended, total, total - settings.missing_eos_penalty)
    share = kl_rewards(
        settings.kl,
        kl_beta,
        logp=experience.logp,
        ref_logp=experience.ref_logp,
        exact=experience.exact,
        mask=mask,
        gamma=settings.update.gamma,
    )
    rewards = share.clone()
    rewards[rows, mask.sum(1) - 1] += total
    counting = mask & torch.from_numpy(scores.valid).to(mask.device)[:, None]
    if not settings.whiten_rewards or not bool(counting.any()):
        return TokenRewards(rewards, share)
    scale = 1.0 / (float(masked_variance(rewards, counting).sqrt()) + 1e-8)
    return TokenRewards(torch.where(mask, rewards * scale, 0.0), share, scale)


def batch_of(
    experience: Experience,
    rewards: Tensor,
    valid: Tensor,
    settings: AlignSettings,
    scale: ReturnScale | None = None,
) -> Batch:
    """Values, advantages and returns of the responses whose score counts (``valid`` [B]), in units of the
    rewards. ``scale``: that of the critic's outputs; None: they are values.
    """
    mask, rows = experience.responses.mask, torch.arange(len(experience.tokens))
    last, ended = mask.sum(1) - 1, torch.zeros_like(mask)
    ended[rows, last] = True
    terminated = ended.clone()
    if settings.truncation == "bootstrap":
        terminated[rows, last] = experience.responses.ended
    update, values, final_values = settings.update, experience.values, experience.final_values
    if scale is not None:
        rewards, values, final_values = rewards.double(), scale.values(values), scale.values(final_values)
    if settings.critic == "none":
        advantages = leave_one_out(rewards, mask, valid, settings.samples_per_prompt, settings.update.gamma)
        targets = torch.zeros_like(rewards)
    else:
        following = torch.cat([values[:, 1:], torch.zeros_like(values[:, :1])], 1)
        following = torch.where(ended, final_values[:, None], following)
        policy_lambda: float | Tensor = update.gae_lambda
        if settings.lambda_alpha is not None:
            policy_lambda = length_lambda(mask.sum(1), settings.lambda_alpha)
        critic_lambda = update.gae_lambda if settings.critic_lambda is None else settings.critic_lambda
        estimate = functools.partial(
            returns.gae,
            rewards=rewards,
            values=values,
            next_values=following,
            terminated=terminated,
            ended=ended,
            gamma=update.gamma,
            mask=mask,
        )
        advantages = estimate(gae_lambda=policy_lambda)
        one_lambda = settings.lambda_alpha is None and critic_lambda == policy_lambda
        targets = (advantages if one_lambda else estimate(gae_lambda=critic_lambda)) + values
    old = experience.responses.logp if settings.dtype == "float32" else experience.logp
    inputs = ResponseInputs(
        tokens=experience.tokens,
        real=experience.real,
        ref_logp=experience.ref_logp,
        row=torch.arange(len(mask), device=mask.device),
        lower=experience.lower,
        ref_hidden=experience.ref_hidden,
        support=experience.responses.support,
    )
    known = {name: x for name, x in vars(inputs).items() if x is not None}
    batch = Batch(known, experience.responses.tokens, old, values, advantages, targets, mask)
    return batch.select(valid.nonzero()[:, 0])


def to_scale(
    batch: Batch, experience: Experience, before: ReturnScale | None, head: nn.Linear | None
) -> tuple[Batch, ReturnScale | None]:
    """The batch as the critic learns it, after the scale of returns has moved to it, and that scale. The
    critic's head moves along, and so do the outputs of a pass that was kept.
    """
    if before is None:
        return batch.in_scale(None, advantages=False), None
    batch, now, (factor, shift) = moved_scale(batch, before, head, advantages=False)
    if experience.first_pass is not None:
        outputs = experience.first_pass.values
        # the graph holds the head that has moved: only the numbers are still those from before
        moved = outputs + (factor * outputs + shift - outputs).detach()
        experience.first_pass = dataclasses.replace(experience.first_pass, values=moved)
    return batch, now


def length_lambda(lengths: Tensor, alpha: float) -> Tensor:
    """VAPO's length-adaptive lambda [B]: max(0, 1 - 1 / (alpha l)) of a response of l tokens."""
    return (1.0 - 1.0 / (alpha * lengths.float())).clamp(min=0.0)


def has_baseline(valid: np.ndarray, samples: int) -> np.ndarray:
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
