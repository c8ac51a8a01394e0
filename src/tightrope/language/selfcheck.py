"""``tightrope doctor --model M``: the contract of RLHF, checked in seconds on the user's own model."""

from __future__ import annotations

import contextlib
import dataclasses

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms import ppo
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.optimise import make_optimiser
from tightrope.findings import Finding
from tightrope.language.alignment.experience import batch_of, gather, rewards_of
from tightrope.language.data.batching import pad_left, pad_right
from tightrope.language.data.examples import read_prompts
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.model import lora
from tightrope.language.model.load import known_ids, quiet_libraries, unreadable, unwritable
from tightrope.language.model.weights import WrongWeights
from tightrope.language.policy.policy_model import Experience, PolicyModel
from tightrope.language.policy.roles import Roles, make_roles
from tightrope.language.reward.functions import Scores
from tightrope.language.settings import AlignSettings, RLHFSettings

WORDS = ("The", "Once upon a time there was", "I think that", "a b c d e f g h")
WEIGHTS = "every weight is the file's"
GRADIENT_LIMIT = 1e-3  # relative, of the norm: float32 sums in another order


@quiet_libraries()
def check_model(model: str, dtype: str = "float32") -> list[Finding]:
    """Every check of one model; a few seconds, nothing is written."""
    settings = AlignSettings(
        model=model, dtype=dtype, lora_rank=4, batch_size=8, samples_per_prompt=2, max_new_tokens=12,
        max_prompt_tokens=16, update=RLHFSettings(minibatch_size=8, num_epochs=1, normalise_advantages=False),
    )  # fmt: skip
    told: list[str] = []
    try:
        roles = make_roles(settings, notify=lambda text: None, warn=told.append)
    except WrongWeights as error:
        return [Finding(WEIGHTS, False, error.seen, error.advice)]
    prompts = read_prompts(
        list(WORDS), roles.tokenizer, max_tokens=16, vocabulary=known_ids(roles.model),
        notify=lambda text: None,
    )  # fmt: skip
    experience = gather(roles, prompts, 0, 0, 2)
    scores = Scores(np.linspace(-1, 1, 8), np.ones(8, bool), {}, {}, {})
    rewards = rewards_of(experience, scores, settings, settings.kl_beta).rewards
    batch = batch_of(experience, rewards, torch.ones(8, dtype=torch.bool), settings)
    return [
        Finding(WEIGHTS, True, told[0] if told else "none is missing and none is left over"),
        _vocabulary(roles),
        _same_logits(roles, experience),
        _same_policy(roles, experience),
        _reference(experience),
        _first_ratios(roles, batch),
        _padding_side(roles, experience),
        *_invariances(roles, batch),
        _dropout(roles),
        _eos(roles, experience),
        _critic(roles, batch, settings),
        _returns(experience, rewards, batch),
        _trunk(roles),
    ]


def _vocabulary(roles: Roles) -> Finding:
    """Tokens without an embedding do no harm while no text has them; those that the chat template or the
    tokenizer itself writes are in every text.
    """
    model, tokenizer, size = roles.model, roles.tokenizer, known_ids(roles.model)
    beyond = [name for name, token in tokenizer.get_vocab().items() if token >= size]
    written = f"{tokenizer.chat_template} {' '.join(map(str, tokenizer.all_special_tokens))}"
    seen = f"{size} ids, {len(unwritable(model, tokenizer))} of which are never sampled: no token has them"
    return Finding(
        "every token of the tokenizer has an embedding", not any(name in written for name in beyond),
        f"{seen}. {unreadable(model, tokenizer)}".rstrip(". "),
        "Texts with the tokenizer's own tokens cannot be read. Call model.resize_token_embeddings("
        "len(tokenizer)), save both, and give that folder.",
    )  # fmt: skip


def _limit(roles: Roles) -> float:
    return roles.gap_limits.rounding


