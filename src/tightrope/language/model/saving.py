"""Model and adapter folders as other programs read them: plain transformers, and PEFT."""

from __future__ import annotations

import copy
import importlib.metadata
import importlib.util
import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from tightrope.language.model import lora
from tightrope.language.model.architecture import parts
from tightrope.language.model.load import read_object, read_tensors, without_weights
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

NUMBER = re.compile(r"\.(\d+)\.")  # the first one in the path of a module is that of its layer
# Where all experts of a layer are one tensor of this name, PEFT takes the names that their projections had as
# modules for that tensor, and leaves out modules that still have these names: a shared expert, a dense layer.
FUSED, EXPERT_NAMES = (
    (".gate_up_proj", ".down_proj"),
    ("gate", "gate_proj", "up_proj", "down_proj", "w1", "w2", "w3"),
)
# PEFT refuses out_proj in these: their kernels read its weight, past any adapter.
MAMBAS = ("falcon_h1", "falcon_mamba", "mamba", "mamba2", "nemotron_h")


def save_adapter(
    model: PreTrainedModel, name: str, folder: Path, *, base_model: str, score: Tensor | None = None
) -> str | None:
    """Write an adapter as PEFT reads it: adapter_config.json, adapter_model.safetensors, and a card. With
    ``score``, a head [1, d], it is the adapter of a model that scores texts.

    Returns why PEFT cannot open it, or gives something else with it, in sentences that the card says too;
    None where it gives the same.
    """
    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
    modules = [(p, m) for p, m in model.named_modules() if isinstance(m, Adapted) and name in m.down]
    rank = modules[0][1].down[name].shape[0]
    config = {
        "peft_type": "LORA",
        "task_type": "CAUSAL_LM" if score is None else "SEQ_CLS",
        "base_model_name_or_path": base_model,
        "r": rank,
        "lora_alpha": modules[0][1]._scale[name] * rank,
        "lora_dropout": 0.0,
        "bias": "none",
        "fan_in_fan_out": modules[0][1].transposed,
        **_targets(model, [path for path, _ in modules]),
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
        refused = _refused_by_peft(model, state, config) or _passed_by(model, name)
        (folder / "README.md").write_text(_card(base_model, refused, score is not None), encoding="utf-8")
    return refused


def _targets(model: PreTrainedModel, paths: list[str]) -> dict[str, Any]:
    """What adapter_config.json says of the adapted modules, so that PEFT finds these and no others.

    Names of modules and numbers of layers where they mean just these, else whole paths; weights where PEFT
    would take a name for that of fused experts.
    """
    fused = any(name.endswith(FUSED) for name, _ in model.named_parameters())
    weights = [path for path in paths if fused and path.rsplit(".", 1)[-1] in EXPERT_NAMES]
    rest = [path for path in paths if path not in weights]
    leaves, layers = {path.rsplit(".", 1)[-1] for path in rest}, {_layer(path) for path in rest}
    inner = {id(part) for m in model.modules() if isinstance(m, Adapted) for part in m.children()}
    every = [path for path, module in model.named_modules() if id(module) not in inner]
    found = [path for path in every if path.rsplit(".", 1)[-1] in leaves and _layer(path) in layers]
    config: dict[str, Any] = {"target_modules": rest}
    if sorted(found) == sorted(rest):
        config = {"target_modules": sorted(leaves), "layers_to_transform": sorted(layers)}
    return {**config, "target_parameters": [f"{path}.weight" for path in weights]} if weights else config


def _layer(path: str) -> int:
    """The decoder layer of a module; -1 for one outside of them."""
    found = NUMBER.search(path)
    return int(found[1]) if found else -1


def _refused_by_peft(model: PreTrainedModel, state: dict[str, Tensor], config: dict[str, Any]) -> str | None:
    """Why PEFT cannot open an adapter, in a sentence; None where it can. It is tried on a model without
    weights where PEFT is installed; tightrope does not need it.
    """
    reason = None
    if model.config.model_type in MAMBAS and any(key.endswith(".out_proj.lora_A.weight") for key in state):
        reason = f"it adapts no out_proj in models of type {model.config.model_type}"
    elif importlib.util.find_spec("peft") is not None:
        try:
            reason = _left_out(model, state, config)
        except Exception as error:  # PEFT's refusals are of many kinds
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
    if reason is None:
        return None
    return f"PEFT does not open this adapter ({reason}). The model folder beside it holds the whole model."


def _passed_by(model: PreTrainedModel, name: str) -> str | None:
    """The layers that PEFT's adapters do not reach, in sentences; None where they reach all."""
    paths = lora.read_only(model, name)
    if not paths:
        return None
    return (
        f"PEFT opens this adapter, but gives something else than was trained: {type(model).__name__} reads "
        f"the weight of {len(paths)} adapted layers, such as {paths[0]}, instead of calling them, and PEFT "
        "changes only calls. Call merge_and_unload() in PEFT first, or take the model folder beside it."
    )


def _left_out(model: PreTrainedModel, state: dict[str, Tensor], config: dict[str, Any]) -> str | None:
    """Weights of an adapter that have no place in PEFT's model, or that it lacks; None: each has one."""
    import peft
    from transformers import AutoModelForCausalLM, AutoModelForSequenceClassification

    scores = config["task_type"] == "SEQ_CLS"
    plain = copy.deepcopy(model.config)
    if scores:
        plain.num_labels = 1
    with torch.device("meta"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bare = without_weights(AutoModelForSequenceClassification if scores else AutoModelForCausalLM, plain)
        wrapped = peft.PeftModel(
            bare, peft.LoraConfig(**{k: v for k, v in config.items() if k != "peft_type"})
        )
        found: Any = peft.set_peft_model_state_dict(wrapped, {key: x.to("meta") for key, x in state.items()})
    wrong = [*found.unexpected_keys, *(key for key in found.missing_keys if ".lora_" in key)]
    return f"{len(wrong)} weights are only here or only there, such as {wrong[0]}" if wrong else None


def _card(base_model: str, refused: str | None, scores: bool) -> str:
    """The card of an adapter: how PEFT opens it, or that it does not."""
    kind, options = ("SequenceClassification", ", num_labels=1") if scores else ("CausalLM", "")
    if importlib.util.find_spec("peft") is None:
        tried = "PEFT was not installed when this was written, so that it was not tried."
    else:
        tried = f"Tried with PEFT {importlib.metadata.version('peft')}: every weight has its place."
    how = f"""```python
from peft import PeftModel
from transformers import AutoModelFor{kind}

base = AutoModelFor{kind}.from_pretrained("base/model"{options})
model = PeftModel.from_pretrained(base, "this/folder")
```

{tried}"""
    return f"""# LoRA adapter

Trained on {"/".join(Path(base_model).parts[-2:])}. The model folder beside it has it folded in.

{refused or how}
"""


def load_adapter(model: PreTrainedModel, name: str, folder: Path) -> None:
    """Add an adapter that `save_adapter` (or PEFT) wrote. ValueError when it does not fit the model."""
    config = read_object(folder / "adapter_config.json")
    rank, alpha, chosen = config.get("r"), config.get("lora_alpha"), config.get("layers_to_transform")
    state = read_tensors(folder / "adapter_model.safetensors")
    ranks, count = {len(x) for key, x in state.items() if ".lora_A." in key}, len(parts(model).layers)
    layers = {_layer(key) for key in state if ".lora_A." in key}
    inside = layers <= set(range(count)) and (
        not isinstance(chosen, list) or layers <= {x for x in chosen if isinstance(x, int)}
    )
    if not (isinstance(rank, int) and {rank} == ranks and isinstance(alpha, int | float) and inside):
        raise ValueError(
            f"{folder / 'adapter_config.json'} has r {rank!r}, lora_alpha {alpha!r}, layers_to_transform "
            f"{chosen!r}; expected the rank {sorted(ranks)} of its weights, a number, and some of the "
            f"model's {count} layers. Was it made for another model?"
        )
    add_adapter(model, name, rank, float(alpha), tuple(sorted(layers)))
    load_adapter_state(model, name, state)


def save_model(
    model: PreTrainedModel,
    tokenizer: PreTrainedTokenizerBase,
    run: Path,
    adapter: str | None,
    base_model: str,
    notify: Callable[[str], None] = warnings.warn,
) -> None:
    """RUN/model for AutoModelForCausalLM.from_pretrained, tokenizer and chat template included. An adapter is
    folded in, and is also written to RUN/adapter for PEFT; ``base_model`` is the model it belongs to. Where
    PEFT cannot open it, ``notify`` is told.
    """
    write_model(model, tokenizer, run / "model", adapter)
    if adapter is not None:
        with atomic_folder(run / "adapter") as folder:
            refused = save_adapter(model, adapter, folder, base_model=base_model)
        if refused:
            notify(f"{run / 'adapter'}: {refused}")


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
