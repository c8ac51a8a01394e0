"""Real packages of tasks: train, evaluate, resume, load and predict, in Python and on the command line.

    python -m venv VENV && VENV/bin/python -m pip install PACKAGES -e .  # --needs prints PACKAGES
    python benchmarks/packages.py --python VENV/bin/python               # writes results/packages.json
    python benchmarks/packages.py --python VENV/bin/python --tasks pusht,catch
    python benchmarks/packages.py --registry                             # PPO(gym.make(id)) for every id

Each task is a process of its own. ``held`` lists the steps that went well, ``error`` says what did not,
``told`` what a user was told. A task that must be refused has the words of the refusal in the table.
--registry makes an agent from an instance of every id of gymnasium, ale_py and minigrid, which has to work
without a message.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.metadata
import io
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "packages.json"
LIMIT = 900  # seconds for a task
FIRST, LAST = 1_024, 2_048  # steps of a run, and after its resume
SHORT = {"num_steps": 64, "evaluation_episodes": 2, "evaluate_every": 1.0, "evaluation_max_steps": 1_000}
KEYS = {"observation_keys": ("image", "direction")}
REGISTRIES = ("gymnasium", "ale_py", "minigrid")


class Crafter(gym.Env):
    """Crafter has the interface of an older Gym; this is what a user writes around it."""

    def __init__(self) -> None:
        import crafter

        self.game = crafter.Env()
        self.observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = gym.spaces.Discrete(17)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        if seed is not None:
            self.game._seed, self.game._episode = seed, 0
        return self.game.reset(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict]:
        seen, reward, ended, info = self.game.step(action)
        dead = info["discount"] == 0
        return seen, float(reward), ended and dead, ended and not dead, {}


class Package(NamedTuple):
    """A task: its ``package``, the ``module`` that registers it, what to train on, the settings given."""

    package: str
    module: str
    env: str | Callable[[], gym.Env]
    values: dict[str, Any] = {}  # noqa: RUF012 - never changed
    steps: int = 1_024
    refused: str = ""


PACKAGES = {
    "minigrid": Package("minigrid", "minigrid", "MiniGrid-Empty-5x5-v0", KEYS, 50_000),
    "minigrid-text": Package("minigrid", "minigrid", "MiniGrid-Empty-5x5-v0", refused="--observation-keys"),
    "babyai": Package("minigrid", "minigrid", "BabyAI-GoToLocal-v0", KEYS),
    "highway": Package("highway-env", "highway_env", "highway-fast-v0"),
    "parking": Package("highway-env", "highway_env", "parking-v0"),
    "pointmaze": Package("gymnasium-robotics", "gymnasium_robotics", "PointMaze_UMaze-v3"),
    "pusht": Package("gym-pusht", "gym_pusht", "gym_pusht/PushT-v0"),
    "stocks": Package("gym-anytrading", "gym_anytrading", "stocks-v0", steps=20_480),
    "crafter": Package("crafter", "crafter", Crafter),
    "panda": Package("panda-gym", "panda_gym", "PandaReach-v3"),
    "flappy": Package("flappy-bird-gymnasium", "flappy_bird_gymnasium", "FlappyBird-v0"),
    "flappy-lidar": Package(
        "flappy-bird-gymnasium", "flappy_bird_gymnasium", "FlappyBird-v0", {"env_kwargs": {"use_lidar": True}}
    ),
    "catch": Package("bsuite", "shimmy", "bsuite/catch-v0"),
    "deep-sea": Package("bsuite", "shimmy", "bsuite/deep_sea-v0", {"env_kwargs": {"size": 10}}),
    "mo-mountaincar": Package("mo-gymnasium", "mo_gymnasium", "mo-mountaincar-v0", refused="reward"),
}


# --------------------------------------------------------------------------------------------------- one task


def in_python(task: Package, folder: Path, told: list[str]) -> Iterator[str]:
    """The names of the steps that went well, in Python."""
    import tightrope
    from tightrope.control.evaluate import evaluate_run
    from tightrope.control.train import resolve, resume, train
    from tightrope.training.events import Message

    own = None if isinstance(task.env, str) else task.env

    def keep(event: Any) -> None:
        if isinstance(event, Message):
            told.append(event.text)

    agent = tightrope.PPO(task.env, seed=0, notify=told.append, **task.values)
    agent.learn(task.steps)
    yield "learn"
    observation = _first_observation(agent)
    action, _ = agent.predict(observation)
    agent.value(observation)
    agent.save(folder / "agent")
    agent.close()
    yield "predict"
    again = tightrope.load(folder / "agent", env=own)
    _require_equal(action, again.predict(observation)[0])
    again.close()
    yield "load"
    run = folder / "python"
    small = SHORT | {"total_steps": FIRST, "seed": 0}
    train(resolve(task.env, "ppo", small | task.values), run_dir=run, env=own, listeners=[keep])
    yield "train"
    found = evaluate_run(run, env=own, episodes=2)
    assert np.isfinite(found["mean_return"])
    yield "evaluate"
    summary = resume(run, total_steps=LAST, env=own, listeners=[keep])
    assert summary["steps"] > FIRST, summary
    yield "resume"
    tightrope.load(run, env=own).close()
    yield "load of the run"


def _first_observation(agent: Any) -> Any:
    """One observation of a copy of the agent's task."""
    env = agent.env() if callable(agent.env) else gym.make(agent.env, **(agent.settings.env_kwargs or {}))
    with contextlib.closing(env):
        return env.reset(seed=0)[0]


