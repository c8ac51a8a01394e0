"""Bringing the rows of a block together, in the order of the permutation, transposed for the vector lanes."""

# mypy: ignore-errors
# (what numba makes of these functions is not what mypy sees)
from __future__ import annotations

import math

import numpy as np

from tightrope.control.engine.compiled import heads as h
from tightrope.control.engine.compiled.dense import BLOCK, ZERO, f
from tightrope.control.engine.compiled.numba_tools import kernel, row


@kernel
def gather_inputs(places, work, inputs, order, begin, n):
    """The block's observations, transposed to [features, n], at the beginning of ``work``."""
    for i in range(n):
        source = inputs[order[begin + i]]
        for d in range(places[h.FEATURES]):
            work[d * n + i] = source[d]


@kernel
def gather_mask(places, work, masks, order, begin, n):
    """Penalties [width, n]: 0 where allowed, -inf where masked."""
    for i in range(n):
        source = masks[order[begin + i]]
        for d in range(places[h.WIDTH]):
            work[places[h.PENALTY] + d * n + i] = ZERO if source[d] else f(-np.inf)


@kernel
def gather_vector(places, work, name, source, order, begin, n):
    """One number a row."""
    target = row(work, places[h.ROWS] + name * BLOCK, n)
    for i in range(n):
        target[i] = source[order[begin + i]]


@kernel
def moments(advantages, order, begin, end):
    """Mean and 1 / (population deviation + 1e-8) of a minibatch's advantages, in float64; 0 and 1 for a
    single row."""
    count = end - begin
    if count == 1:
        return 0.0, 1.0
    mean = 0.0
    for i in range(begin, end):
        mean += np.float64(advantages[order[i]])
    mean /= count
    variance = 0.0
    for i in range(begin, end):
        variance += (np.float64(advantages[order[i]]) - mean) * (np.float64(advantages[order[i]]) - mean)
    return mean, 1.0 / (math.sqrt(variance / count) + 1e-8)
