"""``tightrope sample RUN``: the aligned model beside the one it began as, on the same prompts and random
numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tightrope.language.alignment.samples import read_samples
from tightrope.language.data.batching import pad_left
from tightrope.language.data.examples import Prompt, read_prompts
from tightrope.language.generation.distribution import Sampling
from tightrope.language.generation.sample import sample
from tightrope.language.model.load import (
    eos_ids,
    load_causal,
    load_tokenizer,
    never_drawn,
    pretrained,
    quiet_libraries,
)
from tightrope.language.model.packaged import find_model
from tightrope.language.settings import AlignSettings
from tightrope.runs.folders import require_kind
from tightrope.runs.run import Run


@quiet_libraries()
def sample_run(
    path: str | Path,
    prompt: Sequence[str | Sequence[Mapping[str, object]]] | None = None,
    *,
    count: int = 8,
    seed: int | None = None,
) -> list[dict[str, Any]]:
    """Rows of ``prompt``, ``before`` and ``after`` for a run of align.

    ``prompt``: texts or message lists; by default ``count`` different ones that the run itself answered.
    ``seed`` of sampling: by default the run's + 1. Raises ValueError where there is no finished run.
    """
    from transformers import AutoConfig

    path = Path(path)
    run = Run.open(path)
    require_kind(path, run.settings, "align")
    settings = AlignSettings.from_json(run.settings, path / "settings.json")
    if seed is not None and seed < 0:
        raise ValueError(f"seed is {seed}, expected 0 or more.")
    if not (path / "model" / "config.json").is_file():
        raise ValueError(
            f"{path} holds no aligned model: the run has not finished, or is not a run of align."
        )
    asked = list(prompt) if prompt else _prompts_of(path, count)
    tokenizer = load_tokenizer(str(path / "model"))
    seed = settings.seed + 1 if seed is None else seed
    rows = [{"prompt": text} for text in asked]
    vocabulary = pretrained(AutoConfig, path / "model").get_text_config().vocab_size
    prompts = read_prompts(rows, tokenizer, max_tokens=settings.max_prompt_tokens, vocabulary=vocabulary)
    texts = {
        name: _responses(folder, prompts, settings, seed)
        for name, folder in (("before", find_model(settings.model)), ("after", str(path / "model")))
    }
    return [
        {"prompt": one.shown, "before": before, "after": after}
        for one, before, after in zip(prompts, texts["before"], texts["after"], strict=True)
    ]


def _prompts_of(path: Path, count: int) -> list[Any]:
    """Prompts that the run answered, the newest first, each once."""
    found: dict[str, Any] = {}
    for row in reversed(read_samples(path)):
        found.setdefault(str(row["prompt"]), row["prompt"])
        if len(found) == count:
            break
    return list(found.values())


def _responses(folder: str, prompts: Sequence[Prompt], settings: AlignSettings, seed: int) -> list[str]:
    """One response to every prompt, sampled as in training."""
    model, tokenizer = load_causal(folder), load_tokenizer(folder)
    tokens, real = pad_left([prompt.tokens for prompt in prompts])
    stops = eos_ids(model, tokenizer)
    never = never_drawn(model, tokenizer, stops, ignore_eos=settings.ignore_eos)
    sampling = Sampling(settings.temperature, settings.top_k, never)
    numbers = np.random.default_rng([seed, 8]).random((len(prompts), settings.max_new_tokens))
    found = sample(model, tokens, real, sampling, torch.from_numpy(numbers), stops)
    rows = zip(found.tokens, found.mask, strict=True)
    return [str(tokenizer.decode(ids[mask].tolist(), skip_special_tokens=True)) for ids, mask in rows]
