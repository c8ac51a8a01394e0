"""Policy, reference, critic and reward model: four roles, one trunk in memory where that is possible.

policy     adapter "policy", the language-model head          (tune full: every weight)
reference  the bare trunk, the same head                      (tune full: a frozen copy)
critic     a head on the policy's hidden states | adapter "critic" and a head | a separate model
reward     adapter "reward" and a head | a separate model | a function of the text
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.generation.sample import GapLimits, cache_works, gap_limits, special_stops
from tightrope.language.memory import job_of, require_memory, reward_model_bytes
from tightrope.language.model import lora
from tightrope.language.model.architecture import parameter_counts, parts
from tightrope.language.model.load import (
    eos_ids,
    load_causal,
    load_tokenizer,
    never_drawn,
    pretrained,
    require_device,
    unreadable,
    unwritable,
)
from tightrope.language.model.packaged import find_model
from tightrope.language.model.saving import load_adapter
from tightrope.language.model.trunk import Role, Trunk
from tightrope.language.settings import AlignSettings, weighted

if TYPE_CHECKING:
    from transformers import PreTrainedModel, PreTrainedTokenizerBase


@dataclass
class Roles:
    """The models of an alignment run, most of them on the policy's trunk.

    ``critic``: None where its head reads the policy's hidden states, or where there is no critic.
    """

    tokenizer: PreTrainedTokenizerBase
    policy: Role
    reference: Role
    critic: Role | None
    critic_head: nn.Linear | None
    settings: AlignSettings
    sampling: Sampling
    eos: tuple[int, ...]

    def __post_init__(self) -> None:
        """Statistics of tokens, with all that a rollout and its update must have in common."""
        self.statistics = functools.partial(
            token_statistics,
            head=self.trunk.parts.head,
            sampling=self.sampling,
            reference_head=self.reference.trunk.parts.head,
            ahead=self.settings.logp_alone,
        )

    @property
    def trunk(self) -> Trunk:
        """The policy's trunk."""
        return self.policy.trunk

    @property
    def model(self) -> Any:
        """The policy's model."""
        return self.policy.trunk.model

    @property
    def gap_limits(self) -> GapLimits:
        """How far sampling and training may be apart in this model."""
        layers, head = self.trunk.parts.layers, self.trunk.parts.head
        return gap_limits(self.settings.dtype, len(layers), head.in_features)

    def frozen_policy(self) -> contextlib.AbstractContextManager[None]:
        """Inside, the model is the policy as it is now, its adapter folded in; without gradients."""
        return lora.folded(self.model, self.policy.adapter)

    def critic_parameters(self) -> list[nn.Parameter]:
        """What only the critic trains."""
        found = [] if self.critic_head is None else list(self.critic_head.parameters())
        if self.critic is not None and self.critic.adapter is None:
            found += list(self.critic.trunk.parts.base.parameters())
        elif self.settings.critic == "adapter":
            found += lora.adapter_parameters(self.model, "critic")
        return found

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Every weight of the policy's model and of the critic, by name."""
        yield from self.model.named_parameters()
        if self.critic_head is not None:
            yield from self.critic_head.named_parameters("critic_head")
        if self.critic is not None and self.critic.adapter is None:
            yield from self.critic.trunk.parts.base.named_parameters("critic")

    def lines(self) -> list[str]:
        """What is trained, in lines to show where a run begins."""
        settings, trunk = self.settings, self.trunk
        trained, total = parameter_counts(self.model, self.parameters())
        shared = (
            f"; {trunk.cut} of {len(trunk.parts.layers)} layers computed once for all roles"
            if trunk.cut
            else ""
        )
        never = len(unwritable(self.model, self.tokenizer))
        lines = [
            f"policy: {settings.model}, {settings.tune}, {trained:,} of {total:,} parameters trained{shared}",
            *(
                [f"{never} of the model's ids are never sampled: the tokenizer does not have them"]
                if never
                else []
            ),
            f"critic: {settings.critic}; KL: {settings.kl}, kl_beta {settings.kl_beta:g}",
        ]
        if not cache_works(trunk.parts.base, trunk.parts.head.out_features):
            lines.append(
                "cache: this model keeps none that gives the same numbers, so that every token computes the "
                "whole text again"
            )
        return lines

    def parameters(self) -> list[nn.Parameter]:
        """Everything that is trained: the policy's weights or adapter, then the critic's."""
        if self.policy.adapter is None:
            return list(self.model.parameters()) + self.critic_parameters()
        return lora.adapter_parameters(self.model, self.policy.adapter) + self.critic_parameters()


