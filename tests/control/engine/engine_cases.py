"""Policies and batches for the tests of the compiled engine."""

import gymnasium as gym
import numpy as np
import torch

from tightrope.algorithms.batch import Batch
from tightrope.algorithms.optimise import make_optimiser
from tightrope.algorithms.settings import PPOSettings
from tightrope.control.policy.policy import Policy
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.actions import action_layout
from tightrope.control.spaces.observations import observation_layout

FEATURES = 5
SPACES = {
    "discrete": gym.spaces.Discrete(3),
    "multi-discrete": gym.spaces.MultiDiscrete([3, 2, 4]),
    "binary": gym.spaces.MultiBinary(4),
    "box": gym.spaces.Box(-1, 1, (3,)),
    "mixed": gym.spaces.Tuple(
        (
            gym.spaces.Discrete(2),
            gym.spaces.Box(-1, 1, (2,)),
            gym.spaces.MultiBinary(2),
            gym.spaces.Box(-1, 1, (1,)),
        )
    ),
}


def make(space="discrete", seed=0, **values):
    """Policy, optimiser and PPO settings; weights are moved off their symmetric start."""
    values = {"num_epochs": 2, "learning_rate": 1e-3, "minibatch_size": 64, "hidden": (24, 16), **values}
    settings = TrainSettings(num_envs=8, num_steps=40, seed=seed).with_values(**values)
    observations = gym.spaces.Box(-1, 1, (FEATURES,), np.float32)
    policy = Policy(observation_layout(observations), action_layout(SPACES[space]), settings)
    generator = torch.Generator().manual_seed(seed + 1)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    assert isinstance(settings.update, PPOSettings)
    return (
        policy,
        make_optimiser(policy.parameters(), policy.critic_parameters(), settings.update),
        settings.update,
    )


def make_noise(layout, rows, rng):
    """Uniforms for categories and bits, standard normals for Gaussian columns, [rows, A] float32."""
    noise = rng.random((rows, layout.num_columns), dtype=np.float32)
    for c in layout.components:
        if c.kind == "gaussian":
            noise[:, c.column : c.column + c.count] = rng.standard_normal((rows, c.count), dtype=np.float32)
    return noise


def make_masks(layout, rows, rng):
    """Random action masks that leave at least one choice to every category."""
    masks = rng.random((rows, layout.num_logits)) < 0.6
    for c in layout.components:
        if c.kind == "categorical":
            masks[:, c.mask] = True
    return masks


def make_batch(policy, rows=8, steps=40, seed=2, masked=False, action_masks=False, drift=0.15):
    """A batch sampled from the policy, whose old_logp is ``drift`` off, so that clips happen."""
    rng, shape, count = np.random.default_rng(seed), (rows, steps), rows * steps
    inputs = {"flat": rng.standard_normal((count, FEATURES), dtype=np.float32)}
    if action_masks:
        inputs["action_mask"] = make_masks(policy.layout, count, rng)
    actions, logp = policy.act(inputs, make_noise(policy.layout, count, rng))

    def normal():
        return torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))

    values, advantages = normal(), normal()
    return Batch(
        inputs={name: torch.from_numpy(x).reshape(*shape, -1) for name, x in inputs.items()},
        actions=actions.reshape(*shape, -1),
        old_logp=logp.reshape(shape) + drift * normal(),
        old_values=values,
        advantages=advantages,
        returns=advantages + values,
        mask=torch.from_numpy(rng.random(shape) < 0.8) if masked else torch.ones(shape, dtype=torch.bool),
    )


def numbers(policy):
    """Copies of all parameters."""
    return [p.detach().clone() for p in policy.parameters()]


def difference(first, second):
    """Largest absolute difference between two lists of tensors."""
    return max(float((a - b).abs().max()) for a, b in zip(first, second, strict=True))
