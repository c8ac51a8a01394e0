"""The KV cache of transformers, under whichever name the installed version and the model use.

Up to 5.23 a forward pass takes and returns ``past_key_values``. From 5.24 on the name is ``cache``, and the
old one warns at every step. Models outside transformers may keep the old name.
"""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

from torch import Tensor, nn

NEW, OLD = "cache", "past_key_values"


class Step(NamedTuple):
    """One forward pass: ``hidden`` [B, T, d], the last hidden states, and the cache after it."""

    hidden: Tensor
    cache: Any


def cached_forward(
    base: nn.Module, tokens: Tensor, attention_mask: Tensor, positions: Tensor, cache: Any = None
) -> Step:
    """Run ``base`` on ``tokens`` [B, T] with a cache. None starts a new one; a given one grows in place.

    ``attention_mask`` [B, T + cached]: 1 for real tokens. ``positions`` [B, T].
    """
    name = NEW if NEW in inspect.signature(base.forward).parameters else OLD
    given = {} if cache is None else {name: cache}
    out = base(tokens, attention_mask=attention_mask, position_ids=positions, use_cache=True, **given)
    # asked for by name in this order: reading the old name from a new output warns
    after = out.cache if hasattr(out, NEW) else out.past_key_values
    return Step(out.last_hidden_state, after)
