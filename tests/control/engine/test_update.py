"""The compiled update matches ppo.update: same parameters, metrics and permutations, for all settings."""

import copy
import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from engine_cases import SPACES, difference, make, make_batch, numbers

from tightrope.algorithms import ppo
from tightrope.control.engine.compiled.plan import unsupported
from tightrope.control.engine.compiled.threads import LEFT
from tightrope.control.engine.compiled_engine import CompiledEngine

SETTINGS = {
    "defaults": {},
    "linear": {"hidden": ()},
    "one layer": {"hidden": (12,)},
    "three layers": {"hidden": (32, 7, 20)},
    "narrow": {"hidden": (3, 5)},
    "shared": {"shared": True},
    "shared deep": {"shared": True, "hidden": (16, 4, 20), "entropy_weight": 0.05},
    "shared, two rates": {"shared": True, "critic_learning_rate": 3e-3},
    "relu": {"activation": "relu"},
    "elu": {"activation": "elu"},
    "silu": {"activation": "silu"},
    "shared silu": {"activation": "silu", "shared": True},
    "value clip": {"value_clip": 0.1},
    "high clip": {"clip_high": 0.3, "clip": 0.1},
    "entropy": {"entropy_weight": 0.1},
    "two rates": {"critic_learning_rate": 3e-3},
    "no gradient clip": {"max_grad_norm": None},
    "tight gradient clip": {"max_grad_norm": 0.05},
    "raw advantages": {"normalise_advantages": False},
    "ragged": {"minibatch_size": 37},
    "single last row": {"minibatch_size": 29},  # 320 = 11 * 29 + 1
    "several blocks": {"minibatch_size": 300},
    "blocks of a shared trunk": {"minibatch_size": 300, "shared": True},
    "micro batches": {"micro_batch_size": 16},
}


def both(space="discrete", threads=1, updates=2, batch=None, **values):
    """Metrics and parameters after some updates on torch and on the engine."""
    policy, optimiser, settings = make(space, **values)
    data = make_batch(policy, **(batch or {}))
    assert unsupported(policy, settings, policy.device, "ppo") is None
    twin = copy.deepcopy((policy, optimiser))
    engine = CompiledEngine(*twin, threads)
    metrics = []
    for seed in range(updates):
        metrics = [
            ppo.update(policy, optimiser, data.as_steps(), settings, np.random.default_rng(seed)),
            engine.update(data, settings, np.random.default_rng(seed)),
        ]
    engine.close()
    return metrics, numbers(policy), numbers(twin[0])


def check(metrics, first, second):
    assert difference(first, second) < 1e-5
    expected, got = metrics
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        assert got[name] == pytest.approx(value, rel=1e-3, abs=1e-5), name


@pytest.mark.parametrize("name", SETTINGS)
def test_settings(name):
    check(*both(**SETTINGS[name]))


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("values", [{}, {"shared": True}], ids=["separate", "shared"])
@pytest.mark.parametrize("batch", [{}, {"action_masks": True, "masked": True}], ids=["whole", "masked"])
def test_heads(space, values, batch):
    if batch and space == "box":
        batch = {"masked": True}  # a Box has no action mask
    check(*both(space, batch=batch, entropy_weight=0.03, **values))


@pytest.mark.parametrize("entropy_weight", [0.0, 0.5])
def test_deviations_on_both_sides_of_the_end_of_their_range(entropy_weight):
    """The sum over all blocks of a minibatch tells whether its step leads back."""
    values = {"minibatch_size": 300, "num_epochs": 6, "learning_rate": 0.01}
    metrics, first, second = both("box", log_std_init=2.0, entropy_weight=entropy_weight, **values)
    check(metrics, first, second)
    start = make("box", log_std_init=2.0)[0].log_std.detach()
    moved = next(x for x in first if x.shape == start.shape and x.ndim == 1)
    assert ((start > 2) & (moved < start)).any() or entropy_weight


def test_kl_stop_ends_all_epochs_before_the_step():
    values = {"target_kl": 0.02, "learning_rate": 0.01, "num_epochs": 8}
    result = both(updates=1, batch={"drift": 0.0}, **values)
    check(*result)
    assert 0 < result[0][1]["train/minibatches"] < 8 * 5


