"""What one rollout of responses holds, and the policy and its critic as ppo.update sees them: a batch of
responses -> figures of every token.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.language.data.batching import length_groups, used_columns
from tightrope.language.generation.sample import Completions
from tightrope.language.policy.roles import Roles


@dataclass(frozen=True)
class FirstPass(Evaluation):
    """What policy and critic compute for responses, each [B, R]: an Evaluation, and ``kl``, the exact KL to
    the reference of every state (0 where it was not asked for).
    """

    kl: Tensor


@dataclass(kw_only=True)
class Experience(Completions):
    """Completions, and what the roles compute for them.

    ``logp``, ``ref_logp``, ``entropy``, ``exact`` (KL of the state), ``values``: [B, R]. ``final_values``
    [B]: that of the state after the last token. Values are the critic's outputs, in its scale
    (`ReturnScale`). ``lower`` and ``ref_hidden`` are kept for the epochs that follow. ``first_pass`` holds
    the same numbers with their graph, for the first step of the first epoch; ``short_of_memory``: it was
    asked for and did not fit.
    """

    logp: Tensor
    ref_logp: Tensor
    entropy: Tensor
    exact: Tensor
    values: Tensor
    final_values: Tensor
    ref_hidden: Tensor | None
    first_pass: FirstPass | None
    short_of_memory: bool = False


@dataclass(frozen=True)
class ResponseInputs:
    """The keys of ``Batch.inputs`` for responses. Rows first.

    ``tokens``, ``real`` [B, P + R]; ``ref_logp`` [B, R]; ``row`` [B]: the row in the rollout. ``lower``,
    ``ref_hidden``, ``support`` as in `Experience`; ``ptx`` [B, n]: numbers of pretraining texts.
    """

    tokens: Tensor
    real: Tensor
    ref_logp: Tensor
    row: Tensor
    lower: Tensor | None = None
    ref_hidden: Tensor | None = None
    support: Tensor | None = None
    ptx: Tensor | None = None


@dataclass
class PolicyModel:
    """What ppo.update trains: Batch -> FirstPass, each [B, R]; padding is cut off before the forward pass.

    ``critic_only``: no gradient reaches the policy. ``first_pass``: the rollout's own pass with its graph,
    used for the first call instead of a forward pass. The KL is computed where the batch holds the
    reference's hidden states.
    """

    roles: Roles
    critic_only: bool = False
    first_pass: FirstPass | None = None

    def __call__(self, part: Batch) -> FirstPass:
        """Log-probabilities, entropies and KL of the policy, and the critic's values, where the mask is
        True.
        """
        known, self.first_pass = self.first_pass, None  # a second call after memory ran out must not reuse it
        if known is not None:
            return FirstPass(**{name: x[part.inputs["row"]] for name, x in vars(known).items()})
        groups = length_groups(part.inputs["real"], part.mask)
        if len(groups) == 1:
            return self._pass(part)
        back = torch.cat(groups).argsort()
        passes = [self._pass(part.select(rows)) for rows in groups]
        names = ("logp", "entropy", "kl", "values")
        return FirstPass(**{name: torch.cat([getattr(x, name) for x in passes])[back] for name in names})

    def named_parameters(self) -> Iterator[tuple[str, Tensor]]:
        """Everything that may be trained, by name: for messages."""
        return self.roles.named_parameters()

    def _pass(self, part: Batch) -> FirstPass:
        """One forward pass over some rows."""
        roles, mask, inputs = self.roles, part.mask, ResponseInputs(**part.inputs)
        columns, length = mask.shape[1], inputs.tokens.shape[1]
        left, right = used_columns(inputs.real, mask)
        tokens, real = inputs.tokens[:, left:right], inputs.real[:, left:right]
        lower = None if inputs.lower is None else inputs.lower[:, left:right]
        first = length - columns - left - 1  # the state in which the first response token is chosen
        used = mask[:, : right + 1 - length + columns]

        def steps(hidden: Tensor) -> Tensor:
            return hidden[:, first : first + used.shape[1]][used]

        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.critic_only):
            hidden = roles.policy.hidden(tokens, real, lower)
        found = roles.statistics(
            steps(hidden),
            tokens=part.actions[mask],
            support=None if inputs.support is None else inputs.support[mask],
            reference=None if inputs.ref_hidden is None else inputs.ref_hidden[mask],
        )
        values = found.logp.new_zeros(len(found.logp))
        if roles.critic_head is not None:
            critic = hidden if roles.critic is None else roles.critic.hidden(tokens, real, lower)
            values = roles.critic_head(steps(critic).float())[:, 0]
        zeros = torch.zeros(mask.shape, device=mask.device)
        return FirstPass(
            logp=zeros.masked_scatter(mask, found.logp),
            entropy=zeros.masked_scatter(mask, found.entropy),
            values=zeros.masked_scatter(mask, values),
            kl=zeros.masked_scatter(mask, found.kl),
        )
