"""act, values and gae of the engine match torch."""

import numpy as np
import pytest
import torch
from engine_cases import FEATURES, SPACES, make, make_masks, make_noise

from tightrope.control.engine.compiled_engine import FusedEngine
from tightrope.maths import returns


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("rows", [1, 8, 300])
@pytest.mark.parametrize("masked", [False, True])
def test_act_is_torchs_with_the_same_noise(space, shared, rows, masked):
    policy, optimiser, _ = make(space, shared=shared)
    engine, rng = FusedEngine(policy, optimiser, 1), np.random.default_rng(0)
    layout, raw = policy.layout, rng.standard_normal((rows, FEATURES), dtype=np.float32)
    mean, inverse = rng.random((2, FEATURES), dtype=np.float32) + 0.5
    noise = make_noise(layout, rows, rng)
    masks = make_masks(layout, rows, rng) if masked and layout.num_logits else None
    rollout = np.zeros((rows, 3, layout.num_columns), np.float32)
    logp, inputs = np.zeros((rows, 3), np.float32), np.zeros((rows, 3, FEATURES), np.float32)
    engine.act(raw, mean, inverse, 1.0, masks, noise, rollout[:, 1], logp[:, 1], inputs[:, 1])
    seen = np.clip((raw - mean) * inverse, -1, 1)
    assert np.allclose(inputs[:, 1], seen, atol=1e-6)
    expected = {"flat": torch.from_numpy(inputs[:, 1].copy())}
    if masks is not None:
        expected["action_mask"] = torch.from_numpy(masks)
    actions, expected_logp = policy.act(expected, torch.from_numpy(noise))
    assert np.allclose(rollout[:, 1], actions.numpy(), atol=1e-5)
    assert np.allclose(logp[:, 1], expected_logp.numpy(), atol=1e-5)
    assert not rollout[:, [0, 2]].any() and not logp[:, [0, 2]].any() and not inputs[:, [0, 2]].any()
    assert np.allclose(engine.values(seen), policy.values(expected).detach().numpy(), atol=1e-5)


def test_without_normalisation_inputs_are_the_observations():
    policy, optimiser, _ = make()
    raw, out = np.full((2, FEATURES), 50, np.float32), np.zeros((2, FEATURES), np.float32)
    noise, actions, logp = np.zeros((2, 1), np.float32), np.zeros((2, 1), np.float32), np.zeros(2, np.float32)
    FusedEngine(policy, optimiser, 1).act(raw, None, None, 10.0, None, noise, actions, logp, out)
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
    got = FusedEngine(policy, optimiser, 1).gae(*arrays, mask, 0.99, gae_lambda)
    assert np.isfinite(got).all()
    assert np.allclose(got, expected, atol=1e-5)
