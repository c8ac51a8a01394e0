"""Responses from a causal language model: a prefill of each prompt, then one token per step by its cache
(keys and values, states of recurrent layers), or by the whole text again where a model has none.

Each row's tokens come from uniform numbers of its own, drawn beforehand, so that a response does not depend
on which rows are sampled beside it or have finished before it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from tightrope.language.data.batching import positions
from tightrope.language.generation.distribution import Sampling, next_logits
from tightrope.language.model.architecture import accepted, parts, relative_gap

if TYPE_CHECKING:
    from transformers import PreTrainedModel, PreTrainedTokenizerBase

# A forward pass takes its cache under the old name up to transformers 5.23. From 5.24 on the name is new, and
# the old one warns at every step. Models outside transformers may keep the old name.
NEW, OLD = "cache", "past_key_values"
TRIED = "cache_works"  # an attribute of a base whose cache was tried
CACHE_TOLERANCE, LOWERED_CACHE_TOLERANCE = 1e-3, 0.1  # relative, of hidden states: rounding is far below
# nats; what is sampled is what is trained. Measured on SmolLM2 (30 layers, 576 numbers wide): in bfloat16 two
# passes differ by up to 0.54 in 86,000 tokens, and a wrong mask costs more than 1
LOG_RATIO_LIMIT, LOWERED_LIMIT = 1e-4, 1.0
MEASURED = 30 * 576
STOP, LOWERED_STOP = 10.0, 2.0  # a run ends at so many times the limit; between the two it warns


class GapLimits(NamedTuple):
    """Gaps of two passes over one token, in nats: rounding explains one up to ``rounding``, a run ends above
    ``stop``.
    """

    rounding: float
    stop: float


def gap_limits(dtype: str, layers: int = 1, width: int = 1) -> GapLimits:
    """The limits for a model of this size: they grow with the square root of layers * width, as the errors of
    sums do, from the size that was measured.
    """
    limit, stop = (LOG_RATIO_LIMIT, STOP) if dtype == "float32" else (LOWERED_LIMIT, LOWERED_STOP)
    limit *= math.sqrt(max(1.0, layers * width / MEASURED))
    return GapLimits(limit, limit * stop)


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

    cached = cache_works(base, len(head.weight))
    step = cached_forward(base, prompts, real.long(), positions(real), cached=bool(cached))
    alive = torch.arange(rows, device=device)
    rows_of_prompts = alive // samples_per_prompt
    if samples_per_prompt > 1:
        step = step.of(rows_of_prompts)
    text, seen, hidden = prompts[rows_of_prompts], real[rows_of_prompts], step.hidden[:, -1]
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
            step = step.of(kept)
            alive, text, seen, chosen = alive[kept], text[kept], seen[kept], chosen[kept]
        text = torch.cat([text, chosen[:, None]], 1)
        seen = torch.cat([seen, seen.new_ones(len(seen), 1)], 1)
        step = next_pass(base, text, seen, step, cached)
        hidden = step.hidden[:, -1]
    return Responses(tokens, mask, logp, ended, support, stopped)


def meets_stop(
    tokenizer: PreTrainedTokenizerBase, stop: Sequence[str]
) -> Callable[[list[list[int]]], list[bool]]:
    """A function that finds, of rows of tokens that grow one by one, those that have just come to one of the
    stop strings: their text, or their last token where a stop is a special token.

    Only the end of a row is read: a stop string has no more tokens than bytes; some more, because a tokenizer
    may write the first of a text in another way.
    """
    size, ids = max(len(text.encode()) for text in stop) + 8, special_stops(tokenizer, stop)

    def met(rows: list[list[int]]) -> list[bool]:
        texts = tokenizer.batch_decode([row[-size:] for row in rows], skip_special_tokens=True)
        return [
            row[-1] in ids or any(word in text for word in stop)
            for row, text in zip(rows, texts, strict=True)
        ]

    return met


def texts_of(
    tokenizer: PreTrainedTokenizerBase, rows: Sequence[list[int]], stop: Sequence[str] = ()
) -> list[str]:
    """What rows of tokens say: special tokens are left out, and so is a stop string with all behind it."""
    ids = special_stops(tokenizer, stop)
    ends = [next((i for i, token in enumerate(row) if token in ids), None) for row in rows]
    texts = [
        str(tokenizer.decode(row[:end], skip_special_tokens=True))
        for row, end in zip(rows, ends, strict=True)
    ]
    return [text[: min((text.index(word) for word in stop if word in text), default=None)] for text in texts]


def special_stops(tokenizer: PreTrainedTokenizerBase, stop: Sequence[str]) -> set[int]:
    """The ids of stop strings that are special tokens, which no text shows. ValueError for a stop string that
    has one beside other text: it would never be met.
    """
    found = set[int]()
    for word in stop:
        known = tokenizer.convert_tokens_to_ids(word)
        if isinstance(known, int) and tokenizer.convert_ids_to_tokens(known) == word:
            if not tokenizer.decode([known], skip_special_tokens=True):
                found.add(known)
            continue
        for token in tokenizer.added_tokens_decoder.values():
            if token.special and token.content in word:
                raise ValueError(
                    f"stop {word!r} holds the special token {token.content!r} and other text; expected text, "
                    "or a special token alone. Give them as two stops."
                )
    return found


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
    """One forward pass: ``hidden`` [B, T, d], the last hidden states, and the cache after it; None where the
    model keeps none, or one whose rows cannot be chosen.
    """

    hidden: Tensor
    cache: Any

    def of(self, rows: Tensor) -> CachedPass:
        """These rows, in this order; a row may come several times. The cache changes in place."""
        if self.cache is not None:
            self.cache.reorder_cache(rows)  # that of beam search: recurrent layers have no other
        return CachedPass(self.hidden[rows], self.cache)


def cached_forward(
    base: nn.Module,
    tokens: Tensor,
    attention_mask: Tensor,
    positions: Tensor,
    cache: Any = None,
    *,
    cached: bool = True,
) -> CachedPass:
    """Run ``base`` on ``tokens`` [B, T] with a cache. None starts a new one; a given one grows in place.

    ``attention_mask`` [B, T + cached]: 1 for real tokens. ``positions`` [B, T]. ``cached`` False: no cache.
    """
    given = (
        {} if cache is None else {NEW if NEW in inspect.signature(base.forward).parameters else OLD: cache}
    )
    options = accepted(base, attention_mask=attention_mask, position_ids=positions, use_cache=cached)
    out = base(tokens, **options, **given)
    # asked for by name in this order: reading the old name from a new output warns
    after = next((getattr(out, name) for name in (NEW, OLD) if hasattr(out, name)), None)
    return CachedPass(out.last_hidden_state, after if cached else None)


@torch.no_grad()
def cache_works(base: nn.Module, vocabulary: int) -> str:
    """How passes with this model's cache give the hidden states of passes without, also when its rows are
    chosen, repeated and dropped: with a mask of the "whole" text, or of the "new" tokens (layers that are all
    recurrent); "" where they do not. Tried once on a few tokens and kept on the base.
    """
    known: str | None = getattr(base, TRIED, None)
    if known is None:
        known = next((mask for mask in ("whole", "new") if _tried(base, vocabulary, mask)), "")
        setattr(base, TRIED, known)
    return known


def _tried(base: nn.Module, vocabulary: int, mask: str) -> bool:
    device = next(base.parameters()).device
    tokens = (torch.arange(3, 19, device=device) % vocabulary).view(2, 8)
    real = torch.ones_like(tokens, dtype=torch.bool)
    real[0, :2] = False
    try:
        step = cached_forward(base, tokens[:, :5], real[:, :5].long(), positions(real[:, :5]))
        if step.cache is None:
            return False
        for length, rows in ((6, [1, 0, 1]), (7, [0, 1]), (8, [1])):
            chosen = torch.tensor(rows, device=device)
            step, tokens, real = step.of(chosen), tokens[chosen], real[chosen]
            text, seen = tokens[:, :length], real[:, :length]
            step = next_pass(base, text, seen, step, mask)
            whole = next_pass(base, text, seen, step, "").hidden[:, -1:]
            gap = relative_gap(step.hidden, whole)
            if not gap <= (CACHE_TOLERANCE if whole.dtype == torch.float32 else LOWERED_CACHE_TOLERANCE):
                return False
    except (MemoryError, torch.OutOfMemoryError):
        raise
    except Exception:  # a cache that cannot be reordered fails in ways of its own
        return False
    return True


def next_pass(base: nn.Module, text: Tensor, seen: Tensor, step: CachedPass, mask: str) -> CachedPass:
    """The pass over the last token of every text [B, T] with the cache of ``step``; over the whole text
    without one. ``mask`` as `cache_works` says; ``seen`` [B, T]: the real tokens.
    """
    if not mask:
        return cached_forward(base, text, seen.long(), positions(seen), cached=False)
    real = seen if mask == "whole" else seen[:, -1:]
    return cached_forward(base, text[:, -1:], real.long(), positions(seen)[:, -1:], step.cache)
