"""The training material of ruler.py: two tiny tasks, small data files and a reward; and its jobs in Python.

tightrope train RulerShelf-v0 --env-module benchmarks/ruler_tasks.py
tightrope align --reward benchmarks/ruler_tasks.py:vowels ...
python benchmarks/ruler_tasks.py agents FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

TEXT = "the film was good and its story bad but i like an actor who never sings so much"


class Shelf(gymnasium.Env):
    """Take items from a shelf; missing items are masked. Dict observations contain the mask."""

    action_space = gymnasium.spaces.MultiDiscrete([5, 2])
    observation_space = gymnasium.spaces.Dict({
        "place": gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
        "shelf": gymnasium.spaces.MultiBinary(5),
        "day": gymnasium.spaces.Discrete(3),
        "action_mask": gymnasium.spaces.MultiBinary(7),
    })  # fmt: skip

    def reset(self, *, seed=None, options=None):
        """A full shelf on a random day."""
        super().reset(seed=seed)
        self.left, self.time, self.day = np.ones(5, np.int8), 0, int(self.np_random.integers(3))
        return self._observation(), {}

    def step(self, action):
        """Take one item, hurried or not; truncated after four of the five on day 0."""
        item, hurry = int(action[0]), int(action[1])
        assert self.left[item], "a masked action was taken"
        self.left[item] = 0
        self.time += 1
        reward = float(item == self.day) + 0.1 * item * 0.5**self.time - 0.05 * hurry
        truncated = bool(self.day == 0 and self.time == 4)
        return self._observation(), reward, not self.left.any(), truncated, {}

    def _observation(self) -> dict[str, Any]:
        place = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        mask = np.concatenate([self.left, np.array([1, self.time % 2], np.int8)])
        return {"place": place, "shelf": self.left.copy(), "day": self.day, "action_mask": mask}


class Picture(gymnasium.Env):
    """Name the corner of the bright square, one of four. It can save its state, so it needs no reset."""

    observation_space = gymnasium.spaces.Box(0, 255, (16, 16, 1), np.uint8)
    action_space = gymnasium.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        """A new picture."""
        super().reset(seed=seed)
        self.corner, self.time = int(self.np_random.integers(4)), 0
        return self._observation(), {}

    def step(self, action):
        """One answer, then the next picture; six of them are an episode."""
        reward = float(action == self.corner)
        self.corner, self.time = int(self.np_random.integers(4)), self.time + 1
        return self._observation(), reward, self.time == 6, False, {}

    def _observation(self) -> np.ndarray:
        image = np.zeros((16, 16, 1), np.uint8)
        y, x = 8 * (self.corner // 2), 8 * (self.corner % 2)
        image[y : y + 8, x : x + 8] = 100 + 20 * self.time
        return image

    def get_state(self) -> dict[str, int]:
        """Everything that the next steps depend on, except the generator."""
        return {"corner": self.corner, "time": self.time}

    def set_state(self, state: dict[str, int]) -> None:
        """Restore such a state."""
        self.corner, self.time = state["corner"], state["time"]


for name, task in {"RulerShelf-v0": Shelf, "RulerPicture-v0": Picture}.items():
    if name not in gymnasium.registry:
        gymnasium.register(name, task)


def vowels(prompts: list[str], completions: list[str], **columns: Any) -> list[float | None]:
    """The share of vowels; None, which rewards may return, for a response that begins with z."""
    return [None if text[:1] == "z" else sum(c in "aeiou" for c in text) / 8 for text in completions]


def write_data(folder: Path) -> None:
    """Write texts.jsonl, pairs.jsonl, prompts.jsonl and plain.txt, with the words in a computed order."""
    words = TEXT.split()
    lines = [[words[(i * k + k) % len(words)] for i in range(3, 9)] for k in range(1, 33)]
    halves = [(" ".join(line[:3]) + " ", " ".join(line[3:])) for line in lines]
    texts = [{"prompt": a, "completion": b} for a, b in halves]
    pairs = [{"prompt": a, "chosen": f"{b} good", "rejected": f"bad {b}"} for a, b in halves]
    prompts = [{"prompt": a[: 6 + k % 7]} for k, (a, _) in enumerate(halves)]
    for file, rows in (("texts", texts), ("pairs", pairs), ("prompts", prompts)):
        (folder / f"{file}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "plain.txt").write_text("".join(f"{a}{b}.\n" for a, b in halves))


# ------------------------------------------------------------------------------------- in Python


def write_rows(path: Path, rows: list[Any]) -> None:
    """Rows as JSON lines."""
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def agents(folder: Path) -> None:
    """Three agents through the Python interface: iterate, predict, value, save, load, and learn again."""
    import tightrope

    common = {"seed": 3, "num_envs": 2, "num_steps": 32, "threads": 1, "notify": lambda text: None}
    kinds = {"PPO": {"num_epochs": 2, "engine": "torch", "shared": True}, "A2C": {}, "Reinforce": {}}
    pole = np.array([[0.01, -0.02, 0.03, 0.04], [-0.1, 0.5, 0.05, -0.6]], np.float32)
    rows, answers = [], []
    for kind, values in kinds.items():
        agent = getattr(tightrope, kind)("CartPole-v1", **common, **values)
        rows += [{"agent": kind, "step": report.step, **report.metrics} for report in agent.iterate(192)]
        agent.save(folder / kind)
        agent.close()
        again = tightrope.load(folder / kind)
        found = {"best": again.predict(pole)[0], "drawn": again.predict(pole, deterministic=False)[0]}
        found["values"] = again.value(pole)
        answers.append({name: array.tolist() for name, array in found.items()})
        again.learn(64).save(folder / f"{kind}-again")
        again.close()
    write_rows(folder / "metrics.jsonl", rows)
    write_rows(folder / "answers.jsonl", answers)


def judged(folder: Path) -> None:
    """``align`` with two Python rewards, and responses of the resulting model."""
    from tightrope.language import align, sample_run

    prompts = [json.loads(line)["prompt"] for line in Path("prompts.jsonl").read_text().splitlines()]
    align(
        prompts=prompts, reward=[(vowels, 1.0), ("length", 0.1)], run_dir=folder, seed=4, threads=1,
        total_episodes=16, batch_size=8, minibatch_size=4, num_epochs=1, samples_per_prompt=2,
        max_new_tokens=6, critic="none", kl="exact-loss", checkpoint_every=None,
    )  # fmt: skip
    write_rows(folder / "answers.jsonl", sample_run(folder, prompts[:3], seed=5))


if __name__ == "__main__":
    {"agents": agents, "judged": judged}[sys.argv[1]](Path(sys.argv[2]))
