"""Layers: forward and backward over one flat buffer of parameters, for widths and depths known at run time.

Everything is feature-major, [features, rows], so that rows fill the vector lanes: a layer is Z = W X + b
with W as torch keeps it, [outputs, inputs]. ``work`` holds all intermediate matrices, each [features, n] for
the n rows of a block, packed densely from its own offset.
"""

from __future__ import annotations

from tightrope.control.engine.compiled import plan
from tightrope.control.engine.compiled.primitives import (
    ONE,
    ZERO,
    composite,
    exp,
    gemm,
    kernel,
    row,
    runtime,
    tanh,
)  # fmt: skip  # isort: skip

NARROW_LAYER = 8  # BLAS does not pay for layers with at most so many inputs or outputs


@kernel
def combine(table, start, step, stride, vectors, source, count, target, rows, n, add):
    """target_r = sum_k table[start + r step + k stride] source_k (+ target_r), for ``rows`` r and ``count``
    k; rows of n."""
    for r in range(rows):
        z = row(vectors, target + r * n, n)
        if not add:
            for i in range(n):
                z[i] = ZERO
        at = start + r * step
        groups = count // 4
        for g in range(groups):
            c0, c1 = table[at], table[at + stride]
            c2, c3 = table[at + 2 * stride], table[at + 3 * stride]
            x0, x1 = row(vectors, source + 4 * g * n, n), row(vectors, source + (4 * g + 1) * n, n)
            x2, x3 = row(vectors, source + (4 * g + 2) * n, n), row(vectors, source + (4 * g + 3) * n, n)
            for i in range(n):
                z[i] += c0 * x0[i] + c1 * x1[i] + c2 * x2[i] + c3 * x3[i]
            at += 4 * stride
        for k in range(4 * groups, count):
            c, x = table[at], row(vectors, source + k * n, n)
            for i in range(n):
                z[i] += c * x[i]
            at += stride


@kernel
def correlate(grad, start, vectors, delta, outputs, source, inputs, n, add):
    """grad [outputs, inputs] = sum over rows of delta_j source_d (+ grad): the gradient of a weight, narrow
    layers."""
    for j in range(outputs):
        g = row(vectors, delta + j * n, n)
        target = row(grad, start + j * inputs, inputs)
        groups = inputs // 4
        for q in range(groups):
            x0, x1 = row(vectors, source + 4 * q * n, n), row(vectors, source + (4 * q + 1) * n, n)
            x2, x3 = row(vectors, source + (4 * q + 2) * n, n), row(vectors, source + (4 * q + 3) * n, n)
            s0, s1, s2, s3 = ZERO, ZERO, ZERO, ZERO
            for i in range(n):
                s0 += g[i] * x0[i]
                s1 += g[i] * x1[i]
                s2 += g[i] * x2[i]
                s3 += g[i] * x3[i]
            d = 4 * q
            target[d] = target[d] + s0 if add else s0
            target[d + 1] = target[d + 1] + s1 if add else s1
            target[d + 2] = target[d + 2] + s2 if add else s2
            target[d + 3] = target[d + 3] + s3 if add else s3
        for d in range(4 * groups, inputs):
            x, s = row(vectors, source + d * n, n), ZERO
            for i in range(n):
                s += g[i] * x[i]
            target[d] = target[d] + s if add else s


@kernel
def activate(flat, layers, layer, work, n):
    """Add the bias and apply the activation in place; SiLU leaves its slope too (it is no function of its
    value)."""
    kind, at, slope = layers[layer, plan.ACTIVATION], layers[layer, plan.VALUE], layers[layer, plan.SLOPE]
    for j in range(layers[layer, plan.OUTPUTS]):
        b, z = flat[layers[layer, plan.BIAS] + j], row(work, at + j * n, n)
        if kind == plan.TANH:
            for i in range(n):
                z[i] = tanh(z[i] + b)
        elif kind == plan.RELU:
            for i in range(n):
                x = z[i] + b
                z[i] = ZERO if x < ZERO else x
        elif kind == plan.ELU:
            for i in range(n):
                x = z[i] + b
                z[i] = exp(x) - ONE if x < ZERO else x
        elif kind == plan.SILU:
            d = row(work, slope + j * n, n)
            for i in range(n):
                x = z[i] + b
                s = ONE / (ONE + exp(-x))
                z[i] = x * s
                d[i] = s * (ONE + x * (ONE - s))
        else:
            for i in range(n):
                z[i] += b


