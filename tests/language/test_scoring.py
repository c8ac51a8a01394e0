"""Functions and a reward model judge together; no column is lost and no score is made up."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from language.test_collect import experienced
from language.test_reward_model import preferences
from language.test_roles import PROMPTS, settings
from language.tiny import saved, tiny_llama, tokenizer

from tightrope.language.reward.call import RewardError
from tightrope.language.reward.functions import Rewards
from tightrope.language.reward.judge import Judge, make_judge, shares_trunk
from tightrope.language.settings import RewardSettings
from tightrope.language.supervised.preferences import train_reward

ASKED = [prompt for prompt in PROMPTS for _ in range(2)]


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    """Roles and their six sampled responses."""
    return experienced(settings(saved(tmp_path_factory.mktemp("model"))))


def model_of(*scores):
    """A reward model that gives these scores."""
    return SimpleNamespace(score=lambda tokens, real: torch.tensor(scores))


def reward_model(completions):
    return [1.0] * len(completions)


def test_a_function_called_like_the_reward_model_keeps_its_column(sampled):
    roles, experience = sampled
    scores = Judge(roles, Rewards([reward_model]), model_of(*range(6)))(ASKED, experience)
    assert scores.total.tolist() == [1, 2, 3, 4, 5, 6]
    assert {name: part.tolist() for name, part in scores.parts.items()} == {
        "reward_model": [1.0] * 6,
        "reward_model_2": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
    }
    assert scores.metrics == {"scores/reward_model": 1.0, "scores/reward_model_2": 2.5}


def test_every_kind_of_reward_takes_a_weight(sampled):
    roles, experience = sampled
    one, other = make_judge(["length", reward_model], roles, on_trunk=None, timeout=None), make_judge(
        [("length", 0.5), (reward_model, -2)], roles, on_trunk=None, timeout=None
    )  # fmt: skip
    lengths = one(ASKED, experience).total - 1.0
    assert other(ASKED, experience).total == pytest.approx(0.5 * lengths - 2.0)
    scores = Judge(roles, Rewards([reward_model]), model_of(*range(6)), None, 0.5)(ASKED, experience)
    assert scores.total.tolist() == [1, 1.5, 2, 2.5, 3, 3.5]
    assert scores.parts["reward_model_2"].tolist() == [0, 1, 2, 3, 4, 5]  # a column is before its weight


def test_a_model_score_that_is_not_finite_masks_its_response_and_is_reported(sampled):
    roles, experience = sampled
    for functions, constant in ((None, 0.0), (Rewards([reward_model]), 1.0)):
        model = model_of(1.0, float("nan"), 3.0, float("inf"), 5.0, 6.0)
        scores = Judge(roles, functions, model)(ASKED, experience)
        assert scores.valid.tolist() == [True, False, True, False, True, True]
        assert np.array_equal(np.isnan(scores.total), ~scores.valid)
        assert scores.total[scores.valid].tolist() == [x + constant for x in (1.0, 3.0, 5.0, 6.0)]
        (fault,) = scores.faults
        assert (fault.kind, fault.samples) == ("not finite", (1, 3))
        assert "gave nan for sample 1 of 6 and 1 more" in fault.text
    with pytest.raises(RewardError, match="no finite score for any other: its weights are not usable"):
        Judge(roles, None, model_of(*[float("nan")] * 6))(ASKED, experience)


def test_where_no_function_applies_only_the_model_judges(sampled):
    """Also batch after batch: nothing is wrong then."""
    roles, experience = sampled
    rare = lambda completions: [None, 1.0, None, float("nan"), None, None]  # noqa: E731
    scores = Judge(roles, Rewards([rare], alone=False), model_of(*range(6)))(ASKED, experience)
    assert np.array_equal(scores.total, [0.0, 2.0, 2.0, np.nan, 4.0, 5.0], equal_nan=True)
    assert [fault.kind for fault in scores.faults] == ["not finite"]
    never = Judge(roles, Rewards([lambda completions: [None] * 6], alone=False), model_of(*range(6)))
    for _ in range(4):
        assert never(ASKED, experience).valid.all()


def test_functions_and_models_judge_the_very_tokens_that_were_sampled(sampled):
    """Decoded text may give other tokens when encoded again: here some ids have no word at all."""
    roles, experience = sampled
    seen = {}

    def spy(completion_ids, completions):
        seen.update(ids=completion_ids, texts=completions)
        return [0.0] * 6

    def score(tokens, real):
        seen["model"] = [row[kept].tolist() for row, kept in zip(tokens, real, strict=True)]
        return torch.zeros(6)

    Judge(roles, Rewards([spy]), SimpleNamespace(score=score))(ASKED, experience)
    assert seen["ids"] == experience.ids
    assert [roles.tokenizer(text)["input_ids"] for text in seen["texts"]] != seen["ids"]
    whole = [[*prompt.tokens, *ids] for prompt, ids in zip(ASKED, seen["ids"], strict=True)]
    assert seen["model"] == whole


def reward_folder(path: Path, **changes) -> str:
    """Somebody else's reward model, with the tiny tokenizer."""
    from transformers import LlamaForSequenceClassification

    config = tiny_llama(layers=1).config
    config.num_labels = 1
    LlamaForSequenceClassification(config).save_pretrained(path)
    made = tokenizer()
    if changes:
        made.add_tokens(["new"])
    made.save_pretrained(path)
    return str(path)


def test_what_cannot_judge_is_named(sampled, tmp_path):
    roles, _ = sampled
    good, other = reward_folder(tmp_path / "a"), reward_folder(tmp_path / "b", token=True)
    assert make_judge([good, reward_model], roles, on_trunk=None, timeout=None).functions.alone is False
    for reward, message in [
        ([good, good], "Two reward models were given"),
        (other, "reads .* tokens, the policy writes .* others"),
        (str(tmp_path), "is not a reward model"),
        (3, "reward is 3; expected a function"),
        ((good, "x"), "expected a finite number"),
    ]:
        with pytest.raises(ValueError, match=message):
            make_judge(reward, roles, on_trunk=None, timeout=None)
    config = json.loads((Path(good) / "config.json").read_text())
    assert config["architectures"] == ["LlamaForSequenceClassification"]


def test_an_adapter_shares_a_trunk_with_the_same_weights_wherever_they_are_stored(tmp_path):
    first = tmp_path / "model"
    saved(first, tiny_llama(2))
    given = RewardSettings(model=str(first), minibatch_size=4, max_tokens=16, held_out=0.0)
    train_reward(given, data=preferences(8), run_dir=tmp_path / "reward")
    adapter = tmp_path / "reward" / "adapter"
    assert shares_trunk(adapter, str(first))
    shutil.copytree(first, tmp_path / "copy")
    assert shares_trunk(adapter, str(tmp_path / "copy"))
    saved(first, tiny_llama(2, seed=1))  # the same place, other weights
    assert not shares_trunk(adapter, str(first))
