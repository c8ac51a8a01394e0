"""Epochs of PPO, compiled: gather, forward, loss, backward, the joint norm, Adam.

The equations are those of algorithms/ppo.py. A minibatch is worked on in blocks of BLOCK_ROWS, whose
gradients are added in order. ``role`` tells which half this thread does: ACTOR, CRITIC or BOTH. Either way
each half is computed by the same operations in the same order, and the two meet in the same sum, so that the
number of threads changes no bit.
"""

from __future__ import annotations

import math

import numpy as np

from tightrope.control.engine.compiled import plan
from tightrope.control.engine.compiled.cache import entry
from tightrope.control.engine.compiled.distributions import (
    cut_deviations,
    evaluate_actions,
    gradient_of_outputs,
)
from tightrope.control.engine.compiled.layers import backward, forward
from tightrope.control.engine.compiled.primitives import (
    ONE,
    ZERO,
    composite,
    exp,
    f,
    finite,
    kernel,
    row,
    runtime,
    store_shared,
)  # fmt: skip
from tightrope.control.engine.compiled.threads import ARRIVED, EPOCH, LINE, meet, wait

ACTOR, CRITIC, BOTH = 1, 2, 3
RUNNING, STOPPED, NOT_FINITE, MISMATCH, ALONE = range(5)

# entries of ``options`` (float64)
CLIP_LOW, CLIP_HIGH, VALUE_CLIP, VALUE_WEIGHT, ENTROPY_WEIGHT, TARGET_KL, MAX_NORM, NORMALISE = range(8)
RATE, CRITIC_RATE, BETA_1, BETA_2, EPSILON, RATIO_LIMIT, STEPS_BEFORE, MINIBATCH = range(8, 16)
ACTOR_FROM, ACTOR_TO, CRITIC_FROM, CRITIC_TO = range(16, 20)
OPTIONS = 20

# entries of a role's ledger (float64): sums of the update so far, and of the present minibatch
ROWS_SEEN, POLICY, VALUES, ENTROPY_SUM, KL, HIGH, LOW, NORMS, NORM_COUNT = range(9)
RATIO_MIN, RATIO_MAX, FIRST, STEPS, KL_NOW, BAD_NOW, AT = range(9, 16)
LEDGER = 16

# ``exchange`` (float64): what each half publishes for both, [parity of the meeting, role, LEDGER]
SQUARES, HALT = 0, 1


@kernel
def gather_inputs(places, work, inputs, order, begin, n):
    """The block's observations, transposed to [features, n], at the beginning of ``work``."""
    for i in range(n):
        source = inputs[order[begin + i]]
        for d in range(places[plan.FEATURES]):
            work[d * n + i] = source[d]


@kernel
def gather_mask(places, work, masks, order, begin, n):
    """Penalties [width, n]: 0 where allowed, -inf where masked."""
    for i in range(n):
        source = masks[order[begin + i]]
        for d in range(places[plan.MASK_WIDTH]):
            work[places[plan.PENALTY] + d * n + i] = ZERO if source[d] else f(-np.inf)


@kernel
def gather_vector(places, work, name, source, order, begin, n):
    """One number a row, into the vector of that name."""
    target = row(work, places[plan.VECTORS] + name, n)
    for i in range(n):
        target[i] = source[order[begin + i]]


@kernel
def advantage_moments(advantages, order, begin, end):
    """Mean and 1 / (population deviation + 1e-8) of a minibatch's advantages, in float64; 0 and 1 for one
    row."""
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


