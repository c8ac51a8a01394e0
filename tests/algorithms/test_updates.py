"""The update rules: a single step, several epochs, and the stops."""

import copy
import dataclasses
import difflib
import inspect

import numpy as np
import pytest
import torch
from algorithms.models import TinyModel, make_batch

from tightrope.algorithms import a2c, ppo, reinforce
from tightrope.algorithms.batch import Evaluation
from tightrope.algorithms.descent import SamplingMismatch
from tightrope.algorithms.nonfinite import NonFiniteError
from tightrope.algorithms.optimise import make_optimiser
from tightrope.algorithms.settings import A2CSettings, PPOSettings, ReinforceSettings
from tightrope.maths.divergence import k3
from tightrope.maths.statistics import masked_mean

RULES = [
    (ppo, PPOSettings(num_epochs=1, minibatch_size=1000)),
    (a2c, A2CSettings()),
    (reinforce, ReinforceSettings()),
]


def run(rule, settings, *, batch=None, model=None, seed=0, **more):
    model = TinyModel() if model is None else model
    batch = make_batch(model) if batch is None else batch
    optimiser = make_optimiser(model.parameters(), model.critic.parameters(), settings)
    metrics = rule.update(model, optimiser, batch, settings, np.random.default_rng(seed), **more)
    return model, metrics


def weights(model):
    return torch.cat([p.detach().flatten() for p in model.parameters()])


def distance(a, b):
    return float((weights(a) - weights(b)).abs().max())


def test_first_ppo_step_is_the_a2c_step_and_the_reinforce_step():
    models = [run(rule, settings)[0] for rule, settings in RULES]
    assert distance(models[0], TinyModel()) > 1e-5
    assert distance(models[0], models[1]) < 1e-6
    assert distance(models[1], models[2]) < 1e-6


def test_all_rules_have_one_signature():
    parameters = [list(inspect.signature(rule.update).parameters) for rule, _ in RULES]
    assert parameters[0] == parameters[1] == parameters[2]


def test_the_diff_of_a2c_and_ppo_is_epochs_minibatches_clip_and_kl_stop():
    """Every line of code that a2c has and ppo has not is the plain policy gradient, or the batch in one
    piece.
    """
    code = [inspect.getsource(rule.update).split('"""')[2].splitlines() for rule in (a2c, ppo)]
    stripped = [[line.strip() for line in lines if line.strip()] for lines in code]
    only_a2c = [line[2:] for line in difflib.ndiff(*stripped) if line.startswith("- ")]
    assert len(only_a2c) <= 14, only_a2c
    text = " ".join(only_a2c)
    assert "policy_gradient" in text
    assert all(word not in text for word in ("clip=", "num_epochs", "target_kl"))


@pytest.mark.parametrize(("rule", "settings"), RULES, ids=["ppo", "a2c", "reinforce"])
@pytest.mark.parametrize("micro", [1, 5, 24])
def test_micro_batches_change_nothing(rule, settings, micro):
    batch = make_batch(TinyModel(), rows=24, columns=3, masked=0.4)
    whole, _ = run(rule, settings, batch=batch)
    parts, _ = run(rule, dataclasses.replace(settings, micro_batch_size=micro), batch=batch)
    assert distance(whole, parts) < 2e-6


@pytest.mark.parametrize(("rule", "settings"), RULES, ids=["ppo", "a2c", "reinforce"])
def test_nan_behind_the_mask_changes_nothing(rule, settings):
    clean = make_batch(TinyModel(), rows=12, columns=3, masked=0.5)

    def poison(x):
        return torch.where(clean.mask, x, torch.nan)

    dirty = dataclasses.replace(
        clean,
        old_logp=poison(clean.old_logp),
        old_values=poison(clean.old_values),
        advantages=poison(clean.advantages),
        returns=poison(clean.returns),
    )
    a, metrics_a = run(rule, settings, batch=clean)
    b, metrics_b = run(rule, settings, batch=dirty)
    assert torch.equal(weights(a), weights(b))
    assert metrics_a == metrics_b