def _require_equal(one: Any, other: Any) -> None:
    assert np.array_equal(np.asarray(one), np.asarray(other)), (one, other)


def on_the_command_line(task: Package, folder: Path) -> Iterator[str]:
    """The names of the commands that went well."""
    flags = []
    for name, value in task.values.items():
        parts = [f"{key}={part}" for key, part in value.items()] if isinstance(value, dict) else [*value]
        flags += [f"--{name.replace('_', '-')}", *parts]
    module, run = ["--env-module", task.module, "--json"], str(folder / "cli")
    train = ["train", str(task.env), *flags, "--run-dir", run, "--total-steps", str(FIRST), "--seed", "0"]
    for name, value in SHORT.items():
        train += [f"--{name.replace('_', '-')}", str(value)]
    for words in (
        train,
        ["evaluate", run, "--episodes", "2"],
        ["resume", run, "--total-steps", str(LAST)],
    ):
        ended = subprocess.run(
            [sys.executable, "-m", "tightrope", *words, *module], capture_output=True, text=True
        )
        if ended.returncode:
            said = ended.stderr.strip()[-600:]
            raise RuntimeError(f"tightrope {words[0]}: code {ended.returncode}: {said}")
        json.loads(ended.stdout.splitlines()[-1])
        yield f"tightrope {words[0]}"


def examined(name: str) -> dict[str, Any]:
    """The row of a task."""
    task, told, held, error = PACKAGES[name], [], [], ""
    importlib.import_module(task.module)
    begin, versions = time.perf_counter(), {task.package: importlib.metadata.version(task.package)}
    with (
        warnings.catch_warnings(record=True) as heard,
        contextlib.redirect_stderr(io.StringIO()),
        tempfile.TemporaryDirectory() as place,
    ):
        warnings.simplefilter("default")
        try:
            held += in_python(task, Path(place), told)
            if isinstance(task.env, str):
                held += on_the_command_line(task, Path(place))
        except Exception as problem:
            error = f"{type(problem).__name__}: {problem}"
    good = bool(error) and task.refused in error if task.refused else not error
    told += [f"{item.category.__name__}: {item.message}" for item in heard]
    return {
        "task": name,
        "env": task.env if isinstance(task.env, str) else task.env.__name__,
        "given": task.values,
        "versions": versions,
        "right": good,
        "held": held,
        "told": [line for line in dict.fromkeys(told) if not line.startswith("engine check")],
        "error": error,
        "seconds": round(time.perf_counter() - begin, 1),
    }


