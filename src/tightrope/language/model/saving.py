"""A model folder that plain transformers loads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tightrope.language.model import lora
from tightrope.runs.durable import whole


def write_model(model: Any, tokenizer: Any, folder: Path, adapter: str | None) -> None:
    """Any transformers model with one adapter folded in, and its tokenizer, as safetensors; whole or absent.
    Raises CannotWrite.
    """
    state = {key: tensor.cpu() for key, tensor in lora.merged_state(model, adapter).items()}
    with whole(folder) as temporary:
        model.save_pretrained(temporary, state_dict=state)
        tokenizer.save_pretrained(temporary)