@kernel
def surrogate(places, work, n, count, options, ledger):
    """COEFFICIENT = d loss / d logp of the clipped surrogate, and the sums that describe the ratios."""
    v = places[plan.VECTORS]
    logp, old = row(work, v + plan.LOGP, n), row(work, v + plan.OLD_LOGP, n)
    advantage, c = row(work, v + plan.ADVANTAGE, n), row(work, v + plan.COEFFICIENT, n)
    ratio, entropy = row(work, v + plan.RATIO, n), row(work, v + plan.TOTAL_ENTROPY, n)
    low, high, share = f(1 - options[CLIP_LOW]), f(1 + options[CLIP_HIGH]), f(1.0 / count)
    loss, kl, above, below, disorder = ZERO, ZERO, ZERO, ZERO, ZERO
    for i in range(n):
        x, a = logp[i] - old[i], advantage[i]
        r = exp(x)
        ratio[i] = r
        clipped = low if r < low else r
        clipped = high if clipped > high else clipped
        flat = (a > ZERO and r > high) or (a < ZERO and r < low)
        loss -= clipped * a if flat else r * a
        c[i] = ZERO if flat else -a * r * share
        # exp(x) - 1 - x loses its digits near 0, where its series has them
        series = x * x * (f(0.5) + x * (f(1 / 6) + x * (f(1 / 24) + x * f(1 / 120))))
        kl += series if abs(x) < f(0.25) else r - ONE - x
        above += ONE if r > high else ZERO
        below += ONE if r < low else ZERO
        disorder += entropy[i]
    ledger[POLICY] += loss
    ledger[KL_NOW] += kl
    ledger[HIGH] += above
    ledger[LOW] += below
    ledger[ENTROPY_SUM] += disorder
    smallest, largest = ratio[0], ratio[0]
    for i in range(n):
        smallest = ratio[i] if ratio[i] < smallest else smallest
        largest = ratio[i] if ratio[i] > largest else largest
    ledger[RATIO_MIN] = smallest if smallest < ledger[RATIO_MIN] else ledger[RATIO_MIN]
    ledger[RATIO_MAX] = largest if largest > ledger[RATIO_MAX] else ledger[RATIO_MAX]
    if ledger[NORM_COUNT] == 0:
        for i in range(n):
            x = abs(logp[i] - old[i])
            ledger[FIRST] = x if x > ledger[FIRST] else ledger[FIRST]
    if not (finite(loss) and finite(kl) and finite(disorder)):
        ledger[BAD_NOW] = 1


@kernel
def not_finite(vector):
    """Whether a vector holds a NaN or an infinity."""
    bad = np.int32(0)
    for i in range(len(vector)):
        bad += np.int32(0) if finite(vector[i]) else np.int32(1)
    return bad != 0


@composite
def actor_block(
    places, layers, components, flat, grad, work, data, order, begin, n, count, more, scale, options, ledger
):
    """The actor's half of a block: its sums into the ledger, its gradients into ``grad``."""
    _, masks, actions, old_logp, _, advantages, _ = data
    masked = masks.shape[0] > 0
    for i in range(n):
        source = actions[order[begin + i]]
        for k in range(places[plan.COLUMNS]):
            work[places[plan.ACTIONS] + k * n + i] = source[k]
    gather_vector(places, work, plan.OLD_LOGP, old_logp, order, begin, n)
    target = row(work, places[plan.VECTORS] + plan.ADVANTAGE, n)
    for i in range(n):
        target[i] = f((np.float64(advantages[order[begin + i]]) - scale[0]) * scale[1])
    if masked:
        gather_mask(places, work, masks, order, begin, n)
    forward(flat, layers, places[plan.ACTOR_FIRST], places[plan.ACTOR_LAST], work, n)
    if not_finite(row(work, places[plan.LOGITS], places[plan.PARAMETERS] * n)):
        ledger[BAD_NOW] = 1
    evaluate_actions(places, components, flat, work, n, masked)
    surrogate(places, work, n, count, options, ledger)
    gradient_of_outputs(places, components, flat, grad, work, n, f(options[ENTROPY_WEIGHT] / count))
    backward(
        flat, grad, layers, places[plan.ACTOR_FIRST], places[plan.ACTOR_LAST], work, n, more, runtime(False)
    )


@composite
def critic_block(places, layers, flat, grad, work, data, order, begin, n, count, more, join, options, ledger):
    """The critic's half of a block: 0.5 (V - R)^2, or with value_clip the larger of that and the clipped
    one."""
    _, _, _, _, old_values, _, returns = data
    forward(flat, layers, places[plan.CRITIC_FIRST], places[plan.CRITIC_LAST], work, n)
    last = places[plan.CRITIC_LAST] - 1
    value, delta = row(work, layers[last, plan.VALUE], n), row(work, layers[last, plan.DELTA], n)
    gather_vector(places, work, plan.RETURN, returns, order, begin, n)
    target = row(work, places[plan.VECTORS] + plan.RETURN, n)
    loss, weight = ZERO, f(options[VALUE_WEIGHT] / count)
    if options[VALUE_CLIP] > 0:
        gather_vector(places, work, plan.OLD_VALUE, old_values, order, begin, n)
        old, limit = row(work, places[plan.VECTORS] + plan.OLD_VALUE, n), f(options[VALUE_CLIP])
        for i in range(n):
            error, moved = value[i] - target[i], value[i] - old[i]
            held = -limit if moved < -limit else moved
            held = limit if held > limit else held
            other = old[i] + held - target[i]
            # where the clipped error is the larger one, the value has moved too far and its slope is 0
            free = abs(moved) <= limit or error * error > other * other
            loss += f(0.5) * (error * error if free else other * other)
            delta[i] = weight * (error if free else other * ZERO)
    else:
        for i in range(n):
            error = value[i] - target[i]
            loss += f(0.5) * error * error
            delta[i] = weight * error
    ledger[VALUES] += loss
    if not finite(loss) or not_finite(value):
        ledger[BAD_NOW] = 1
    backward(flat, grad, layers, places[plan.CRITIC_FIRST], places[plan.CRITIC_LAST], work, n, more, join)


