"""The first stage: supervised fine-tuning of a causal language model on text, completions or chats.

L = - sum over learnt tokens of log p(token | the tokens before it) / their number in the minibatch
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from tightrope.language.data.batching import (
    PADDING,
    Example,
    Packed,
    attention_of,
    collate,
    pack_rows,
    row_of,
)
from tightrope.language.data.examples import Row, Rows, sft_examples
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.model.architecture import (
    MISFITS,
    ROUTER_UNUSED,
    accepted,
    attention_window,
    parts,
    relative_gap,
    router_weight,
)
from tightrope.language.model.load import known_ids
from tightrope.language.model.saving import save_model
from tightrope.language.settings import SFTSettings
from tightrope.language.supervised.fit import Objective, Stage, micro_batches, resume_stage, train_stage
from tightrope.language.supervised.prepare import GivenModel, Loaded, examples_of, precision
from tightrope.training.events import Listener, Listeners

if TYPE_CHECKING:
    from transformers import PreTrainedModel

PACKED_GAP = 0.05, 1e-3  # relative, in bfloat16 and in float32: a row of two texts sums in another order


def hidden_states(model: PreTrainedModel, rows: Packed) -> Tensor:
    """Hidden states [B, N, d] of right-padded rows; no text sees padding, or another text of its row."""
    base = parts(model).base
    if not bool((rows.segments > 0).any()):
        # One text a row: the padding follows it, and causal attention never looks ahead.
        return base(**accepted(base, input_ids=rows.tokens, use_cache=False)).last_hidden_state
    allowed = attention_of(rows.segments)
    # Added to the scores by every implementation of attention; some would add a boolean mask as 0 and 1.
    mask = torch.zeros(allowed.shape, dtype=model.dtype, device=allowed.device)
    mask.masked_fill_(~allowed, torch.finfo(model.dtype).min)
    options = accepted(base, attention_mask=mask, position_ids=rows.positions, use_cache=False)
    return base(input_ids=rows.tokens, **options).last_hidden_state


def require_packable(model: PreTrainedModel, longest: int) -> None:
    """ValueError for a model whose loss would not be the same when texts share a row of ``longest`` tokens:
    its attention has a shorter window, a layer carries a state from one text to the next, or positions and
    masks are read differently.

    A text must not depend on the one before it: the gradient of its hidden states in the embeddings of that
    one is exactly 0, in every precision, where masked attention is all that connects them.
    """
    name, window = type(model).__name__, attention_window(model)
    if window is not None and window < longest:
        raise ValueError(
            f"--pack with {name}, some layers of which look back over {window} tokens, and max_tokens "
            f"{longest}: in packed rows they would look further. Leave --pack out, or choose --max-tokens "
            f"{window} or less."
        )
    texts = [Example(tuple(range(size)), (False, *(True,) * (size - 1))) for size in (5, 4)]
    rows = [row_of(part).to(model.device) for part in ([texts[0]], [texts[1]], texts)]
    try:
        with torch.no_grad():
            apart = torch.cat([hidden_states(model, row) for row in rows[:2]], 1).float()
        leak, together = _leak(model, rows[2], len(texts[0].tokens))
    except MISFITS as error:
        raise ValueError(
            f"--pack with {name}: a row of two texts cannot be computed ({error}). Leave --pack out."
        ) from error
    gap = relative_gap(together.float(), apart)
    if leak or not gap <= PACKED_GAP[together.dtype == torch.float32]:
        seen = (
            f"the second of two texts in a row depends on the first ({leak:.1e})"
            if leak
            else (f"two texts in one row give other hidden states than apart, relative gap {gap:.1e}")
        )
        raise ValueError(
            f"--pack with {name}: {seen}. A recurrent or convolutional layer carries its state on, or the "
            "model reads attention masks or positions in another way. Leave --pack out."
        )


def _leak(model: PreTrainedModel, row: Packed, first: int) -> tuple[float, Tensor]:
    """The largest gradient of what follows the first text in the embeddings of its ``first`` tokens, and the
    hidden states [1, N, d].
    """
    embedded: list[Tensor] = []

    def follow(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        embedded.append(output.detach().requires_grad_())
        return embedded[-1]

    handle = model.get_input_embeddings().register_forward_hook(follow)
    try:
        with torch.enable_grad():
            hidden = hidden_states(model, row)
            (slope,) = torch.autograd.grad(hidden[:, first:].float().square().sum(), embedded[0])
    finally:
        handle.remove()
    return float(slope[:, :first].abs().max()), hidden.detach()


def token_loss(model: PreTrainedModel, rows: Packed) -> Tensor:
    """-log p summed over the learnt tokens, a scalar in nats; divide by ``rows.learn.sum()`` for the mean."""
    return _loss_of(model, hidden_states(model, rows), rows)


def _loss_of(model: PreTrainedModel, hidden: Tensor, rows: Packed) -> Tensor:
    head, targets = parts(model).head, rows.learn[:, 1:]
    hidden = hidden[:, :-1][targets].to(head.weight.dtype)
    with torch.autocast(hidden.device.type, enabled=False):
        return -token_statistics(hidden, head, rows.tokens[:, 1:][targets], Sampling()).logp.sum()


class RouterLoss:
    """The loss that keeps the experts of a mixture evenly used, where the model's configuration asks for it
    (output_router_logits), computed by the model itself: its own function, coefficient included.
    """

    def __init__(self, model: PreTrainedModel, notify: Callable[[str], None], *, packed: bool) -> None:
        self.model, self.weight = model, 0.0
        weight = router_weight(model)
        if not weight:
            return
        reason = "rows of several texts (--pack) have no mask that it could read" if packed else ""
        if not reason:
            text = Example(tuple(range(4)), (False, True, True, True))
            try:
                with torch.no_grad():
                    self._pass(row_of([text]).to(model.device))
                self.weight = weight
                return
            except MISFITS as error:
                reason = f"{type(model).__name__} gives none ({error})"
        notify(ROUTER_UNUSED.format(reason))

    def sums(self, rows: Packed) -> tuple[Tensor, dict[str, Tensor]]:
        """`token_loss` of the rows plus the weighted router loss, which counts once a token; and the router
        loss by itself.
        """
        if not self.weight:
            return token_loss(self.model, rows), {}
        hidden, router = self._pass(rows)
        share = router * rows.learn.sum()
        return _loss_of(self.model, hidden, rows) + self.weight * share, {"router_loss": share.detach()}

    def _pass(self, rows: Packed) -> tuple[Tensor, Tensor]:
        """Hidden states and the router loss of one forward pass through the model as it stands."""
        states: list[Tensor] = []

        def keep(module: nn.Module, inputs: tuple[Any, ...], output: Any) -> None:
            states.append(output.last_hidden_state)

        handle = parts(self.model).base.register_forward_hook(keep)
        try:
            out = self.model(
                input_ids=rows.tokens, attention_mask=(rows.segments != PADDING).long(), use_cache=False,
                output_router_logits=True, logits_to_keep=1,
            )  # fmt: skip
        finally:
            handle.remove()
        if not isinstance(getattr(out, "aux_loss", None), Tensor):
            raise ValueError("its output holds no aux_loss")
        return states[0], out.aux_loss


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

    router = RouterLoss(model, listeners.warn, packed=settings.pack)

    def loss(items: Sequence[Packed]) -> tuple[Tensor, dict[str, Tensor]]:
        with precision(settings):
            return router.sums(collate(items).to(model.device))

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
