"""Responses to prompts, before anything is known of them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from tightrope.language.generation.sample import Responses


@dataclass
class Answers:
    """Responses to prompts. ``tokens``, ``real``: prompt and response, [B, P + R]; ``seconds``: to sample.

    ``lower``: what enters the trunk's upper part, [B, P + R, d], where that was computed.
    """

    tokens: Tensor
    real: Tensor
    responses: Responses
    seconds: float
    lower: Tensor | None

    def ids(self) -> list[list[int]]:
        """The token ids of each response, padding left out."""
        pairs = zip(self.responses.tokens, self.responses.mask, strict=True)
        return [tokens[mask].tolist() for tokens, mask in pairs]