@composite
def gradients(role, places, layers, components, flat, grad, work, data, order, begin, end, options, ledgers):
    """The gradients of a minibatch, rows begin .. end - 1 of the order, block by block."""
    count, trunk, scale = end - begin, places[plan.TRUNK_LAST], (0.0, 1.0)
    if role & ACTOR:
        ledgers[0, KL_NOW], ledgers[0, BAD_NOW] = 0, 0
        for k in range(places[plan.DEVIATIONS]):
            grad[places[plan.LOG_STD] + k] = ZERO
        if options[NORMALISE] != 0:
            scale = advantage_moments(data[5], order, begin, end)
    if role & CRITIC:
        ledgers[1, BAD_NOW] = 0
    for at in range(begin, end, plan.BLOCK_ROWS):
        n, more = plan.BLOCK_ROWS if end - at > plan.BLOCK_ROWS else end - at, at > begin
        gather_inputs(places, work, data[0], order, at, n)
        forward(flat, layers, runtime(0), trunk, work, n)
        if role & ACTOR:
            actor_block(
                places, layers, components, flat, grad, work, data, order, at, n, count, more, scale, options,
                ledgers[0],
            )  # fmt: skip
        if role & CRITIC:
            critic_block(
                places,
                layers,
                flat,
                grad,
                work,
                data,
                order,
                at,
                n,
                count,
                more,
                trunk > 0,
                options,
                ledgers[1],
            )
        backward(flat, grad, layers, runtime(0), trunk, work, n, more, runtime(False))
    if role & ACTOR:
        cut_deviations(places, flat, grad)


@kernel
def squares(flat, grad, begin, end):
    """Sum of squares of a half's gradients; NaN also when one of its weights is not finite."""
    g, total = row(grad, begin, end - begin), ZERO
    for i in range(end - begin):
        total += g[i] * g[i]
    return np.float64(f(np.nan) if not_finite(row(flat, begin, end - begin)) else total)


@kernel
def adam(flat, grad, mean, square, begin, end, scale, rate, step, options):
    """torch.optim.Adam on a half: m += (1 - b1)(g - m), v = b2 v + (1 - b2) g^2, p -= a m / (sqrt(v / c2) +
    eps)."""
    beta_1, beta_2, n = f(options[BETA_1]), f(options[BETA_2]), end - begin
    size = f(rate / (1 - options[BETA_1] ** step))
    root, epsilon = f(1 / math.sqrt(1 - options[BETA_2] ** step)), f(options[EPSILON])
    g, p = row(grad, begin, n), row(flat, begin, n)
    m, v = row(mean, begin, n), row(square, begin, n)
    scale = f(scale)
    for i in range(n):
        x = g[i] * scale
        first = m[i] + (ONE - beta_1) * (x - m[i])
        second = beta_2 * v[i] + (ONE - beta_2) * x * x
        m[i] = first
        v[i] = second
        p[i] -= size * first / (np.sqrt(second) * root + epsilon)


@composite
def decide_and_step(role, exchange, flat, grad, moment, square, options, ledgers):
    """Once both halves are known: decide as the other thread does, record the norm, and step unless it is
    time to stop."""
    total = exchange[SQUARES] + exchange[LEDGER + SQUARES]
    norm = math.sqrt(total)
    halt = exchange[HALT] if exchange[HALT] > exchange[LEDGER + HALT] else exchange[LEDGER + HALT]
    status = int(halt)
    if not finite(f(total)):
        status = NOT_FINITE
    scale = options[MAX_NORM] / (norm + 1e-6)
    scale = scale if scale < 1.0 else 1.0
    for k in range(2):
        if not role & (k + 1):
            continue
        ledger = ledgers[k]
        if status > STOPPED:
            continue
        ledger[NORMS] += norm
        ledger[NORM_COUNT] += 1
        if status != RUNNING:
            continue
        ledger[STEPS] += 1
        step = options[STEPS_BEFORE] + ledger[STEPS]
        begin, end = int(options[ACTOR_FROM + 2 * k]), int(options[ACTOR_TO + 2 * k])
        adam(flat, grad, moment, square, begin, end, scale, options[RATE + k], step, options)
    return status


