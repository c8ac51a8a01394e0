"""``tightrope sample RUN``: the aligned model beside the one it began as, on the same prompts and random
numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tightrope.language.alignment.experience import respond
from tightrope.language.alignment.samples import read_samples
from tightrope.language.data.examples import read_prompts
from tightrope.language.generation.distribution import Sampling
from tightrope.language.generation.sample import Completions, texts_of
from tightrope.language.model.load import (
    eos_ids,
    known_ids,
    load_causal,
    load_tokenizer,
    never_drawn,
    quiet_libraries,
)
from tightrope.language.model.packaged import find_model
from tightrope.language.model.trunk import Role, Trunk
from tightrope.language.policy.roles import Roles
from tightrope.language.reward.judge import RewardSources, make_judge
from tightrope.language.settings import AlignSettings, may_stand_in_a_file
from tightrope.runs.folders import require_kind
from tightrope.runs.run import Run


@quiet_libraries()
def sample_run(
    path: str | Path,
    prompt: Sequence[str | Sequence[Mapping[str, object]]] | None = None,
    *,
    count: int = 8,
    seed: int | None = None,
    figures: bool = False,
    reward: RewardSources | None = None,
) -> list[dict[str, Any]]:
    """Rows of ``prompt``, ``before`` and ``after`` for a run of align.

    ``prompt``: texts or message lists; by default ``count`` different ones that the run itself answered.
    ``seed`` of sampling: by default the run's + 1. ``figures``: also ``tokens_before`` and ``tokens_after``
    of the responses, their KL to the model before, k1 summed over the response in nats (``kl_before`` is 0),
    and the scores, None where a response has none. They are those of ``reward``, by default the run's; where
    that was code, which no file may name, they are left out. Raises ValueError where there is no finished
    run.
    """
    path = Path(path)
    run = Run.open(path)
    require_kind(path, run.settings, "align")
    settings = AlignSettings.from_json(run.settings, path / "settings.json").with_values(device="cpu")
    if seed is not None and seed < 0:
        raise ValueError(f"seed is {seed}, expected 0 or more.")
    if not (path / "model" / "config.json").is_file():
        raise ValueError(
            f"{path} holds no aligned model: the run has not finished, or is not a run of align."
        )
    after = _roles(str(path / "model"), settings)
    rows = [{"prompt": text} for text in (list(prompt) if prompt else _prompts_of(path, count))]
    vocabulary = known_ids(after.model)
    prompts = read_prompts(
        rows, after.tokenizer, max_tokens=settings.max_prompt_tokens, vocabulary=vocabulary
    )
    seed = settings.seed + 1 if seed is None else seed
    answers = {"after": respond(after, prompts, [seed, 8], 1)}
    before = _roles(find_model(settings.model), settings)
    answers["before"] = respond(before, prompts, [seed, 8], 1)
    found: list[dict[str, Any]] = [{"prompt": one.shown} for one in prompts]
    for name in ("before", "after"):
        texts = texts_of(before.tokenizer, answers[name].ids, settings.stop)
        found = [{**row, name: text} for row, text in zip(found, texts, strict=True)]
    if not figures:
        return found
    if reward is None and all(map(may_stand_in_a_file, settings.reward)):
        reward = list(settings.reward)
    judge = None
    if reward is not None:
        judge = make_judge(reward, before, on_trunk=None, timeout=settings.reward_timeout)
    for name, given in answers.items():
        responses = given.responses
        others = responses.logp if name == "before" else _logp(before, given)
        kl = torch.where(responses.mask, responses.logp - others, 0.0).sum(1)
        scores = None if judge is None else judge(prompts, given).total
        for i, row in enumerate(found):
            row[f"tokens_{name}"], row[f"kl_{name}"] = len(given.ids[i]), float(kl[i])
            if scores is not None:
                row[f"score_{name}"] = float(scores[i]) if np.isfinite(scores[i]) else None
    return found


def _prompts_of(path: Path, count: int) -> list[Any]:
    """Prompts that the run answered, the newest first, each once."""
    found: dict[str, Any] = {}
    for row in reversed(read_samples(path)):
        found.setdefault(str(row["prompt"]), row["prompt"])
        if len(found) == count:
            break
    return list(found.values())


def _roles(folder: str, settings: AlignSettings) -> Roles:
    """A model that is policy and reference in one, sampling as in training."""
    model, tokenizer = load_causal(folder), load_tokenizer(folder)
    stops = eos_ids(model, tokenizer)
    never = never_drawn(model, tokenizer, stops, ignore_eos=settings.ignore_eos)
    sampling = Sampling(settings.temperature, settings.top_k, never)
    role = Role(Trunk(model))
    return Roles(tokenizer, role, role, None, None, settings, sampling, stops)


@torch.no_grad()
def _logp(roles: Roles, given: Completions) -> Tensor:
    """Log-probabilities [B, R] of responses by another model, from the same distribution that was sampled."""
    responses, mask = given.responses, given.responses.mask
    hidden = roles.reference.hidden(given.tokens, given.real)[:, -mask.shape[1] - 1 : -1]
    support = None if responses.support is None else responses.support[mask]
    found = roles.statistics(hidden[mask], tokens=responses.tokens[mask], support=support)
    return torch.zeros(mask.shape).masked_scatter(mask, found.logp)
