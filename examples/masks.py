"""Forbidden actions: the environment returns a mask of allowed actions, all others get probability 0.

python examples/masks.py
"""

import gymnasium
import numpy as np

import tightrope


class Shelf(gymnasium.Env):
    """Take all six items from a shelf. Higher numbers pay more, and sooner is better.

    Taking an item that is gone is an error here, so training on this task needs masks.
    """

    observation_space = gymnasium.spaces.MultiBinary(6)
    action_space = gymnasium.spaces.Discrete(6)

    def reset(self, *, seed=None, options=None):
        """A full shelf."""
        super().reset(seed=seed)
        self.left, self.time = np.ones(6, np.int8), 0
        return self.left.copy(), {}

    def step(self, action):
        """Take one item."""
        assert self.left[action], "a masked action was taken"
        self.left[action] = 0
        reward = float(action) * 0.5**self.time
        self.time += 1
        return self.left.copy(), reward, not self.left.any(), False, {}

    def action_masks(self) -> np.ndarray:
        """True where an action is allowed; info["action_mask"] would work as well."""
        return self.left.astype(bool)


def main() -> None:
    """Train, then empty a shelf with the best actions."""
    agent = tightrope.PPO(Shelf, seed=0, num_steps=48, learning_rate=2e-3, entropy_weight=0.0).learn(24_576)
    env = Shelf()
    observation, _ = env.reset(seed=0)
    order, over = [], False
    while not over:
        action, _ = agent.predict(observation, action_masks=env.action_masks())
        order.append(int(action))
        observation, _, over, _, _ = env.step(action)
    print("order:", order)
    assert sorted(order) == list(range(6)) and order[:2] == [5, 4]


if __name__ == "__main__":
    main()
