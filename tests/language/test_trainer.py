"""The loop of an alignment run: every part gets its own data, nothing twice and nothing stale."""

import math
import time

import numpy as np
import pytest
import torch
from language.tiny import saved, tiny_llama

from tightrope.algorithms import ppo
from tightrope.algorithms.descent import OutOfMemory
from tightrope.language.alignment.align import align
from tightrope.language.alignment.experience import batch_of, gather, to_scale
from tightrope.language.alignment.iteration import Trainer, hold_out_prompts
from tightrope.language.alignment.kl import adapted
from tightrope.language.alignment.ptx import Pretraining
from tightrope.language.data.examples import Prompt
from tightrope.language.model import lora
from tightrope.language.policy.policy_model import PolicyModel
from tightrope.language.reward.call import RewardError
from tightrope.language.settings import KL_FORMS, AlignSettings, RewardSettings
from tightrope.language.supervised.preferences import train_reward
from tightrope.training.events import Listeners

PROMPTS = ["ab", "cde", "f", "ghij"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model that stops often, with responses of all lengths."""
    model = tiny_llama()
    model.generation_config.eos_token_id = [*range(3, 12)]
    return saved(tmp_path_factory.mktemp("model"), model)


def letters(completions, **_):
    return [sum(c in "abcdefghijklm" for c in text) / 6 for text in completions]


def nothing(completions, **_):
    return [0.0] * len(completions)


def trainer(folder, reward=letters, **values):
    usual = {
        "total_episodes": 32, "batch_size": 16, "minibatch_size": 8, "max_new_tokens": 6, "lora_rank": 4,
        "learning_rate": 1e-2, "seed": 1,
    }  # fmt: skip
    settings = AlignSettings(model=folder).with_values(**{**usual, **values})
    return Trainer(settings, PROMPTS, reward, None, Listeners())


def shaken(made):
    """The same trainer with a policy that has left the reference."""
    generator = torch.Generator().manual_seed(1)
    for parameter in lora.adapter_parameters(made.roles.model, "policy"):
        parameter.data += 0.04 * torch.randn(parameter.shape, generator=generator)
    return made


@pytest.mark.parametrize("form", KL_FORMS)
def test_where_nothing_is_to_be_earned_the_kl_leads_back_to_the_reference(folder, form):
    """The sign of the KL: with the wrong sign the policy would move away from the reference."""
    made = shaken(
        trainer(folder, nothing, kl=form, kl_beta=1.0, total_episodes=320, batch_size=64, learning_rate=3e-3)
    )
    found = [metrics["objective/kl_exact"] for metrics in (update.metrics for update in made.iterate())]
    assert found[0] > 0.2 and found[-1] < 0.7 * found[0], found


def test_kl_beta_follows_the_kl_of_whole_responses_once_a_rollout(folder):
    """The goal is close to the KL, so that the error is not clipped and its size reveals the input."""
    still = {"total_episodes": 64, "learning_rate": 1e-6, "kl_beta": 0.2, "kl_horizon": 100.0}
    first = next(shaken(trainer(folder, **still)).iterate()).metrics
    goal = 0.95 * first["objective/kl"]
    made, kl_beta = shaken(trainer(folder, kl_goal=goal, **still)), 0.2
    for metrics in (update.metrics for update in made.iterate()):
        assert metrics["objective/kl_beta"] == pytest.approx(kl_beta)
        kl_beta = adapted(kl_beta, metrics["objective/kl"], 16, target=goal, horizon=100.0)
        assert made.kl_beta == pytest.approx(kl_beta) and made.kl_beta != 0.2


@pytest.mark.parametrize("tune, critic", [("lora", "head"), ("lora", "adapter"), ("full", "separate")])
def test_every_weight_of_the_critic_is_trained(folder, tune, critic):
    made = trainer(folder, tune=tune, critic=critic, critic_learning_rate=1e-2)
    before = [p.detach().clone() for p in made.roles.critic_parameters()]
    for _ in made.iterate():
        pass
    after = made.roles.critic_parameters()
    assert before and not any(torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("form", ["exact-split", "k2-loss"])
def test_micro_batches_change_no_metric(folder, form):
    values = {"kl": form, "num_epochs": 1, "total_episodes": 16, "kl_beta": 0.5, "value_clip": 0.2}
    found = []
    for micro in (None, 3):
        made = shaken(trainer(folder, micro_batch_size=micro, **values))
        metrics = next(made.iterate()).metrics
        found.append({name: x for name, x in metrics.items() if name[:5] != "time/"})
    assert found[0] == pytest.approx(found[1], rel=1e-2, abs=1e-4)
    assert found[0]["train/kl_loss"] > 0.05


def test_the_pass_that_the_rollout_keeps_changes_no_metric(folder, monkeypatch):
    """Batches of one pass: three iterations, with and without the rollout's pass as the first one."""
    values = {"minibatch_size": 16, "num_epochs": 2, "total_episodes": 48, "critic_warmup": 1}
    taken, found = [], []
    init = PolicyModel.__init__
    counted = lambda *a, first_pass=None, **k: (  # noqa: E731
        taken.append(first_pass is not None) or init(*a, first_pass=first_pass, **k)
    )
    monkeypatch.setattr(PolicyModel, "__init__", counted)
    for micro in (None, 16):
        made = shaken(trainer(folder, micro_batch_size=micro, **values))
        rows = [update.metrics for update in made.iterate()]
        found.append([{name: x for name, x in row.items() if name[:5] != "time/"} for row in rows])
    assert taken == [False, True, True, False, False, False]  # never while only the critic warms up
    for kept, own in zip(*found, strict=True):
        assert kept == pytest.approx(own, rel=1e-2, abs=1e-3)


@pytest.mark.parametrize("tune, critic", [("lora", "head"), ("lora", "adapter"), ("full", "separate")])
def test_a_kept_pass_moves_with_the_scale_of_returns_and_so_do_its_gradients(folder, tune, critic):
    """Its graph was made with the head from before: values and gradients are those of a pass with the new."""
    made = trainer(folder, minibatch_size=16, tune=tune, critic=critic, total_episodes=48)
    next(made.iterate())
    parameters = made.roles.parameters()
    experience = gather(made.roles, made.prompts * 4, 5, 0, 1, keep=True)
    valid, rewards = torch.ones(16, dtype=torch.bool), torch.full_like(experience.values, 40.0)
    batch = batch_of(experience, rewards, valid, made.settings, made.return_scale)
    before, found = made.return_scale, []
    batch, made.return_scale = to_scale(batch, experience, before, made.roles.critic_head)
    assert made.return_scale.deviation > 3 * before.deviation > 0
    for first_pass in (experience.first_pass, None):
        now = PolicyModel(made.roles, first_pass=first_pass)(batch)
        values = torch.where(batch.mask, now.values, 0.0)
        gradients = torch.autograd.grad(
            (values - batch.returns).square()[batch.mask].sum(), parameters, allow_unused=True,
            materialize_grads=True,
        )  # fmt: skip
        found.append([values, *gradients])
        real = torch.where(batch.mask, made.return_scale.values(values) - before.values(experience.values), 0)
        assert float(real.detach().abs().max()) < 1e-4
    for kept, own in zip(*found, strict=True):
        torch.testing.assert_close(kept, own, rtol=1e-3, atol=1e-4)


def test_the_critic_learns_returns_of_any_size_alike(folder):
    found = []
    for scale in (1e-6, 1e6):
        made = trainer(
            folder, reward_scale=scale, kl_beta=0.0, total_episodes=320, critic_warmup=20, gae_lambda=1.0
        )
        shown = [update.metrics for update in made.iterate()]
        explained = [row["train/explained_variance"] for row in shown]
        found.append([*explained, shown[-1]["train/return_mean"] / scale, shown[-1]["train/value_loss"]])
    assert np.mean(found[0][10:20]) > 0.1
    assert found[0] == pytest.approx(found[1], rel=1e-2, abs=1e-3)


def test_a_new_critic_counts_for_nothing_and_none_has_no_scale(folder):
    assert trainer(folder).return_scale.deviation == 0
    assert trainer(folder, normalise_values=False).return_scale is None
    assert trainer(folder, critic="none", samples_per_prompt=2).return_scale is None


@pytest.mark.parametrize("micro", [1, 3, 5])
def test_the_pretraining_loss_adds_up_over_micro_batches(folder, tmp_path, micro):
    """Texts of very different lengths: a part's mean weighs otherwise than the minibatch's. So does the
    metric, a mean over the tokens of the texts.
    """
    texts = tmp_path / "texts.txt"
    texts.write_text("ab\nbcdefghijklmnopqrst\ncd\nxyzxyzxyz\n")
    found, booked = [], []
    for size in (None, micro):
        made = trainer(folder, micro_batch_size=size, minibatch_size=16, ptx_weight=27.8, ptx_data=str(texts),
                       ptx_per_response=2, max_grad_norm=None, num_epochs=1)  # fmt: skip
        gradients = []
        made.optimiser.register_step_pre_hook(
            lambda *_, made=made, gradients=gradients: gradients.append(
                torch.cat([p.grad.flatten() for p in made.roles.parameters() if p.grad is not None])
            )
        )
        booked.append(next(made.iterate()).metrics["train/ptx_loss"])
        found.append(gradients[0])
    assert float((found[0] - found[1]).norm()) <= 1e-4 * float(found[0].norm())
    assert booked[1] == pytest.approx(booked[0], rel=1e-5)


def test_a_pass_that_memory_ends_is_repeated_with_the_same_pretraining_texts(folder, tmp_path, monkeypatch):
    texts = tmp_path / "texts.txt"
    texts.write_text("\n".join("abcdefghijklmnopqrst"[: 3 + k] for k in range(16)))
    real, found = Pretraining.loss, []
    for fails in (False, True):
        made = shaken(trainer(folder, minibatch_size=8, ptx_weight=27.8, ptx_data=str(texts), num_epochs=2,
                              ptx_per_response=2, max_grad_norm=None))  # fmt: skip
        learnt, gradients, left = [], [], [1] if fails else []

        def loss(self, chosen, learnt=learnt, left=left):
            result = real(self, chosen)
            if learnt and left:  # in the second minibatch, after its texts were looked at
                left.pop()
                raise MemoryError
            learnt.append(chosen)
            return result

        monkeypatch.setattr(Pretraining, "loss", loss)
        made.optimiser.register_step_pre_hook(
            lambda *_, made=made, gradients=gradients: gradients.append(
                torch.cat([p.grad.flatten() for p in made.roles.parameters() if p.grad is not None])
            )
        )
        metrics = next(made.iterate()).metrics
        assert not left and ("train/memory_halvings" in metrics) == fails
        found.append((torch.cat(learnt), gradients, made.pretraining.rng.bit_generator.state))
    (plain, steps, state), (again, steps_again, state_again) = found
    assert torch.equal(plain, again) and len(plain.unique()) > 10 and state == state_again
    assert len(steps) == 4
    for one, other in zip(steps, steps_again, strict=True):
        assert float((one - other).norm()) <= 1e-3 * float(one.norm())


def test_whitening_leaves_the_reward_metrics_in_units_of_the_score(folder, monkeypatch):
    """Without a score all of the reward is the KL's; whitened, one was divided and the other not."""
    from tightrope.language.alignment import iteration as module

    made = shaken(trainer(folder, reward=nothing, whiten_rewards=True, kl_beta=0.5))
    scales, whole = [], module.rewards_of

    def seen(*arguments):
        found = whole(*arguments)
        scales.append(found.scale)
        return found

    monkeypatch.setattr(module, "rewards_of", seen)
    metrics = next(made.iterate()).metrics
    assert scales and 1.0 not in scales
    share = metrics["objective/non_score_reward"]
    assert share == pytest.approx(-0.5 * metrics["objective/kl"], rel=1e-5)
    assert metrics["objective/rlhf_reward"] == pytest.approx(share, rel=1e-5)


def test_held_out_prompts_are_never_trained_on_not_even_twins():
    prompts = [Prompt((k % 9,), str(k), {}) for k in range(30)]
    kept, held = hold_out_prompts(prompts, 2)
    assert len(held) == 2 and not {p.tokens for p in held} & {p.tokens for p in kept}
    assert len(hold_out_prompts(prompts, 100)[1]) == 2  # a quarter of nine different ones
    with pytest.raises(ValueError, match="3 different prompts"):
        hold_out_prompts(prompts[:3] * 4, 1)


def test_the_settings_of_the_update_reach_the_update(folder, monkeypatch):
    values = {
        "dual_clip": 3.0, "clip": 0.1, "clip_high": 0.3, "value_clip": 0.4, "value_weight": 0.7,
        "entropy_weight": 0.01, "max_grad_norm": 0.5, "num_epochs": 2, "target_kl": 0.9,
        "micro_batch_size": 5, "adam_eps": 1e-4, "critic_learning_rate": 1e-3,
    }  # fmt: skip
    seen, real = [], ppo.update

    def spy(model, optimiser, batch, settings, *rest, **more):
        seen.append((settings, optimiser))
        return real(model, optimiser, batch, settings, *rest, **more)

    monkeypatch.setattr(ppo, "update", spy)
    made = trainer(folder, total_episodes=16, **values)
    (_,) = made.iterate()
    ((settings, optimiser),) = seen
    assert {name: getattr(settings, name) for name in values} == values and settings.gamma == 1.0
    assert [group["lr"] for group in optimiser.param_groups] == [1e-2, 1e-3]
    assert {group["eps"] for group in optimiser.param_groups} == {1e-4}


@pytest.mark.parametrize("critic", ["adapter", "separate"])
@pytest.mark.parametrize("tune", ["lora", "full"])
def test_a_critic_made_of_the_reward_model_begins_with_its_scores(folder, tmp_path, critic, tune):
    rows = [{"prompt": "ab", "chosen": "x" * n, "rejected": "y" * n} for n in range(1, 9)]
    values = {"tune": tune, "lora_rank": 4, "max_tokens": 32, "learning_rate": 1e-2, "threads": 1}
    train_reward(RewardSettings(model=folder, **values), data=rows, run_dir=tmp_path / "run")
    reward = str(tmp_path / "run")
    if (critic, tune) == ("adapter", "full"):
        with pytest.raises(ValueError, match="critic separate"):
            trainer(folder, reward, critic=critic, critic_from_reward=True)
        return
    shaped = {"critic_from_reward": True, "reward_scale": 3.0}
    made = trainer(folder, (reward, -0.5), critic=critic, **shaped)
    experience = gather(made.roles, made.prompts, 1, 0, 1)
    scores = made.judge(made.prompts, experience)
    values = made.return_scale.values(experience.final_values)
    np.testing.assert_allclose(values.numpy(), 3.0 * scores.total, rtol=1e-3, atol=1e-3)
    assert scores.total.std() > 0.01


def test_a_head_on_the_policy_cannot_be_made_of_a_reward_model(folder, tmp_path):
    with pytest.raises(ValueError, match="critic 'head': expected the folder"):
        trainer(folder, critic="head", critic_from_reward=True)
    with pytest.raises(ValueError, match="expected the folder of a reward model"):
        trainer(folder, letters, critic="separate", critic_from_reward=True)


def test_held_out_prompts_are_answered_as_many_at_a_time_as_a_batch_has(folder, monkeypatch):
    """The memory ledger counts on it."""
    from tightrope.language.alignment import iteration as module

    sizes, real = [], module.respond
    monkeypatch.setattr(module, "respond", lambda roles, prompts, *more: (
        sizes.append(len(prompts)), real(roles, prompts, *more))[1])  # fmt: skip
    settings = AlignSettings(model=folder, batch_size=4, max_new_tokens=3, held_out_prompts=10)
    made = Trainer(
        settings, [chr(97 + k % 26) * (1 + k // 26) for k in range(44)], letters, letters, Listeners()
    )
    found = made.gold_scores()
    assert sizes == [4, 4, 2] and len(made.held_out) == 10 and 0 <= found["eval/gold"] <= 1


def test_responses_without_a_gold_score_are_reported_and_counted(folder):
    """With a message, because the mean covers only some of the responses."""
    lines, prompts = [], [chr(97 + k % 26) * (1 + k // 26) for k in range(40)]
    settings = AlignSettings(model=folder, batch_size=8, max_new_tokens=3, held_out_prompts=8)

    report = Listeners([lambda event: lines.append(str(event))])

    def choosy(completions, **_):
        return [math.nan if k % 4 == 0 else 1.0 for k in range(len(completions))]

    made = Trainer(settings, prompts, letters, choosy, report)
    for _ in range(2):
        assert made.gold_scores() == {"eval/gold": 1.0, "eval/gold_masked": 2.0}
    assert sum("gold judge" in line and "choosy" in line for line in lines) == 1
    made = Trainer(settings, prompts, letters, lambda completions, **_: [None] * len(completions), report)
    with pytest.raises(RewardError, match="^The gold judge: Not one response"):
        for _ in range(3):
            made.gold_scores()


def test_a_run_without_one_step_reports_it(folder, tmp_path):
    lines = []
    run = align(
        model=folder, prompts=["ab", "cd"], reward=lambda completions, **_: [None] * len(completions),
        total_episodes=8, batch_size=4, max_new_tokens=3, run_dir=tmp_path / "run",
        listeners=[lambda event: lines.append(str(event))],
    )  # fmt: skip
    assert len(run.metrics) == 2 and any("not one step was taken" in line for line in lines)


def test_no_reward_is_no_folder(folder):
    with pytest.raises(ValueError, match="There is no reward"):
        trainer(folder, reward="")


def test_memory_that_is_short_for_scoring_names_the_setting(folder, monkeypatch):
    made = trainer(folder)
    monkeypatch.setattr(
        type(made.judge), "_of_model", lambda *_: (_ for _ in ()).throw(torch.OutOfMemoryError("CUDA"))
    )
    with pytest.raises(OutOfMemory, match="--micro-batch-size"):
        next(made.iterate())


def test_too_little_memory_for_a_kept_pass_is_reported_once(folder, monkeypatch):
    """From then on no pass is kept: the checkpoint stores the micro-batch size, which implies it."""
    from tightrope.language.alignment import experience as collect

    lines, looks, whole = [], [], collect._evaluate

    def short(*args):
        looks.append(torch.is_grad_enabled())
        if looks[-1]:
            raise torch.OutOfMemoryError("CUDA")
        return whole(*args)

    monkeypatch.setattr(collect, "_evaluate", short)
    made = trainer(folder, minibatch_size=16, total_episodes=48)
    made.listeners.add(lambda event: lines.append(getattr(event, "text", "")))
    assert len(list(made.iterate())) == 3 and looks == [True, False, False, False]
    assert made.micro_batch_size == 16 and sum("memory ran out" in line for line in lines) == 1


def test_the_clock_of_a_run_leaves_evaluations_out(folder, tmp_path):
    def slow(completions, **_):
        time.sleep(0.3)
        return [0.0] * len(completions)

    settings = AlignSettings(model=folder, batch_size=4, max_new_tokens=3, total_episodes=4)
    begin = time.perf_counter()
    run = align(settings, prompts=list("abcdefgh"), reward=letters, gold=slow, run_dir=tmp_path / "run")
    [metrics] = run.metrics
    assert "eval/gold" in metrics and metrics["time/seconds"] <= time.perf_counter() - begin - 0.3
    assert metrics["time/update_seconds"] < metrics["time/seconds"]
