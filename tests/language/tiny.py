"""Tiny random models and a tokenizer, made in memory, for all language tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

WORDS = ["<pad>", "<unk>", "<bos>", "<eos>", *"abcdefghijklmnopqrstuvwxyz .!?,'", "\n"]
WORDS += "αβγδεζηθικλμνξοπρστυφχψ"  # what models write and tests do not
VOCABULARY = 64  # a few ids have no word, as in many real models: they are never sampled


def tiny_llama(layers: int = 3, seed: int = 0, scale: float = 3.0) -> Any:
    """A Llama of some 20,000 parameters with peaked, far from uniform predictions."""
    from transformers import LlamaConfig, LlamaForCausalLM

    torch.manual_seed(seed)
    config = LlamaConfig(
        vocab_size=VOCABULARY, hidden_size=32, intermediate_size=48, num_hidden_layers=layers,
        num_attention_heads=4, num_key_value_heads=2, head_dim=8, max_position_embeddings=96,
        tie_word_embeddings=True, bos_token_id=2, eos_token_id=3, pad_token_id=0, initializer_range=0.1,
    )  # fmt: skip
    model = LlamaForCausalLM(config)
    with torch.no_grad():
        model.model.norm.weight.mul_(scale)
    return model.eval()


def tiny_gpt2(layers: int = 3, seed: int = 0) -> Any:
    """A GPT-2: learnt positions, transposed weights, dropout in its config, no PAD token."""
    from transformers import GPT2Config, GPT2LMHeadModel

    torch.manual_seed(seed)
    config = GPT2Config(
        vocab_size=VOCABULARY, n_embd=32, n_layer=layers, n_head=4, n_positions=96, bos_token_id=3,
        eos_token_id=3, initializer_range=0.3, resid_pdrop=0.1, embd_pdrop=0.1, attn_pdrop=0.1,
    )  # fmt: skip
    return GPT2LMHeadModel(config).eval()


def tokenizer(chat: bool = False) -> Any:
    """Characters; EOS and PAD are separate tokens."""
    from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    inner = Tokenizer(models.WordLevel({w: i for i, w in enumerate(WORDS)}, unk_token="<unk>"))
    inner.pre_tokenizer = pre_tokenizers.Split(Regex("[\\s\\S]"), "isolated")
    inner.decoder = decoders.Fuse()
    made = PreTrainedTokenizerFast(
        tokenizer_object=inner, pad_token="<pad>", unk_token="<unk>", bos_token="<bos>", eos_token="<eos>",
        model_max_length=96, clean_up_tokenization_spaces=False,
    )  # fmt: skip
    if chat:
        made.chat_template = (
            "{% for m in messages %}{{ m['role'][0] }}.{{ m['content'] }}"
            "{% if m['role'] == 'assistant' %}<eos>{% else %}\n{% endif %}{% endfor %}"
            "{% if add_generation_prompt %}a.{% endif %}"
        )
    return made


def saved(folder: Path, model: Any = None, chat: bool = False) -> str:
    """A model folder in the format of transformers."""
    (tiny_llama() if model is None else model).save_pretrained(folder)
    tokenizer(chat).save_pretrained(folder)
    return str(folder)


def padded(rows: int = 4, prompt: int = 6, response: int = 7, seed: int = 0) -> tuple[Any, Any, Any]:
    """tokens, real [B, P + R] and mask [B, R]: left-padded prompts, right-padded responses of all lengths."""
    generator = torch.Generator().manual_seed(seed)
    tokens = torch.randint(4, VOCABULARY, (rows, prompt + response), generator=generator)
    real = torch.zeros(rows, prompt + response, dtype=torch.bool)
    for row in range(rows):
        before = int(torch.randint(1, prompt + 1, (), generator=generator))
        after = int(torch.randint(1, response + 1, (), generator=generator))
        real[row, prompt - before : prompt + after] = True
    return tokens, real, real[:, prompt:]


def tiny_of(kind: str, of: str = "CausalLM", **values: Any) -> Any:
    """A random model of one of transformers' families, by the name in front of ``Config``."""
    import transformers

    torch.manual_seed(0)
    sizes = {
        "vocab_size": VOCABULARY, "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 3,
        "num_attention_heads": 2, "num_key_value_heads": 2, "max_position_embeddings": 96,
        "bos_token_id": 2, "eos_token_id": 3, "pad_token_id": 0, "initializer_range": 0.3,
    }  # fmt: skip
    config = getattr(transformers, f"{kind}Config")(**{**sizes, **values})
    return getattr(transformers, f"AutoModelFor{of}").from_config(config).eval()
