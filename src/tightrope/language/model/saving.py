"""Model and adapter folders as other programs read them: plain transformers, and PEFT."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from tightrope.language.model.architecture import parts
from tightrope.language.model.load import read_object, read_tensors
from tightrope.language.model.lora import (
    Adapted,
    adapter_state,
    add_adapter,
    load_adapter_state,
    merged_state,
)
from tightrope.runs.durable import atomic_folder, writing

if TYPE_CHECKING:
    from transformers import PreTrainedModel, PreTrainedTokenizerBase


def save_adapter(
    model: PreTrainedModel, name: str, folder: Path, *, base_model: str, score: Tensor | None = None
) -> None:
    """Write an adapter as PEFT reads it: adapter_config.json and adapter_model.safetensors. With ``score``,
    a head [1, d], it is the adapter of a model that scores texts.
    """
    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
    modules = [(p, m) for p, m in model.named_modules() if isinstance(m, Adapted) and name in m.down]
    rank = modules[0][1].down[name].shape[0]
    numbers = {int(word) for path, _ in modules for word in path.split(".") if word.isdigit()}
    config = {
        "peft_type": "LORA",
        "task_type": "CAUSAL_LM" if score is None else "SEQ_CLS",
        "base_model_name_or_path": base_model,
        "r": rank,
        "lora_alpha": modules[0][1]._scale[name] * rank,
        "lora_dropout": 0.0,
        "bias": "none",
        "fan_in_fan_out": modules[0][1].transposed,
        "target_modules": sorted({path.rsplit(".", 1)[-1] for path, _ in modules}),
        "layers_to_transform": sorted(numbers),
        "inference_mode": True,
    }
    state = adapter_state(model, name)
    if score is not None:
        config["modules_to_save"] = ["score"]
        state["base_model.model.score.weight"] = score
    state = {key: tensor.cpu().contiguous().clone() for key, tensor in state.items()}
    with writing(folder):
        save_file(state, folder / "adapter_model.safetensors", metadata={"format": "pt"})
        (folder / "adapter_config.json").write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")


def load_adapter(model: PreTrainedModel, name: str, folder: Path) -> None:
    """Add an adapter that `save_adapter` (or PEFT) wrote. ValueError when it does not fit the model."""
    config = read_object(folder / "adapter_config.json")
    rank, alpha, chosen = config.get("r"), config.get("lora_alpha"), config.get("layers_to_transform")
    state = read_tensors(folder / "adapter_model.safetensors")
    ranks, count = {len(x) for key, x in state.items() if ".lora_A." in key}, len(parts(model).layers)
    layers = chosen if isinstance(chosen, list) and chosen else list(range(count))
    inside = all(isinstance(layer, int) and 0 <= layer < count for layer in layers)
    if not (isinstance(rank, int) and {rank} == ranks and isinstance(alpha, int | float) and inside):
        raise ValueError(
            f"{folder / 'adapter_config.json'} has r {rank!r}, lora_alpha {alpha!r}, layers_to_transform "
            f"{chosen!r}; expected the rank {sorted(ranks)} of its weights, a number, and some of the "
            f"model's {count} layers. Was it made for another model?"
        )
    add_adapter(model, name, rank, float(alpha), tuple(layers))
    load_adapter_state(model, name, state)


def save_model(
    model: PreTrainedModel,
    tokenizer: PreTrainedTokenizerBase,
    run: Path,
    adapter: str | None,
    base_model: str,
) -> None:
    """RUN/model for AutoModelForCausalLM.from_pretrained, tokenizer and chat template included. An adapter is
    folded in, and is also written to RUN/adapter for PEFT; ``base_model`` is the model it belongs to.
    """
    write_model(model, tokenizer, run / "model", adapter)
    if adapter is not None:
        with atomic_folder(run / "adapter") as folder:
            save_adapter(model, adapter, folder, base_model=base_model)


def write_model(
    model: PreTrainedModel, tokenizer: PreTrainedTokenizerBase, folder: Path, adapter: str | None
) -> None:
    """Any transformers model with one adapter folded in, and its tokenizer, as safetensors; whole or absent.
    Raises CannotWrite.
    """
    state = {key: tensor.cpu() for key, tensor in merged_state(model, adapter).items()}
    with atomic_folder(folder) as temporary:
        model.save_pretrained(temporary, state_dict=state)
        tokenizer.save_pretrained(temporary)
