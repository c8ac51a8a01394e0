"""The results of a run folder: loaded, evaluated, used and resumed, as numbers and tensors.

`write.py` records them with the code of a day, `test_old_runs.py` computes them with the current code. Paths
in the runs are relative: call this from a copy of the folder of that day.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch

import tightrope
from tightrope.cli.main import main
from tightrope.control import train
from tightrope.control.evaluate import evaluate_run
from tightrope.runs import checkpoint
from tightrope.runs.records import dumps
from tightrope.runs.run import Run

Tensors = dict[str, torch.Tensor]
TEXTS = ["ab", "the cat.", "zebra, why?", "mn is o!"]
CLOCKS = ("seconds", "wall_seconds", "records", "run_dir")  # records: bytes of files that hold seconds


class Outcome(NamedTuple):
    """The compared values: plain JSON, and tensors by name."""

    numbers: Any
    tensors: Tensors


class Walk(gym.Env):
    """A noisy walk that saves its state, so that its runs resume in the middle of an episode."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self.place, self.resets, self.trail = 0.0, 0, np.zeros(3)

    def _seen(self) -> np.ndarray:
        return np.array([self.place, self.resets % 7], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.place, self.resets = 0.0, self.resets + 1
        return self._seen(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.place += (2 * int(action) - 1) * 0.3 + float(self.np_random.normal()) * 0.1
        self.trail = np.roll(self.trail, 1)
        self.trail[0] = self.place
        return self._seen(), -abs(float(self.trail.mean())), abs(self.place) > 2, False, {}

    def get_state(self) -> dict:
        return {"place": self.place, "resets": self.resets, "trail": self.trail}

    def set_state(self, state: dict) -> None:
        self.place, self.resets, self.trail = state["place"], state["resets"], state["trail"]


def walk() -> gym.Env:
    """The environment of the run called walk."""
    return gym.wrappers.TimeLimit(Walk(), 40)


ENVIRONMENTS: dict[str, Any] = {"cartpole": None, "pendulum": None, "walk": walk}  # None: the run names it


def without_clocks(value: Any) -> Any:
    """JSON without clock times."""
    if isinstance(value, list):
        return [without_clocks(item) for item in value]
    if not isinstance(value, dict):
        return value
    names = [name for name in value if name not in CLOCKS and not name.startswith("time/")]
    return {name: without_clocks(value[name]) for name in names}


def outcome(numbers: Any, tensors: Tensors | None = None) -> Outcome:
    """Numbers as read back from a JSON file, without clock times."""
    return Outcome(without_clocks(json.loads(dumps(numbers))), tensors or {})


def stored(folder: Path) -> Tensors:
    """Every tensor of a checkpoint, by file and name."""
    groups, _ = checkpoint.load(folder)
    return {f"{group}/{name}": tensor for group, inside in groups.items() for name, tensor in inside.items()}


# ------------------------------------------------------------------------------------------------ control


def loaded(name: str) -> Outcome:
    """tightrope.load of the newest and of the best policy: actions, values, and the weights after more
    learning.
    """
    numbers, tensors = {}, {}
    for best in (False, True):
        agent = tightrope.load(name, env=ENVIRONMENTS[name], best=best)
        space = agent.environments.observation_layout.space
        seen = np.random.default_rng(5).normal(size=(6, *space.shape)).astype(space.dtype)
        key = "best" if best else "newest"
        numbers[key] = {
            "steps": agent.steps,
            "likeliest": agent.predict(seen)[0],
            "sampled": agent.predict(seen, deterministic=False)[0],
            "one": agent.predict(seen[0])[0],
            "values": agent.value(seen),
        }
        agent.learn(2 * agent.settings.num_envs * agent.settings.num_steps)
        state = {**agent.policy.state_dict(), **agent.normalisers.state()}
        tensors |= {f"{key}/{tensor}": value.clone() for tensor, value in state.items()}
        agent.close()
    return outcome(numbers, tensors)


def evaluated(name: str) -> Outcome:
    """Returns of episodes with the newest policy, likeliest and sampled actions, and with the best one."""
    kinds = {"newest": {}, "sampled": {"stochastic": True}, "best": {"best": True}}
    found = {
        kind: evaluate_run(name, episodes=3, env=ENVIRONMENTS[name], **how) for kind, how in kinds.items()
    }
    return outcome(found)


# ------------------------------------------------------------------------------------------------ language


def log_probabilities(folder: Path) -> list[list[float]]:
    """log p of each token of TEXTS under a model folder, read as transformers reads it."""
    from tightrope.language.model.load import load_causal, load_tokenizer

    model, tokenizer, found = load_causal(str(folder)), load_tokenizer(str(folder)), []
    for text in TEXTS:
        tokens = torch.tensor([tokenizer(text)["input_ids"]])
        with torch.no_grad():
            logp = model(tokens).logits[0, :-1].log_softmax(-1)
        found.append(logp.gather(1, tokens[0, 1:, None])[:, 0].tolist())
    return found


def used_sft(name: str) -> Outcome:
    """The fine-tuned model of a finished run."""
    return outcome(log_probabilities(Path(name) / "model"))


def used_reward(name: str) -> Outcome:
    """The scores of a finished reward model."""
    from tightrope.language.model.load import load_tokenizer
    from tightrope.language.reward.model import load_reward

    model, tokenizer = load_reward(name), load_tokenizer(str(Path(name) / "model"))
    scores = []
    for text in TEXTS:
        tokens = torch.tensor([tokenizer(text)["input_ids"]])
        scores.append(float(model.score(tokens, torch.ones_like(tokens, dtype=torch.bool))))
    return outcome(scores)


def used_align(name: str) -> Outcome:
    """The output of ``tightrope sample`` for a finished run, and the aligned model's probabilities."""
    from tightrope.language.compare import sample_run

    return outcome({"samples": sample_run(name, count=3), "log p": log_probabilities(Path(name) / "model")})


# -------------------------------------------------------------------------------------------------- both


def end_of(name: str) -> Outcome:
    """The results of a run: its rows, its last checkpoint, the best policy and its models."""
    from safetensors.torch import load_file

    path = Path(name)
    point = Run.open(path).newest()
    numbers: dict[str, Any] = {"checkpoint": point.folder.name, "state": point.state}
    numbers["final"] = json.loads((path / "summary.json").read_text(encoding="utf-8"))["final"]
    for file in sorted(path.glob("*.jsonl")):
        numbers[file.name] = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    tensors = stored(point.folder)
    if (path / "best").is_dir():
        tensors |= {f"best/{key}": tensor for key, tensor in stored(path / "best").items()}
    for folder in ("model", "adapter"):
        for file in sorted((path / folder).glob("*.safetensors")):
            tensors |= {f"{folder}/{key}": tensor for key, tensor in load_file(file).items()}
    return outcome(numbers, tensors)


def resumed(name: str) -> Outcome:
    """The killed run, resumed to its end as a user would, or why it cannot be."""
    if name in ENVIRONMENTS:
        try:
            train.resume(name, env=ENVIRONMENTS[name])
        except ValueError as refusal:
            return outcome({"refused": str(refusal).replace(f"{Path.cwd()}/", "")})
    elif code := main(["resume", name, "--quiet"]):
        raise AssertionError(f"tightrope resume {name} ends with {code}")
    return end_of(name)


ASKED: dict[str, tuple[str, Callable[[str], Outcome]]] = {  # file in expected/ -> run folder, question
    **{f"{name}-loaded": (name, loaded) for name in ENVIRONMENTS},
    **{f"{name}-evaluated": (name, evaluated) for name in ENVIRONMENTS},
    **{f"{name}-resumed": (name, resumed) for name in ENVIRONMENTS},
    "sft-used": ("sft", used_sft),
    "sft-resumed": ("sft-killed", resumed),
    "reward-used": ("reward", used_reward),
    "reward-resumed": ("reward-killed", resumed),
    "align-used": ("align", used_align),
    "align-resumed": ("align-killed", resumed),
}
