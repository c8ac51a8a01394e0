"""The judge of responses: a reward model on the policy's trunk, one with a trunk of its own, or functions."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.descent import OutOfMemory, is_out_of_memory
from tightrope.language.data.examples import Prompt
from tightrope.language.generation.sample import Completions, texts_of
from tightrope.language.model import lora
from tightrope.language.model.architecture import context_length
from tightrope.language.model.load import HEAD, known_ids, read_metadata, weights_fingerprint
from tightrope.language.model.packaged import not_on_hub
from tightrope.language.model.trunk import Role
from tightrope.language.policy.roles import Roles
from tightrope.language.reward.call import Fault, RewardError, RewardFunction
from tightrope.language.reward.functions import (
    Rewards,
    Scores,
    checked_weight,
    load_reward_function,
    unique_name,
)
from tightrope.language.reward.model import RewardModel, last_real, load_reward, read_head
from tightrope.language.settings import AlignSettings, weighted

# What a user may give: a function, the words of the command line, or the folder of a reward model; alone or
# with its weight, or several in a list.
RewardSource = RewardFunction | str | Path
RewardSources = (
    RewardSource | tuple[RewardSource, float] | Sequence[RewardSource | tuple[RewardSource, float]]
)


class Judge:
    """Scores of whole responses, from functions of the text and from a reward model, weighted and added up.

    ``adapter``: a reward adapter on the policy's trunk with its head [1, d] and shift; ``model``: one with a
    trunk of its own, which must know the policy's tokens; ``weight``: of either.
    """

    def __init__(
        self,
        roles: Roles,
        functions: Rewards | None = None,
        model: RewardModel | None = None,
        adapter: tuple[Tensor, float] | None = None,
        weight: float = 1.0,
    ) -> None:
        self.roles, self.functions, self.model, self.adapter = roles, functions, model, adapter
        self.weight = weight

    def __call__(
        self, prompts: Sequence[Prompt], answers: Completions, trainer_state: object = None
    ) -> Scores:
        """Scores of the responses to ``prompts``, one prompt per response."""
        found = self._of_functions(prompts, answers, trainer_state)
        try:
            learnt = self._of_model(answers)
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            raise OutOfMemory(
                f"Memory is not enough for the reward model to score {len(answers.tokens)} responses. "
                "Choose a smaller --micro-batch-size or --batch-size."
            ) from error
        if learnt is not None:
            return with_model(found, learnt, self.weight)
        assert found is not None
        return found

    def _of_functions(self, prompts: Sequence[Prompt], answers: Completions, state: object) -> Scores | None:
        if self.functions is None:
            return None
        texts = texts_of(self.roles.tokenizer, answers.ids, self.roles.settings.stop)
        completions = [
            text if isinstance(prompt.shown, str) else [{"role": "assistant", "content": text}]
            for prompt, text in zip(prompts, texts, strict=True)
        ]
        names = {name for prompt in prompts for name in prompt.columns}
        columns = {name: [prompt.columns.get(name) for prompt in prompts] for name in sorted(names)}
        return self.functions.score([p.shown for p in prompts], completions, answers.ids, columns, state)

    @torch.no_grad()
    def _of_model(self, answers: Completions) -> np.ndarray | None:
        if self.model is None and self.adapter is None:
            return None
        size = self.roles.settings.update.micro_batch_size or len(answers.tokens)
        scores = []
        for start in range(0, len(answers.tokens), size):
            rows = slice(start, start + size)
            tokens, real = answers.tokens[rows], answers.real[rows]
            if self.model is not None:
                scores.append(self.model.score(tokens, real).float())
                continue
            assert self.adapter is not None
            head, shift = self.adapter
            lower = None if answers.lower is None else answers.lower[rows]
            hidden = Role(self.roles.trunk, "reward").hidden(tokens, real, lower)
            scores.append((last_real(hidden, real).float() @ head.float().T)[:, 0] - shift)
        return torch.cat(scores).double().cpu().numpy()


def with_model(found: Scores | None, learnt: np.ndarray, weight: float = 1.0) -> Scores:
    """The functions' scores and a reward model's, [B], added up.

    Where no function applies only the model's score counts. A score of the model that is not finite masks its
    response. RewardError when none is finite: the model is broken.
    """
    good = np.isfinite(learnt)
    if not good.any():
        raise RewardError(
            f"The reward model gave {learnt[0]} for sample 0 of {len(learnt)} and no finite score for any "
            "other: its weights are not usable. Train it again, or give another."
        )
    if found is None:
        found = Scores(np.zeros(len(learnt)), np.ones(len(learnt), bool), {}, {}, {})
    model_only = np.zeros(len(learnt), bool)
    model_only[[sample for fault in found.faults if fault.kind == "none" for sample in fault.samples]] = True
    valid = (found.valid | model_only) & good
    part, name = np.where(good, learnt, np.nan), unique_name(found.parts, "reward_model")
    faults = [fault for fault in found.faults if fault.kind != "none"]
    if not good.all():
        bad = tuple(np.flatnonzero(~good).tolist())
        where = f"sample {bad[0]} of {len(learnt)}" + (f" and {len(bad) - 1} more" if len(bad) > 1 else "")
        text = f"The reward model gave {learnt[bad[0]]} for {where}, expected a finite number."
        faults.append(Fault(name, "not finite", bad, text))
    return Scores(
        total=np.where(valid, np.where(model_only, 0.0, found.total) + weight * part, np.nan),
        valid=valid,
        parts={**found.parts, name: part},
        metrics={**found.metrics, f"scores/{name}": float(part[good].mean())},
        extras=found.extras,
        faults=faults,
    )


class GivenReward(NamedTuple):
    """One of the rewards that were given, its weight, and its folder where it is a reward model."""

    given: object
    weight: float
    folder: Path | None


def _entries(reward: RewardSources) -> list[GivenReward]:
    """The rewards that were given: one, or a list. ValueError for a weight that is not a finite number."""
    found = []
    for given in reward if isinstance(reward, list) else [reward]:
        word: object = given
        weight = 1.0
        if isinstance(given, tuple) and len(given) == 2:
            word, weight = given[0], checked_weight(given[1])
        if isinstance(word, str):
            word, typed = weighted(word)
            weight *= checked_weight(typed)
        folder = _folder(word) if isinstance(word, str | Path) else None
        found.append(GivenReward(word, weight, folder))
    return found


def _folder(word: str | Path) -> Path | None:
    """The folder of a reward model: the one named, or that of a hub id, whose files are fetched; None for
    what names neither.
    """
    path = Path(word).expanduser()
    if path.is_dir():
        return path
    return _from_hub(str(word)) if re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", str(word)) else None


@functools.cache
def _from_hub(word: str) -> Path:
    """A hub model's folder on this machine. RewardError, with what was looked for, where there is none."""
    if reason := not_on_hub(word):
        raise RewardError(
            f"There is no reward {word!r}. Looked for: {', '.join(AlignSettings.BUILT_IN_REWARDS)}, "
            "FILE.py:function, the folder of a reward model (none of that name), and a reward model of that "
            f"id on the hub ({reason})."
        )
    from huggingface_hub import snapshot_download

    return Path(snapshot_download(word, allow_patterns=["*.json", "*.safetensors", "*.model", "*.txt"]))


