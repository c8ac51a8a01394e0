"""Heads: the actor's outputs to log-probability, entropy, gradient and sample; equations of
control/distributions.py.

All per row of a block, feature-major like the layers. ``heads`` is a table with a row per component of the
action.
``places`` says where in ``work`` the block's matrices begin (names below).
"""

# mypy: ignore-errors
# (what numba makes of these functions is not what mypy sees)
from __future__ import annotations

import numpy as np

from tightrope.control.engine.compiled.dense import BLOCK, ONE, ZERO, exp, f, log
from tightrope.control.engine.compiled.numba_tools import glue, kernel, row

# columns of the table of heads
KIND, PARAMETER, COUNT, COLUMN, MASK, DEVIATION, ENTROPY = range(7)
CATEGORICAL, BERNOULLI, GAUSSIAN = range(3)

# entries of ``places``: offsets into ``work``, and the sizes of the matrices there
LOGITS, DELTAS, LOGS, ACTIONS, PENALTY, ENTROPIES, ROWS = range(7)
(FEATURES, COLUMNS, WIDTH, PARAMETERS, LOG_STD, SAVED) = range(7, 13)
(ACTOR_FIRST, ACTOR_LAST, CRITIC_FIRST, CRITIC_LAST, TRUNK_LAST) = range(13, 18)
PLACES = 18

# vectors of one number a row, BLOCK apart, from places[ROWS]
LOGP, TOTAL_ENTROPY, OLD_LOGP, ADVANTAGE, COEFFICIENT, TOP, SUM, OWN, RETURN, OLD_VALUE, ERROR, RATIO = range(
    12
)
VECTORS = 12

LOG_ROOT_TWO_PI = f(0.9189385332046727)
LOG_STD_LOW, LOG_STD_HIGH = f(-20.0), f(2.0)


@glue
def clamp_log_std(x):
    """The log deviation within its range; NaN stays NaN."""
    y = LOG_STD_LOW if x < LOG_STD_LOW else x
    return LOG_STD_HIGH if y > LOG_STD_HIGH else y


@kernel
def apply_mask(places, heads, work, n):
    """Masked categories: logit -inf, so that their probability is exactly 0. (Bits see the mask
    themselves.)"""
    for c in range(len(heads)):
        if heads[c, KIND] != CATEGORICAL:
            continue
        for k in range(heads[c, COUNT]):
            z = row(work, places[LOGITS] + (heads[c, PARAMETER] + k) * n, n)
            penalty = row(work, places[PENALTY] + (heads[c, MASK] + k) * n, n)
            for i in range(n):
                z[i] += penalty[i]


@kernel
def normalise_logits(places, work, first, count, n):
    """TOP = the largest of ``count`` logits, SUM = log of the sum of exp(logit - TOP)."""
    top, total = row(work, places[ROWS] + TOP * BLOCK, n), row(work, places[ROWS] + SUM * BLOCK, n)
    z = row(work, first, n)
    for i in range(n):
        top[i] = z[i]
        total[i] = ZERO
    for k in range(1, count):
        z = row(work, first + k * n, n)
        for i in range(n):
            top[i] = z[i] if z[i] > top[i] else top[i]
    for k in range(count):
        z = row(work, first + k * n, n)
        for i in range(n):
            total[i] += exp(z[i] - top[i])
    for i in range(n):
        total[i] = log(total[i])


