"""The pretraining loss that InstructGPT mixes into PPO (Ouyang et al. 2022, eq. 2): against the alignment
tax.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tightrope.language.data import Example, Notify, pad_right, read_rows, sft_examples
from tightrope.language.roles import Roles
from tightrope.language.settings import AlignSettings
from tightrope.language.token_stats import Sampling, token_statistics


class Pretraining:
    """Texts whose negative log-likelihood, at temperature 1, is added to PPO's loss."""

    def __init__(self, roles: Roles, examples: list[Example], per_response: int, seed: int) -> None:
        self.roles, self.examples, self.per_response = roles, examples, per_response
        self.rng = np.random.default_rng([seed, 11])

    @classmethod
    def make(cls, settings: AlignSettings, roles: Roles, notify: Notify) -> Pretraining:
        """From the settings' ptx_data, each text cut to the tokens of a prompt and a response; ``notify`` is
        told how many were.
        """
        longest = settings.max_prompt_tokens + settings.max_new_tokens
        rows = read_rows(settings.ptx_data)
        examples = sft_examples(
            rows, roles.tokenizer, eos=roles.eos, max_tokens=longest, on_completions=False, notify=notify
        )
        return cls(roles, examples, settings.ptx_per_response, settings.seed)

    def loss(self, responses: int) -> tuple[Tensor, int]:
        """-log p summed over fresh texts, ``per_response`` for each of ``responses``, and their tokens.

        The texts do not depend on how responses are split into calls.
        """
        device = next(self.roles.model.parameters()).device
        chosen = self.rng.integers(len(self.examples), size=responses * self.per_response)
        picked = [self.examples[int(i)] for i in chosen]
        tokens, real = (x.to(device) for x in pad_right([example.tokens for example in picked]))
        learn = torch.zeros_like(real)
        for row, example in enumerate(picked):
            learn[row, : len(example.learn)] = torch.tensor(example.learn, device=device)
        with torch.no_grad():
            lower = self.roles.trunk.lower(tokens, real)
        hidden = self.roles.policy_hidden(tokens, real, lower)
        targets = learn[:, 1:]
        found = token_statistics(
            hidden[:, :-1][targets], self.roles.trunk.parts.head, tokens[:, 1:][targets], Sampling()
        )
        return -found.logp.sum(), len(found.logp)