@pytest.mark.parametrize(("rule", "settings"), RULES, ids=["ppo", "a2c", "reinforce"])
def test_nan_from_a_model_behind_the_mask_changes_nothing(rule, settings):
    class Babbling(TinyModel):
        def forward(self, batch):
            now = super().forward(batch)
            poison = torch.where(batch.mask, 0.0, torch.nan)  # added: a bad gradient would pass through
            return Evaluation(now.logp + poison, now.entropy + poison, now.values + poison)

    batch = make_batch(TinyModel(), rows=12, columns=3, masked=0.5)
    a, metrics_a = run(rule, settings, batch=batch)
    b, metrics_b = run(rule, settings, batch=batch, model=Babbling())
    assert torch.equal(weights(a), weights(b)) and metrics_a == metrics_b


@pytest.mark.parametrize(("rule", "settings"), RULES, ids=["ppo", "a2c", "reinforce"])
@pytest.mark.parametrize("columns", [1, 3])
def test_a_batch_of_which_no_step_counts_is_refused(rule, settings, columns):
    batch = make_batch(TinyModel(), rows=4, columns=columns)
    masked = dataclasses.replace(batch, mask=torch.zeros_like(batch.mask))
    cases = (masked, "False throughout"), (batch.select(slice(0, 0)), "empty"), (masked.as_steps(), "empty")
    for nothing, words in cases:
        model = TinyModel()
        with pytest.raises(ValueError, match=rf"No step of the batch counts.*{words}.*expected at least one"):
            run(rule, settings, batch=nothing, model=model)
        assert distance(model, TinyModel()) == 0


@pytest.mark.parametrize(("rule", "settings"), RULES, ids=["ppo", "a2c", "reinforce"])
def test_a_row_of_which_no_step_counts_changes_nothing(rule, settings):
    """Even if it would form its own minibatch or part, with a mean over nothing."""
    batch = make_batch(TinyModel(), rows=6, columns=3)
    kept = torch.tensor([0, 2, 3, 5])
    mask = batch.mask.clone()
    mask[1] = mask[4] = False
    size = {"minibatch_size": 1, "num_epochs": 2} if rule is ppo else {"micro_batch_size": 1}
    settings = dataclasses.replace(settings, normalise_advantages=False, **size)
    some, metrics = run(rule, settings, batch=dataclasses.replace(batch, mask=mask))
    alone, expected = run(rule, settings, batch=batch.select(kept))
    assert torch.equal(weights(some), weights(alone)) and metrics == expected


def test_recomputed_advantages_must_count_too():
    def nothing(batch):
        return dataclasses.replace(batch, mask=torch.zeros_like(batch.mask))

    settings = PPOSettings(num_epochs=2, recompute_advantages=True, minibatch_size=24)
    with pytest.raises(ValueError, match="No step of the batch counts"):
        run(ppo, settings, refresh=nothing)


def test_every_row_is_used_once_an_epoch_and_the_last_minibatch_may_be_smaller():
    model, metrics = run(ppo, PPOSettings(num_epochs=3, minibatch_size=10))
    assert model.calls == 9
    assert metrics["train/minibatches"] == 9


def test_metrics_are_means_over_all_minibatches():
    """With a learning rate too small to move anything, the mean over minibatches is the mean over the
    batch.
    """
    settings = PPOSettings(num_epochs=2, minibatch_size=7, learning_rate=1e-12, normalise_advantages=False)
    model = TinyModel()
    batch = make_batch(model)
    expected_value = 0.5 * (batch.old_values - batch.returns).square().mean()
    _, metrics = run(ppo, settings, batch=batch)
    assert metrics["train/value_loss"] == pytest.approx(float(expected_value), rel=1e-4)
    assert metrics["train/policy_gradient_loss"] == pytest.approx(-float(batch.advantages.mean()), abs=1e-5)
    assert metrics["train/approx_kl"] == pytest.approx(0, abs=1e-6)
    assert metrics["train/ratio_min"] == pytest.approx(1, abs=1e-5)


def test_kl_stop_is_decided_before_the_step_and_ends_all_epochs():
    settings = PPOSettings(num_epochs=50, minibatch_size=8, learning_rate=0.05, target_kl=0.01)
    batch = make_batch(TinyModel())
    _, free = run(ppo, dataclasses.replace(settings, target_kl=None), batch=batch)
    model, stopped = run(ppo, settings, batch=batch)
    taken = int(stopped["train/minibatches"])
    assert 0 < taken < free["train/minibatches"] == 150
    # the same number of steps without a stop gives the same weights: the offending step was not taken
    again = TinyModel()
    optimiser = make_optimiser(again.parameters(), again.critic.parameters(), settings)
    rng, count = np.random.default_rng(0), 0
    free_settings = dataclasses.replace(settings, target_kl=None)
    while count < taken:
        for minibatch in batch.minibatches(8, rng):
            one = dataclasses.replace(free_settings, num_epochs=1, minibatch_size=8)
            ppo.update(again, optimiser, minibatch, one, np.random.default_rng(0))
            count += 1
            if count == taken:
                break
    assert distance(model, again) < 1e-5


