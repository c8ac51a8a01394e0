"""A new user's first run: each algorithm solves CartPole with its preset, in seconds."""

import json

import pytest

import tightrope
from tightrope.cli.main import main
from tightrope.control.rollout.evaluation import evaluate_agent, evaluation_environments


def score(agent, episodes=20):
    with evaluation_environments(agent.env, agent.settings, episodes) as environments:
        return evaluate_agent(agent, environments, episodes, seed=123)["mean_return"]


@pytest.mark.parametrize("engine", ["fused", "torch"])
def test_ppo_solves_cartpole(engine):
    agent = tightrope.PPO("CartPole-v1", seed=5, engine=engine).learn()
    assert score(agent) >= 450


def test_a2c_solves_cartpole():
    assert score(tightrope.A2C("CartPole-v1", seed=5).learn(300_000)) >= 450


def test_the_command_line_trains_evaluates_and_resumes(tmp_path, capsys):
    run = str(tmp_path / "run")
    assert (
        main(["train", "CartPole-v1", "--total-steps", "20000", "--run-dir", run, "--json", "--seed", "3"])
        == 0
    )
    trained = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert 19_000 < trained["steps"] <= 20_000
    assert main(["resume", run, "--total-steps", "100000", "--json"]) == 0
    resumed = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert 99_000 < resumed["steps"] <= 100_000
    assert main(["evaluate", run, "--episodes", "20", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert found["episodes"] == 20
    assert found["mean_return"] >= 450
    assert main(["evaluate", run, "--episodes", "20", "--json", "--best"]) == 0
