"""Loading models, tokenizers and the files of model folders. Nothing in a folder is run.

transformers would run code that a configuration names (``auto_map``) when allowed to, unpickle
``pytorch_model.bin`` when there is no safetensors file, hand an ``adapter_config.json`` to PEFT, which
imports modules by the names it finds there, fetch kernels that a configuration asks for, and read any file
that an index, a configuration or a link names. Here all of these are refused.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import stat
import warnings
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from tightrope.language.model.architecture import parts
from tightrope.language.model.weights import require_weights
from tightrope.runs.records import each_key_once

if TYPE_CHECKING:
    from transformers import PreTrainedConfig, PreTrainedModel, PreTrainedTokenizerBase

# every file of a model folder in which transformers looks for the names of code
CONFIGS = ("config.json", "generation_config.json", "tokenizer_config.json", "processor_config.json")
UNPICKLED = ("pytorch_model.bin", "pytorch_model.bin.index.json")
INDEX = "model.safetensors.index.json"
HEAD = "head.safetensors"  # score.weight [1, d] and shift: beside an adapter, or beside a bare trunk
# keys of config.json whose text may look like a path: transformers stores it and opens nothing
TEXTS = ("_name_or_path", "name_or_path", "id2label", "label2id", "task_specific_params", "chat_template")
MOST_LAYERS = 10_000
# how experts are computed: other words have transformers fetch a kernel. Attention is chosen by `fused`.
EXPERTS = (None, "eager", "batched_mm", "grouped_mm")


def require_device(device: str) -> None:
    """ValueError unless torch can put a tensor on this device of this machine; before a model is loaded."""
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:  # each backend has its own
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(
            f"device is {device!r}, which cannot be used here ({reason}). Choose cpu."
        ) from error


def weights_fingerprint(folder: str) -> str | None:
    """A hash that differs between weights: of the size and of 64 samples, 4 kB each, of every weight file
    in a model folder; None where there is none.
    """
    files = sorted(Path(folder).glob("*.safetensors"))
    digest, block = hashlib.sha256(), 4096
    for path in files:
        size = path.stat().st_size
        digest.update(f"{path.name} {size} ".encode())
        with open(path, "rb") as file:
            for number in range(64):
                file.seek(number * max(0, size - block) // 63)
                digest.update(file.read(block))
    return digest.hexdigest() if files else None


def load_tokenizer(folder: str) -> PreTrainedTokenizerBase:
    """The tokenizer. Its padding settings are not used."""
    from transformers import AutoTokenizer

    return pretrained(AutoTokenizer, folder)


def load_causal(
    folder: str, dtype: torch.dtype = torch.float32, notify: Callable[[str], None] = warnings.warn
) -> Any:
    """The model, ready to sample and to train: dropout is 0 in every module, so that both see one policy.

    Raises ValueError for a reward model and for a model that `parts` refuses, and WrongWeights, which is one,
    as `pretrained` does.
    """
    from transformers import AutoModelForCausalLM

    config = Path(folder) / "config.json"
    kinds = (read_object(config).get("architectures") or [""]) if config.is_file() else [""]
    if str(kinds[0]).endswith("Classification"):  # with a tied head, no weight of a language model is missing
        raise ValueError(
            f"{folder} holds {kinds[0]}, which scores or classifies texts; expected a causal language model, "
            "such as the model it was trained from."
        )

    model = fused(pretrained, AutoModelForCausalLM, folder, notify=notify, dtype=dtype)
    without_dropout(model)
    parts(model.eval())
    return model


def fused(make: Callable[..., Any], *arguments: object, **options: object) -> Any:
    """A model of `pretrained` or `without_weights`, with fused attention where its architecture has it. What
    its configuration chooses for attention is ignored: it may name a kernel to download.
    """
    try:
        return make(*arguments, **options, attn_implementation="sdpa")
    except ValueError as error:
        if "scaled_dot_product_attention" not in str(error):
            raise
        return make(*arguments, **options, attn_implementation="eager")


def without_dropout(model: nn.Module) -> None:
    """Set every dropout probability to 0, also those that attention reads as a plain number."""
    for module in model.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
        for name, value in list(vars(module).items()):
            if isinstance(value, float) and ("dropout" in name or "pdrop" in name):
                setattr(module, name, 0.0)


def eos_ids(model: PreTrainedModel, tokenizer: PreTrainedTokenizerBase) -> tuple[int, ...]:
    """Every token that ends a response: those in the model's generation settings, else the tokenizer's.

    The tokenizer's own comes first: it is the one that training data is closed with.
    """
    for source in (getattr(model, "generation_config", None), model.config, tokenizer):
        found = getattr(source, "eos_token_id", None)
        if found is not None:
            own = getattr(tokenizer, "eos_token_id", None)
            every = found if isinstance(found, list | tuple) else [found]
            return tuple(sorted({int(token) for token in every}, key=lambda token: (token != own, token)))
    raise ValueError(
        "The model names no EOS token, so that no response could end. Set eos_token_id in its config."
    )


def known_ids(model: Any) -> int:
    """How many ids a model of transformers reads: the rows of its embedding."""
    return int(model.get_input_embeddings().weight.shape[0])


def unreadable(model: PreTrainedModel, tokenizer: PreTrainedTokenizerBase) -> str:
    """A sentence that names the tokens without an embedding, added ones as a rule; empty without any."""
    size = known_ids(model)
    names = [repr(name) for name, token in sorted(tokenizer.get_vocab().items()) if token >= size]
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return (
        f"The tokenizer has tokens beyond the {size} ids of the model: {', '.join(names[:5])}{more}. A text "
        "that holds one is refused."
        if names
        else ""
    )


def unwritable(model: PreTrainedModel, tokenizer: PreTrainedTokenizerBase) -> tuple[int, ...]:
    """The ids of the head that no text has: beyond the tokenizer's, where the vocabulary is padded, or unused
    by it. Nobody can read them, so they are never drawn.
    """
    size = known_ids(model)
    known = {token for token in tokenizer.get_vocab().values() if token < size}
    return tuple(token for token in range(len(parts(model).head.weight)) if token not in known)


def never_drawn(
    model: PreTrainedModel, tokenizer: PreTrainedTokenizerBase, eos: tuple[int, ...], *, ignore_eos: bool
) -> tuple[int, ...]:
    """The ids that have probability 0, in sampling and in all that is computed for samples: those that are
    `unwritable`, and with ``ignore_eos`` every EOS. ValueError where no response could end.
    """
    strangers = unwritable(model, tokenizer)
    stops = {token for token in eos if token < len(parts(model).head.weight)}
    if not stops.difference(strangers):
        raise ValueError(
            f"The model ends responses with {', '.join(map(str, eos))}, which its tokenizer does not have: "
            "none could end. Set eos_token_id in generation_config.json to one of the tokenizer's ids."
        )
    return tuple(sorted(stops.union(strangers) if ignore_eos else strangers))


def pretrained(
    kind: Any,
    folder: str | Path,
    *,
    notify: Callable[[str], None] = warnings.warn,
    read: Collection[str] = (),
    **options: object,
) -> Any:
    """``kind.from_pretrained(folder)`` for any of transformers' Auto classes: a folder or a hub id.

    Code of the folder is never run: trust_remote_code is off, and a model that names code is refused.
    ValueError, with the reason, for what cannot be loaded; WrongWeights as `require_weights`, which gets
    ``notify`` and ``read``.
    """
    refuse_code(folder)
    refuse_places(folder)
    is_model = kind.__name__.startswith("AutoModel")
    if is_model:
        # a wrong shape is in the report then; the error that transformers raises does not name it
        options |= {"output_loading_info": True, "ignore_mismatched_sizes": True}
        if "gguf_file" not in options:
            options["use_safetensors"] = True  # the other format is pickle
    try:
        found = kind.from_pretrained(str(folder), trust_remote_code=False, **options)
    except (MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # transformers, tokenizers and safetensors raise many kinds
        pickled = [name for name in UNPICKLED if (Path(folder) / name).exists()]
        advice = "Is it whole, and of an architecture that transformers knows?"
        if pickled and not any(Path(folder).glob("*.safetensors")):
            advice = (
                f"It holds {pickled[0]}, a pickle, which is never read. Convert it where you trust it: "
                "model.save_pretrained(FOLDER) of a recent transformers writes safetensors."
            )
        reason = (str(error).strip().splitlines() or [""])[0]
        if "conversion of the weights" in reason:  # it goes on: "see the report", which is not shown
            reason = "weights that belong together, such as those of a layer's experts, are not all there"
        raise ValueError(
            f"{folder} cannot be loaded by {kind.__name__} ({type(error).__name__}: {reason}). {advice}"
        ) from error
    if not is_model:
        return found
    model, report = found
    require_weights(model, report, str(folder), notify, read)
    return model


def without_weights(kind: Any, config: PreTrainedConfig, **options: object) -> Any:
    """``kind.from_config(config)`` for any of transformers' Auto classes; no code of a folder is run.
    ValueError, with the reason, for a configuration of which no model can be built.
    """
    try:
        return kind.from_config(config, trust_remote_code=False, **options)
    except MemoryError:
        raise
    except Exception as error:
        if "scaled_dot_product_attention" in str(error):  # `fused` asks for another kind of attention
            raise
        reason = (str(error).strip().splitlines() or [""])[0]
        raise ValueError(
            f"config.json describes no model that can be built ({type(error).__name__}: {reason}). Is it "
            "whole, and of an architecture that transformers knows?"
        ) from error


def refuse_code(folder: str | Path) -> None:
    """ValueError for a model that names code: in ``auto_map``, or by an adapter beside it.

    Of a hub id only the adapter is looked for; its ``auto_map`` is refused by transformers, where it has no
    code of its own for the architecture.
    """
    path = Path(folder)
    for name in CONFIGS:
        if (path / name).exists() and _names_code(read_object(path / name)):
            raise ValueError(
                f"{path / name} names code that lies beside the model (auto_map), which is never run. "
                "Where transformers knows the architecture itself, take auto_map out of the file; else "
                "choose another model."
            )
    if path.is_dir():
        adapter = (path / "adapter_config.json").exists()
    else:
        from transformers.utils import find_adapter_config_file

        try:
            adapter = find_adapter_config_file(str(folder)) is not None
        except OSError:  # no connection, or no such model: loading reports it
            adapter = False
    if adapter:
        raise ValueError(
            f"{folder} holds a PEFT adapter (adapter_config.json), which may name modules to import, and is "
            "never applied automatically. Fold it into its model with PEFT's merge_and_unload, save that, "
            "and give its folder."
        )


def _names_code(value: object) -> bool:
    """Whether ``auto_map`` occurs anywhere in a configuration: the parts of a composite model have their
    own.
    """
    if isinstance(value, dict):
        return "auto_map" in value or any(map(_names_code, value.values()))
    return isinstance(value, list) and any(map(_names_code, value))


def refuse_places(folder: str | Path) -> None:
    """ValueError for a model whose files name a place outside of it, another kind of weights, or a kernel.

    Looked at are links, the indices of weights, config.json (key by key: what may look like a path is in
    TEXTS) and the file names in tokenizer_config.json.
    """
    path = Path(folder)
    if path.is_dir():
        _refuse_links(path)
        indices = sorted(path.glob("*.index.json"))
        config, tokenizer = path / "config.json", path / "tokenizer_config.json"
    else:
        found = [_of_hub(str(folder), name) for name in ("config.json", "tokenizer_config.json", INDEX)]
        config, tokenizer = (Path(name) if name else path / "none" for name in found[:2])
        indices = [Path(found[2])] if found[2] else []
    for index in indices:
        weights = read_object(index).get("weight_map")
        for name in weights.values() if isinstance(weights, dict) else ():
            if not _plain(name) or not name.endswith(".safetensors"):
                raise ValueError(
                    f"{index} names the weights {name!r}; expected safetensors files in the same folder, "
                    "which alone are read. Save the model again with a recent transformers."
                )
    if config.exists():
        _refuse_in_config(config, read_object(config))
    if tokenizer.exists():
        _refuse_file_names(tokenizer, read_object(tokenizer))


def _of_hub(name: str, file: str) -> str | None:
    """A file of a hub id, downloaded as loading would; None where it is missing or cannot be reached."""
    from transformers.utils import cached_file

    try:
        return cached_file(name, file, _raise_exceptions_for_missing_entries=False)
    except (OSError, ValueError):  # loading reports it
        return None


def _refuse_links(path: Path) -> None:
    """ValueError for a link out of the folder. Those of a hub snapshot lead to blobs of the same model."""
    root = path.resolve()
    inside = [root, *([root.parent.parent / "blobs"] if root.parent.name == "snapshots" else [])]
    for entry in sorted(path.iterdir()):
        if entry.is_symlink() and not any(entry.resolve().is_relative_to(place) for place in inside):
            raise ValueError(
                f"{entry} is a link to {entry.resolve()}, outside the model's folder, where nothing is read. "
                "Put the file itself there."
            )
        if not (entry.is_file() or entry.is_dir()):  # a pipe, whose reader would wait for ever
            raise ValueError(f"{entry} is not a regular file. Take it out of the model's folder.")


def _plain(name: object) -> bool:
    """Whether this is the name of a file in the same folder."""
    return isinstance(name, str) and not set("/\\:") & set(name) and name not in ("", ".", "..")


def _refuse_in_config(path: Path, value: object, key: str = "") -> None:
    """ValueError for what in a configuration could make transformers fetch code or open a file."""
    if isinstance(value, dict):
        for name, part in value.items():
            if name in ("quantization_config", "transformers_weights") and part is not None:
                raise ValueError(
                    f"{path} has {name}, which chooses code or files to load with. Only plain weights are "
                    "read and trained: save the model without it (model.dequantize() where it is quantised)."
                )
            if name not in TEXTS:
                _refuse_in_config(path, part, name)
    elif isinstance(value, list):
        for part in value:
            _refuse_in_config(path, part, key)
    elif isinstance(value, int) and not isinstance(value, bool):
        _refuse_size(path, key, value)
    elif "experts_implementation" in key and value not in EXPERTS:
        raise ValueError(f"{path} has {key} {value!r}; expected one of {EXPERTS}. Take it out of the file.")
    elif isinstance(value, str) and value and not _plain(value):
        raise ValueError(
            f"{path} has {key} {value!r}, which may name a place or code elsewhere. Nothing of the kind is "
            "followed: take it out of the file where you trust the model."
        )


def _refuse_size(path: Path, key: str, value: int) -> None:
    """ValueError for a number of layers that would never be built, and for sizes that are none."""
    layers = key in ("num_hidden_layers", "n_layer", "num_layers", "n_layers")
    size = layers or key.endswith(
        ("_size", "_heads", "head_dim", "_embd", "_positions", "_embeddings", "_window")
    )
    low, high = (1, MOST_LAYERS) if layers else (0, 2**31) if size else (-(2**63), 2**63 - 1)
    if not low <= value <= high:
        digits = str(value) if abs(value) < 10**30 else "a number of more than 30 digits"
        raise ValueError(f"{path}: {key} is {digits}; expected {low} to {high}. Choose another model.")


def _refuse_file_names(path: Path, value: object) -> None:
    """ValueError for a file elsewhere in a tokenizer's configuration."""
    for key, part in value.items() if isinstance(value, dict) else ():
        names = part if isinstance(part, list) else [part]
        if key.endswith(("_file", "_files", "_path", "_dir")) and key not in TEXTS:
            for name in names:
                if isinstance(name, str) and not _plain(name):
                    raise ValueError(f"{path} has {key} {name!r}; expected a file in the same folder.")
        for part in names:
            _refuse_file_names(path, part)


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file as other programs write them: NaN and Infinity are let pass, a key that
    occurs twice is not (readers differ in which one counts). ValueError names the file.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("it is not a regular file")
        value = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=each_key_once)
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not readable as JSON ({error}).") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} holds {type(value).__name__}, expected an object.")
    return value