def folder_of(reward: RewardSources) -> Path | None:
    """The folder of a reward model, where a reward, or one of several, is one."""
    return next((entry.folder for entry in _entries(reward) if entry.folder is not None), None)


def reward_adapter(reward: RewardSources) -> Path | None:
    """The adapter folder of a reward model that was trained with LoRA, None for any other reward."""
    folders = [entry.folder / "adapter" for entry in _entries(reward) if entry.folder is not None]
    return next((folder for folder in folders if (folder / HEAD).is_file()), None)


def shares_trunk(adapter: Path, model: str) -> bool:
    """Whether a reward adapter was trained on the same weights that are aligned, in any folder."""
    trained = read_metadata(adapter / HEAD).get("trunk")
    return bool(trained) and trained == weights_fingerprint(model)


def make_judge(reward: RewardSources, roles: Roles, *, on_trunk: Path | None, timeout: float | None) -> Judge:
    """A judge from what the user gave: a function, (function, weight), words of the command line, or several.

    ``on_trunk``: the folder of the adapter that `make_roles` has put on the trunk.
    """
    functions: list[Any] = []
    model, adapter, model_weight = None, None, 1.0
    if reward in ("", []):
        raise ValueError(
            "There is no reward. Give a function, 'length', FILE.py:function or the folder of a reward model."
        )
    for entry in _entries(reward):
        if entry.folder is not None:
            if model is not None or adapter is not None:
                raise ValueError("Two reward models were given; expected one, and any number of functions.")
            model_weight = entry.weight
            if on_trunk is not None and entry.folder / "adapter" == on_trunk:
                weight, shift = read_head(on_trunk / HEAD, roles.trunk.parts.head.in_features)
                adapter = weight.to(roles.settings.device), shift
            else:
                model = load_reward(entry.folder).to(roles.settings.device)
                _same_tokens(model, roles, entry.folder)
                _require_context(model, roles.settings, entry.folder)
        elif isinstance(entry.given, str):
            functions.append((load_reward_function(entry.given), entry.weight))
        elif callable(entry.given):
            functions.append((entry.given, entry.weight))
        else:
            raise ValueError(
                f"reward is {entry.given!r}; expected a function, 'length', FILE.py:function, the folder of "
                "a reward model, one of these with its weight in a pair, or a list of them."
            )
    alone = model is None and adapter is None
    rewards = Rewards(functions, timeout=timeout, alone=alone) if functions else None
    return Judge(roles, rewards, model, adapter, model_weight)


