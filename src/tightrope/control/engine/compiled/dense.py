"""Layers: forward and backward over one flat buffer of parameters, widths and depths known only at run time.

Everything is feature-major, [features, rows], so that rows fill the vector lanes: a layer is Z = W X + b
with W as torch
keeps it, [outputs, inputs]. ``work`` holds all intermediate matrices, each [features, n] for the n rows of a
block,
densely packed from its own offset.
"""

# mypy: ignore-errors
# (what numba makes of these functions is not what mypy sees)
from __future__ import annotations

import numpy as np

from tightrope.control.engine.compiled.numba_tools import (
    bits_of_float,
    element,
    float_of_bits,
    gemm,
    glue,
    kernel,
    plain,
    row,
)

BLOCK = 128  # rows worked on at once: sums are made block by block, so this number is part of the bits
NARROW = 8  # BLAS does not pay below

# columns of the table of layers
INPUTS, OUTPUTS, WEIGHT, BIAS, ACTIVATION, VALUE, DELTA, SLOPE, FEED = range(9)
NONE, TANH, RELU, ELU, SILU = range(5)

f = np.float32
ZERO, ONE = f(0), f(1)


@element
def exp(x):
    """e^x within 2 ulp; inf above 88.72, 0 below -87.3, NaN for NaN (Cephes; 1.5 * 2^23 rounds to an
    integer)."""
    y = f(-87.3) if x < f(-87.3) else x
    y = f(88.72) if y > f(88.72) else y
    shifted = y * f(1.44269504088896341) + f(12582912.0)
    whole = shifted - f(12582912.0)
    r = y - whole * f(0.693359375)
    r = r + whole * f(2.12194440e-4)
    p = f(1.9875691500e-4) * r + f(1.3981999507e-3)
    p = p * r + f(8.3334519073e-3)
    p = p * r + f(4.1665795894e-2)
    p = p * r + f(1.6666665459e-1)
    p = p * r + f(5.0000001201e-1)
    p = p * r * r + r + ONE
    # two halves of the exponent, as 2^128 is not a float32
    bits = np.int32(bits_of_float(shifted) - np.int32(0x4B400000))
    half = np.int32(bits >> np.int32(1))
    p = p * float_of_bits(np.int32((half + np.int32(127)) << np.int32(23)))
    p = p * float_of_bits(np.int32((bits - half + np.int32(127)) << np.int32(23)))
    p = f(np.inf) if x > f(88.72) else p
    return ZERO if x < f(-87.3) else p


@element
def log(x):
    """Natural logarithm of a normal positive x within 2 ulp; NaN for NaN and inf (Cephes)."""
    bits = bits_of_float(x)
    whole = f(np.int32((bits >> np.int32(23)) - np.int32(126)))
    m = float_of_bits(np.int32((bits & np.int32(0x007FFFFF)) | np.int32(0x3F000000)))
    low = m < f(0.707106781186547524)
    whole = whole - ONE if low else whole
    r = (m + m if low else m) - ONE
    p = f(7.0376836292e-2) * r + f(-1.1514610310e-1)
    p = p * r + f(1.1676998740e-1)
    p = p * r + f(-1.2420140846e-1)
    p = p * r + f(1.4249322787e-1)
    p = p * r + f(-1.6668057665e-1)
    p = p * r + f(2.0000714765e-1)
    p = p * r + f(-2.4999993993e-1)
    p = p * r + f(3.3333331174e-1)
    square = r * r
    y = p * r * square + whole * f(-2.12194440e-4) - f(0.5) * square
    return r + y + whole * f(0.693359375) + (x - x)