@composite
def forward(flat, layers, first, last, work, n):
    """Fill the VALUE of layers first .. last - 1; layer ``first`` reads what its FEED says (-1: the inputs
    at 0)."""
    for layer in range(first, last):
        inputs, outputs = layers[layer, plan.INPUTS], layers[layer, plan.OUTPUTS]
        feed, at = layers[layer, plan.FEED], layers[layer, plan.VALUE]
        source = layers[feed, plan.VALUE] if feed >= 0 else 0
        weight = layers[layer, plan.WEIGHT]
        if inputs > NARROW_LAYER and outputs > NARROW_LAYER:
            gemm(
                False,
                False,
                n,
                outputs,
                inputs,
                (work, source, n),
                (flat, weight, inputs),
                ZERO,
                (work, at, n),
            )
        else:
            combine(flat, weight, inputs, runtime(1), work, source, inputs, at, outputs, n, runtime(False))
        activate(flat, layers, layer, work, n)


@kernel
def descend(layers, layer, work, n):
    """Turn the gradient by the layer's value, at DELTA, into that by the sum before its activation."""
    kind, at = layers[layer, plan.ACTIVATION], layers[layer, plan.VALUE]
    g, h = (
        row(work, layers[layer, plan.DELTA], layers[layer, plan.OUTPUTS] * n),
        row(work, at, layers[layer, plan.OUTPUTS] * n),
    )
    if kind == plan.TANH:
        for i in range(len(g)):
            g[i] *= ONE - h[i] * h[i]
    elif kind == plan.RELU:
        for i in range(len(g)):
            g[i] *= ONE if h[i] > ZERO else ZERO
    elif kind == plan.ELU:
        for i in range(len(g)):
            g[i] *= ONE if h[i] > ZERO else h[i] + ONE
    elif kind == plan.SILU:
        d = row(work, layers[layer, plan.SLOPE], layers[layer, plan.OUTPUTS] * n)
        for i in range(len(g)):
            g[i] *= d[i]


@kernel
def backward(flat, grad, layers, first, last, work, n, more, join):
    """Gradients of layers last - 1 .. first from the DELTA of the last one (by its value).

    ``more``: add to the gradients (not the minibatch's first block). ``join``: add to the DELTA of the layer
    that feeds the first one (the critic's share of a trunk, after the actor's) and do not begin it.
    """
    for layer in range(last - 1, first - 1, -1):
        descend(layers, layer, work, n)
        inputs, outputs = layers[layer, plan.INPUTS], layers[layer, plan.OUTPUTS]
        feed, delta = layers[layer, plan.FEED], layers[layer, plan.DELTA]
        source = layers[feed, plan.VALUE] if feed >= 0 else 0
        weight, wide = layers[layer, plan.WEIGHT], inputs > NARROW_LAYER and outputs > NARROW_LAYER
        bias = row(grad, layers[layer, plan.BIAS], outputs)
        for j in range(outputs):
            g, s = row(work, delta + j * n, n), ZERO
            for i in range(n):
                s += g[i]
            bias[j] = bias[j] + s if more else s
        if wide:
            beta = ONE if more else ZERO
            gemm(
                True,
                False,
                inputs,
                outputs,
                n,
                (work, source, n),
                (work, delta, n),
                beta,
                (grad, weight, inputs),
            )
        else:
            correlate(grad, weight, work, delta, outputs, source, inputs, n, more)
        if feed < 0:
            continue
        below, add = layers[feed, plan.DELTA], join and layer == first
        if wide:
            beta = ONE if add else ZERO
            gemm(
                False,
                True,
                n,
                inputs,
                outputs,
                (work, delta, n),
                (flat, weight, inputs),
                beta,
                (work, below, n),
            )
        else:
            combine(flat, weight, runtime(1), inputs, work, delta, outputs, below, inputs, n, add)