@torch.no_grad()
def _same_logits(roles: Roles, experience: Experience) -> Finding:
    """The bare trunk and its head beside the model's own logits, unpadded rows one at a time."""
    worst, head = 0.0, roles.trunk.parts.head
    for row, real in zip(experience.tokens, experience.real, strict=True):
        tokens = row[real][None]
        hidden = roles.reference.hidden(tokens, torch.ones_like(tokens, dtype=torch.bool))[0, :-1]
        ours = token_statistics(hidden, head, tokens[0, 1:], Sampling()).logp
        logits = roles.model(input_ids=tokens, use_cache=False).logits[0, :-1].float()
        theirs = logits.log_softmax(1).gather(1, tokens[0, 1:, None])[:, 0]
        worst = max(worst, float((ours - theirs).abs().max()))
    return Finding(
        "log-probabilities are those of model(tokens).logits", worst <= _limit(roles),
        f"largest gap {worst:.1e} nats a token",
        "The model's logits are not head(base(tokens)) times a factor. Report the model.",
    )  # fmt: skip


def _same_policy(roles: Roles, experience: Experience) -> Finding:
    mask = experience.responses.mask
    gap = float((experience.responses.logp - experience.logp)[mask].abs().max())
    return Finding(
        "sampling and training agree", gap <= _limit(roles), f"largest gap {gap:.1e} nats a token",
        "The model computes different numbers with and without its KV cache. Update transformers, or report "
        "the model.",
    )  # fmt: skip


def _reference(experience: Experience) -> Finding:
    kl = float(experience.exact[experience.responses.mask].abs().max())
    return Finding(
        "KL to the reference is 0 at the start", kl <= 1e-5, f"{kl:.1e} nats a state",
        "The fresh adapter changes the model: its weights were not at 0.",
    )  # fmt: skip


def _first_ratios(roles: Roles, batch: Batch) -> Finding:
    with torch.no_grad():
        now = PolicyModel(roles)(batch)
    worst = float((now.logp - batch.old_logp)[batch.mask].abs().max())
    return Finding(
        "every ratio is 1 before the first step", worst <= _limit(roles), f"largest |log ratio| {worst:.1e}",
        "Something differs between rollout and update: dropout, temperature, positions or precision.",
    )  # fmt: skip


@torch.no_grad()
def _padding_side(roles: Roles, experience: Experience) -> Finding:
    rows = [tokens[real].tolist() for tokens, real in zip(experience.tokens, experience.real, strict=True)]
    sides = []
    for pad in (pad_right, pad_left):
        tokens, real = (x.to(experience.tokens.device) for x in pad(rows))
        hidden, known = roles.policy.hidden(tokens, real), real[:, 1:] & real[:, :-1]
        states, head = hidden[:, :-1][known], roles.trunk.parts.head
        sides.append(token_statistics(states, head, tokens[:, 1:][known], Sampling()).logp)
    gap = float((sides[0] - sides[1]).abs().max())
    return Finding(
        "padding on the right and on the left are one", gap <= _limit(roles), f"largest gap {gap:.1e} nats",
        "The model takes positions from columns, or reads padding. Its attention mask or positions are not "
        "respected.",
    )  # fmt: skip


def _gradient(roles: Roles, batch: Batch, micro: int | None = None) -> Tensor:
    """The gradient of one PPO minibatch over everything that is trained, nothing stepped."""
    optimiser = torch.optim.SGD(roles.parameters(), 0.0)
    settings = dataclasses.replace(
        roles.settings.update, micro_batch_size=micro, minibatch_size=len(batch), max_grad_norm=None
    )
    ppo.update(PolicyModel(roles), optimiser, batch, settings, np.random.default_rng(0))
    return torch.cat([p.grad.flatten() for p in roles.parameters() if p.grad is not None])


