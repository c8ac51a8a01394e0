"""Reward functions: called as in TRL; whatever they return, no wrong number results."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import math
import sys
import threading
import time
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tightrope.language.reward.functions import RewardError, Rewards, length, load_reward_function
from tightrope.metrics.table import check_names

PROMPTS = ["The sky is", "The sun is", "The sea is"]
TEXTS = [" blue.", " in the sky.", " deep!"]
IDS = [[1, 2], [3, 4, 5, 6], [7, 8, 9]]
SOON = 0.2


def score(*functions, columns=None, **settings):
    """The scores of the three texts."""
    return Rewards(functions, **settings).score(PROMPTS, TEXTS, IDS, columns)


def constant(*values):
    """A reward function that always returns this list."""
    return lambda **_: list(values)


# ------------------------------------------------------------------------------------- what it is given


def test_every_argument_of_trl_is_passed_by_keyword():
    seen = {}

    def reward(
        *, prompts, completions, completion_ids, trainer_state, log_extra, log_metric, answer, **columns
    ):
        seen.update(locals())
        return [0.5] * len(completions)

    state = object()
    rewards = Rewards([reward])
    found = rewards.score(PROMPTS, TEXTS, IDS, {"answer": [1, 2, 3], "level": "abc"}, state)
    assert (seen["prompts"], seen["completions"], seen["completion_ids"]) == (PROMPTS, TEXTS, IDS)
    assert seen["trainer_state"] is state
    assert seen["answer"] == [1, 2, 3] and seen["columns"] == {"level": ["a", "b", "c"]}
    assert found.total.tolist() == [0.5, 0.5, 0.5] and found.valid.all()


def test_a_function_gets_only_what_its_signature_takes():
    def counts(completions):
        return [c.count("!") for c in completions]

    def second(completion_ids, *args, scale=2.0):
        return [scale * len(ids) + len(args) for ids in completion_ids]

    found = score(counts, second, columns={"answer": [1, 2, 3], "args": [1, 2, 3]})
    assert found.parts["counts"].tolist() == [0, 0, 1]
    assert found.parts["second"].tolist() == [4, 8, 6]


def test_chat_is_passed_as_messages():
    prompts = [[{"role": "user", "content": "Hi"}]]
    completions = [[{"role": "assistant", "content": "Hello!"}]]

    def reward(prompts, completions):
        return [
            p[0]["content"] == "Hi" and c[0]["content"].count("!")
            for p, c in zip(prompts, completions, strict=True)
        ]

    assert Rewards([reward]).score(prompts, completions, [[1]]).total.tolist() == [1.0]


def test_what_one_function_changes_no_other_sees():
    def spoils(prompts, completions, completion_ids, answer, **_):
        completions[0][0]["content"] = ""
        prompts.clear()
        completion_ids[0].append(9)
        answer.pop()
        return [0.0]

    def reads(prompts, completions, completion_ids, answer, **_):
        return [len(prompts) + len(completions[0][0]["content"]) + len(completion_ids[0]) + len(answer)]

    completions = [[{"role": "assistant", "content": "abc"}]]
    found = Rewards([spoils, reads]).score(["p"], completions, [[1, 2]], {"answer": [7]})
    assert found.parts["reads"].tolist() == [1 + 3 + 2 + 1]
    assert completions == [[{"role": "assistant", "content": "abc"}]]


def test_the_prompt_column_is_not_passed_twice_and_other_clashes_are_named():
    assert score(length, columns={"prompt": PROMPTS, "completion": TEXTS}).valid.all()
    with pytest.raises(ValueError, match=r"column 'completions' has the name of an argument"):
        score(length, columns={"completions": TEXTS})


@pytest.mark.parametrize("on_error", ["mask", "raise", None])
def test_a_function_with_an_unknown_argument_gets_the_list_of_columns(on_error):
    def accuracy(completions, answers):
        return [0.0] * len(completions)

    with pytest.raises(RewardError, match=r"'accuracy' wants 'answers'\. Did you mean 'answer'\?.*prompts"):
        score(accuracy, columns={"answer": [1, 2, 3]}, on_error=on_error)


def test_positions_are_refused_as_arguments_are_passed_by_keyword():
    def reward(completions, /):
        return [0.0] * len(completions)

    with pytest.raises(RewardError, match="by position"):
        score(reward)


@pytest.mark.parametrize("name", ["completions", "completion_ids", "answer"])
def test_lists_of_another_length_are_refused(name):
    lists = {"completions": TEXTS, "completion_ids": IDS, "answer": [1, 2, 3]} | {name: [[1]]}
    with pytest.raises(ValueError, match=f"{name} has 1 entries, expected 3"):
        Rewards([length]).score(
            PROMPTS, lists["completions"], lists["completion_ids"], {"answer": lists["answer"]}
        )


# ------------------------------------------------------------------------------------- what comes back


@pytest.mark.parametrize(
    "values",
    [
        [1, 0, 2],
        (1.0, 0.0, 2.0),
        [True, False, Fraction(2)],
        np.array([1.0, 0.0, 2.0], np.float32),
        torch.tensor([1.0, 0.0, 2.0], dtype=torch.bfloat16, requires_grad=True),
        [torch.tensor(1), np.int64(0), np.float16(2)],
        range(1, 4),
    ],
    ids=str,
)
def test_all_kinds_of_numbers_are_read(values):
    expected = [1.0, 2.0, 3.0] if isinstance(values, range) else [1.0, 0.0, 2.0]
    found = score(lambda **_: values)
    assert found.total.tolist() == expected and found.total.dtype == np.float64


def test_a_generator_is_read():
    assert score(lambda completions: (len(c) for c in completions)).total.tolist() == [6, 12, 6]


score_or_none = st.none() | st.floats(-1e6, 1e6)


@given(
    rows=st.integers(1, 4).flatmap(
        lambda n: st.lists(st.lists(score_or_none, min_size=n, max_size=n), min_size=1, max_size=4)
    ),
    weights=st.lists(st.floats(-10, 10), min_size=4, max_size=4),
)
def test_the_total_is_the_weighted_sum_over_the_functions_that_apply(rows, weights):
    count = len(rows[0])
    functions = [(constant(*row), weight) for row, weight in zip(rows, weights, strict=False)]
    rewards = Rewards(functions, timeout=None)
    found = rewards.score(["p"] * count, ["c"] * count, [[1]] * count)
    for sample in range(count):
        given_ = [(w, row[sample]) for row, w in zip(rows, weights, strict=False) if row[sample] is not None]
        assert found.valid[sample] == bool(given_)
        expected = sum(w * value for w, value in given_) if given_ else math.nan
        assert found.total[sample] == pytest.approx(expected, rel=1e-9, abs=1e-6, nan_ok=True)
    for name, row in zip(rewards.names, rows, strict=True):
        expected = [math.nan if value is None else value for value in row]
        assert np.array_equal(found.parts[name], expected, equal_nan=True)


def test_a_sample_that_no_function_applies_to_is_masked_and_never_a_zero():
    found = score(constant(1.0, None, None), constant(None, 2.0, None))
    assert found.valid.tolist() == [True, True, False]
    assert math.isnan(found.total[2])
    assert [(fault.kind, fault.samples) for fault in found.faults] == [("none", (2,))]


@pytest.mark.parametrize(
    "bad", [math.nan, math.inf, -math.inf, 1e39, 10**400, torch.tensor(math.nan)], ids=str
)
def test_a_score_that_is_not_finite_masks_its_sample_despite_other_scores(bad):
    """1e39 is finite here, but infinite in float32, the type of training."""
    found = score(constant(1.0, bad, 3.0), length)
    assert found.valid.tolist() == [True, False, True]
    assert np.array_equal(found.total, [3.0, math.nan, 6.0], equal_nan=True)
    assert [(fault.kind, fault.samples) for fault in found.faults] == [("not finite", (1,))]
    with pytest.raises(RewardError, match=r"returned .* for sample 1 of 3 \(response ' in the sky\.'\)"):
        score(constant(1.0, bad, 3.0), on_error="raise")


@pytest.mark.parametrize(
    "values",
    [[1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [], np.zeros(2), torch.zeros(4), itertools.repeat(1.0)],
    ids=["short", "long", "empty", "array", "tensor", "endless"],
)
def test_a_wrong_number_of_scores_is_an_error_or_masks_the_batch(values):
    with pytest.raises(RewardError, match=r"'reward' returned \d scores, expected a list of 3"):
        score(lambda **_: values, names=["reward"])
    found = score(lambda **_: values, length, on_error="mask")
    assert not found.valid.any() and np.isnan(found.total).all()
    assert [fault.kind for fault in found.faults] == ["length"]


async def later():
    return [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    "make",
    [
        lambda: 1.0,
        lambda: None,
        lambda: "abc",
        lambda: b"abc",
        lambda: {0: 1.0, 1: 1.0, 2: 1.0},
        lambda: {1.0, 2.0, 3.0},
        lambda: np.zeros((3, 1)),
        lambda: torch.tensor(1.0),
        lambda: ["0.5", "1", "2"],
        lambda: [1.0, [2.0], 3.0],
        lambda: [1.0, 2j, 3.0],
        lambda: [1.0, np.zeros(1), 3.0],
        later,
    ],
)
def test_what_is_no_list_of_numbers_is_an_error_or_masks(make):
    with pytest.raises(RewardError, match="'reward' returned .*expected"):
        score(lambda **_: make(), names=["reward"])
    found = score(lambda **_: make(), on_error="mask")
    assert {fault.kind for fault in found.faults} == {"type"}
    assert not found.valid[1]


# ------------------------------------------------------------------------------------- what goes wrong


def fails(error):
    def reward(completions, **_):
        raise error

    return reward


@pytest.mark.parametrize("error", [KeyError("answer"), SystemExit(3), TimeoutError("no network")], ids=repr)
@pytest.mark.parametrize("timeout", [5.0, None])
def test_an_exception_is_reported_with_its_place_or_masks_the_batch(error, timeout):
    name = type(error).__name__
    with pytest.raises(RewardError, match=rf"'reward' raised {name}.*line \d+ of test_rewards.py") as caught:
        score(fails(error), timeout=timeout)
    assert caught.value.__cause__ is error
    found = score(fails(error), length, timeout=timeout, on_error="mask")
    assert not found.valid.any() and found.faults[0].kind == "exception"
    assert found.parts["length"].tolist() == [2, 4, 3]


def test_a_function_that_hangs_masks_its_samples_and_is_not_entered_again_before_it_is_back():
    release, entered = threading.Event(), []

    def hangs(completions):
        entered.append(len(entered))
        if len(entered) == 1:
            release.wait(20)
            return [-1.0] * len(completions)
        return [7.0] * len(completions)

    rewards = Rewards([hangs, length], timeout=SOON)
    start = time.monotonic()
    found = rewards.score(PROMPTS, TEXTS, IDS)
    assert time.monotonic() - start < 10 * SOON
    assert not found.valid.any() and found.faults[0].kind == "timeout"
    assert np.isnan(found.parts["hangs"]).all() and found.parts["length"].tolist() == [2, 4, 3]
    assert not rewards.score(PROMPTS, TEXTS, IDS).valid.any()
    assert entered == [0]
    release.set()
    third = rewards.score(PROMPTS, TEXTS, IDS)
    assert third.parts["hangs"].tolist() == [7.0, 7.0, 7.0], "the late answer to the first batch was not used"
    assert entered == [0, 1], "the batch that was given up before it began was not scored"


def test_a_run_in_which_nothing_can_be_scored_ends():
    rewards = Rewards([constant(None, None, None)])
    for _ in range(2):
        assert not rewards.score(PROMPTS, TEXTS, IDS).valid.any()
    with pytest.raises(RewardError, match="last 3 batches.*all returned None"):
        rewards.score(PROMPTS, TEXTS, IDS)


def test_one_scored_batch_restarts_the_count():
    answers = iter([[None], [None], [1.0], [None], [None]])
    rewards = Rewards([lambda **_: next(answers)])
    valid = [bool(rewards.score(["p"], ["c"], [[1]]).valid[0]) for _ in range(5)]
    assert valid == [False, False, True, False, False]


# ------------------------------------------------------------------------------------- async


def test_async_functions_run_together():
    """Each waits for the other: in sequence both would time out."""
    begun = []

    async def meet(completions, me):
        begun.append(me)
        while len(begun) < 2:
            await asyncio.sleep(0.005)
        return [float(me)] * len(completions)

    async def one(completions):
        return await meet(completions, 1)

    async def two(completions):
        return await meet(completions, 2)

    found = score(one, partial(two), length, timeout=5.0)
    assert found.total.tolist() == [3 + 2, 3 + 4, 3 + 3]


def test_an_object_called_by_a_coroutine_is_awaited():
    class Judge:
        async def __call__(self, completions):
            return [float(len(c)) for c in completions]

    assert score(Judge()).total.tolist() == [6, 12, 6]


def test_a_coroutine_that_hangs_makes_only_itself_late():
    cancelled = []

    async def hangs(completions):
        try:
            await asyncio.sleep(60)
        except asyncio.CancelledError:
            cancelled.append(True)
            raise

    async def quick(completions):
        return [1.0] * len(completions)

    rewards = Rewards([hangs, quick], timeout=SOON)
    found = rewards.score(PROMPTS, TEXTS, IDS)
    assert [fault.function for fault in found.faults] == ["hangs"]
    assert found.parts["quick"].tolist() == [1.0, 1.0, 1.0] and not found.valid.any()
    rewards.score(PROMPTS, TEXTS, IDS)
    assert cancelled


def test_scores_that_a_cancelled_coroutine_returns_are_not_used():
    async def stubborn(completions):
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(60)
        return [9.0] * len(completions)

    rewards = Rewards([stubborn], timeout=SOON)
    for _ in range(2):
        found = rewards.score(PROMPTS, TEXTS, IDS)
        assert [fault.kind for fault in found.faults] == ["timeout"] and not found.valid.any()


def test_a_coroutine_that_blocks_its_loop_does_not_block_us():
    release = threading.Event()

    async def blocks(completions):
        release.wait(20)
        return [1.0] * len(completions)

    rewards = Rewards([blocks], timeout=SOON)
    assert [fault.kind for fault in rewards.score(PROMPTS, TEXTS, IDS).faults] == ["timeout"]
    release.set()
    assert rewards.score(PROMPTS, TEXTS, IDS).valid.all()


def test_an_exception_in_a_coroutine_is_reported():
    async def breaks(completions):
        await asyncio.sleep(0)
        raise ValueError("no")

    async def cancels(completions):
        raise asyncio.CancelledError

    with pytest.raises(RewardError, match=r"'breaks' raised ValueError: no \(line \d+ of test_rewards.py\)"):
        score(breaks)
    with pytest.raises(RewardError, match="'cancels' raised CancelledError"):
        score(cancels)


def test_all_batches_share_one_event_loop():
    """A client that a function keeps belongs to the event loop in which it was created."""
    loops = []

    async def reward(completions):
        loops.append(asyncio.get_running_loop())
        return [0.0] * len(completions)

    rewards = Rewards([reward])
    for _ in range(2):
        rewards.score(PROMPTS, TEXTS, IDS)
    assert loops[0] is loops[1]


@pytest.mark.parametrize("timeout", [5.0, None])
def test_it_works_inside_an_event_loop_as_in_a_notebook(timeout):
    async def reward(completions):
        await asyncio.sleep(0)
        return [1.0] * len(completions)

    async def notebook():
        return score(reward, length, timeout=timeout)

    assert asyncio.run(notebook()).total.tolist() == [3, 5, 4]


# ------------------------------------------------------------------------------------- threads


def test_without_a_timeout_the_callers_thread_is_used():
    seen = []
    score(lambda completions: [seen.append(threading.get_ident()) or 0.0] * 3, timeout=None)
    assert seen == [threading.get_ident()]


def test_threads_end_with_the_rewards():
    async def slow(completions):
        return [0.0] * 3

    before = set(threading.enumerate())
    rewards = Rewards([length, slow])
    rewards.score(PROMPTS, TEXTS, IDS)
    begun = set(threading.enumerate()) - before
    assert len(begun) == 2 and all(thread.daemon for thread in begun)
    del rewards
    gc.collect()
    for thread in begun:
        thread.join(5)
        assert not thread.is_alive()


# ------------------------------------------------------------------------------------- logs and names


def test_what_functions_log_is_kept_under_declared_names():
    def first(completions, log_extra, log_metric):
        log_extra("words", [len(c.split()) for c in completions])
        log_metric("accuracy", 0.25)
        log_metric("accuracy", torch.tensor(0.75))
        return [1.0, None, 3.0]

    def second(completions, log_extra):
        log_extra("words", list("abc"))
        return [0.0] * 3

    found = score(first, second)
    assert found.extras == {"words": [1, 3, 1], "words (second)": ["a", "b", "c"]}
    assert found.metrics == {"scores/first": 2.0, "scores/second": 0.0, "logged/accuracy": 0.5}
    check_names(found.metrics)


def test_a_logged_column_of_another_length_is_an_error():
    def reward(completions, log_extra):
        log_extra("words", ["one"])
        return [0.0] * 3

    with pytest.raises(RewardError, match=r"log_extra\('words'\) got 1 entries, expected 3"):
        score(reward)


def test_functions_have_names_of_their_own():
    rewards = Rewards([length, (partial(length), 0.5), length, lambda **_: [], print])
    assert rewards.names == ["length", "length_2", "length_3", "lambda", "print"]
    assert rewards.weights == [1.0, 0.5, 1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Rewards([]), "no reward function"),
        (lambda: Rewards(["length"]), "expected a callable"),
        (lambda: Rewards([(length, math.nan)]), "finite"),
        (lambda: Rewards([length], names=["a", "b"]), "expected 1 different"),
        (lambda: Rewards([length, length], names=["a", "a"]), "expected 2 different"),
        (lambda: Rewards([length], timeout=0), "timeout is 0"),
        (lambda: Rewards([length], on_error="ignore"), "on_error"),
    ],
)
def test_bad_settings_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_an_empty_batch_has_no_scores_and_no_faults():
    found = Rewards([length]).score([], [], [])
    assert found.total.shape == (0,) and not found.faults


# ------------------------------------------------------------------------------------- from the command line


@pytest.fixture
def folder(tmp_path: Path):
    """A folder for reward files; their imports are removed afterwards."""
    path, modules = list(sys.path), set(sys.modules)
    yield tmp_path
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        with contextlib.suppress(KeyError):
            del sys.modules[name]


def test_length_counts_tokens():
    assert score(load_reward_function("length")).total.tolist() == [2, 4, 3]


def test_a_function_is_loaded_from_the_file_that_the_user_names(folder):
    (folder / "beside_it.py").write_text("FACTOR = 3\n")
    (folder / "judge.py").write_text(
        "from dataclasses import dataclass\nfrom beside_it import FACTOR\n"
        "@dataclass\nclass Weight:\n    value: int = FACTOR\n"
        "def total(completions, **_):\n    return [Weight().value * len(c) for c in completions]\n"
    )
    function = load_reward_function(f"{folder}/judge.py:total")
    assert score(function).total.tolist() == [18, 36, 18]


def test_a_file_does_not_take_the_place_of_a_module(folder):
    import json

    (folder / "json.py").write_text("def reward(**_):\n    return []\n")
    load_reward_function(f"{folder}/json.py:reward")
    assert sys.modules["json"] is json


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("lenght", r"no reward 'lenght'\. Looked for: 'length', FILE\.py:function.*Did you mean 'length'\?"),
        ("judge.py", r"no reward 'judge\.py'\. Looked for"),
        ("judge.txt:reward", "no reward"),
        ("judge.py:", "no reward"),
        ("missing.py:reward", "no file missing.py"),
        ("judge.py:rewards", r"no function 'rewards'; it has helper, reward\."),
        ("judge.py:NUMBER", "no function 'NUMBER'"),
        ("broken.py:reward", r"cannot be run, ZeroDivisionError: division by zero \(line 2 of broken.py\)"),
        ("typo.py:reward", "cannot be run, SyntaxError"),
        ("leaves.py:reward", "cannot be run, SystemExit"),
    ],
)
def test_a_word_that_names_no_function_is_answered(folder, monkeypatch, word, message):
    monkeypatch.chdir(folder)
    Path("judge.py").write_text(
        "NUMBER = 1\ndef helper():\n    pass\ndef reward(**_):\n    return []\ndef _own():\n    pass\n"
    )
    Path("broken.py").write_text("def reward():\n    return 1 / 0\nreward()\n")
    Path("typo.py").write_text("def reward(:\n")
    Path("leaves.py").write_text("import sys\nsys.exit(1)\n")
    with pytest.raises(RewardError, match=message):
        load_reward_function(word)
