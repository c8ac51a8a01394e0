"""A NaN or an infinity is named before the step; weights and moments stay bit-identical."""

import dataclasses

import numba
import numpy as np
import pytest
import torch
from engine_cases import difference, make, make_batch, numbers

from tightrope.algorithms.descent import SamplingMismatch
from tightrope.algorithms.nonfinite import NonFiniteError
from tightrope.control.engine.compiled_engine import CompiledEngine


def refuse(policy, optimiser, settings, batch, threads):
    """Update and expect the error; returns its text and whether weights and moments are unchanged."""
    engine = CompiledEngine(policy, optimiser, threads)
    before = numbers(policy)
    moments = [s[k].clone() for s in optimiser.state.values() for k in ("exp_avg", "exp_avg_sq", "step")]
    with pytest.raises(NonFiniteError) as caught:
        engine.update(batch, settings, np.random.default_rng(0))
    after = [s[k] for s in optimiser.state.values() for k in ("exp_avg", "exp_avg_sq", "step")]
    assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(moments, after, strict=True))
    same = all(
        torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(before, numbers(policy), strict=True)
    )
    engine.close()
    return str(caught.value), same


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("field", "name"),
    [
        ("flat", "input flat"),
        ("old_logp", "old_logp"),
        ("advantages", "advantage"),
        ("returns", "return"),
        ("old_values", "old value"),
        ("actions", "action"),
    ],
)
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_one_bad_number_of_the_batch(field, name, bad, threads, activation):
    # one minibatch: the first step is refused
    policy, optimiser, settings = make(minibatch_size=320, value_clip=0.2, activation=activation)
    batch = make_batch(policy)
    tensor = batch.inputs["flat"] if field == "flat" else getattr(batch, field)
    tensor[3, 7] = float(bad)
    text, same = refuse(policy, optimiser, settings, batch, threads)
    assert same
    assert f"The {name} (row, step, ...)[3, 7" in text and "minibatch 1 of epoch 1" in text


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("activation", ["tanh", "relu", "elu", "silu"])
@pytest.mark.parametrize("which", ["actor.0.weight", "actor.4.bias", "critic.2.weight", "log_std"])
def test_one_bad_weight(which, bad, activation):
    policy, optimiser, settings = make("box", activation=activation)
    batch = make_batch(policy)
    with torch.no_grad():
        dict(policy.named_parameters())[which].view(-1)[0] = bad
    text, same = refuse(policy, optimiser, settings, batch, 1)
    assert same
    assert which in text


def test_a_logit_and_a_value_that_overflow():
    for head in ("actor", "critic"):
        policy, optimiser, settings = make(activation="relu")
        batch = make_batch(policy)
        with torch.no_grad():
            getattr(policy, head)[2].bias.fill_(3e38)
            getattr(policy, head)[4].weight.fill_(1.0)
        text, same = refuse(policy, optimiser, settings, batch, 1)
        assert same
        assert ("logit" if head == "actor" else "value") in text


def test_later_minibatches_are_caught_after_the_steps_before_them():
    policy, optimiser, settings = make(minibatch_size=16)
    batch = make_batch(policy)
    order = np.random.default_rng(0).permutation(320)
    batch.returns.view(-1)[order[16 * 7]] = torch.nan
    engine = CompiledEngine(policy, optimiser, 2)
    with pytest.raises(NonFiniteError, match="minibatch 8 of epoch 1"):
        engine.update(batch, settings, np.random.default_rng(0))
    assert float(optimiser.state[policy.actor[0].weight]["step"]) == 7
    assert all(torch.isfinite(p).all() for p in policy.parameters())
    engine.close()


def test_masked_steps_may_hold_anything():
    policy, optimiser, settings = make()
    batch = make_batch(policy, masked=True)
    for tensor in (batch.inputs["flat"], batch.old_logp, batch.advantages, batch.returns, batch.actions):
        tensor[~batch.mask] = torch.nan
    CompiledEngine(policy, optimiser, 1).update(batch, settings, np.random.default_rng(0))
    assert all(torch.isfinite(p).all() for p in policy.parameters())


def test_first_ratios_off_one_are_refused_before_any_step():
    policy, optimiser, settings = make()
    before, batch = numbers(policy), make_batch(policy, drift=0.0)
    engine = CompiledEngine(policy, optimiser, 1)
    batch = dataclasses.replace(batch, old_logp=batch.old_logp + 0.01)
    with pytest.raises(SamplingMismatch, match="differ by 0"):
        engine.update(batch, settings, np.random.default_rng(0), log_ratio_limit=1e-5)
    assert difference(before, numbers(policy)) == 0.0


def test_what_is_sampled_is_what_is_trained():
    policy, optimiser, settings = make("mixed")
    batch = make_batch(policy, drift=0.0)
    engine = CompiledEngine(policy, optimiser, 1)
    metrics = engine.update(batch, settings, np.random.default_rng(0), log_ratio_limit=1e-5)
    assert metrics["train/log_ratio_first"] <= 1e-5


def test_compiled_code_sees_nan_and_infinity():
    from tightrope.control.engine.compiled.update import not_finite

    look = numba.njit(lambda x: not_finite(x))
    good = np.linspace(-3e38, 3e38, 1000).astype(np.float32)
    assert not look(good)
    for bad in (np.nan, np.inf, -np.inf):
        poisoned = good.copy()
        poisoned[777] = bad
        assert look(poisoned)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_a_gradient_that_overflows_while_data_weights_and_loss_are_finite(activation, threads):
    """An input of 1e38 behind weights of 0: everything is finite except the gradient of these weights."""
    policy, optimiser, settings = make(minibatch_size=320, activation=activation)
    batch = make_batch(policy)
    with torch.no_grad():
        policy.actor[0].weight[:, 0] = 0.0
        policy.critic[0].weight[:, 0] = 0.0
    batch.inputs["flat"][..., 0] = 1e38
    text, same = refuse(policy, optimiser, settings, batch, threads)
    assert same and "The norm of the gradient is not finite, though each number in it is" in text
    assert all(parameter.grad is None for parameter in policy.parameters())
