"""What an alignment run leaves: the model that plain transformers loads, the adapter that PEFT loads, and the
state from which the run goes on.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from tightrope.algorithms.optimise import optimiser_tensors, restore_optimiser
from tightrope.language import lora
from tightrope.language.models import find_model
from tightrope.language.roles import Roles
from tightrope.language.settings import AlignSettings
from tightrope.runs import checkpoint
from tightrope.runs.run import Run

if TYPE_CHECKING:
    from tightrope.language.trainer import Trainer


def save_model(roles: Roles, path: Path, settings: AlignSettings) -> None:
    """RUN/model for AutoModelForCausalLM.from_pretrained, tokenizer and chat template included; with LoRA the
    adapter is folded in, and lies in RUN/adapter for PEFT as well.
    """
    name = "policy" if settings.tune == "lora" else None
    write_model(roles.model, roles.tokenizer, path / "model", name)
    if name is not None:
        lora.save_adapter(roles.model, name, path / "adapter", base_model=find_model(settings.model))


def write_model(model: Any, tokenizer: Any, folder: Path, adapter: str | None) -> None:
    """Any transformers model with one adapter folded in, and its tokenizer, as safetensors."""
    state = {key: tensor.cpu() for key, tensor in lora.merged_state(model, adapter).items()}
    model.save_pretrained(folder, state_dict=state)
    tokenizer.save_pretrained(folder)


def trained_tensors(roles: Roles) -> dict[str, Tensor]:
    """Every tensor that training changes, in the order of the optimiser."""
    return {f"{index:05d}": parameter for index, parameter in enumerate(roles.parameters())}


def save_state(trainer: Trainer, run: Run) -> Path:
    """A checkpoint at the present episode."""
    tensors = {"trained": trained_tensors(trainer.roles), "optimiser": optimiser_tensors(trainer.optimiser)}
    state: dict[str, Any] = {
        "story": "align",
        "episodes": trainer.episodes,
        "iteration": trainer.iteration,
        "kl_beta": trainer.kl_beta,
        "prompt_position": trainer.order.position,
        "rng": {"update": trainer.update_rng.bit_generator.state},
        "monitor": trainer.monitor.state(),
    }
    if trainer.pretraining is not None:
        state["rng"]["ptx"] = trainer.pretraining.rng.bit_generator.state
    return checkpoint.save(run.checkpoint_folder(trainer.episodes), tensors, state)


def restore_state(trainer: Trainer, folder: Path) -> None:
    """Put a checkpoint into a trainer of the same settings. ValueError when it is another story's."""
    tensors, state = checkpoint.load(folder)
    if state.get("story") != "align":
        raise ValueError(f"{folder} is no checkpoint of an alignment run.")
    with torch.no_grad():
        for key, parameter in trained_tensors(trainer.roles).items():
            parameter.copy_(tensors["trained"][key])
    restore_optimiser(trainer.optimiser, tensors["optimiser"])
    trainer.episodes, trainer.iteration = int(state["episodes"]), int(state["iteration"])
    trainer.kl_beta = float(state["kl_beta"])
    trainer.order.position = int(state["prompt_position"])
    trainer.update_rng.bit_generator.state = state["rng"]["update"]
    trainer.monitor.restore(state["monitor"])
    if trainer.pretraining is not None:
        trainer.pretraining.rng.bit_generator.state = state["rng"]["ptx"]
