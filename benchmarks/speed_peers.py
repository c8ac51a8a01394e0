"""The peers' side of speed.py: one training run of a peer, in the peers' own interpreter.

    python speed_peers.py stable-baselines3 '{"env": "CartPole-v1", "num_envs": 8, ...}' RESULT.json

This file does not import tightrope. It writes steps and optimiser steps (counted by the optimiser itself);
the wall time is measured from outside. ``speed_peers.py versions RESULT.json`` writes the installed versions.

PureJaxRL is not a package: the environment variable PUREJAXRL names the folder of its ppo.py. Its whole run
is one compiled call, including the environment. It writes only the seconds of that call, without start-up and
compilation.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import sys
import tempfile
import time
import types
from pathlib import Path
from typing import Any

PACKAGES = {  # name -> module, distributions whose versions matter
    "stable-baselines3": ("stable_baselines3", ("stable-baselines3", "torch", "gymnasium", "numpy")),
    "sbx": ("sbx", ("sbx-rl", "jax", "stable-baselines3", "gymnasium")),
    "purejaxrl": ("gymnax", ("gymnax", "jax", "flax", "optax")),
}


def installed() -> dict[str, dict[str, str]]:
    """The peers this interpreter can import, with versions."""
    return {
        peer: {name: importlib.metadata.version(name) for name in names}
        for peer, (module, names) in PACKAGES.items()
        if importlib.util.find_spec(module) is not None and (peer != "purejaxrl" or "PUREJAXRL" in os.environ)
    }


def train(peer: str, scenario: dict[str, Any], total_steps: int) -> dict[str, Any]:
    """Train with the scenario's settings; the metrics of every update go to a file, as in our run."""
    import torch
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.logger import configure
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    torch.set_num_threads(1)  # the fastest choice for networks this small
    algorithm = importlib.import_module(PACKAGES[peer][0]).PPO
    vector = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}[scenario["peer_vec"]]
    env = make_vec_env(
        scenario["env"], n_envs=scenario["num_envs"], seed=scenario["seed"], vec_env_cls=vector
    )
    model = algorithm(
        "MlpPolicy",
        env,
        n_steps=scenario["num_steps"],
        batch_size=scenario["minibatch_size"],
        n_epochs=scenario["num_epochs"],
        learning_rate=scenario["learning_rate"],
        gamma=scenario["gamma"],
        gae_lambda=scenario["gae_lambda"],
        clip_range=0.2,
        ent_coef=scenario["entropy_weight"],
        vf_coef=0.5,
        max_grad_norm=0.5,
        target_kl=None,
        seed=scenario["seed"],
        device="cpu",
    )
    with tempfile.TemporaryDirectory() as folder:
        model.set_logger(configure(folder, ["json"]))
        model.learn(total_steps)
    env.close()
    if peer == "sbx":
        count = int(model.policy.actor_state.step)
    else:
        count = int(next(iter(model.policy.optimizer.state.values()))["step"])
    return {"steps": model.num_timesteps, "optimiser_steps": count}


class _Absent(types.ModuleType):
    """Placeholder for a package that PureJaxRL's wrappers import for tasks that are not run here."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


def train_purejaxrl(scenario: dict[str, Any], total_steps: int) -> dict[str, Any]:
    """PureJaxRL's published ppo.py with the scenario's settings; its value loss is always clipped."""
    import jax

    for name in ("brax", "brax.envs", "brax.envs.wrappers", "brax.envs.wrappers.training", "navix"):
        sys.modules[name] = _Absent(name)
    if not hasattr(jax, "tree_map"):
        jax.tree_map = jax.tree.map
    sys.path.insert(0, os.environ["PUREJAXRL"])
    ppo = importlib.import_module("ppo")
    num_envs, num_steps, size = (scenario[name] for name in ("num_envs", "num_steps", "minibatch_size"))
    config = {
        "LR": scenario["learning_rate"],
        "NUM_ENVS": num_envs,
        "NUM_STEPS": num_steps,
        "TOTAL_TIMESTEPS": total_steps,
        "UPDATE_EPOCHS": scenario["num_epochs"],
        "NUM_MINIBATCHES": num_envs * num_steps // size,
        "GAMMA": scenario["gamma"],
        "GAE_LAMBDA": scenario["gae_lambda"],
        "CLIP_EPS": 0.2,
        "ENT_COEF": scenario["entropy_weight"],
        "VF_COEF": 0.5,
        "MAX_GRAD_NORM": 0.5,
        "ACTIVATION": "tanh",
        "ENV_NAME": scenario["env"],
        "ANNEAL_LR": False,
        "DEBUG": False,
    }
    key = jax.random.PRNGKey(scenario["seed"])
    compiled = jax.jit(ppo.make_train(config)).lower(key).compile()
    begin = time.perf_counter()
    out = jax.block_until_ready(compiled(key))
    seconds = time.perf_counter() - begin
    state = out["runner_state"][0]
    return {"steps": total_steps, "optimiser_steps": int(state.step), "call_seconds": seconds}


def main(words: list[str]) -> None:
    """Run the job of the command line and write the result file."""
    if words[0] == "versions":
        result: Any = installed()
    elif words[0] == "purejaxrl":
        scenario = json.loads(words[1])
        result = train_purejaxrl(scenario, scenario["total_steps"])
    else:
        scenario = json.loads(words[1])
        result = train(words[0], scenario, scenario["total_steps"])
    Path(words[-1]).write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
