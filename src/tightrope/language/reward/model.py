"""A reward model: scores of whole texts."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from tightrope.language.data.batching import positions
from tightrope.language.model.architecture import accepted
from tightrope.language.model.load import (
    HEAD,
    fused,
    load_tokenizer,
    pretrained,
    quiet_libraries,
    read_object,
    read_tensors,
    without_dropout,
)

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

SHIFT = "tightrope_reward_shift"  # in config.json: score = output of the head - shift
BIAS = "score.bias"


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
        inputs: dict[str, Any] = {"input_ids": tokens, "use_cache": False}
        if not right and not bool(real.all()):
            inputs |= {"attention_mask": real.long(), "position_ids": positions(real)}
        hidden = self.base(**accepted(self.base, **inputs)).last_hidden_state
        with torch.autocast(hidden.device.type, enabled=False):
            return self.head(last_real(hidden, real).to(self.head.weight.dtype))[:, 0]

    @torch.no_grad()
    def score(self, tokens: Tensor, real: Tensor) -> Tensor:
        """Scores [B] of texts [B, T] padded anywhere, with any id; ``real`` is True for their tokens."""
        # to the right: what comes before a text changes the hidden states of some models (recurrent ones,
        # those that count positions by themselves)
        order = (~real).to(torch.uint8).argsort(dim=1, stable=True)[:, : int(real.sum(1).max())]
        return self.raw(tokens.gather(1, order), real.gather(1, order)) - self.shift


def read_head(path: Path, width: int) -> tuple[Tensor, float]:
    """The score head [1, width] and the shift in a file called HEAD. ValueError for anything else."""
    tensors = read_tensors(path)
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if shapes != {"score.weight": (1, width), "shift": ()}:
        raise ValueError(
            f"{path} holds {shapes}, expected score.weight (1, {width}) and a shift. Train the reward model "
            "again: tightrope reward."
        )
    return tensors["score.weight"], float(tensors["shift"])


def write_head(path: Path, weight: Tensor, shift: float, trunk: str | None = None) -> None:
    """Write what `read_head` reads; ``trunk``: the fingerprint of the weights that it belongs to."""
    from safetensors.torch import save_file

    tensors = {"score.weight": weight.detach().cpu(), "shift": torch.tensor(shift, dtype=torch.float64)}
    save_file(tensors, path, metadata={"trunk": trunk} if trunk else None)


@quiet_libraries()
def load_reward(
    folder: str | Path, dtype: torch.dtype = torch.float32, notify: Callable[[str], None] = warnings.warn
) -> RewardModel:
    """A reward model from a run folder of ``tightrope reward``, from its folder ``model``, or from any
    folder that AutoModelForSequenceClassification loads with one label and a linear head called ``score``.

    ValueError when there is none, or when the folder holds another kind of model; WrongWeights, which is one,
    when weights are missing. ``notify`` is told of weights that are not used.
    """
    from transformers import AutoModel

    path = Path(folder)
    path = path / "model" if (path / "model" / "config.json").is_file() else path
    if not (path / "config.json").is_file():
        raise ValueError(
            f"{folder} is not a reward model: it holds no config.json. Train one: tightrope reward."
        )
    if (path / HEAD).is_file():
        base = fused(pretrained, AutoModel, path, notify=notify, dtype=dtype)
        weight, shift = read_head(path / HEAD, _width(base))
        head = nn.Linear(weight.shape[1], 1, bias=False).to(dtype)
        head.weight.data = weight.to(dtype)
    else:
        model = _classifier(path, dtype, notify)
        base, head = getattr(model, model.base_model_prefix), model.score
        shift = float(getattr(model.config, SHIFT, 0.0)) - _take_bias(head, path)
    without_dropout(base.eval())
    return RewardModel(base, head, shift, load_tokenizer(str(path)))


@torch.no_grad()
def _width(base: Any) -> int:
    """The width of a base's hidden states, which a projection at its end may change (OPT-350m)."""
    token = torch.zeros(1, 1, dtype=torch.long)
    return base(**accepted(base, input_ids=token, use_cache=False)).last_hidden_state.shape[-1]


def _classifier(path: Path, dtype: torch.dtype, notify: Callable[[str], None]) -> Any:
    """A model of AutoModelForSequenceClassification with one label and a linear head called ``score``."""
    from transformers import AutoModelForSequenceClassification

    kinds = read_object(path / "config.json").get("architectures") or ["nothing named"]
    if not kinds[0].endswith("ForSequenceClassification"):
        raise ValueError(
            f"{path} holds {kinds[0]}, which gives no scores. Train a reward model: tightrope reward."
        )
    model = fused(
        pretrained, AutoModelForSequenceClassification, path, notify=notify, read=(BIAS,), dtype=dtype
    )
    if model.config.num_labels != 1 or not isinstance(getattr(model, "score", None), nn.Linear):
        raise ValueError(
            f"{path} is {kinds[0]} with {model.config.num_labels} labels; expected one label and a linear "
            "head called score. Wrap it in a reward function."
        )
    return model


def _take_bias(head: nn.Linear, path: Path) -> float:
    """The bias of a score head, which is taken off: the head's own, or one in the file of a model whose class
    gives its head none. 0.0 where there is none.
    """
    from safetensors import safe_open

    bias: Tensor | None = head.bias
    for file in sorted(path.glob("*.safetensors")) if bias is None else ():
        with safe_open(file, "pt") as tensors:
            if BIAS in set(tensors.keys()):
                bias = tensors.get_tensor(BIAS)
    if bias is not None and bias.numel() != 1:
        raise ValueError(
            f"{path} holds {BIAS} with {bias.numel()} numbers; expected one, as its head gives one score. "
            "Export the reward model again."
        )
    head.register_parameter("bias", None)
    return 0.0 if bias is None else float(bias.detach())
