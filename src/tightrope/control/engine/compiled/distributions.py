"""Distributions of actions: the actor's outputs to log-probability, entropy, gradient and sample.

The equations are those of control/policy/distributions.py. All matrices are feature-major like the layers'.
The tables ``places`` and ``components`` are described in plan.py.
"""

from __future__ import annotations

import numpy as np

from tightrope.control.engine.compiled import plan
from tightrope.control.engine.compiled.primitives import ONE, ZERO, composite, exp, f, kernel, log, row

LOG_ROOT_TWO_PI = f(0.9189385332046727)
LOG_STD_LOW, LOG_STD_HIGH = f(-20.0), f(2.0)


@composite
def clamp_log_std(x):
    """The log deviation within its range; NaN stays NaN."""
    y = LOG_STD_LOW if x < LOG_STD_LOW else x
    return LOG_STD_HIGH if y > LOG_STD_HIGH else y


@kernel
def apply_mask(places, components, work, n):
    """Masked categories: logit -inf, so that their probability is exactly 0. (``bernoulli`` masks bits.)"""
    for c in range(len(components)):
        if components[c, plan.KIND] != plan.CATEGORICAL:
            continue
        for k in range(components[c, plan.COUNT]):
            z = row(work, places[plan.LOGITS] + (components[c, plan.PARAMETER] + k) * n, n)
            penalty = row(work, places[plan.PENALTY] + (components[c, plan.MASK] + k) * n, n)
            for i in range(n):
                z[i] += penalty[i]


@kernel
def normalise_logits(places, work, first, count, n):
    """TOP = the largest of ``count`` logits, SUM = log of the sum of exp(logit - TOP)."""
    vectors = places[plan.VECTORS]
    top, total = row(work, vectors + plan.TOP, n), row(work, vectors + plan.SUM, n)
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
def categorical(places, component, work, n):
    """logp and entropy of one choice; LOGS keeps every log-probability."""
    first, count = places[plan.LOGITS] + component[plan.PARAMETER] * n, component[plan.COUNT]
    saved, vectors = places[plan.LOGS] + component[plan.PARAMETER] * n, places[plan.VECTORS]
    normalise_logits(places, work, first, count, n)
    top, total = row(work, vectors + plan.TOP, n), row(work, vectors + plan.SUM, n)
    own = row(work, vectors + plan.CHOSEN, n)
    h = row(work, places[plan.ENTROPIES] + component[plan.ENTROPY_ROW] * n, n)
    chosen = row(work, places[plan.ACTIONS] + component[plan.COLUMN] * n, n)
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
    logp, entropy = row(work, vectors + plan.LOGP, n), row(work, vectors + plan.TOTAL_ENTROPY, n)
    for i in range(n):
        logp[i] += own[i]
        entropy[i] += h[i]


@kernel
def bernoulli(places, component, work, n, masked):
    """logp and entropy of independent bits; LOGS keeps p, and -1 for a masked bit."""
    logp = row(work, places[plan.VECTORS] + plan.LOGP, n)
    entropy = row(work, places[plan.VECTORS] + plan.TOTAL_ENTROPY, n)
    for k in range(component[plan.COUNT]):
        z = row(work, places[plan.LOGITS] + (component[plan.PARAMETER] + k) * n, n)
        saved = row(work, places[plan.LOGS] + (component[plan.PARAMETER] + k) * n, n)
        bit = row(work, places[plan.ACTIONS] + (component[plan.COLUMN] + k) * n, n)
        penalty = row(work, places[plan.PENALTY] + (component[plan.MASK] + k if masked else 0) * n, n)
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
def gaussian(places, component, flat, work, n):
    """logp and entropy of independent normals of state-independent deviation; LOGS keeps (a - mean) / std."""
    logp = row(work, places[plan.VECTORS] + plan.LOGP, n)
    entropy = row(work, places[plan.VECTORS] + plan.TOTAL_ENTROPY, n)
    for k in range(component[plan.COUNT]):
        mean = row(work, places[plan.LOGITS] + (component[plan.PARAMETER] + k) * n, n)
        saved = row(work, places[plan.LOGS] + (component[plan.PARAMETER] + k) * n, n)
        action = row(work, places[plan.ACTIONS] + (component[plan.COLUMN] + k) * n, n)
        log_std = clamp_log_std(flat[places[plan.LOG_STD] + component[plan.DEVIATION] + k])
        inverse, constant = exp(-log_std), log_std + LOG_ROOT_TWO_PI
        for i in range(n):
            z = (action[i] - mean[i]) * inverse
            saved[i] = z
            logp[i] -= f(0.5) * z * z + constant
            entropy[i] += constant + f(0.5)


