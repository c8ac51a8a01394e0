"""The rollout's side, compiled: act on a batch of observations, values of many, advantages."""

from __future__ import annotations

import math

import numpy as np

from tightrope.control.engine.compiled import plan
from tightrope.control.engine.compiled.cache import entry
from tightrope.control.engine.compiled.distributions import evaluate_actions, sample_actions
from tightrope.control.engine.compiled.layers import forward
from tightrope.control.engine.compiled.primitives import ZERO, f, row, runtime, scalar


@scalar
def standard(x, mean, inverse, edge, hard):
    """One number as ObservationNormaliser gives it."""
    z = (x - mean) * inverse
    beyond = abs(z) - edge
    if beyond > 0:
        size = edge if hard else edge + math.log1p(beyond)
        return size if z > 0 else -size
    return z


@entry(
    "void(int64[::1], int64[:,::1], int64[:,::1], float32[::1], float32[::1], float64[:,:], float64[::1],"
    "float64[::1], float64, boolean, boolean[:,:], float32[:,:], float32[:,:], float32[:], float32[:,:])"
)
def act_batch(
    places, layers, components, flat, work,
    raw, mean, inverse, edge, hard, masks, noise, actions, logp, inputs,
):  # fmt: skip
    """Normalise, run the actor, sample; write actions, log-probabilities and normalised inputs.

    Parameters in order: the tables of the plan; the buffers of parameters and of intermediate matrices; raw
    observations [B, D]; mean and inverse [D] of the normaliser (empty: none), its edge, and whether it clips
    there; action masks [B, W] (no rows: none); noise [B, A]; outputs: actions [B, A], logp [B] and inputs
    [B, D].
    """
    normalise, masked = len(mean) > 0, masks.shape[0] > 0
    for begin in range(0, len(raw), plan.BLOCK_ROWS):
        n = plan.BLOCK_ROWS if len(raw) - begin > plan.BLOCK_ROWS else len(raw) - begin
        for i in range(n):
            for d in range(places[plan.FEATURES]):
                x = f(raw[begin + i, d])
                if normalise:
                    x = f(standard(raw[begin + i, d], mean[d], inverse[d], edge, hard))
                inputs[begin + i, d] = x
                work[d * n + i] = x
            if masked:
                for k in range(places[plan.MASK_WIDTH]):
                    work[places[plan.PENALTY] + k * n + i] = ZERO if masks[begin + i, k] else f(-np.inf)
        forward(flat, layers, runtime(0), places[plan.TRUNK_LAST], work, n)
        forward(flat, layers, places[plan.ACTOR_FIRST], places[plan.ACTOR_LAST], work, n)
        sample_actions(places, components, flat, work, noise, begin, n, masked)
        evaluate_actions(places, components, flat, work, n, masked)
        own = row(work, places[plan.VECTORS] + plan.LOGP, n)
        for i in range(n):
            logp[begin + i] = own[i]
            for k in range(places[plan.COLUMNS]):
                actions[begin + i, k] = work[places[plan.ACTIONS] + k * n + i]


@entry("void(int64[::1], int64[:,::1], float32[::1], float32[::1], float32[:,:], float32[::1])")
def value_batch(places, layers, flat, work, inputs, out):
    """The critic's value of every row of ``inputs``, already normalised."""
    for begin in range(0, len(inputs), plan.BLOCK_ROWS):
        n = plan.BLOCK_ROWS if len(inputs) - begin > plan.BLOCK_ROWS else len(inputs) - begin
        for i in range(n):
            for d in range(places[plan.FEATURES]):
                work[d * n + i] = inputs[begin + i, d]
        forward(flat, layers, runtime(0), places[plan.TRUNK_LAST], work, n)
        forward(flat, layers, places[plan.CRITIC_FIRST], places[plan.CRITIC_LAST], work, n)
        value = row(work, layers[places[plan.CRITIC_LAST] - 1, plan.VALUE], n)
        for i in range(n):
            out[begin + i] = value[i]


@entry(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], boolean[:,::1], boolean[:,::1], boolean[:,::1],"
    "float64, float64, float64[:,::1])"
)
def gae_batch(rewards, values, next_values, terminated, ended, mask, gamma, gae_lambda, out):
    """A_t = r_t + gamma V_{t+1} - V_t + gamma lambda A_{t+1}, cut as in maths.returns.gae.

    Numbers behind a cut may be anything: they are not used.
    """
    for b in range(rewards.shape[0]):
        trace = 0.0
        for t in range(rewards.shape[1] - 1, -1, -1):
            delta = rewards[b, t] - values[b, t]
            if not terminated[b, t]:
                delta += gamma * next_values[b, t]
            trace = delta if ended[b, t] else delta + gamma * gae_lambda * trace
            if not mask[b, t]:
                trace = 0.0
            out[b, t] = trace