def make_roles(
    settings: AlignSettings,
    reward_adapter: Path | None = None,
    notify: Callable[[str], None] = print,
    *,
    warn: Callable[[str], None] = warnings.warn,
    own_reward: bool = False,
) -> Roles:
    """Load and arrange the models. ``reward_adapter``: a reward model's adapter for the same trunk;
    ``own_reward``: the reward is a model with a trunk of its own, which will be loaded beside them.

    The memory ledger is handed to ``notify`` before anything large is loaded; what cannot fit is a
    ValueError. ``warn`` is told of weights in the file that are not used.
    """
    require_device(settings.device)
    folder, dtype, device = find_model(settings.model), getattr(torch, settings.dtype), settings.device
    guessed = own_reward and not any(Path(weighted(word)[0]).is_dir() for word in settings.reward)
    kind = "separate" if guessed else "none" if reward_adapter is None else "adapter"
    _require_memory(folder, settings, kind, notify, own_reward)
    tokenizer, model = load_tokenizer(folder), load_causal(folder, dtype, warn).to(device)
    stops, cut = eos_ids(model, tokenizer), 0
    special_stops(tokenizer, settings.stop)  # refuses what would never be met
    if strangers := unreadable(model, tokenizer):
        notify(strangers)
    again = functools.partial(load_causal, folder, dtype, lambda text: None)  # what it tells was told above
    if settings.tune == "lora":
        layers = lora.top_layers(model, settings.lora_layers)
        cut = layers[0]
        for number, name in enumerate(["policy"] + ["critic"] * (settings.critic == "adapter")):
            seed = settings.seed * 10 + number
            lora.add_adapter(model, name, settings.lora_rank, settings.lora_alpha, layers, seed)
        if reward_adapter is not None:
            load_adapter(model, "reward", reward_adapter)
            cut = min(cut, lowest_layer(model, "reward"))
    checkpointing = settings.gradient_checkpointing
    trunk = Trunk(model, cut, checkpointing=checkpointing)
    policy, reference = Role(trunk, "policy"), Role(trunk)
    if settings.tune == "full":
        copy = again().to(device).requires_grad_(False)
        policy, reference = Role(trunk), Role(Trunk(copy))
    critic = None
    if settings.critic == "adapter":
        critic = Role(trunk, "critic")
    elif settings.critic == "separate":
        critic = Role(Trunk(again().to(device), checkpointing=checkpointing))
    head = None
    if settings.critic != "none":
        head = nn.Linear(parts(model).head.in_features, 1).to(device)
        nn.init.zeros_(head.weight)  # the first values are 0 for any hidden state
        nn.init.zeros_(head.bias)
    never = never_drawn(model, tokenizer, stops, ignore_eos=settings.ignore_eos)
    sampling = Sampling(settings.temperature, settings.top_k, never)
    return Roles(tokenizer, policy, reference, critic, head, settings, sampling, stops)


def _require_memory(
    folder: str, settings: AlignSettings, reward: str, notify: Callable[[str], None], own_reward: bool
) -> None:
    """Report what the job will take, and refuse it with advice when it cannot fit: before weights are loaded.

    The gold judge, and the reward with ``own_reward``, have a trunk of their own where they are folders.
    """
    from transformers import AutoConfig

    rows = min(settings.update.micro_batch_size or settings.update.minibatch_size, settings.batch_size)
    texts = rows * settings.ptx_per_response if settings.ptx_weight else 0
    named = [*(settings.reward if own_reward else ()), *([settings.gold] if settings.gold else [])]
    judges = [folder for folder in (Path(weighted(word)[0]) for word in named) if folder.is_dir()]
    job = job_of(
        settings,
        reward=reward,
        extra_tokens=texts * (settings.max_prompt_tokens + settings.max_new_tokens),
        judges=tuple((judge.resolve().name, reward_model_bytes(judge)) for judge in judges),
    )
    require_memory(pretrained(AutoConfig, folder), job, settings.device, notify)


def lowest_layer(model: PreTrainedModel, name: str) -> int:
    """The index of the lowest decoder layer that an adapter changes."""
    for index, layer in enumerate(parts(model).layers):
        if name in lora.adapter_names(layer):
            return index
    raise ValueError(f"The model has no adapter {name!r}.")