@kernel
def categorical(places, head, work, n):
    """logp and entropy of one choice; LOGS keeps every log-probability."""
    first, count, saved = (
        places[LOGITS] + head[PARAMETER] * n,
        head[COUNT],
        places[LOGS] + head[PARAMETER] * n,
    )
    normalise_logits(places, work, first, count, n)
    vectors = places[ROWS]
    top, total, own = (
        row(work, vectors + TOP * BLOCK, n),
        row(work, vectors + SUM * BLOCK, n),
        row(work, vectors + OWN * BLOCK, n),
    )
    h, chosen = (
        row(work, places[ENTROPIES] + head[ENTROPY] * n, n),
        row(work, places[ACTIONS] + head[COLUMN] * n, n),
    )
    for i in range(n):
        own[i] = f(np.nan)  # an action that is no category has no probability
        h[i] = ZERO
    for k in range(count):
        z, s, index = row(work, first + k * n, n), row(work, saved + k * n, n), f(k)
        for i in range(n):
            lp = (z[i] - top[i]) - total[i]
            p = exp(lp)
            s[i] = lp
            h[i] -= p * lp if lp > f(-87) else ZERO
            own[i] = lp if chosen[i] == index else own[i]
    logp, entropy = row(work, vectors + LOGP * BLOCK, n), row(work, vectors + TOTAL_ENTROPY * BLOCK, n)
    for i in range(n):
        logp[i] += own[i]
        entropy[i] += h[i]


@kernel
def bernoulli(places, head, work, n, masked):
    """logp and entropy of independent bits; LOGS keeps p, and -1 for a masked bit."""
    logp = row(work, places[ROWS] + LOGP * BLOCK, n)
    entropy = row(work, places[ROWS] + TOTAL_ENTROPY * BLOCK, n)
    for k in range(head[COUNT]):
        z = row(work, places[LOGITS] + (head[PARAMETER] + k) * n, n)
        saved = row(work, places[LOGS] + (head[PARAMETER] + k) * n, n)
        bit = row(work, places[ACTIONS] + (head[COLUMN] + k) * n, n)
        penalty = row(work, places[PENALTY] + (head[MASK] + k if masked else 0) * n, n)
        for i in range(n):
            x = z[i]
            soft = log(ONE + exp(-abs(x)))
            log_one, log_zero = (x if x < ZERO else ZERO) - soft, (ZERO if x < ZERO else -x) - soft
            p = exp(log_one)
            lp = log_one if bit[i] > f(0.5) else log_zero
            free = not (masked and penalty[i] < ZERO)
            saved[i] = p if free else -ONE
            logp[i] += lp if free else ZERO
            entropy[i] -= p * log_one + (ONE - p) * log_zero if free else ZERO


@kernel
def gaussian(places, head, flat, work, n):
    """logp and entropy of independent normals of state-independent deviation; LOGS keeps (a - mean) / std."""
    logp = row(work, places[ROWS] + LOGP * BLOCK, n)
    entropy = row(work, places[ROWS] + TOTAL_ENTROPY * BLOCK, n)
    for k in range(head[COUNT]):
        mean = row(work, places[LOGITS] + (head[PARAMETER] + k) * n, n)
        saved = row(work, places[LOGS] + (head[PARAMETER] + k) * n, n)
        action = row(work, places[ACTIONS] + (head[COLUMN] + k) * n, n)
        log_std = clamp_log_std(flat[places[LOG_STD] + head[DEVIATION] + k])
        inverse, constant = exp(-log_std), log_std + LOG_ROOT_TWO_PI
        for i in range(n):
            z = (action[i] - mean[i]) * inverse
            saved[i] = z
            logp[i] -= f(0.5) * z * z + constant
            entropy[i] += constant + f(0.5)


@glue
def evaluate(places, heads, flat, work, n, masked):
    """LOGP and TOTAL_ENTROPY of the block's actions: sums over the components."""
    logp = row(work, places[ROWS] + LOGP * BLOCK, n)
    entropy = row(work, places[ROWS] + TOTAL_ENTROPY * BLOCK, n)
    for i in range(n):
        logp[i] = ZERO
        entropy[i] = ZERO
    if masked:
        apply_mask(places, heads, work, n)
    for c in range(len(heads)):
        if heads[c, KIND] == CATEGORICAL:
            categorical(places, heads[c], work, n)
        elif heads[c, KIND] == BERNOULLI:
            bernoulli(places, heads[c], work, n, masked)
        else:
            gaussian(places, heads[c], flat, work, n)


