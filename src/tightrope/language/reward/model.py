"""A reward model: scores of whole texts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from tightrope.language.data.batching import positions
from tightrope.language.model.load import (
    fused,
    load_tokenizer,
    pretrained,
    quiet_libraries,
    read_object,
    without_dropout,
)

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

SHIFT = "tightrope_reward_shift"  # in config.json: score = output of the head - shift


def last_real(hidden: Tensor, real: Tensor) -> Tensor:
    """The hidden state [B, d] of each row's last real token: by the mask, never by a padding id."""
    places = torch.arange(real.shape[1], device=real.device)
    last = torch.where(real, places, 0).argmax(1)
    return hidden[torch.arange(len(hidden), device=hidden.device), last]


class RewardModel:
    """Scores of whole texts. ``base`` gives hidden states, ``head`` [1, d] their score, less ``shift``."""

    def __init__(
        self, base: nn.Module, head: nn.Linear, shift: float, tokenizer: PreTrainedTokenizerBase | None = None
    ) -> None:
        self.base, self.head, self.shift, self.tokenizer = base, head, shift, tokenizer

    def to(self, device: torch.device | str) -> RewardModel:
        """Move it, and return it."""
        self.base.to(device)
        self.head.to(device)
        return self

    def raw(self, tokens: Tensor, real: Tensor, *, right: bool = False) -> Tensor:
        """Scores [B] before the shift, differentiable. ``right``: all padding follows the text, where
        causal attention never looks, and no mask is needed.
        """
        mask: dict[str, Tensor] = {}
        if not right and not bool(real.all()):
            mask = {"attention_mask": real.long(), "position_ids": positions(real)}
        hidden = self.base(input_ids=tokens, use_cache=False, **mask).last_hidden_state
        with torch.autocast(hidden.device.type, enabled=False):
            return self.head(last_real(hidden, real).to(self.head.weight.dtype))[:, 0]

    @torch.no_grad()
    def score(self, tokens: Tensor, real: Tensor) -> Tensor:
        """Scores [B] of texts [B, T] padded anywhere, with any id; ``real`` is True for their tokens."""
        return self.raw(tokens, real) - self.shift


@quiet_libraries()
def load_reward(folder: str | Path, dtype: torch.dtype = torch.float32) -> RewardModel:
    """A reward model from a run folder of ``tightrope reward``, or from any folder that
    AutoModelForSequenceClassification loads with one label and a head called ``score``.

    ValueError when there is none, or when the folder holds another kind of model.
    """
    from transformers import AutoModelForSequenceClassification

    path = Path(folder)
    path = path / "model" if (path / "model" / "config.json").is_file() else path
    if not (path / "config.json").is_file():
        raise ValueError(
            f"{folder} is not a reward model: it holds no config.json. Train one: tightrope reward."
        )
    kinds = read_object(path / "config.json").get("architectures") or ["nothing named"]
    if not kinds[0].endswith("ForSequenceClassification"):  # loading would make up a head
        raise ValueError(
            f"{folder} holds {kinds[0]}, which gives no scores. Train a reward model: tightrope reward."
        )
    model = fused(pretrained, AutoModelForSequenceClassification, path, dtype=dtype)
    head = getattr(model, "score", None)
    if model.config.num_labels != 1 or not isinstance(head, nn.Linear):
        raise ValueError(
            f"{folder} is {kinds[0]} with {model.config.num_labels} labels; expected one label and a linear "
            "head called score. Wrap it in a reward function."
        )
    without_dropout(model)
    base = getattr(model.eval(), model.base_model_prefix)
    return RewardModel(base, head, float(getattr(model.config, SHIFT, 0.0)), load_tokenizer(str(path)))
