"""act, values and gae of the engine match torch."""

import numpy as np
import pytest
import torch
from engine_cases import FEATURES, SPACES, make, make_masks, make_noise

from tightrope.control.engine.base import Acted, Steps
from tightrope.control.engine.compiled_engine import CompiledEngine
from tightrope.control.policy.normalise import ObservationNormaliser
from tightrope.maths import returns


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("rows", [1, 8, 300])
@pytest.mark.parametrize("masked", [False, True])
def test_act_is_torchs_with_the_same_noise(space, shared, rows, masked):
    policy, optimiser, _ = make(space, shared=shared)
    engine, rng = CompiledEngine(policy, optimiser, 1), np.random.default_rng(0)
    layout, raw = policy.layout, rng.standard_normal((rows, FEATURES))
    normaliser = ObservationNormaliser(np.ones(FEATURES, bool), old=masked)
    normaliser.mean, normaliser.inverse_std = rng.random((2, FEATURES)) + 0.5
    normaliser.inverse_std *= 8  # some lie beyond the edge
    noise = make_noise(layout, rows, rng)
    masks = make_masks(layout, rows, rng) if masked and layout.num_logits else None
    rollout = np.zeros((rows, 3, layout.num_columns), np.float32)
    logp, inputs = np.zeros((rows, 3), np.float32), np.zeros((rows, 3, FEATURES), np.float32)
    seen = {"flat": inputs[:, 1], "action_mask": np.zeros((rows, layout.num_logits), bool)}
    out = Acted(seen, rollout[:, 1], logp[:, 1])
    engine.act({"flat": raw}, normaliser, masks, noise, slice(0, rows), out)
    assert np.allclose(inputs[:, 1], normaliser(raw), atol=1e-5)
    expected = {"flat": inputs[:, 1]}
    if masks is not None:
        expected["action_mask"] = masks
        assert np.array_equal(seen["action_mask"], masks)
    actions, expected_logp = policy.act(expected, noise)
    assert np.allclose(rollout[:, 1], actions.numpy(), atol=1e-5)
    assert np.allclose(logp[:, 1], expected_logp.numpy(), atol=1e-5)
    assert not rollout[:, [0, 2]].any() and not logp[:, [0, 2]].any() and not inputs[:, [0, 2]].any()
    assert np.allclose(engine.values(expected), policy.values(expected).numpy(), atol=1e-5)


def test_without_normalisation_inputs_are_the_observations():
    policy, optimiser, _ = make()
    raw, out = np.full((2, FEATURES), 50.0), np.zeros((2, FEATURES), np.float32)
    noise, actions, logp = np.zeros((2, 1), np.float32), np.zeros((2, 1), np.float32), np.zeros(2, np.float32)
    engine = CompiledEngine(policy, optimiser, 1)
    engine.act({"flat": raw}, None, None, noise, slice(0, 2), Acted({"flat": out}, actions, logp))
    assert np.array_equal(raw, out)


@pytest.mark.parametrize("gae_lambda", [0.0, 0.95, 1.0])
def test_gae_is_that_of_maths_and_nothing_leaks_from_behind_a_cut(gae_lambda):
    policy, optimiser, _ = make()
    rng, shape = np.random.default_rng(0), (5, 60)
    rewards, values, following = rng.standard_normal((3, *shape), dtype=np.float32)
    terminated = rng.random(shape) < 0.1
    ended, mask = terminated | (rng.random(shape) < 0.1), rng.random(shape) < 0.9
    following[terminated] = np.nan
    rewards[~mask] = values[~mask] = np.nan
    arrays = (rewards, values, following, terminated, ended)
    tensors = [torch.from_numpy(x) for x in arrays]
    expected = returns.gae(*tensors, 0.99, gae_lambda, torch.from_numpy(mask)).numpy()
    got = CompiledEngine(policy, optimiser, 1).gae(Steps(*arrays, mask), 0.99, gae_lambda)
    assert np.isfinite(got).all()
    assert np.allclose(got, expected, atol=1e-5)