def test_a_nan_gradient_takes_no_step_and_is_reported():
    batch = make_batch(TinyModel())
    batch = dataclasses.replace(
        batch, advantages=batch.advantages.index_fill(0, torch.tensor([3]), torch.nan)
    )
    for rule, settings in RULES:
        model = TinyModel()
        settings = dataclasses.replace(settings, normalise_advantages=False)
        with pytest.raises(NonFiniteError, match="was not taken"):
            run(rule, settings, batch=batch, model=model)
        assert distance(model, TinyModel()) == 0


def test_the_fused_adam_skips_a_refused_step_by_itself():
    """Accelerators rely on it: found_inf leaves weights and moments unchanged."""
    parameter = torch.nn.Parameter(torch.ones(3))
    optimiser = torch.optim.Adam([parameter], fused=True)
    parameter.grad = torch.full((3,), 2.0)
    optimiser.found_inf = torch.ones(())
    optimiser.step()
    assert torch.equal(parameter.detach(), torch.ones(3))


def test_separate_learning_rates_move_actor_and_critic_separately():
    settings = PPOSettings(num_epochs=1, minibatch_size=24, learning_rate=1e-2, critic_learning_rate=1e-3)
    model, _ = run(ppo, settings)
    start = TinyModel()
    assert float((model.actor.weight - start.actor.weight).detach().abs().max()) == pytest.approx(
        1e-2, rel=0.02
    )
    assert float((model.critic.weight - start.critic.weight).detach().abs().max()) == pytest.approx(
        1e-3, rel=0.02
    )


def test_one_joint_norm_limits_all_gradients():
    batch = make_batch(TinyModel())
    settings = PPOSettings(num_epochs=1, minibatch_size=24, max_grad_norm=None)
    model = TinyModel()
    optimiser = torch.optim.SGD(model.parameters(), lr=1.0)
    free = ppo.update(model, optimiser, batch, settings, np.random.default_rng(0))
    limit = free["train/grad_norm"] / 4
    other = TinyModel()
    optimiser = torch.optim.SGD(other.parameters(), lr=1.0)
    ppo.update(
        other, optimiser, batch, dataclasses.replace(settings, max_grad_norm=limit), np.random.default_rng(0)
    )
    start = weights(TinyModel())
    torch.testing.assert_close(weights(other) - start, (weights(model) - start) / 4, rtol=1e-4, atol=1e-6)


def test_extra_loss_joins_the_loss_and_its_metrics():
    def pull(model, part, evaluation, count):
        return 10.0 * model.actor.bias.square().sum(), {"entropy": torch.zeros(part.mask.shape)}

    model, metrics = run(
        ppo, PPOSettings(num_epochs=20, minibatch_size=24, learning_rate=1e-2), extra_loss=pull
    )
    plain, plain_metrics = run(ppo, PPOSettings(num_epochs=20, minibatch_size=24, learning_rate=1e-2))
    assert model.actor.bias.norm() < 0.5 * plain.actor.bias.norm()
    assert metrics["train/entropy"] == pytest.approx(plain_metrics["train/entropy"] / 2, rel=0.2)


