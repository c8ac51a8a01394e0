"""Presets: settings that make the default good, by task and, for tasks not listed, by space and time limit.

A Python table; flags and a settings file override it. docs/benchmarks.md holds what each preset reaches.
"""

from __future__ import annotations

from typing import Any

_MUJOCO = {
    "num_envs": 8,
    "num_steps": 256,
    "normalise_observations": True,
    "normalise_rewards": True,
}

_LANDER = {
    "num_envs": 16,
    "num_steps": 256,
    "minibatch_size": 256,
    "gamma": 0.999,
    "gae_lambda": 0.98,
    "learning_rate": 1e-3,
    "normalise_observations": True,
    "normalise_rewards": True,
    "total_steps": 1_000_000,
}

PPO_PRESETS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {
        "num_envs": 8,
        "num_steps": 128,
        "minibatch_size": 256,
        "num_epochs": 10,
        "gae_lambda": 0.95,
        "gamma": 0.99,
        "learning_rate": 1e-3,
        "entropy_weight": 0.0,
        "normalise_observations": True,
        "total_steps": 100_000,
    },
    "Acrobot-v1": {
        "num_envs": 16,
        "num_steps": 256,
        "minibatch_size": 256,
        "gae_lambda": 0.94,
        "learning_rate": 1e-3,
        "entropy_weight": 0.0,
        "normalise_observations": True,
        "normalise_rewards": True,
        "total_steps": 500_000,
    },
    "MountainCarContinuous-v0": {
        "num_envs": 8,
        "num_steps": 256,
        "std": "gsde",
        "gsde_steps": 256,
        "normalise_observations": True,
        "total_steps": 100_000,
    },
    "Pendulum-v1": {
        "num_envs": 8,
        "num_steps": 256,
        "gamma": 0.95,
        "learning_rate": 1e-3,
        "activation": "relu",
        "total_steps": 200_000,
    },
    "LunarLander-v3": {**_LANDER, "entropy_weight": 0.01},
    "LunarLanderContinuous-v3": _LANDER,
    "HalfCheetah-v5": {**_MUJOCO, "log_std_init": -1.0, "total_steps": 1_000_000},
    "Hopper-v5": {**_MUJOCO, "normalise_rewards": False, "total_steps": 1_000_000},
    "Walker2d-v5": {**_MUJOCO, "log_std_init": -1.0, "total_steps": 1_000_000},
}

A2C_PRESETS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {
        "num_envs": 8,
        "num_steps": 16,
        "learning_rate": 1e-3,
        "total_steps": 300_000,
    },
}

REINFORCE_PRESETS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {"num_envs": 1, "num_steps": 1500, "learning_rate": 3e-3, "total_steps": 300_000},
}

BY_TASK = {"ppo": PPO_PRESETS, "a2c": A2C_PRESETS, "reinforce": REINFORCE_PRESETS}
A2C_DEFAULT = {"num_steps": 16, "learning_rate": 7e-4}


KINDS = ("discrete", "continuous", "images")


def decided(algorithm: str) -> tuple[set[str], set[str]]:
    """The settings that presets decide for some tasks, and those that are decided for every task that is
    not listed.
    """
    kinds = [set(preset("", algorithm, kind)) for kind in KINDS]
    listed = {name for values in BY_TASK[algorithm].values() for name in values}
    return listed.union(*kinds, preset("ALE/", algorithm)), set.intersection(*kinds)


def preset(
    env_id: str, algorithm: str, kind: str | None = None, max_episode_steps: int | None = None
) -> dict[str, Any]:
    """Overrides of the defaults for a task: by its id, else by kind of action space and time limit.

    ``kind`` is ``discrete``, ``continuous`` or ``images`` (observations), None when the task is not known
    yet.
    """
    listed = BY_TASK[algorithm].get(env_id)
    if listed is not None:
        return dict(listed)
    values: dict[str, Any] = {"entropy_weight": 0.0 if kind == "continuous" else 0.01}
    if env_id.startswith("ALE/"):  # a seeded reset loads the game again, 80 ms
        values["reseed_after"] = 8192
    if kind == "images":
        values |= {
            "num_steps": 128,
            "learning_rate": 2.5e-4,
            "hidden": (),
            "shared": True,
            "normalise_observations": True,  # what lies beside the images
        }
        if algorithm == "ppo":
            # twice the step that is usual for 10 million frames of Atari, as in Procgen's baseline: budgets
            # here are a tenth of that, and 2.5e-4 left approx_kl at 0.001
            values |= {"num_epochs": 4, "minibatch_size": 256, "clip": 0.1, "learning_rate": 5e-4}
        return values
    values["normalise_observations"] = True
    if algorithm == "ppo":
        # with gae_lambda, a late reward moves about 1 / (1 - lambda) = 20 steps towards the start each time
        # that an episode is seen: too slowly for thousands of steps. Images, whose actor shares the critic's
        # layers, keep one lambda
        values["critic_lambda"] = 1.0
    if kind == "continuous":
        values["log_std_init"] = -0.5
    if algorithm == "a2c":
        values |= A2C_DEFAULT
    if algorithm == "reinforce":  # whole episodes must fit: several time limits per rollout
        limit = max_episode_steps or 1000
        values |= {"num_envs": 2, "num_steps": 3 * limit, "learning_rate": 3e-3}
    return values
