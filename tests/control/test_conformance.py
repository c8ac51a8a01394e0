"""The advantages of an episode are bit-identical for every vector type and every way to signal its end.

The task is the scripted chain (tests/control/chain.py): known lengths, terminations and time limits. The
policy is a function of (episode, step); the critic is exact arithmetic per row. Every episode that lies
wholly inside a rollout must get the same advantages in every autoreset mode and vector type.
"""

import gymnasium as gym
import numpy as np
import pytest
import torch
from chain import BASE_SEED, Chain, ChainVector, action_for, reward_of
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from torch import nn

import tightrope
from tightrope.control.rollout.rollout import to_batch

GAMMA, LAMBDA, COLUMNS = 0.9375, 0.875, 40


class Scripted(nn.Module):
    """Always the scripted action; V = 4 row + episode + step / 8, without a matrix product whose rounding
    could depend on the size of the batch."""

    def __init__(self):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, observation):
        action = torch.from_numpy(action_for(observation.numpy()).astype(np.int64))[:, 0]
        logits = torch.where(torch.arange(3) == action[:, None], 1e4, 0.0)
        return logits, value(observation)


def value(observation):
    return observation[:, 0] * 4 + observation[:, 1] + observation[:, 2] / 8


def sync(mode):
    return lambda: SyncVectorEnv([Chain] * 2, autoreset_mode=mode)


WAYS = {
    "serial": (lambda: Chain, dict(vector_backend="serial")),
    "workers": (lambda: Chain, dict(vector_backend="workers", num_workers=2)),
    "one copy": (lambda: Chain, dict(vector_backend="serial", num_envs=1)),
    "instance": (Chain, dict(vector_backend="serial")),
    **{f"SyncVectorEnv {mode.name}": (sync(mode), {}) for mode in AutoresetMode},
    **{
        f"own vector env {mode.name}": ((lambda mode=mode: ChainVector(2, autoreset_mode=mode)), {})
        for mode in AutoresetMode
    },
    "AsyncVectorEnv NEXT_STEP": (
        lambda: AsyncVectorEnv([Chain] * 2, autoreset_mode=AutoresetMode.NEXT_STEP),
        {},
    ),
    "AsyncVectorEnv SAME_STEP": (
        lambda: AsyncVectorEnv([Chain] * 2, autoreset_mode=AutoresetMode.SAME_STEP),
        {},
    ),
}


def advantages_by_step(make, settings, *, rollouts=2):
    """{(row, episode, step): (reward, terminated, truncated, advantage)} of the steps of ``rollouts``
    rollouts.
    """
    env = make()
    agent = tightrope.PPO(
        env, policy=Scripted(), seed=BASE_SEED, reseed_after=None, gamma=GAMMA, gae_lambda=LAMBDA,
        num_steps=COLUMNS, normalise_observations=False, normalise_values=False,
        **{"num_envs": 2, **settings},
    )  # fmt: skip
    agent.collector.reset(BASE_SEED)
    found = {}
    for _ in range(rollouts):
        rollout = agent.collector.collect(agent.engine, COLUMNS)
        batch = to_batch(rollout, agent.engine, agent.normalisers, agent.settings.update)
        for row, t in np.argwhere(rollout.mask):
            key = tuple(int(x) for x in rollout.inputs["flat"][row, t])
            flags = (
                bool(rollout.terminated[row, t]),
                bool(rollout.truncated[row, t] & ~rollout.terminated[row, t]),
            )
            found[key] = (float(rollout.rewards[row, t]), *flags, float(batch.advantages[row, t]))
    agent.close()
    if isinstance(env, gym.vector.VectorEnv):
        env.close()
    return found


def whole_episodes(found):
    """The episodes of row 0 and 1 that lie in one rollout: their last step carries a flag, their first is
    step 0.
    """
    ends = {(row, episode): step for (row, episode, step), x in found.items() if x[1] or x[2]}
    return {
        (row, episode): [found[row, episode, k] for k in range(last + 1)]
        for (row, episode), last in ends.items()
        if all((row, episode, k) in found for k in range(last + 1))
    }


def expected_advantages(row, episode, steps):
    """GAE by its definition, backwards in float64, only from the script."""
    numbers = [torch.tensor([[row, episode, k]], dtype=torch.float32) for k in range(len(steps) + 1)]
    values = torch.stack([value(x)[0] for x in numbers]).double()
    trace, result = torch.zeros((), dtype=torch.float64), []
    for k in reversed(range(len(steps))):
        reward, terminated, _, _ = steps[k]
        future = torch.zeros(()) if terminated else values[k + 1]
        delta = reward + GAMMA * future - values[k]
        trace = delta + GAMMA * LAMBDA * trace
        result.append(float(trace.float()))
    return result[::-1]


@pytest.fixture(scope="module")
def reference():
    return whole_episodes(advantages_by_step(*WAYS["serial"]))


@pytest.mark.parametrize("way", WAYS)
def test_advantages_are_bit_equal_in_every_mode_and_vector_type(way, reference):
    episodes = whole_episodes(advantages_by_step(*WAYS[way]))
    shared = [key for key in episodes if key in reference and key[1] > 0]
    assert len(shared) >= (12 if way != "one copy" else 6)
    for row, episode in shared:
        steps = episodes[row, episode]
        crossing = [a for a, b in zip(steps, reference[row, episode], strict=True) if a[:3] != b[:3]]
        assert not crossing
        expected = expected_advantages(row, episode, steps)
        # episodes cut by the end of a rollout are bootstrapped there: they differ by design
        for seen in (steps, reference[row, episode]):
            got = [x[3] for x in seen]
            if got != expected:
                assert cut_in_two(row, episode)


def cut_in_two(row, episode):
    """Whether some way of stepping lets a rollout end inside this episode: decided by the scripted lengths
    alone.
    """
    from chain import SCRIPT

    before = sum(SCRIPT[(k + row) % len(SCRIPT)][0] for k in range(episode))
    length = SCRIPT[(episode + row) % len(SCRIPT)][0]
    plain = range(before, before + length)  # columns without phantom rows
    phantom = range(before + episode, before + episode + length)  # one more for each earlier episode
    return any(columns.start < COLUMNS * k < columns.stop for columns in (plain, phantom) for k in (1, 2))


@pytest.mark.parametrize("way", WAYS)
def test_every_transition_is_delivered_once_with_its_own_reward(way):
    found = advantages_by_step(*WAYS[way])
    for (row, episode, step), (reward, *_rest) in found.items():
        action = int(action_for(np.array([[row, episode, step]], np.float32))[0, 0]) + 5
        assert reward == reward_of(row, episode, step, action)


def test_truncation_taken_for_death_would_be_noticed(reference):
    """The mutant: without the value of the true final observation, truncated episodes get other
    advantages.
    """
    changed = 0
    for (row, episode), steps in reference.items():
        if not steps[-1][2]:
            continue
        dead = [*steps[:-1], (steps[-1][0], True, False, 0.0)]
        changed += expected_advantages(row, episode, dead) != [x[3] for x in steps]
    assert changed >= 3
