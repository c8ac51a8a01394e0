"""Language: endless and empty responses, bad numbers of a role, memory, faulty rewards."""

import asyncio
import json
import math
import time
import weakref

import numpy as np
import pytest
import torch
from language.tiny import VOCABULARY, saved, tiny_llama

from tightrope.algorithms.descent import OutOfMemory
from tightrope.algorithms.nonfinite import NonFiniteError
from tightrope.language.alignment.iteration import Trainer
from tightrope.language.reward.functions import RewardError, Rewards
from tightrope.language.settings import AlignSettings
from tightrope.training.events import Listeners


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("model"))


def trainer(folder, **values):
    usual = {
        "total_episodes": 16, "batch_size": 8, "minibatch_size": 8, "max_new_tokens": 5, "lora_rank": 2,
        "num_epochs": 1, "learning_rate": 1e-3,
    }  # fmt: skip
    settings = AlignSettings(model=folder).with_values(**{**usual, **values})
    return Trainer(settings, ["ab", "cde", "f"], "length", None, Listeners())


def trained(made):
    return torch.cat([p.detach().flatten().clone() for p in made.roles.parameters()]).nan_to_num()


# ------------------------------------------------------------------------------------ endless and empty


def with_stops(path, stops):
    model = tiny_llama()
    model.generation_config.eos_token_id = stops
    return saved(path, model)


@pytest.mark.parametrize("kl", ["k1-reward", "exact-split"])
@pytest.mark.parametrize("critic", ["head", "none"])
@pytest.mark.parametrize(
    ("what", "stops", "tokens", "length", "cut"),
    [
        ("never an end", None, 5, 5.0, 1.0),
        ("an end at once", list(range(VOCABULARY)), 5, 1.0, 0.0),
        ("one token, no end", None, 1, 1.0, 1.0),
        ("one token, an end", list(range(VOCABULARY)), 1, 1.0, 0.0),
    ],
)
def test_responses_without_end_and_without_text_train(tmp_path, what, stops, tokens, length, cut, critic, kl):
    source = with_stops(tmp_path / "model", stops or [3])
    more = {"samples_per_prompt": 2} if critic == "none" else {}
    made = trainer(source, max_new_tokens=tokens, ignore_eos=stops is None, critic=critic, kl=kl, **more)
    for metrics, rows in ((u.metrics, u.samples) for u in made.iterate()):
        assert metrics["objective/truncated_fraction"] == cut == 1.0 - metrics["objective/eos_fraction"]
        assert metrics["objective/response_length"] == length
        assert math.isfinite(metrics["train/policy_gradient_loss"])
        assert math.isfinite(metrics["train/grad_norm"]) and metrics["train/log_ratio_first"] <= 1e-4
        assert len(rows) == 8
    assert bool(torch.isfinite(trained(made)).all())


# ------------------------------------------------------------------------------------------- bad numbers


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("site", "words"),
    [
        (
            "weight",
            r"log-probability of sampling.* is nan; .* the weight model.layers.0.*\[0, 0\] is -?(nan|inf)",
        ),
        ("value", r"The value of response, token \[0, 0\] is -?(nan|inf); .*critic_head.*bias\[0\]"),
        ("reward", r"The (advantage|return) \(row, step, ...\)\[\d, \d\] is -?(nan|inf)"),
        (
            "gradient",
            r"Data and outputs are finite, but the gradient of .*q_proj.down.policy\[0, 0\] is -?(nan|inf)",
        ),
    ],
)
def test_a_bad_number_is_named_before_the_step(folder, site, words, bad, monkeypatch):
    from tightrope.language.alignment import iteration as module

    made = trainer(folder)
    if site == "weight":
        with torch.no_grad():
            next(p for n, p in made.roles.model.named_parameters() if "q_proj" in n).data[0, 0] = bad
    if site == "value":
        with torch.no_grad():
            made.roles.critic_head.bias.data[0] = bad
    if site == "reward":
        whole = module.rewards_of

        def poisoned(experience, *arguments):
            found = whole(experience, *arguments)
            found.rewards[2, 0] = bad
            return found

        monkeypatch.setattr(module, "rewards_of", poisoned)
        made.settings = made.settings.with_values(normalise_advantages=False)
    if site == "gradient":

        def poison(gradient):
            gradient = gradient.clone()
            gradient[0, 0] = bad
            return gradient

        made.roles.parameters()[0].register_hook(poison)
    before = trained(made)
    with pytest.raises(NonFiniteError, match=words):
        next(made.iterate())
    assert torch.equal(trained(made), before)