@element
def tanh(x):
    """Hyperbolic tangent within 4 ulp, NaN for NaN: a rational function on [-7.9, 7.9], +-1 beyond in
    float32."""
    y = f(7.90531110763549805) if x > f(7.90531110763549805) else x
    y = f(-7.90531110763549805) if y < f(-7.90531110763549805) else y
    s = y * y
    p = f(-2.76076847742355e-16) * s + f(2.00018790482477e-13)
    p = p * s + f(-8.60467152213735e-11)
    p = p * s + f(5.12229709037114e-08)
    p = p * s + f(1.48572235717979e-05)
    p = p * s + f(6.37261928875436e-04)
    p = p * s + f(4.89352455891786e-03)
    q = f(1.19825839466702e-06) * s + f(1.18534705686654e-04)
    q = q * s + f(2.26843463243900e-03)
    q = q * s + f(4.89352518554385e-03)
    return y * p / q


@element
def finite(x):
    """Whether a float32 is neither NaN nor infinite, read from its bits: reassociation turns x - x and 0 * x
    into 0,
    and np.isfinite with them, NaN or not."""
    return (bits_of_float(x) & np.int32(0x7F800000)) != np.int32(0x7F800000)


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
    kind, at, slope = layers[layer, ACTIVATION], layers[layer, VALUE], layers[layer, SLOPE]
    for j in range(layers[layer, OUTPUTS]):
        b, z = flat[layers[layer, BIAS] + j], row(work, at + j * n, n)
        if kind == TANH:
            for i in range(n):
                z[i] = tanh(z[i] + b)
        elif kind == RELU:
            for i in range(n):
                x = z[i] + b
                z[i] = ZERO if x < ZERO else x
        elif kind == ELU:
            for i in range(n):
                x = z[i] + b
                z[i] = exp(x) - ONE if x < ZERO else x
        elif kind == SILU:
            d = row(work, slope + j * n, n)
            for i in range(n):
                x = z[i] + b
                s = ONE / (ONE + exp(-x))
                z[i] = x * s
                d[i] = s * (ONE + x * (ONE - s))
        else:
            for i in range(n):
                z[i] += b


@glue
def forward(flat, layers, first, last, work, n):
    """Fill the VALUE of layers first .. last - 1; layer ``first`` reads what its FEED says (-1: the inputs
    at 0)."""
    for layer in range(first, last):
        inputs, outputs = layers[layer, INPUTS], layers[layer, OUTPUTS]
        feed, at = layers[layer, FEED], layers[layer, VALUE]
        source = layers[feed, VALUE] if feed >= 0 else 0
        weight = layers[layer, WEIGHT]
        if inputs > NARROW and outputs > NARROW:
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
            combine(flat, weight, inputs, plain(1), work, source, inputs, at, outputs, n, plain(False))
        activate(flat, layers, layer, work, n)


@kernel
def descend(layers, layer, work, n):
    """Turn the gradient by the layer's value, at DELTA, into that by the sum before its activation."""
    kind, at = layers[layer, ACTIVATION], layers[layer, VALUE]
    g, h = (
        row(work, layers[layer, DELTA], layers[layer, OUTPUTS] * n),
        row(work, at, layers[layer, OUTPUTS] * n),
    )
    if kind == TANH:
        for i in range(len(g)):
            g[i] *= ONE - h[i] * h[i]
    elif kind == RELU:
        for i in range(len(g)):
            g[i] *= ONE if h[i] > ZERO else ZERO
    elif kind == ELU:
        for i in range(len(g)):
            g[i] *= ONE if h[i] > ZERO else h[i] + ONE
    elif kind == SILU:
        d = row(work, layers[layer, SLOPE], layers[layer, OUTPUTS] * n)
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
        inputs, outputs = layers[layer, INPUTS], layers[layer, OUTPUTS]
        feed, delta = layers[layer, FEED], layers[layer, DELTA]
        source = layers[feed, VALUE] if feed >= 0 else 0
        weight, wide = layers[layer, WEIGHT], inputs > NARROW and outputs > NARROW
        bias = row(grad, layers[layer, BIAS], outputs)
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
        below, add = layers[feed, DELTA], join and layer == first
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
            combine(flat, weight, plain(1), inputs, work, delta, outputs, below, inputs, n, add)
