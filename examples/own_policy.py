"""Your own network: any torch module that returns action parameters and values.

python examples/own_policy.py
"""

import tempfile
from pathlib import Path

import torch
from torch import nn

import tightrope


class Residual(nn.Module):
    """A trunk with a skip connection, shared by actor and critic."""

    def __init__(self, inputs: int, outputs: int, width: int = 64) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, width)
        self.second = nn.Linear(width, width)
        self.actor = nn.Linear(width, outputs)
        self.critic = nn.Linear(width, 1)
        nn.init.orthogonal_(self.actor.weight, gain=0.01)  # start with all actions about equally likely

    def forward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Observations [N, D] -> parameters [N, P] (logits, or means of Box actions) and values [N]."""
        hidden = torch.tanh(self.first(observations))
        hidden = hidden + torch.tanh(self.second(hidden))
        return self.actor(hidden), self.critic(hidden)[:, 0]


def build(observation_space, action_space) -> nn.Module:
    """A function of the spaces works for every task; a ready-made module is accepted as well."""
    return Residual(observation_space.shape[0], int(action_space.n))


def main() -> None:
    """Train on the torch path, which takes any module, and load the policy again."""
    agent = tightrope.PPO("CartPole-v1", policy=build, seed=1)
    returns = [
        report.metrics["rollout/new_ep_rew_mean"]
        for report in agent.iterate(30_720)
        if "rollout/new_ep_rew_mean" in report.metrics
    ]
    print("return of the first and of the last rollout:", returns[0], returns[-1])
    assert returns[-1] > 3 * returns[0]

    with tempfile.TemporaryDirectory() as folder:
        agent.save(Path(folder) / "agent")  # saves the parameters; the class stays in your code
        again = tightrope.load(Path(folder) / "agent", policy=build)
    assert again.value([0.0, 0.0, 0.0, 0.0]) == agent.value([0.0, 0.0, 0.0, 0.0])


if __name__ == "__main__":
    main()