def _require_context(model: RewardModel, settings: AlignSettings, folder: Path) -> None:
    base: Any = model.base
    limit, longest = context_length(base), settings.max_prompt_tokens + settings.max_new_tokens
    if limit is not None and longest > limit:
        raise ValueError(
            f"max_prompt_tokens {settings.max_prompt_tokens} + max_new_tokens {settings.max_new_tokens} "
            f"exceed the context of the reward model {folder}, {limit} tokens. Choose less of either."
        )


def _same_tokens(model: RewardModel, roles: Roles, folder: Path) -> None:
    assert model.tokenizer is not None
    theirs, ours = model.tokenizer.get_vocab(), roles.tokenizer.get_vocab()
    if theirs != ours:
        raise ValueError(
            f"The reward model {folder} reads {len(theirs)} tokens, the policy writes {len(ours)} others. "
            "Wrap it in a reward function of the text, or train it from the policy's own model."
        )
    strange = [token for token in ours.values() if known_ids(model.base) <= token < known_ids(roles.model)]
    if strange:
        raise ValueError(
            f"The reward model {folder} reads {known_ids(model.base)} ids, the policy also writes "
            f"{roles.tokenizer.convert_ids_to_tokens(min(strange))!r}, id {min(strange)}. Wrap it in a "
            "reward function of the text, or train it from the policy's own model."
        )


def critic_from_reward(judge: Judge, roles: Roles, reward: RewardSources) -> None:
    """Begin the critic with a reward model's weights: V = what its score adds to the reward at first.

    An adapter takes the reward model's adapter, a critic of its own the whole reward model; a head on the
    policy's hidden states cannot read those of the reward model. ValueError for what does not
    fit.
    """
    folder = folder_of(reward)
    kind, head = roles.settings.critic, roles.critic_head
    if folder is None or head is None or kind == "head" or (kind == "adapter" and judge.adapter is None):
        raise ValueError(
            f"critic_from_reward with critic {kind!r}: expected the folder of a reward model as reward and "
            "critic separate, or critic adapter with a reward adapter on the same model that is aligned "
            "(tightrope reward --tune lora). Choose one, or leave critic_from_reward out."
        )
    if kind == "adapter" and judge.adapter is not None:
        weight, shift = judge.adapter
        state = lora.adapter_state(roles.model, "reward")
        lora.load_adapter_state(roles.model, "critic", state)
    else:
        assert roles.critic is not None
        model = judge.model or load_reward(folder)
        weight, shift = model.head.weight, model.shift
        try:
            roles.critic.trunk.parts.base.load_state_dict(model.base.state_dict())
        except RuntimeError as error:
            raise ValueError(
                f"critic_from_reward: the reward model {folder} is built differently from the critic, which "
                f"is made of {roles.settings.model} ({str(error).splitlines()[-1].strip()}). Leave it out."
            ) from error
    scale = judge.weight * roles.settings.reward_scale
    with torch.no_grad():
        head.weight.copy_(weight * scale)
        head.bias.fill_(-shift * scale)
