"""The rollout's side, compiled: act on a batch of observations, values of many, advantages."""

# mypy: ignore-errors
# (what numba makes of these functions is not what mypy sees)
from __future__ import annotations

import numpy as np

from tightrope.control.engine.compiled import heads as h
from tightrope.control.engine.compiled.dense import BLOCK, VALUE, ZERO, f, forward
from tightrope.control.engine.compiled.numba_tools import entry, plain, row


@entry(
    "void(int64[::1], int64[:,::1], int64[:,::1], float32[::1], float32[::1], float32[:,:], float32[::1],"
    "float32[::1], float64, boolean[:,:], float32[:,:], float32[:,:], float32[:], float32[:,:])"
)
def act(
    places, layers, heads, flat, work, raw, mean, inverse, clip, masks, noise, actions, logp, inputs
):  # fmt: skip
    """Normalise, run the actor, sample, and write actions, log-probabilities and inputs as seen, row by
    row."""
    normalise, limit, masked = len(mean) > 0, f(clip), masks.shape[0] > 0
    for begin in range(0, len(raw), BLOCK):
        n = BLOCK if len(raw) - begin > BLOCK else len(raw) - begin
        for i in range(n):
            for d in range(places[h.FEATURES]):
                x = raw[begin + i, d]
                if normalise:
                    x = (x - mean[d]) * inverse[d]
                    x = -limit if x < -limit else x
                    x = limit if x > limit else x
                inputs[begin + i, d] = x
                work[d * n + i] = x
            if masked:
                for k in range(places[h.WIDTH]):
                    work[places[h.PENALTY] + k * n + i] = ZERO if masks[begin + i, k] else f(-np.inf)
        forward(flat, layers, plain(0), places[h.TRUNK_LAST], work, n)
        forward(flat, layers, places[h.ACTOR_FIRST], places[h.ACTOR_LAST], work, n)
        h.sample(places, heads, flat, work, noise, begin, n, masked)
        h.evaluate(places, heads, flat, work, n, masked)
        own = row(work, places[h.ROWS] + h.LOGP * BLOCK, n)
        for i in range(n):
            logp[begin + i] = own[i]
            for k in range(places[h.COLUMNS]):
                actions[begin + i, k] = work[places[h.ACTIONS] + k * n + i]


@entry("void(int64[::1], int64[:,::1], float32[::1], float32[::1], float32[:,:], float32[::1])")
def values(places, layers, flat, work, inputs, out):
    """The critic's value of every row of ``inputs``, already normalised."""
    for begin in range(0, len(inputs), BLOCK):
        n = BLOCK if len(inputs) - begin > BLOCK else len(inputs) - begin
        for i in range(n):
            for d in range(places[h.FEATURES]):
                work[d * n + i] = inputs[begin + i, d]
        forward(flat, layers, plain(0), places[h.TRUNK_LAST], work, n)
        forward(flat, layers, places[h.CRITIC_FIRST], places[h.CRITIC_LAST], work, n)
        value = row(work, layers[places[h.CRITIC_LAST] - 1, VALUE], n)
        for i in range(n):
            out[begin + i] = value[i]


@entry(
    "void(float32[:,::1], float32[:,::1], float32[:,::1], boolean[:,::1], boolean[:,::1], boolean[:,::1],"
    "float64, float64, float32[:,::1])"
)
def gae(rewards, values, next_values, terminated, ended, mask, gamma, gae_lambda, out):
    """A_t = r_t + gamma V_{t+1} - V_t + gamma lambda A_{t+1}, cut as in maths.returns.gae, whatever lies
    behind a cut."""
    discount, decay = f(gamma), f(gamma * gae_lambda)
    for b in range(rewards.shape[0]):
        trace = ZERO
        for t in range(rewards.shape[1] - 1, -1, -1):
            delta = rewards[b, t] - values[b, t]
            if not terminated[b, t]:
                delta += discount * next_values[b, t]
            trace = delta if ended[b, t] else delta + decay * trace
            if not mask[b, t]:
                trace = ZERO
            out[b, t] = trace