@composite
def evaluate_actions(places, components, flat, work, n, masked):
    """LOGP and TOTAL_ENTROPY of the block's actions: sums over the components."""
    logp = row(work, places[plan.VECTORS] + plan.LOGP, n)
    entropy = row(work, places[plan.VECTORS] + plan.TOTAL_ENTROPY, n)
    for i in range(n):
        logp[i] = ZERO
        entropy[i] = ZERO
    if masked:
        apply_mask(places, components, work, n)
    for c in range(len(components)):
        if components[c, plan.KIND] == plan.CATEGORICAL:
            categorical(places, components[c], work, n)
        elif components[c, plan.KIND] == plan.BERNOULLI:
            bernoulli(places, components[c], work, n, masked)
        else:
            gaussian(places, components[c], flat, work, n)


@kernel
def gradient_of_outputs(places, components, flat, grad, work, n, entropy_share):
    """DELTAS = d loss / d outputs, where the loss of a row has d loss / d logp = COEFFICIENT and holds
    -entropy_share * entropy.

    With c = COEFFICIENT, w = entropy_share:
    categorical: c (1[k = a] - p_k) + w p_k (log p_k + H);  bit: c (b - p) + w z p (1 - p); gaussian: c (a -
    mean) / std^2, and c (((a - mean) / std)^2 - 1) - w for its log_std (see `cut_deviations`).
    """
    w, c = entropy_share, row(work, places[plan.VECTORS] + plan.COEFFICIENT, n)
    for j in range(len(components)):
        kind = components[j, plan.KIND]
        column = 0 if kind == plan.CATEGORICAL else 1
        h = row(work, places[plan.ENTROPIES] + components[j, plan.ENTROPY_ROW] * n, n)
        for k in range(components[j, plan.COUNT]):
            at = (components[j, plan.PARAMETER] + k) * n
            z, s = row(work, places[plan.LOGITS] + at, n), row(work, places[plan.LOGS] + at, n)
            g = row(work, places[plan.DELTAS] + at, n)
            a = row(work, places[plan.ACTIONS] + (components[j, plan.COLUMN] + column * k) * n, n)
            if kind == plan.CATEGORICAL:
                index = f(k)
                for i in range(n):
                    p = exp(s[i])
                    hit = ONE if a[i] == index else ZERO
                    pull = p * (s[i] + h[i]) if s[i] > f(-87) else ZERO
                    g[i] = c[i] * (hit - p) + w * pull
            elif kind == plan.BERNOULLI:
                for i in range(n):
                    p = s[i]
                    value = c[i] * ((ONE if a[i] > f(0.5) else ZERO) - p) + w * z[i] * p * (ONE - p)
                    g[i] = ZERO if p < ZERO else value
            else:
                place = places[plan.LOG_STD] + components[j, plan.DEVIATION] + k
                inverse, total = exp(-clamp_log_std(flat[place])), ZERO
                for i in range(n):
                    g[i] = c[i] * s[i] * inverse
                    total += c[i] * (s[i] * s[i] - ONE) - w
                grad[place] += total


@kernel
def cut_deviations(places, flat, grad):
    """Cut the gradient of a log deviation outside its range where a step along it would lead farther out."""
    for k in range(places[plan.DEVIATIONS]):
        place = places[plan.LOG_STD] + k
        above, below = flat[place] > LOG_STD_HIGH, flat[place] < LOG_STD_LOW
        if (above and grad[place] < ZERO) or (below and grad[place] > ZERO):
            grad[place] = ZERO


@kernel
def sample_actions(places, components, flat, work, noise, start, n, masked):
    """Write the block's ACTIONS, drawn with the given noise [rows, columns] from row ``start`` on."""
    if masked:
        apply_mask(places, components, work, n)
    vectors = places[plan.VECTORS]
    top, total = row(work, vectors + plan.TOP, n), row(work, vectors + plan.SUM, n)
    for c in range(len(components)):
        first = places[plan.LOGITS] + components[c, plan.PARAMETER] * n
        count, column = components[c, plan.COUNT], components[c, plan.COLUMN]
        if components[c, plan.KIND] == plan.CATEGORICAL:
            normalise_logits(places, work, first, count, n)
            for i in range(n):
                u, reached, last, pick = noise[start + i, column], ZERO, 0, -1
                for k in range(count):
                    p = exp((work[first + k * n + i] - top[i]) - total[i])
                    reached += p
                    last = k if p > ZERO else last
                    pick = k if pick < 0 and reached > u else pick
                work[places[plan.ACTIONS] + column * n + i] = f(last if pick < 0 else pick)
            continue
        for k in range(count):
            z, a = row(work, first + k * n, n), row(work, places[plan.ACTIONS] + (column + k) * n, n)
            if components[c, plan.KIND] == plan.BERNOULLI:
                penalty = row(
                    work, places[plan.PENALTY] + (components[c, plan.MASK] + k if masked else 0) * n, n
                )
                for i in range(n):
                    one = noise[start + i, column + k] < ONE / (ONE + exp(-z[i]))
                    a[i] = ONE if one and not (masked and penalty[i] < ZERO) else ZERO
            else:
                std = exp(clamp_log_std(flat[places[plan.LOG_STD] + components[c, plan.DEVIATION] + k]))
                for i in range(n):
                    a[i] = z[i] + std * noise[start + i, column + k]