@composite
def publish(role, exchange, flat, grad, options, ledgers, count):
    """Write what this thread's half, or both halves, contribute to the decision."""
    for k in range(2):
        if not role & (k + 1):
            continue
        halt, ledger = RUNNING, ledgers[k]
        if k == 0:
            ledger[KL] += ledger[KL_NOW]
            if ledger[KL_NOW] / count > options[TARGET_KL]:
                halt = STOPPED
            if ledger[NORM_COUNT] == 0 and ledger[FIRST] > options[RATIO_LIMIT]:
                halt = MISMATCH
        ledger[ROWS_SEEN] += count
        if ledger[BAD_NOW] != 0:
            halt = NOT_FINITE
        begin, end = int(options[ACTOR_FROM + 2 * k]), int(options[ACTOR_TO + 2 * k])
        exchange[k * LEDGER + SQUARES], exchange[k * LEDGER + HALT] = squares(flat, grad, begin, end), halt


@composite
def save_ledgers(role, ledgers, start):
    """Note where this minibatch begins, and copy the ledgers: they are restored if the other thread
    leaves."""
    for k in range(2):
        if role & (k + 1):
            ledgers[k, AT] = start
            for j in range(LEDGER):
                ledgers[2 + k, j] = ledgers[k, j]


@entry(
    "int64(int64, int64, int64, int64, int64[::1], int64[:,::1], int64[:,::1], float32[::1], float32[::1],"
    "float32[::1], float32[::1], float32[::1], float32[:,::1], boolean[:,::1], float32[:,::1], float32[::1],"
    "float32[::1], float32[::1], float32[::1], int64[::1], float64[::1], int64[::1],"
    "float64[::1], float64[:,::1])"
)
def run_epochs(
    role, begin, epoch, epochs, places, layers, components, flat, grad, moment, square, work,
    inputs, masks, actions, old_logp, old_values, advantages, returns, order, options, control, exchange,
    ledgers,
):  # fmt: skip
    """Run epochs ``epoch`` .. ``epochs`` - 1 of an update over the rows in ``order``, the first from row
    ``begin`` on.

    Parameters in order: role (ACTOR, CRITIC or BOTH); begin, epoch, epochs; the tables of the plan: places,
    layers, components; the flat buffers: parameters, gradients, Adam's two moments; the intermediate
    matrices of this thread; the batch's columns: inputs [N, D], masks [N, W] (no rows: none), actions [N,
    A], old_logp, old_values, advantages, returns [N]; order [M], indices of rows; options [OPTIONS]; control
    [CONTROL_SIZE]; exchange [4 LEDGER]; ledgers [4, LEDGER]: of actor and critic, then copies from before
    this minibatch.

    Returns RUNNING, or why it stopped before a step: STOPPED (KL), NOT_FINITE, MISMATCH, ALONE (the other
    thread left). ``ledgers[., AT]`` is the first row of that minibatch.
    """
    data = (inputs, masks, actions, old_logp, old_values, advantages, returns)
    rows, size = len(order), int(options[MINIBATCH])
    for now in range(epoch, epochs):
        if role == CRITIC and not wait(control, runtime(EPOCH), now + 1):
            return ALONE
        if role == ACTOR:
            store_shared(control, EPOCH, now + 1)
        for start in range(begin, rows, size):
            end = start + size if start + size < rows else rows
            # the other may still be reading the last exchange: two take turns
            parity = control[ARRIVED + LINE * (role == CRITIC)] & 1
            own = row(exchange, parity * 2 * LEDGER, 2 * LEDGER)
            save_ledgers(role, ledgers, start)
            gradients(
                role, places, layers, components, flat, grad, work, data, order, start, end, options, ledgers
            )
            publish(role, own, flat, grad, options, ledgers, end - start)
            if role != BOTH and not meet(control, role - 1):
                return ALONE
            status = decide_and_step(role, own, flat, grad, moment, square, options, ledgers)
            if status != RUNNING:
                return status
        if role != BOTH and not meet(control, role - 1):
            return RUNNING
        begin = 0
    return RUNNING