# ------------------------------------------------------------------------------------------------ memory


def test_a_minibatch_that_does_not_fit_is_halved_reported_and_remembered(folder, monkeypatch):
    from tightrope.language.alignment import iteration as module

    results = []
    for fits in (100, 3):
        made, lines = trainer(folder, total_episodes=24), []
        made.listeners.add(lambda event, lines=lines: lines.append(event.text))
        whole, sizes = module.PolicyModel.__call__, []

        def asked(self, part, fits=fits, sizes=sizes, whole=whole):
            sizes.append(len(part))
            if len(part) > fits:
                raise torch.OutOfMemoryError("CUDA out of memory.")
            return whole(self, part)

        with monkeypatch.context() as patch:
            patch.setattr(module.PolicyModel, "__call__", asked)
            rows = [update.metrics for update in made.iterate()]
        results.append(trained(made))
        if fits == 3:
            assert sizes == [8, 4, 2, 2, 2, 2] + [2] * 8  # tried once, remembered for the rest of the run
            assert [row.get("train/memory_halvings") for row in rows] == [2.0, None, None]
            told = [line for line in lines if "memory ran out" in line]
            assert len(told) == 1 and "--micro-batch-size 2" in told[0]
    torch.testing.assert_close(*results, rtol=0, atol=1e-5)


def test_sampling_that_does_not_fit_ends_with_advice(folder, monkeypatch):
    from tightrope.language.alignment import experience as collect

    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")

    monkeypatch.setattr(collect, "sample", full)
    with pytest.raises(OutOfMemory, match="8 responses at once .*20.00 GiB.*--batch-size"):
        next(trainer(folder).iterate())


def test_a_rollout_whose_gradients_do_not_fit_continues_without_keeping_them(folder, monkeypatch):
    from tightrope.language.alignment import experience as collect
    from tightrope.language.policy.policy_model import PolicyModel

    whole, init, results, kept = collect._evaluate, PolicyModel.__init__, [], []

    def full(*arguments):
        if torch.is_grad_enabled():
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return whole(*arguments)

    counted = lambda *a, first_pass=None, **k: (  # noqa: E731
        kept.append(first_pass is not None) or init(*a, first_pass=first_pass, **k)
    )
    monkeypatch.setattr(PolicyModel, "__init__", counted)
    for look in (whole, full):
        monkeypatch.setattr(collect, "_evaluate", look)
        made = trainer(folder)
        assert len(list(made.iterate())) == 2
        results.append(trained(made))
    assert kept == [True, True, False, False]
    torch.testing.assert_close(*results, rtol=0, atol=1e-4)


def test_a_pass_that_failed_for_memory_is_held_by_nothing(folder, monkeypatch):
    """The graph of the rollout's pass is freed before the minibatch is repeated in halves."""
    from tightrope.language.alignment import iteration as module

    made, graphs, alive = trainer(folder, total_episodes=8, kl="exact-split"), [], []
    loss, gather = module.kl_loss, module.gather

    def remembered(*arguments, **how):
        experience = gather(*arguments, **how)
        graphs.extend(weakref.ref(x) for x in vars(experience.first_pass).values())
        return experience

    def full(*arguments):
        if not alive:
            alive.append(None)
            raise torch.OutOfMemoryError("CUDA out of memory.")
        alive.append(sum(graph() is not None for graph in graphs))
        return loss(*arguments)

    monkeypatch.setattr(module, "gather", remembered)
    monkeypatch.setattr(module, "kl_loss", full)
    next(made.iterate())
    assert len(graphs) == 4 and alive[1:] == [0] * len(alive[1:]) and len(alive) >= 3


# ------------------------------------------------------------------------------------------------ rewards


def hangs(completions, **_):
    time.sleep(3)


async def hangs_async(completions, **_):
    await asyncio.sleep(30)


def raises(completions, **_):
    raise KeyError("no such answer")


async def raises_async(completions, **_):
    raise KeyError("no such answer")