# ------------------------------------------------------------------------------------------------ every id


def registry(words: list[str]) -> dict[str, Any]:
    """PPO of an instance of every id: those that do not work, or say something, and what they say."""
    import tightrope

    found: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for module in REGISTRIES:
        gym.register_envs(importlib.import_module(module))
    for env_id, spec in list(gym.registry.items()):
        package = str(spec.entry_point).partition(":")[0].partition(".")[0]
        if package not in REGISTRIES or (words and not any(word in (package, env_id) for word in words)):
            continue
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                env = gym.make(env_id)
        except Exception as error:  # no task to learn: removed, or its package is not there
            counts[f"{package}: cannot be made ({type(error).__name__})"] += 1
            continue
        told: list[str] = []
        try:
            with warnings.catch_warnings(record=True) as heard:
                warnings.simplefilter("always")
                more = KEYS if package == "minigrid" else {}
                with contextlib.closing(
                    tightrope.PPO(env, num_envs=2, num_steps=16, notify=told.append, **more)
                ):
                    told += [str(item.message) for item in heard]
        except Exception as error:
            told.append(f"{type(error).__name__}: {error}")
        finally:
            env.close()
        counts[f"{package}: {'told' if told else 'without a message'}"] += 1
        if told:
            found[env_id] = "; ".join(told)
        print(env_id, found.get(env_id, ""), file=sys.stderr, flush=True)
    return {"counts": dict(counts), "told": found}


# ----------------------------------------------------------------------------------------------------- all


def apart(python: str, words: list[str]) -> dict[str, Any]:
    """What this file finds with ``words`` in a process of another interpreter."""
    source = str(HERE.parent / "src")
    environment = {**os.environ, "SDL_VIDEODRIVER": "dummy", "OMP_NUM_THREADS": "1", "PYTHONPATH": source}
    command = [python, str(Path(__file__).resolve()), *words, "--here"]
    try:
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT)
        return json.loads(ended.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        return {"right": False, "error": f"not back after {LIMIT} s"}
    except (IndexError, json.JSONDecodeError):
        return {"right": False, "error": f"code {ended.returncode}: {ended.stderr.strip()[-600:]}"}


def main() -> int:
    """Run the tasks asked for, and write their rows beside those of the others."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--python", default=sys.executable, metavar="FILE", help="interpreter with the packages"
    )
    parser.add_argument("--tasks", default=",".join(PACKAGES), metavar="A,B", help="which, of the table")
    parser.add_argument(
        "--registry", nargs="*", metavar="WORD", help="every id, or those of packages, or some ids"
    )
    parser.add_argument("--needs", action="store_true", help="print the packages")
    parser.add_argument("--here", action="store_true", help="in this interpreter, only print the JSON")
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    if given.needs:
        print(*sorted({task.package for task in PACKAGES.values()} | {"shimmy[bsuite]", "ale-py"}))
        return 0
    if given.registry is not None:
        print(json.dumps(registry(given.registry)))
        return 0
    names = given.tasks.split(",")
    if given.here:
        print(json.dumps(examined(names[0])))
        return 0
    rows = (
        {row["task"]: row for row in json.loads(given.out.read_text())["rows"]} if given.out.exists() else {}
    )
    for name in names:
        rows[name] = {"task": name, "date": str(date.today()), **apart(given.python, ["--tasks", name])}
        row = rows[name]
        print(
            f"{name:<16} {'right' if row['right'] else 'WRONG'} {row.get('seconds')} s {row['error'][:300]}"
        )
        for line in row.get("told", ()):
            print(f"    {line[:300]}")
        command = "python benchmarks/packages.py --python VENV/bin/python"
        ordered = [rows[key] for key in PACKAGES if key in rows]
        given.out.write_text(json.dumps({"command": command, "rows": ordered}, indent=1) + "\n")
    return 0 if all(row["right"] for row in rows.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
