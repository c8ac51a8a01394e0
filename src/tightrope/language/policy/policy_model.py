"""The policy and its critic as ppo.update sees them: a batch of responses -> what is said of every token."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.language.data.batching import length_groups, used_columns
from tightrope.language.generation.distribution import token_statistics
from tightrope.language.policy.roles import Roles

Said = tuple[
    Tensor, Tensor, Tensor, Tensor
]  # of all rows [B, R]: log p, entropy, KL to the reference, values


class PolicyModel:
    """What ppo.update trains: Batch -> Evaluation, each [B, R]; padding is cut off before the forward pass.

    ``exact``: also the exact KL to the reference of every state, left in ``kl`` for the loss ([B, R]).
    ``said``: what the rollout's own pass says, with its gradients; taken once, for the first question.
    """

    def __init__(
        self, roles: Roles, *, exact: bool = False, critic_alone: bool = False, said: Said | None = None
    ) -> None:
        self.roles, self.exact, self.critic_alone, self.said = roles, exact, critic_alone, said
        self.kl: Tensor | None = None

    def __call__(self, part: Batch) -> Evaluation:
        """Log-probabilities and entropies of the policy, and the critic's values, where the mask is True."""
        said, self.said, self.kl = self.said, None, None  # memory ran out: nothing of the pass before is kept
        if said is not None:
            logp, entropy, self.kl, values = (x[part.inputs["row"]] for x in said)
            return Evaluation(logp, entropy, values)
        groups = length_groups(part.inputs["real"], part.mask)
        if len(groups) == 1:
            logp, entropy, self.kl, values = self._rows(part)
            return Evaluation(logp, entropy, values)
        back = torch.cat(groups).argsort()
        found = zip(*(self._rows(part.select(rows)) for rows in groups), strict=True)
        logp, entropy, self.kl, values = (torch.cat(pieces)[back] for pieces in found)
        return Evaluation(logp, entropy, values)

    def named_parameters(self) -> Iterator[tuple[str, Tensor]]:
        """Everything that may be trained, by name: for messages."""
        return self.roles.named_parameters()

    def _rows(self, part: Batch) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Log-probabilities, entropies, KL to the reference and values of some rows, each [b, R]."""
        roles, mask = self.roles, part.mask
        columns, length = mask.shape[1], part.inputs["tokens"].shape[1]
        left, right = used_columns(part.inputs["real"], mask)
        tokens, real = (part.inputs[name][:, left:right] for name in ("tokens", "real"))
        lower = part.inputs["lower"][:, left:right] if "lower" in part.inputs else None
        first = length - columns - left - 1  # the state in which the first response token is chosen
        here = mask[:, : right + 1 - length + columns]

        def steps(hidden: Tensor) -> Tensor:
            return hidden[:, first : first + here.shape[1]][here]

        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.critic_alone):
            hidden = roles.policy_hidden(tokens, real, lower)
        support = part.inputs.get("support")
        reference = part.inputs.get("ref_hidden") if self.exact else None
        found = token_statistics(
            steps(hidden), roles.trunk.parts.head, part.actions[mask], roles.sampling,
            support=None if support is None else support[mask],
            reference=None if reference is None else reference[mask],
            reference_head=roles.head_of_reference(),
            ahead=roles.settings.logp_alone,
        )  # fmt: skip
        values = found.logp.new_zeros(len(found.logp))
        if roles.critic_head is not None:
            critic = roles.critic_hidden(hidden, tokens, real, lower)
            values = roles.critic_head(steps(critic).float())[:, 0]
        logp, entropy, kl, values = (_spread(x, mask) for x in (found.logp, found.entropy, found.kl, values))
        return logp, entropy, kl, values


def _spread(x: Tensor, mask: Tensor) -> Tensor:
    """[N] numbers of the counting steps -> [B, R], 0 elsewhere."""
    return torch.zeros(mask.shape, dtype=x.dtype, device=x.device).masked_scatter(mask, x)