KINDS = {
    "raises": (raises, "errors", 4),
    "raises, async": (raises_async, "errors", 4),
    "hangs": (hangs, "timeouts", 4),
    "hangs, async": (hangs_async, "timeouts", 4),
    "too few": (lambda completions, **_: [1.0], "errors", 4),
    "None": (lambda completions, **_: None, "errors", 4),
    "text": (lambda completions, **_: ["1.0"] * 4, "errors", 4),
    "a matrix": (lambda completions, **_: torch.ones(4, 2), "errors", 4),
    "NaN in a tensor": (lambda completions, **_: torch.tensor([1.0, torch.nan, 2.0, 3.0]), "errors", 1),
    "infinity in an array": (lambda completions, **_: np.array([1.0, np.inf, 2.0, -np.inf]), "errors", 2),
    "one sample": (lambda completions, **_: [1.0, "?", 2.0, 3.0], "errors", 1),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_faulty_reward_masks_and_counts_and_another_one_stays_what_it_is(kind):
    function, counter, count = KINDS[kind]
    good = lambda completions, **_: [1.0] * len(completions)  # noqa: E731
    rewards = Rewards([function, good], names=["bad", "good"], timeout=0.3, on_error="mask")
    begin = time.monotonic()
    scores = rewards.score(["p"] * 4, ["c"] * 4, [[1]] * 4)
    assert time.monotonic() - begin < 2
    assert scores.metrics[f"rewards/bad/{counter}"] == count
    assert not [name for name in scores.metrics if name.startswith("rewards/good")]
    assert (~scores.valid).sum() == count and np.isnan(scores.total[~scores.valid]).all()
    from tightrope.metrics.table import check_names

    check_names(scores.metrics)
    with pytest.raises(RewardError, match="'bad'"):
        Rewards([function], names=["bad"], timeout=0.3, on_error="raise").score(
            ["p"] * 4, ["c"] * 4, [[1]] * 4
        )


@pytest.mark.parametrize("values", [torch.arange(4), np.arange(4.0), (0, 1, 2, 3), [0, True, np.int64(2), 3]])
def test_tensors_arrays_and_tuples_are_scores(values):
    scores = Rewards([lambda completions, **_: values]).score(["p"] * 4, ["c"] * 4, [[1]] * 4)
    assert scores.total.tolist() == [0.0, 1.0, 2.0, 3.0] and scores.valid.all()
    assert not [name for name in scores.metrics if name.startswith("rewards/")]


@pytest.mark.parametrize("critic", ["head", "none"])
def test_batches_without_a_score_teach_nothing_and_the_run_continues(folder, critic):
    calls, scored = [0], [4.0] * 8

    def late(completions, **_):
        calls[0] += 1
        return [math.nan] * 8 if calls[0] <= 2 else [x + k for k, x in enumerate(scored)]

    made = trainer(folder, total_episodes=32, critic=critic, kl_goal=1.0, samples_per_prompt=2)
    made.judge = Trainer(made.settings, ["ab", "cde", "f"], late, None, Listeners()).judge
    before, seen = trained(made), []
    for metrics, rows in ((u.metrics, u.samples) for u in made.iterate()):
        seen.append((metrics["objective/masked_samples"], torch.equal(trained(made), before)))
        assert len(rows) == 8 and ("train/grad_norm" in metrics) == (metrics["objective/masked_samples"] == 0)
    assert seen == [(8.0, True), (8.0, True), (0.0, False), (0.0, False)]


@pytest.mark.parametrize("critic", ["head", "none"])
def test_a_run_that_never_gets_a_score_ends_with_the_last_reason(folder, critic, tmp_path):
    from tightrope.language import align

    silence = lambda completions, **_: [math.nan] * len(completions)  # noqa: E731
    with pytest.raises(RewardError, match="last 3 batches.*nan"):
        align(
            model=folder, prompts=["ab", "cde"], reward=silence, run_dir=tmp_path / "run", total_episodes=32,
            batch_size=8, minibatch_size=8, max_new_tokens=4, critic=critic, samples_per_prompt=2,
        )  # fmt: skip
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [8, 16]
    assert [row["objective/masked_samples"] for row in rows] == [8.0, 8.0]
