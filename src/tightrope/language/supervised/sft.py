"""The first stage: supervised fine-tuning of a causal language model on text, completions or chats.

L = - sum over learnt tokens of log p(token | the tokens before it) / their number in the minibatch
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from tightrope.language.data.batching import Example, Packed, attention_of, collate, pack_rows, row_of
from tightrope.language.data.examples import Row, Rows, sft_examples
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.model.architecture import attention_window, parts
from tightrope.language.model.load import known_ids
from tightrope.language.model.saving import save_model
from tightrope.language.settings import SFTSettings
from tightrope.language.supervised.fit import Objective, Stage, micro_batches, resume_stage, train_stage
from tightrope.language.supervised.prepare import GivenModel, Loaded, examples_of, precision
from tightrope.training.events import Listener, Listeners

if TYPE_CHECKING:
    from transformers import PreTrainedModel

PACKED_GAP = 1e-4  # relative, float32: a row of two texts sums in another order


def hidden_states(model: PreTrainedModel, rows: Packed) -> Tensor:
    """Hidden states [B, N, d] of right-padded rows; no text sees padding, or another text of its row."""
    base = parts(model).base
    if not bool((rows.segments > 0).any()):
        # One text a row: the padding follows it, and causal attention never looks ahead.
        return base(input_ids=rows.tokens, use_cache=False).last_hidden_state
    allowed = attention_of(rows.segments)
    # Added to the scores by every implementation of attention; some would add a boolean mask as 0 and 1.
    mask = torch.zeros(allowed.shape, dtype=model.dtype, device=allowed.device)
    mask.masked_fill_(~allowed, torch.finfo(model.dtype).min)
    out = base(input_ids=rows.tokens, attention_mask=mask, position_ids=rows.positions, use_cache=False)
    return out.last_hidden_state


@torch.no_grad()
def require_packable(model: PreTrainedModel, longest: int) -> None:
    """ValueError for a model whose loss would not be the same when texts share a row of ``longest`` tokens:
    its attention has a shorter window, or it reads attention masks differently.
    """
    name, window = type(model).__name__, attention_window(model)
    if window is not None and window < longest:
        raise ValueError(
            f"--pack with {name}, some layers of which look back over {window} tokens, and max_tokens "
            f"{longest}: in packed rows they would look further. Leave --pack out, or choose --max-tokens "
            f"{window} or less."
        )
    texts = [Example(tuple(range(size)), (False, *(True,) * (size - 1))) for size in (5, 4)]
    apart = token_loss(model, collate([row_of([text]) for text in texts]).to(model.device))
    gap, reason = float("inf"), ""
    try:
        gap = float((token_loss(model, row_of(texts).to(model.device)) / apart - 1).abs())
    except (TypeError, ValueError, RuntimeError, AttributeError, IndexError) as error:
        reason = f" ({error})"
    if gap > (PACKED_GAP if model.dtype == torch.float32 else 0.05):
        raise ValueError(
            f"--pack with {name}: two texts in one row give another loss than apart, relative gap {gap:.1e}"
            f"{reason}. The model reads attention masks in another way. Leave --pack out."
        )


def token_loss(model: PreTrainedModel, rows: Packed) -> Tensor:
    """-log p summed over the learnt tokens, a scalar in nats; divide by ``rows.learn.sum()`` for the mean."""
    head, targets = parts(model).head, rows.learn[:, 1:]
    hidden = hidden_states(model, rows)[:, :-1][targets].to(head.weight.dtype)
    with torch.autocast(hidden.device.type, enabled=False):
        return -token_statistics(hidden, head, rows.tokens[:, 1:][targets], Sampling()).logp.sum()


@torch.no_grad()
def mean_loss(model: PreTrainedModel, rows: Sequence[Packed], size: int) -> float:
    """The mean loss per learnt token over all rows, ``size`` rows at a time; nats."""
    total, count = 0.0, 0
    for part in micro_batches(rows, size, len):
        batch = collate(part).to(model.device)
        total, count = total + float(token_loss(model, batch)), count + int(batch.learn.sum())
    return total / count


def train_sft(
    settings: SFTSettings,
    *,
    data: Rows | None = None,
    validation: Rows | None = None,
    model: GivenModel | None = None,
    listeners: Sequence[Listener] = (),
    run_dir: str | Path | None = None,
) -> dict[str, Any]:
    """Fine-tune a model; returns the summary that is also written to the run folder.

    ``data`` and ``validation`` replace the files that the settings name: rows in any format of
    `sft_examples`. ``model``: a (model, tokenizer) that is trained in place. The run folder holds
    settings.json, metrics.jsonl, summary.json and ``model``, which AutoModelForCausalLM.from_pretrained
    loads, with tokenizer and chat template; tuned by LoRA the adapter is folded into it, and is also
    written to ``adapter`` for PEFT. Raises ValueError for data or settings that cannot work, before anything
    is trained, and DoesNotFit, which is one, for too little memory, before the model is loaded.
    """
    given = {"data": data, "validation": validation}
    return train_stage(SFT_STAGE, settings, given, model, listeners, run_dir)


def resume_sft(
    run_dir: str | Path,
    *,
    data: Rows | None = None,
    validation: Rows | None = None,
    model: GivenModel | None = None,
    listeners: Sequence[Listener] = (),
) -> dict[str, Any]:
    """Continue a run from its newest checkpoint, or from its beginning where there is none yet. It ends like
    an uninterrupted run, bit for bit.

    What `train_sft` was given as an object is given again, the model as it was before training. Files are
    read again. ValueError names what is missing.
    """
    return resume_stage(SFT_STAGE, run_dir, {"data": data, "validation": validation}, model, listeners)


def _objective(
    settings: SFTSettings, loaded: Loaded, given: Mapping[str, Rows | None], listeners: Listeners
) -> Objective:
    model, size = loaded.model, settings.micro_batch_size or settings.minibatch_size
    rows, held = _rows(settings, loaded, given, listeners)

    def loss(items: Sequence[Packed]) -> tuple[Tensor, dict[str, Tensor]]:
        with precision(settings):
            return token_loss(model, collate(items).to(model.device)), {}

    def evaluate() -> dict[str, float]:
        with precision(settings):
            return {"sft/held_out_loss": mean_loss(model, held, size)} if held else {}

    learnt = sum(_learnt(row) for row in rows)

    def save(folder: Path, newest: dict[str, float]) -> dict[str, Any]:
        save_model(model, loaded.tokenizer, folder, loaded.adapter, loaded.source)
        return {"rows": len(rows), "held_out_rows": len(held), "tokens": learnt}

    return Objective(
        "sft", "sft", rows, loss, _learnt, len, evaluate, save,
        seen="sft/tokens", parameters=loaded.trained(model),
        data=f"{len(rows)} rows, {learnt:,} tokens to learn; {len(held)} rows held out",
    )  # fmt: skip


SFT_STAGE = Stage("sft", SFTSettings, _objective)


def _learnt(row: Packed) -> int:
    return int(row.learn.sum())


def _rows(
    settings: SFTSettings, loaded: Loaded, given: Mapping[str, Rows | None], listeners: Listeners
) -> tuple[list[Packed], list[Packed]]:
    """The rows to train on and those held out; packed apart, so that nothing held out is trained on."""

    def read(rows: list[Row]) -> list[Example]:
        return sft_examples(
            rows,
            loaded.tokenizer,
            eos=loaded.eos,
            max_tokens=settings.max_tokens,
            on_completions=settings.on_completions,
            vocabulary=known_ids(loaded.model),
            notify=listeners.warn,
        )

    own, held = examples_of(settings, given, read)
    if settings.pack:
        require_packable(loaded.model, settings.max_tokens)
        return pack_rows(own, settings.max_tokens), pack_rows(held, settings.max_tokens)
    return [row_of([example]) for example in own], [row_of([example]) for example in held]
