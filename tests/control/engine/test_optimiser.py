"""The engine works on the memory and state of torch's parameters and torch's Adam."""

import copy

import numpy as np
import torch
from engine_cases import difference, make, make_batch, numbers

from tightrope.algorithms import ppo
from tightrope.control.engine.compiled_engine import CompiledEngine


def rng(seed):
    return np.random.default_rng(seed)


def test_continuing_on_torch_equals_continuing_fused():
    policy, optimiser, settings = make("mixed")
    batch = make_batch(policy)
    engine = CompiledEngine(policy, optimiser, 1)
    engine.update(batch, settings, rng(0))
    state = copy.deepcopy((policy.state_dict(), optimiser.state_dict()))
    other, other_optimiser, _ = make("mixed", seed=7)
    other.load_state_dict(state[0])
    other_optimiser.load_state_dict(state[1])
    ppo.update(other, other_optimiser, batch.as_steps(), settings, rng(1))
    engine.update(batch, settings, rng(1))
    assert difference(numbers(policy), numbers(other)) < 1e-5


def test_the_engine_takes_over_torchs_moments_and_a_loaded_state():
    policy, optimiser, settings = make()
    batch = make_batch(policy)
    ppo.update(policy, optimiser, batch.as_steps(), settings, rng(0))
    state = copy.deepcopy((policy.state_dict(), optimiser.state_dict()))
    engine = CompiledEngine(policy, optimiser, 1)
    engine.update(batch, settings, rng(1))
    expected = numbers(policy)
    policy.load_state_dict(state[0])
    optimiser.load_state_dict(state[1])  # replaces the tensors of the state: the engine must find them again
    engine.update(batch, settings, rng(1))
    assert difference(expected, numbers(policy)) == 0.0


def test_state_dicts_have_torchs_form():
    policy, optimiser, settings = make("box")
    CompiledEngine(policy, optimiser, 1).update(make_batch(policy), settings, rng(0))
    state = optimiser.state_dict()["state"]
    assert len(state) == len(list(policy.parameters()))
    ordered = [p for group in optimiser.param_groups for p in group["params"]]
    for index, parameter in enumerate(ordered):
        entry = state[index]
        assert entry["exp_avg"].shape == entry["exp_avg_sq"].shape == parameter.shape
        assert float(entry["step"]) == 10 and entry["step"].shape == ()
        assert parameter.is_contiguous()


def test_schedules_reach_the_engine_through_the_optimisers_groups():
    policy, optimiser, settings = make()
    before, engine = numbers(policy), CompiledEngine(policy, optimiser, 1)
    for group in optimiser.param_groups:
        group["lr"] = 0.0
    engine.update(make_batch(policy), settings, rng(0))
    assert difference(before, numbers(policy)) == 0.0


def test_parameters_that_were_replaced_are_found_again():
    policy, optimiser, settings = make()
    engine, batch = CompiledEngine(policy, optimiser, 1), make_batch(policy)
    first = policy.actor[0].weight
    first.data = torch.zeros_like(first)
    engine.update(batch, settings, rng(0))
    assert float(first.detach().abs().max()) > 0
