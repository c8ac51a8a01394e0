"""The engine's own exp, log and tanh: accurate in float32, and NaN stays NaN."""

import numba
import numpy as np
import pytest

from tightrope.control.engine.compiled import primitives


def run(function, x):
    @numba.njit(error_model="numpy")
    def loop(source, out):
        for i in range(len(source)):
            out[i] = function(source[i])

    out = np.empty_like(x)
    loop(x, out)
    return out


def ulps(got, expected):
    return np.max(np.abs(got - expected) / np.spacing(np.abs(expected).astype(np.float32)))


@pytest.mark.parametrize(("name", "low", "high", "limit"), [("tanh", -12, 12, 6), ("exp", -87, 88.5, 2)])
def test_accuracy(name, low, high, limit):
    x = np.linspace(low, high, 200_001).astype(np.float32)
    assert ulps(run(getattr(primitives, name), x), getattr(np, name)(x.astype(np.float64))) <= limit


def test_log_accuracy():
    x = np.geomspace(1e-30, 1e30, 200_001).astype(np.float32)
    assert ulps(run(primitives.log, x), np.log(x.astype(np.float64))) <= 3


def test_special_numbers():
    x = np.array([np.nan, np.inf, -np.inf, 0.0], np.float32)
    assert np.array_equal(
        run(primitives.exp, x), np.array([np.nan, np.inf, 0, 1], np.float32), equal_nan=True
    )
    assert np.allclose(run(primitives.tanh, x), [np.nan, 1, -1, 0], equal_nan=True)
    assert np.isnan(run(primitives.log, x[:1])[0])
