"""The end of an engine, and the switch to another one."""

import pytest
import threadpoolctl
import torch

import tightrope

SMALL = {"num_envs": 2, "num_steps": 64, "minibatch_size": 64, "num_epochs": 1}


def blas_threads() -> dict[str, int]:
    """Threads of each BLAS in the process: numpy and scipy bring one each."""
    found = threadpoolctl.threadpool_info()
    return {one["filepath"]: one["num_threads"] for one in found if one["user_api"] == "blas"}


def test_the_users_blas_threads_come_back():
    agent = tightrope.PPO("CartPole-v1", engine="fused", **SMALL)
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        agent.learn(256)
        agent.close()
        assert blas_threads() == before and set(before.values()) == {2}


def test_a_device_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="device is 'nowhere'"):
        tightrope.PPO("CartPole-v1", device="nowhere", **SMALL)


def test_a_saved_agent_continues_with_the_other_engine(tmp_path):
    agent = tightrope.PPO("CartPole-v1", engine="auto", **SMALL).learn(256)
    assert agent.engine.name == "fused"
    agent.save(tmp_path / "agent")
    again = tightrope.load(tmp_path / "agent", engine="torch")
    assert again.engine.name == "torch"
    pairs = zip(agent.policy.parameters(), again.policy.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    again.learn(128)


def test_weights_whose_memory_was_replaced_are_the_ones_that_act():
    agent = tightrope.PPO("CartPole-v1", engine="fused", **SMALL).learn(128)
    with torch.no_grad():
        for parameter in agent.policy.parameters():
            parameter.data = torch.randn_like(parameter) * 0.1
    agent.learn(128)  # would raise SamplingMismatch
