"""Responses from a causal language model: a prefill of each prompt, then one token per step by KV cache.

Each row's tokens come from uniform numbers of its own, drawn beforehand, so that a response does not depend
on which rows are sampled beside it or have finished before it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from tightrope.language.data.batching import positions
from tightrope.language.generation.distribution import Sampling, next_logits
from tightrope.language.model.architecture import parts

if TYPE_CHECKING:
    from transformers import PreTrainedModel, PreTrainedTokenizerBase

# A forward pass takes its cache under the old name up to transformers 5.23. From 5.24 on the name is new, and
# the old one warns at every step. Models outside transformers may keep the old name.
NEW, OLD = "cache", "past_key_values"
LOG_RATIO_LIMIT = 1e-4  # float32; what is sampled is what is trained
# nats, bfloat16: two passes differ by up to 0.54 in 86,000 tokens of SmolLM2; a wrong mask costs more
LOWERED_LIMIT = 1.0


def log_ratio_limit(dtype: str) -> float:
    """The largest gap of two passes over one token that is rounding, in nats."""
    return LOG_RATIO_LIMIT if dtype == "float32" else LOWERED_LIMIT


@dataclass(frozen=True)
class Responses:
    """B responses of at most R tokens: ``tokens`` and ``logp`` [B, R], ``mask`` [B, R] True for real tokens.

    ``ended`` [B]: the response closed itself, with an EOS or a stop string (whose tokens count as its own);
    ``stopped`` [B]: with a stop string; None where there are none. ``support`` [B, R, k]: the ids among which
    top-k drew, k at most those that may be drawn; None without top-k.
    """

    tokens: Tensor
    mask: Tensor
    logp: Tensor
    ended: Tensor
    support: Tensor | None
    stopped: Tensor | None = None


@dataclass(kw_only=True)
class Completions:
    """Responses to prompts. ``tokens``, ``real``: prompt and response, [B, P + R]; ``ids``: of each response,
    padding left out; ``seconds``: to sample.

    ``lower``: what enters the trunk's upper part, [B, P + R, d], where that was computed.
    """

    tokens: Tensor
    real: Tensor
    responses: Responses
    ids: list[list[int]]
    seconds: float
    lower: Tensor | None = None


@torch.no_grad()
def sample(
    model: PreTrainedModel,
    prompts: Tensor,
    real: Tensor,
    sampling: Sampling,
    uniforms: Tensor,
    eos: tuple[int, ...],
    *,
    samples_per_prompt: int = 1,
    stops_at: Callable[[list[list[int]]], list[bool]] | None = None,
) -> Responses:
    """Sample a response to every prompt [N, P] (left-padded, ``real`` its mask), ``samples_per_prompt`` each.

    ``uniforms`` [N * samples_per_prompt, R] in [0, 1) decide every token; R is the longest a response gets.
    Rows of one prompt are neighbours. Rows that met an EOS leave the batch, and so do those of whose tokens
    so far ``stops_at`` says so, such as `meets_stop`. Log-probabilities are those of
    the distribution that was sampled: after temperature and top-k.
    """
    base, _, head = parts(model)
    rows, columns = uniforms.shape
    device = prompts.device
    tokens = torch.zeros(rows, columns, dtype=torch.int64, device=device)
    mask = torch.zeros(rows, columns, dtype=torch.bool, device=device)
    logp = torch.zeros(rows, columns, device=device)
    shape = (rows, columns, sampling.choices(len(head.weight)))
    support = torch.zeros(shape, dtype=torch.int64, device=device) if sampling.top_k else None
    ended = torch.zeros(rows, dtype=torch.bool, device=device)
    stopped = None if stops_at is None else ended.clone()
    stops = torch.tensor(eos, device=device)

    step = cached_forward(base, prompts, real.long(), positions(real))
    cache, hidden = step.cache, step.hidden[:, -1]
    alive, seen = torch.arange(rows, device=device), real.repeat_interleave(samples_per_prompt, 0)
    if samples_per_prompt > 1:
        cache.batch_repeat_interleave(samples_per_prompt)
        hidden = hidden.repeat_interleave(samples_per_prompt, 0)
    place_of_next = seen.sum(1)
    for t in range(columns):
        chosen, own_logp, allowed = draw(hidden, head, sampling, uniforms[alive, t])
        tokens[alive, t], logp[alive, t], mask[alive, t] = chosen, own_logp, True
        if support is not None and allowed is not None:
            support[alive, t] = allowed
        going = ~torch.isin(chosen, stops)
        if stops_at is not None and stopped is not None:
            met = torch.tensor(stops_at(tokens[alive, : t + 1].tolist()), device=device)
            stopped[alive] = met & going
            going &= ~met
        ended[alive[~going]] = True
        if t + 1 == columns or not bool(going.any()):
            break
        if not bool(going.all()):
            kept = going.nonzero()[:, 0]
            cache.batch_select_indices(kept)
            alive, seen, chosen, place_of_next = alive[kept], seen[kept], chosen[kept], place_of_next[kept]
        seen = torch.cat([seen, seen.new_ones(len(seen), 1)], 1)
        step = cached_forward(base, chosen[:, None], seen.long(), place_of_next[:, None], cache)
        cache, hidden, place_of_next = step.cache, step.hidden[:, -1], place_of_next + 1
    return Responses(tokens, mask, logp, ended, support, stopped)


def meets_stop(rows: list[list[int]], tokenizer: PreTrainedTokenizerBase, stop: Sequence[str]) -> list[bool]:
    """Of rows of tokens that grow one by one, whose text has just come to one of the stop strings.

    Only the end of a row is read: a stop string has no more tokens than bytes; some more, because a tokenizer
    may write the first of a text in another way.
    """
    size = max(len(text.encode()) for text in stop) + 8
    texts = tokenizer.batch_decode([row[-size:] for row in rows], skip_special_tokens=True)
    return [any(word in text for word in stop) for text in texts]


def texts_of(
    tokenizer: PreTrainedTokenizerBase, rows: Sequence[list[int]], stop: Sequence[str] = ()
) -> list[str]:
    """What rows of tokens say: special tokens are left out, and so is a stop string with all behind it."""
    texts = [str(tokenizer.decode(row, skip_special_tokens=True)) for row in rows]
    return [text[: min((text.index(word) for word in stop if word in text), default=None)] for text in texts]


def draw(
    hidden: Tensor, head: nn.Linear, sampling: Sampling, uniforms: Tensor
) -> tuple[Tensor, Tensor, Tensor | None]:
    """One token per row from hidden states [N, d]: ids, log-probabilities [N], and with top-k its support."""
    logits, support = next_logits(hidden, head, sampling), None
    if sampling.top_k:
        logits, support = logits.topk(sampling.choices(logits.shape[1]), dim=1)
    logs = logits.log_softmax(1)
    steps = logs.double().exp().cumsum(1)
    # the last step may round to less than 1, and what follows the last possible token must not be reached
    index = torch.searchsorted(steps, uniforms.double()[:, None] * steps[:, -1:], right=True)
    last = (logs > -torch.inf).int().cumsum(1).argmax(1, keepdim=True)
    index = torch.minimum(index, last)
    own = logs.gather(1, index)[:, 0]
    chosen = index[:, 0] if support is None else support.gather(1, index)[:, 0]
    return chosen, own, support


class CachedPass(NamedTuple):
    """One forward pass: ``hidden`` [B, T, d], the last hidden states, and the cache after it."""

    hidden: Tensor
    cache: Any


def cached_forward(
    base: nn.Module, tokens: Tensor, attention_mask: Tensor, positions: Tensor, cache: Any = None
) -> CachedPass:
    """Run ``base`` on ``tokens`` [B, T] with a cache. None starts a new one; a given one grows in place.

    ``attention_mask`` [B, T + cached]: 1 for real tokens. ``positions`` [B, T].
    """
    name = NEW if NEW in inspect.signature(base.forward).parameters else OLD
    given = {} if cache is None else {name: cache}
    out = base(tokens, attention_mask=attention_mask, position_ids=positions, use_cache=True, **given)
    # asked for by name in this order: reading the old name from a new output warns
    after = out.cache if hasattr(out, NEW) else out.past_key_values
    return CachedPass(out.last_hidden_state, after)
