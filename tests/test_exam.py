"""The exam of the defaults: its tasks are what they say, and it runs from end to end."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import exam  # noqa: E402
from exam_tasks import TASKS  # noqa: E402

sys.path.remove(str(BENCHMARKS))

TASK = pytest.mark.parametrize("name", TASKS)


def test_there_are_forty_tasks_and_more():
    assert len(TASKS) >= 40 and set(exam.FAST) <= set(TASKS)
    assert all(task.best > task.random and task.steps >= 100_000 for task in TASKS.values())


@TASK
def test_a_task_is_an_environment_as_gymnasium_wants_it(name: str):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it recommends usual bounds, which is what these tasks are about
        check_env(TASKS[name].make().unwrapped, skip_render_check=True)


@TASK
def test_the_hand_policy_reaches_the_best_return(name: str):
    task = TASKS[name]
    many = 20 if exam.steps_of_best(task) > 100 else 200
    returns, cut = exam.play(task.make(), lambda observation, allowed: task.hand(observation), many)
    error = np.std(returns) / many**0.5
    assert not cut
    assert abs(np.mean(returns) - task.best) <= 4 * error + 1e-6 * abs(task.best)


@TASK
def test_the_random_return_is_that_of_random_actions(name: str):
    task, env, rng = TASKS[name], TASKS[name].make(), np.random.default_rng(0)
    env.action_space.seed(0)
    many = 40 if exam.steps_of_best(task) > 100 else 500

    def choose(observation, allowed):
        return env.action_space.sample() if allowed is None else rng.choice(np.flatnonzero(allowed))

    returns, _ = exam.play(env, choose, many)
    assert abs(np.mean(returns) - task.random) <= 4 * np.std(returns) / many**0.5


def test_an_error_is_an_answer_and_luck_is_taken_out(monkeypatch: pytest.MonkeyPatch):
    task = TASKS["reward-noisy"]
    monkeypatch.setattr(exam, "train_ours", lambda task, seed, steps: lambda seen, allowed: task.hand(seen))
    row = exam.sit(task, exam.OURS, 0, 1)
    assert row["solved"] and row["score"] == pytest.approx(1) and abs(row["luck"]) > 0.01
    monkeypatch.setattr(exam, "train_ours", lambda *given: [][1])
    assert exam.sit(task, exam.OURS, 0, 1) == {"error": "IndexError: list index out of range"}


def test_an_episode_without_an_end_is_cut():
    task = TASKS["no-time-limit"]
    returns, cut = exam.play(task.make(), lambda observation, allowed: 0, 2, max_steps=50)
    assert cut == 2 and returns == pytest.approx([-0.5, -0.5])


def test_the_page_shows_the_committed_results():
    rows = json.loads(exam.RESULTS.read_text(encoding="utf-8"))["rows"]
    assert exam.render(exam.PAGE, exam.table(rows)) == exam.PAGE.read_text(encoding="utf-8")


def test_the_fast_part_runs_and_is_not_run_again(tmp_path: Path, capsys: pytest.CaptureFixture):
    words = ["--fast", "--tasks", "one-step-contextual", "--out", str(tmp_path / "exam.json")]
    assert exam.main(words) == 0
    first = capsys.readouterr()
    (row,) = json.loads((tmp_path / "exam.json").read_text())["rows"]
    assert row["solved"] and row["steps"] == 8_192 and row["versions"]["commit"]
    assert "one-step-contextual" in first.out and "1 of 1" in first.out and "solved" in first.err
    assert exam.main(words) == 0
    second = capsys.readouterr()
    assert second.out == first.out and not second.err
