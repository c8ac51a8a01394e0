"""Probe environments: each is solvable only if one part of the algorithm works."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Probe(gym.Env):
    """One observation column; subclasses define the observation and the reward."""

    observation_space = spaces.Box(-2.0, 2.0, (1,), np.float32)
    action_space = spaces.Discrete(2)
    length = 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.seen = self.draw()
        return self._observation(), {}

    def _observation(self):
        return np.full(1, self.seen, np.float32)

    def draw(self):
        return 0.0

    def pay(self, action):
        return 1.0

    def step(self, action):
        reward = float(self.pay(action))
        self.t += 1
        terminated = self.t >= self.length
        self.seen = self.draw()
        return self._observation(), reward, terminated, False, {}


class ValueProbe(Probe):
    """Always reward 1: V = 1. Isolates the value loss."""


class ValueByObservation(Probe):
    """The reward equals the observation, -1 or 1: V(s) = s. Isolates the critic's inputs."""

    def draw(self):
        return float(self.np_random.choice([-1.0, 1.0]))

    def pay(self, action):
        return self.seen


class DiscountProbe(Probe):
    """Two steps, 1 at the end: V(0) = gamma, V(1) = 1. Isolates discount and bootstrapping."""

    length = 2

    def draw(self):
        return float(self.t)

    def pay(self, action):
        return float(self.t == 1)


class PolicyProbe(Probe):
    """Action 1 pays 1, action 0 pays -1. Isolates the policy gradient."""

    def pay(self, action):
        return 1.0 if action == 1 else -1.0


class ConditionProbe(ValueByObservation):
    """The action that matches the sign of the observation pays 1. Isolates conditioning on it."""

    def pay(self, action):
        return 1.0 if (action == 1) == (self.seen > 0) else -1.0


class Forever(Probe):
    """Reward 1 for ever; the time limit around it truncates. V = 1 / (1 - gamma) when truncations
    bootstrap.
    """

    length = 10**9


class Identity(gym.Env):
    """Pays for answering with the observation, in any action space that can be compared with an
    observation.
    """

    def __init__(self, space, length=16):
        self.observation_space = self.action_space = space
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.t = 0
        self.state = self.observation_space.sample()
        return self.state, {}

    def step(self, action):
        reward = closeness(self.observation_space, self.state, action)
        self.t += 1
        self.state = self.observation_space.sample()
        return self.state, reward, False, self.t >= self.length, {}


def closeness(space, a, b):
    """Similarity in [0, 1], 1 for equal values; means over the parts of a space."""
    if isinstance(space, spaces.Dict):
        return float(np.mean([closeness(s, a[k], b[k]) for k, s in space.spaces.items()]))
    if isinstance(space, spaces.Tuple):
        return float(np.mean([closeness(s, x, y) for s, x, y in zip(space.spaces, a, b, strict=True)]))
    if isinstance(space, spaces.Box):
        width = space.high - space.low
        return float(1.0 - np.minimum(1.0, np.abs(np.asarray(a) - np.asarray(b)) / width * 2).mean())
    return float(np.mean(np.asarray(a) == np.asarray(b)))