@pytest.mark.parametrize(("rule", "settings"), RULES, ids=["ppo", "a2c", "reinforce"])
@pytest.mark.parametrize("micro", [None, 1, 5, 24])
def test_extra_loss_gets_the_count_of_the_whole_minibatch(rule, settings, micro):
    """It gives a summed loss the scale of the other terms, so that micro-batches change nothing."""
    batch = make_batch(TinyModel(), rows=24, columns=3, masked=0.4)
    counts = []

    def entropy_again(model, part, evaluation, count):
        counts.append(int(count))
        return -0.5 * masked_mean(evaluation.entropy, part.mask, count), {}

    settings = dataclasses.replace(settings, micro_batch_size=micro)
    extra, _ = run(rule, settings, batch=batch, extra_loss=entropy_again)
    assert set(counts) == {int(batch.mask.sum())} and len(counts) == (1 if micro is None else -(-24 // micro))
    built_in, _ = run(rule, dataclasses.replace(settings, entropy_weight=0.5), batch=batch)
    assert distance(extra, built_in) < 2e-6
    assert distance(extra, run(rule, settings, batch=batch)[0]) > 1e-5


def test_refresh_is_called_before_each_later_epoch_when_asked():
    seen = []

    def refresh(batch):
        seen.append(len(batch))
        return batch

    run(ppo, PPOSettings(num_epochs=4, recompute_advantages=True, minibatch_size=24), refresh=refresh)
    assert seen == [24, 24, 24]
    run(ppo, PPOSettings(num_epochs=4, minibatch_size=24), refresh=refresh)
    assert len(seen) == 3


def test_sampling_mismatch_is_named_before_any_step():
    batch = make_batch(TinyModel())
    shifted = dataclasses.replace(batch, old_logp=batch.old_logp + 0.1)
    model = TinyModel()
    with pytest.raises(SamplingMismatch, match="normaliser"):
        run(ppo, PPOSettings(minibatch_size=24), batch=shifted, model=model, log_ratio_limit=1e-5)
    assert distance(model, TinyModel()) == 0
    run(ppo, PPOSettings(minibatch_size=24), batch=batch, log_ratio_limit=1e-5)


@pytest.mark.parametrize("name", ["dual_clip", "kl_beta", "clip_high", "value_clip"])
def test_each_variant_of_the_loss_changes_the_result(name):
    value = {"dual_clip": 1.01, "kl_beta": 3.0, "clip_high": 0.01, "value_clip": 0.01}[name]
    settings = PPOSettings(num_epochs=10, minibatch_size=24, learning_rate=3e-2)
    a, _ = run(ppo, settings)
    b, _ = run(ppo, dataclasses.replace(settings, **{name: value}))
    assert distance(a, b) > 1e-4


def test_the_kl_penalty_holds_the_policy_back():
    settings = PPOSettings(num_epochs=30, minibatch_size=24, learning_rate=1e-2, kl_beta=0.01)
    _, loose = run(ppo, settings)
    _, tight = run(ppo, dataclasses.replace(settings, kl_beta=30.0))
    assert tight["train/approx_kl"] < 0.3 * loose["train/approx_kl"]


def test_approx_kl_is_of_the_last_epoch_and_kl_after_of_the_batch_behind_it():
    """As the peers have it: a mean over all epochs is diluted by the first, in which the KL is near 0."""
    settings = PPOSettings(num_epochs=1, minibatch_size=24, learning_rate=1e-2)
    _, one = run(ppo, settings)
    assert one["train/approx_kl"] == pytest.approx(0, abs=1e-6)
    _, two = run(ppo, dataclasses.replace(settings, num_epochs=2))
    batch = make_batch(TinyModel())
    model, _ = run(ppo, settings, batch=batch)
    with torch.no_grad():
        wanted = k3(model(batch).logp - batch.old_logp)[batch.mask].mean()
    assert two["train/approx_kl"] == pytest.approx(float(wanted), rel=1e-4)
    assert "train/kl_after" not in two
    adaptive = dataclasses.replace(settings, kl_beta=1e-12, kl_adapt=0.01, clip=1e6, num_epochs=3)
    for size in (24, 5):
        batch = make_batch(TinyModel())
        model, found = run(ppo, dataclasses.replace(adaptive, minibatch_size=size), batch=batch)
        with torch.no_grad():
            wanted = k3(model(batch).logp - batch.old_logp)[batch.mask].mean()
        assert found["train/kl_after"] == pytest.approx(float(wanted), rel=1e-4)
        assert found["train/kl_after"] > found["train/approx_kl"]


def test_adaptive_kl_beta_doubles_and_halves():
    assert ppo.next_kl_beta(1.0, 0.05, 0.01) == 2.0
    assert ppo.next_kl_beta(1.0, 0.005, 0.01) == 0.5
    assert ppo.next_kl_beta(1.0, 0.01, 0.01) == 1.0


def test_same_seed_same_bits():
    settings = PPOSettings(num_epochs=3, minibatch_size=7)
    a, _ = run(ppo, settings)
    b, _ = run(ppo, copy.deepcopy(settings))
    c, _ = run(ppo, settings, seed=1)
    assert torch.equal(weights(a), weights(b))
    assert not torch.equal(weights(a), weights(c))