def test_kl_stop_leaves_the_generator_where_torch_leaves_it():
    policy, optimiser, settings = make(target_kl=0.02, learning_rate=0.01, num_epochs=8)
    data, twin = make_batch(policy, drift=0.0), copy.deepcopy((policy, optimiser))
    first, second = np.random.default_rng(0), np.random.default_rng(0)
    ppo.update(policy, optimiser, data.as_steps(), settings, first)
    CompiledEngine(*twin, 1).update(data, settings, second)
    assert first.random() == second.random()


@pytest.mark.parametrize(
    "values", [{}, {"minibatch_size": 300}, {"target_kl": 0.02, "learning_rate": 0.01, "num_epochs": 8}]
)
@pytest.mark.parametrize("space", ["discrete", "mixed"])
def test_bits_do_not_depend_on_the_number_of_threads(space, values):
    results = [both(space, threads=threads, entropy_weight=0.01, **values) for threads in (1, 2)]
    assert difference(results[0][2], results[1][2]) == 0.0
    assert results[0][0][1] == results[1][0][1]


def fused(threads, start=None):
    policy, optimiser, settings = make("mixed")
    engine = CompiledEngine(policy, optimiser, threads)
    if start is not None:
        engine._helper.start = start(engine._helper.start)
    metrics = engine.update(make_batch(policy), settings, np.random.default_rng(0))
    engine.close()
    return numbers(policy), metrics


def never_begins(start):
    def replaced(job, control):
        control[LEFT] = 1
        return True

    return replaced


def raises(start):
    def fail():
        raise RuntimeError("the helper dies")

    return lambda job, control: start(fail, control)


def refused(start):
    return lambda job, control: False


@pytest.mark.parametrize("start", [never_begins, raises, refused])
def test_a_lost_helper_changes_nothing(start):
    expected, got = fused(1), fused(2, start)
    assert difference(expected[0], got[0]) == 0.0
    assert expected[1] == got[1]


def test_an_interrupt_between_epochs_releases_the_helper():
    policy, optimiser, settings = make()
    engine = CompiledEngine(policy, optimiser, 2)

    class Interrupted:
        calls = 0

        def permutation(self, count):
            self.calls += 1
            if self.calls == 2:
                raise KeyboardInterrupt
            return np.arange(count)

    batch = make_batch(policy)
    with pytest.raises(KeyboardInterrupt):
        engine.update(batch, settings, Interrupted())
    engine.update(batch, settings, np.random.default_rng(0))
    engine.close()


def test_first_minibatch_check_sees_no_difference_and_changes_nothing():
    policy, optimiser, settings = make("mixed")
    engine, batch = CompiledEngine(policy, optimiser, 1), make_batch(policy)
    before = numbers(policy)
    assert engine.check_first_minibatch(batch, settings) < 1e-6
    assert difference(before, numbers(policy)) == 0.0


def test_a_batch_without_a_step_is_refused():
    policy, optimiser, settings = make()
    engine, batch = CompiledEngine(policy, optimiser, 1), make_batch(policy)
    before, rng = numbers(policy), np.random.default_rng(0)
    nothing = dataclasses.replace(batch, mask=batch.mask & False)
    with pytest.raises(ValueError, match="No step of the batch counts"):
        engine.update(nothing, settings, rng)
    assert difference(before, numbers(policy)) == 0.0
    engine.close()


def test_unsupported_names_the_reason():
    policy, _, settings = make(dual_clip=3.0)
    assert unsupported(policy, settings, "cpu", "ppo") == "dual_clip"
    policy, _, settings = make("box", std="gsde")
    assert unsupported(policy, settings, "cpu", "ppo") == "gSDE"
    policy, _, settings = make()
    assert "cuda" in (unsupported(policy, settings, "cuda", "ppo") or "")
    assert "a2c" in (unsupported(policy, settings, "cpu", "a2c") or "")


def test_the_process_ends_cleanly_right_after_an_update_with_two_threads():
    lines = [
        "import numpy as np",
        "from engine_cases import make, make_batch",
        "from tightrope.control.engine.compiled_engine import CompiledEngine",
        "policy, optimiser, settings = make()",
        "engine = CompiledEngine(policy, optimiser, 2)",
        "engine.update(make_batch(policy), settings, np.random.default_rng(0))",
    ]
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    ended = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode == 0, ended.stderr