def read_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file, on the CPU. ValueError names the file."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path} is not readable as safetensors ({error}).") from error


def read_metadata(path: Path) -> dict[str, str]:
    """The texts in the header of a safetensors file. ValueError names the file."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            return dict(file.metadata() or {})
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path} is not readable as safetensors ({error}).") from error


NOISY_LIBRARIES = r"(tightrope|transformers|torch|tokenizers|huggingface_hub|peft|safetensors)(\.|$)"


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """Inside, transformers and the hub show no progress bars and log errors only; both are put back after.

    Deprecations are for those who write code, so the libraries' are hidden. The filter is the last
    in the list: what a caller has asked for, such as ``-W error``, comes before it. Also a decorator.
    """
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars
    from transformers.utils import logging

    level, bars, hub_bars_off = (
        logging.get_verbosity(), logging.is_progress_bar_enabled(), are_progress_bars_disabled()
    )  # fmt: skip
    logging.set_verbosity_error()
    with _no_warning_of_the_hub():
        logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning, module=NOISY_LIBRARIES, append=True)
            yield
    finally:
        logging.set_verbosity(level)
        if bars:
            with _no_warning_of_the_hub():
                logging.enable_progress_bar()  # switches the hub's bars on too
                if hub_bars_off:
                    disable_progress_bars()


@contextlib.contextmanager
def _no_warning_of_the_hub() -> Iterator[None]:
    """The hub warns when HF_HUB_DISABLE_PROGRESS_BARS decides and a call cannot."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Cannot (en|dis)able progress bars", category=UserWarning)
        yield