@kernel
def gradient(places, heads, flat, grad, work, n, entropy_share):
    """DELTAS = d loss / d outputs, from COEFFICIENT = d loss / d logp and a loss of -entropy_share * entropy
    a row.

    categorical: c (1[k = a] - p_k) + w p_k (log p_k + H);  bit: c (b - p) + w z p (1 - p);
    gaussian: c (a - mean) / std^2, and c (((a - mean) / std)^2 - 1) - w for its log_std (0 outside the
    clamp).
    """
    w, c = entropy_share, row(work, places[ROWS] + COEFFICIENT * BLOCK, n)
    for j in range(len(heads)):
        kind = heads[j, KIND]
        column = 0 if kind == CATEGORICAL else 1
        h = row(work, places[ENTROPIES] + heads[j, ENTROPY] * n, n)
        for k in range(heads[j, COUNT]):
            at = (heads[j, PARAMETER] + k) * n
            z, s, g = (
                row(work, places[LOGITS] + at, n),
                row(work, places[LOGS] + at, n),
                row(work, places[DELTAS] + at, n),
            )
            a = row(work, places[ACTIONS] + (heads[j, COLUMN] + column * k) * n, n)
            if kind == CATEGORICAL:
                index = f(k)
                for i in range(n):
                    p = exp(s[i])
                    hit = ONE if a[i] == index else ZERO
                    pull = p * (s[i] + h[i]) if s[i] > f(-87) else ZERO
                    g[i] = c[i] * (hit - p) + w * pull
            elif kind == BERNOULLI:
                for i in range(n):
                    p = s[i]
                    value = c[i] * ((ONE if a[i] > f(0.5) else ZERO) - p) + w * z[i] * p * (ONE - p)
                    g[i] = ZERO if p < ZERO else value
            else:
                place = places[LOG_STD] + heads[j, DEVIATION] + k
                log_std, total = clamp_log_std(flat[place]), ZERO
                inverse = exp(-log_std)
                for i in range(n):
                    g[i] = c[i] * s[i] * inverse
                    total += c[i] * (s[i] * s[i] - ONE) - w
                if flat[place] == log_std:
                    grad[place] += total


@kernel
def sample(places, heads, flat, work, noise, start, n, masked):
    """Write the block's ACTIONS, drawn with the given noise [rows, columns] from row ``start`` on."""
    if masked:
        apply_mask(places, heads, work, n)
    top, total = row(work, places[ROWS] + TOP * BLOCK, n), row(work, places[ROWS] + SUM * BLOCK, n)
    for c in range(len(heads)):
        first, count, column = places[LOGITS] + heads[c, PARAMETER] * n, heads[c, COUNT], heads[c, COLUMN]
        if heads[c, KIND] == CATEGORICAL:
            normalise_logits(places, work, first, count, n)
            for i in range(n):
                u, reached, last, pick = noise[start + i, column], ZERO, 0, -1
                for k in range(count):
                    p = exp((work[first + k * n + i] - top[i]) - total[i])
                    reached += p
                    last = k if p > ZERO else last
                    pick = k if pick < 0 and reached > u else pick
                work[places[ACTIONS] + column * n + i] = f(last if pick < 0 else pick)
            continue
        for k in range(count):
            z, a = row(work, first + k * n, n), row(work, places[ACTIONS] + (column + k) * n, n)
            if heads[c, KIND] == BERNOULLI:
                penalty = row(work, places[PENALTY] + (heads[c, MASK] + k if masked else 0) * n, n)
                for i in range(n):
                    one = noise[start + i, column + k] < ONE / (ONE + exp(-z[i]))
                    a[i] = ONE if one and not (masked and penalty[i] < ZERO) else ZERO
            else:
                std = exp(clamp_log_std(flat[places[LOG_STD] + heads[c, DEVIATION] + k]))
                for i in range(n):
                    a[i] = z[i] + std * noise[start + i, column + k]
