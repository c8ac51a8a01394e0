"""Whether the weights of a model are those of its file.

transformers makes up what a file lacks, leaves out what it has no place for, and goes on. A run would then
train and judge another model than the one that was given, and another one after each load.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from torch import nn

from tightrope.errors import TightropeError


class WrongWeights(TightropeError, ValueError):
    """The weights of a folder are not those of its model: ``seen`` says what, ``advice`` what to do."""

    def __init__(self, seen: str, advice: str) -> None:
        super().__init__(f"{seen} {advice}")
        self.seen, self.advice = seen, advice


def require_weights(
    model: nn.Module,
    report: dict[str, Any],
    folder: str,
    notify: Callable[[str], None],
    read: Collection[str] = (),
) -> None:
    """WrongWeights for weights that are not the file's. ``report`` is what ``output_loading_info`` gives;
    tied weights, and buffers that an architecture computes itself, are not in it.

    Refused are weights that transformers would make up, because they are missing or have another shape, and
    weights that belong to a module that has no place for them: a bias, a PEFT adapter, a norm, a layer beyond
    those of config.json. Other unused weights are told: a tower or a head beside the trunk. ``read``: names
    of weights that the caller reads from the file itself.
    """
    name, missing = type(model).__name__, sorted(report["missing_keys"])
    unused = sorted(set(report["unexpected_keys"]) - set(read))
    shapes = sorted(report["mismatched_keys"])
    total = len(model.state_dict())
    if missing:
        raise WrongWeights(
            f"{folder} lacks {len(missing)} of the {total} weights of {name}, which would be made up at "
            f"random: {_few(missing)}.",
            _remedy(missing, unused),
        )
    if shapes:
        words = [f"{key} is {list(seen)}, expected {list(wanted)}" for key, seen, wanted in shapes]
        raise WrongWeights(
            f"{folder} holds {len(shapes)} weights of another shape than its config.json gives, which would "
            f"be made up at random: {_few(words)}.",
            "Give the config.json that belongs to these weights, or save the model again, whole.",
        )
    inside = [key for key in unused if _belongs_inside(model, key)]
    if inside:
        raise WrongWeights(
            f"{folder} holds {len(inside)} weights for which the modules of {name} have no place: "
            f"{_few(inside)}. Without them it is another model.",
            _remedy(inside, unused),
        )
    if unused:
        notify(f"{folder} holds {len(unused)} weights that {name} does not use: {_few(unused)}.")


def _few(words: list[str]) -> str:
    """The first three, and how many more."""
    return ", ".join(words[:3]) + (f" and {len(words) - 3} more" if len(words) > 3 else "")


def _belongs_inside(model: nn.Module, key: str) -> bool:
    """Whether the innermost module that a weight is named after has weights of its own, or lies inside the
    trunk and lacks the part that the weight is of. What is computed is no weight: rotary frequencies that
    older versions saved, and masks directly in such a module.
    """
    words, module = key.split("."), model
    trunk = getattr(model, "base_model", model)
    for word in words[:-1]:
        inner = module._modules.get(word)
        if inner is None:
            if module not in (model, trunk) and not key.endswith("inv_freq"):
                return True
            break
        module = inner
    return next(module.parameters(recurse=False), None) is not None


def _common_prefix(missing: list[str], unused: list[str]) -> str:
    """The prefix that all unused names share and that, taken off, turns one of them into a missing name."""
    ends = (key.removesuffix(name) for name in missing for key in unused if key.endswith("." + name))
    return next((end for end in ends if all(key.startswith(end) for key in unused)), "")


def _remedy(wrong: list[str], unused: list[str]) -> str:
    """What to do about wrong weights, from the names of those that were not used."""
    if any(".lora_" in key or ".base_layer." in key for key in unused):
        return "PEFT saved them beside its adapter: save the model again after merge_and_unload()."
    prefix = _common_prefix(wrong, unused)
    if prefix:
        peft = " (of PEFT: save merge_and_unload())" if prefix.startswith("base_model.") else ""
        return (
            f"Its names begin with {prefix!r}{peft}: take that off every name, with load_file and save_file "
            "of safetensors.torch."
        )
    if all(key.endswith(("score.weight", "score.bias")) for key in wrong):
        return "It is no trained reward model. Train one: tightrope reward."
    if wrong == ["lm_head.weight"]:
        return (
            "Give the folder of a model with its language-model head; where the head is the embedding, "
            "config.json says tie_word_embeddings true."
        )
    return (
        "Save the model again, whole, merged and not quantised, or give the config.json that belongs to "
        "these weights."
    )
