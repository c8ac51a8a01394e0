"""Your own environment: any class with Gymnasium's API; pass the class or another factory.

    python examples/own_environment.py

On the command line the same task needs an id, and the file that registers it:

    tightrope train Corridor-v0 --env-module examples/own_environment.py
"""

import gymnasium
import numpy as np

import tightrope


class Corridor(gymnasium.Env):
    """Walk to the right end: every step costs 1, the end pays 10. A time limit truncates after 50 steps."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, length: int = 8) -> None:
        self.length, self.place, self.time = length, 0, 0

    def reset(self, *, seed=None, options=None):
        """Begin at the left end."""
        super().reset(seed=seed)
        self.place, self.time = 0, 0
        return self._observation(), {}

    def step(self, action):
        """0 steps left, 1 steps right."""
        self.place = max(0, self.place + (1 if action == 1 else -1))
        self.time += 1
        terminated = self.place == self.length  # no future exists: the task is over
        truncated = not terminated and self.time >= 50  # the time limit stops it; the future still counts
        return self._observation(), (10.0 if terminated else -1.0), terminated, truncated, {}

    def _observation(self) -> np.ndarray:
        return np.array([self.place / self.length], np.float32)


gymnasium.register("Corridor-v0", entry_point=Corridor)


def main() -> None:
    """Train on the factory and walk through the corridor."""
    agent = tightrope.PPO(Corridor, seed=0, num_steps=64, learning_rate=1e-3).learn(16_384)
    places = np.linspace(0.0, 0.875, 8, dtype=np.float32)[:, None]
    actions, _ = agent.predict(places)  # a batch of observations
    print("actions from left to right:", actions)
    assert actions.tolist() == [1] * 8


if __name__ == "__main__":
    main()
