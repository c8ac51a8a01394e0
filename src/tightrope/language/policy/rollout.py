"""What one rollout holds: completions and what the roles compute for them; and the inputs of its batch."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from tightrope.algorithms.batch import Evaluation
from tightrope.language.generation.sample import Completions


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