def _invariances(roles: Roles, batch: Batch) -> list[Finding]:
    """Loss and gradient must not depend on how the rows are padded, split or ordered."""
    wanted = _gradient(roles, batch)
    filler = {**batch.inputs, "tokens": torch.where(batch.inputs["real"], batch.inputs["tokens"], 1)}
    wide = {name: x for name, x in batch.inputs.items() if name not in ("tokens", "real", "lower")}
    for name in ("tokens", "real"):
        wide[name] = torch.nn.functional.pad(filler[name], (5, 0))
    order = torch.arange(len(batch) - 1, -1, -1)
    others = {
        "filler of the padding": (dataclasses.replace(batch, inputs=filler), None),
        "amount of padding": (dataclasses.replace(batch, inputs=wide), None),
        "micro-batches": (batch, 3),
        "order of the rows": (batch.select(order), None),
    }
    findings = []
    for what, (other, micro) in others.items():
        gap = float((_gradient(roles, other, micro) - wanted).norm() / wanted.norm().clamp(min=1e-12))
        bound = GRADIENT_LIMIT if roles.settings.dtype == "float32" else 0.1
        findings.append(
            Finding(
                f"the gradient does not depend on the {what}",
                gap <= bound,
                f"relative difference {gap:.1e}",
                "The model's forward pass reads padding. Its attention mask or positions are not respected.",
            )
        )
    return findings


def _dropout(roles: Roles) -> Finding:
    """In the mode in which activations are checkpointed, where the model has it; no other is trained in."""
    with contextlib.suppress(ValueError):
        lora.checkpoint_activations(roles.model)
    lora.training_mode(roles.model, True)
    same = lora.repeats(roles.model)
    lora.training_mode(roles.model, False)
    return Finding(
        "dropout is off, also in training mode", same,
        "two passes are equal" if same else "two passes differ",
        "A module draws random numbers in training mode under a name that is not known here.",
    )  # fmt: skip


def _eos(roles: Roles, experience: Experience) -> Finding:
    tokenizer, responses = roles.tokenizer, experience.responses
    pad = tokenizer.pad_token_id
    closed = all(
        (int(responses.tokens[row][mask][-1]) in roles.eos) == bool(responses.ended[row])
        for row, mask in enumerate(responses.mask)
    )
    note = (
        "no PAD token" if pad is None else "PAD is EOS" if pad in roles.eos else "PAD is a token of its own"
    )
    return Finding(
        "responses end with EOS and nothing behind it counts", closed,
        f"EOS {', '.join(map(str, roles.eos))}; {note}: padding is by mask, all three are fine",
        "A response counts tokens behind its EOS.",
    )  # fmt: skip


def _critic(roles: Roles, batch: Batch, settings: AlignSettings) -> Finding:
    before = [p.detach().clone() for p in roles.critic_parameters()]
    optimiser = make_optimiser(roles.parameters(), roles.critic_parameters(), settings.update)
    ppo.update(PolicyModel(roles), optimiser, batch, settings.update, np.random.default_rng(0))
    moved = max(
        float((a - b.detach()).abs().max()) for a, b in zip(before, roles.critic_parameters(), strict=True)
    )
    return Finding(
        "the critic moves", moved > 0, f"largest change of a weight in one step {moved:.1e}",
        "No gradient reaches the critic.",
    )  # fmt: skip


def _returns(experience: Experience, rewards: Tensor, batch: Batch) -> Finding:
    """With lambda below 1 returns are not sums; A_t = sum_k lambda^k delta_{t+k}, summed here directly."""
    settings, mask, worst = AlignSettings().update, experience.responses.mask, 0.0
    for row in range(len(mask)):
        length = int(mask[row].sum())
        values = [*experience.values[row, :length].tolist(), 0.0]
        for t in range(length):
            total = sum(
                (settings.gamma * settings.gae_lambda) ** (k - t)
                * (float(rewards[row, k]) + settings.gamma * values[k + 1] - values[k])
                for k in range(t, length)
            )
            worst = max(worst, abs(total - float(batch.advantages[row, t])))
    return Finding(
        "advantages equal brute-force sums", worst <= 1e-4, f"largest difference {worst:.1e}",
        "Please report this with the model's name.",
    )  # fmt: skip


def _trunk(roles: Roles) -> Finding:
    from tightrope.language.model.trunk import Trunk

    layers = len(roles.trunk.parts.layers)
    cut = Trunk(roles.model, layers // 2).cut if layers > 1 else 1
    seen = "the layers below the adapters are computed once" if cut else "computed whole: correct, but slower"
    return Finding("lora_layers can share the lower layers", True, seen)
