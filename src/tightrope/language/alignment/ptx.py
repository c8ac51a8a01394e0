"""The pretraining loss that InstructGPT mixes into PPO (Ouyang et al. 2022, eq. 2): against the alignment
tax.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch
from tightrope.language.data.batching import Example, pad_right
from tightrope.language.data.examples import Notify, read_rows, sft_examples
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.model.load import known_ids
from tightrope.language.policy.roles import Roles
from tightrope.language.settings import AlignSettings


class Pretraining:
    """Texts whose negative log-likelihood, at temperature 1, is added to PPO's loss."""

    def __init__(self, roles: Roles, examples: list[Example], per_response: int, seed: int) -> None:
        self.roles, self.examples, self.per_response = roles, examples, per_response
        self.rng = np.random.default_rng([seed, 11])

    @classmethod
    def make(cls, settings: AlignSettings, roles: Roles, notify: Notify) -> Pretraining:
        """From the settings' ptx_data, each text cut to the tokens of a prompt and a response; ``notify``
        receives how many were cut.
        """
        longest = settings.max_prompt_tokens + settings.max_new_tokens
        assert settings.ptx_data is not None  # ptx_weight needs it
        rows = read_rows(settings.ptx_data)
        examples = sft_examples(
            rows, roles.tokenizer, eos=roles.eos, max_tokens=longest, on_completions=False,
            vocabulary=known_ids(roles.model), notify=notify,
        )  # fmt: skip
        return cls(roles, examples, settings.ptx_per_response, settings.seed)

    def draw(self, minibatch: Batch) -> Batch:
        """The minibatch with fresh texts beside its responses: their numbers in the input ``ptx``,
        [B, per_response].

        They travel with the responses, so that they are the same however these are split, and in a pass that
        is repeated.
        """
        shape = len(minibatch), self.per_response
        chosen = torch.from_numpy(self.rng.integers(len(self.examples), size=shape))
        return dataclasses.replace(minibatch, inputs={**minibatch.inputs, "ptx": chosen})

    def loss(self, chosen: Tensor) -> tuple[Tensor, int]:
        """-log p summed over the texts of these numbers, and their tokens."""
        device = next(self.roles.model.parameters()).device
        picked = [self.examples[i] for i in chosen.flatten().tolist()]
        tokens, real = (x.to(device) for x in pad_right([example.tokens for example in picked]))
        learn = torch.zeros_like(real)
        for row, example in enumerate(picked):
            learn[row, : len(example.learn)] = torch.tensor(example.learn, device=device)
        with torch.no_grad():
            lower = self.roles.trunk.lower(tokens, real)
        hidden = self.roles.policy.hidden(tokens, real, lower)
        targets = learn[:, 1:]
        found = token_statistics(
            hidden[:, :-1][targets], self.roles.trunk.parts.head, tokens[:, 1:][targets], Sampling()
        )
        return -found.logp.sum(), len(found.logp)
