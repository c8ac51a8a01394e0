"""Kill storms: a run that is repeatedly killed and resumed ends like an uninterrupted one.

    python benchmarks/storm.py --kills 75 --stories pendulum workers vector minigrid
    python benchmarks/storm.py --kills 25 --stories language
    python benchmarks/storm.py --cost

Every kill is a SIGKILL at a random moment drawn from a seed: some milliseconds after the k-th update of a
process, or inside a save, which a shim in this script slows down. Between them come SIGTERM and SIGINT, after
which the process has to end with 143 or 130, and with a checkpoint that holds every update that was reported.
There is no manual step in between. The storm records the newest valid checkpoint at each kill. It fails
unless the resumed process begins there and its first new row is the next one. At the end of the run all its
results are compared: SHA-256 of weights, optimiser and normalisers, generators and counters, and every row of
every .jsonl file, except ``seconds`` and ``time/*``. If a run ends before all kills are used, another one
follows.

Processes are forked from this one, which has imported the library and never trained: importing takes most of
the time of a short process, and a resume cannot depend on it.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SLOW = 0.03  # extra seconds for every fsync of a save that will be killed; a save has half a dozen
LEAVE = 120.0  # seconds in which a process has to end after a signal
CLOCKS = ("seconds", "wall_seconds")


# ------------------------------------------------------------------------------------- the runs


def control(env: Any, **values: Any) -> Callable[[Path, Any], None]:
    """A small run on a Gymnasium task or a factory, started, or resumed if it exists."""
    common = {"num_envs": 4, "num_steps": 64, "seed": 1, "evaluation_episodes": 2, "threads": 1}

    def run(folder: Path, report: Any) -> None:
        from tightrope.control.resolve import resolve
        from tightrope.control.train import resume, train

        given = {"listeners": [report], "env": None if isinstance(env, str) else env}
        if (folder / "settings.json").exists():
            resume(folder, **given)
        else:
            train(resolve(env, "ppo", {**common, **values}), run_dir=folder, **given)

    return run


def letters(prompts: list[str], completions: list[str], **columns: Any) -> list[float]:
    """The reward of the language storm: the share of a to m."""
    return [sum(c in "abcdefghijklm" for c in text) / 8 for text in completions]


def language(folder: Path, report: Any) -> None:
    """PPO on a random Llama of two layers: value head, reference, KL controller, shuffled prompts."""
    from tightrope.language.alignment.align import align, resume_align

    prompts = ["".join(random.Random(k).choices("abcdefghijklmnop", k=1 + k % 5)) for k in range(11)]
    given = {"prompts": prompts, "reward": letters, "listeners": [report]}
    if (folder / "settings.json").exists():
        resume_align(folder, **given)
        return
    align(
        model=tiny_llama(folder.parent / "llama"), run_dir=folder, total_episodes=320, batch_size=16,
        minibatch_size=8, max_new_tokens=8, lora_rank=4, learning_rate=1e-2, seed=1, critic="head",
        kl_goal=1.0, kl_horizon=200.0, checkpoint_every=0.1, threads=1, **given,
    )  # fmt: skip


def tiny_llama(folder: Path) -> str:
    """A model folder with random weights and a tokenizer of single characters."""
    if (folder / "config.json").exists():
        return str(folder)
    import torch
    from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers
    from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

    torch.manual_seed(0)
    words = ["<pad>", "<unk>", "<bos>", "<eos>", *"abcdefghijklmnopqrstuvwxyz ."]
    config = LlamaConfig(
        vocab_size=len(words), hidden_size=32, intermediate_size=48, num_hidden_layers=2,
        num_attention_heads=4, num_key_value_heads=2, head_dim=8, max_position_embeddings=128,
        tie_word_embeddings=True, bos_token_id=2, eos_token_id=3, pad_token_id=0, initializer_range=0.2,
    )  # fmt: skip
    LlamaForCausalLM(config).save_pretrained(folder)
    inner = Tokenizer(models.WordLevel({w: i for i, w in enumerate(words)}, unk_token="<unk>"))
    inner.pre_tokenizer = pre_tokenizers.Split(Regex("[\\s\\S]"), "isolated")
    inner.decoder = decoders.Fuse()
    special = {"pad_token": "<pad>", "unk_token": "<unk>", "bos_token": "<bos>", "eos_token": "<eos>"}
    PreTrainedTokenizerFast(tokenizer_object=inner, **special).save_pretrained(folder)
    return str(folder)


def minigrid() -> Any:
    """Doors and keys, seen as a vector; needs the package minigrid."""
    import gymnasium
    import minigrid.wrappers

    env = gymnasium.make("MiniGrid-DoorKey-5x5-v0")
    return gymnasium.wrappers.FlattenObservation(minigrid.wrappers.ImgObsWrapper(env))


def normalised() -> Any:
    """A task whose wrappers keep statistics over all episodes."""
    import gymnasium

    env = gymnasium.wrappers.NormalizeObservation(gymnasium.make("Pendulum-v1"))
    return gymnasium.wrappers.NormalizeReward(env)


def pictures() -> Any:
    """CartPole as an image: a bright column where the cart is, another where the pole points."""
    import gymnasium
    import numpy as np

    def draw(observation: Any) -> Any:
        image = np.zeros((1, 36, 36), np.uint8)
        image[0, :18, int(np.clip(observation[2] * 60 + 18, 0, 35))] = 255
        image[0, 18:, int(np.clip(observation[0] * 7 + 18, 0, 35))] = 255
        return image

    space = gymnasium.spaces.Box(0, 255, (1, 36, 36), np.uint8)
    return gymnasium.wrappers.TransformObservation(gymnasium.make("CartPole-v1"), draw, space)


def masked() -> Any:
    """FrozenLake on its slippery ice, where the way back is forbidden."""
    import gymnasium
    import numpy as np

    class Masked(gymnasium.Wrapper):
        def reset(self, **keywords: Any) -> Any:
            observation, info = self.env.reset(**keywords)
            return observation, {**info, "action_mask": np.ones(4, np.int8)}

        def step(self, action: Any) -> Any:
            observation, *rest, info = self.env.step(action)
            mask = np.arange(4) != (int(action) + 2) % 4
            return observation, *rest, {**info, "action_mask": mask.astype(np.int8)}

    return Masked(gymnasium.make("FrozenLake-v1"))


BASE = {"minibatch_size": 128, "num_epochs": 2, "checkpoint_every": 0.1, "evaluate_every": 0.15}
NORMALISED = {"normalise_observations": True, "normalise_rewards": True}
STORIES: dict[str, Callable[[Path, Any], None]] = {
    "cartpole": control("CartPole-v1", total_steps=8192, **BASE),
    "pendulum": control("Pendulum-v1", total_steps=8192, **BASE, **NORMALISED),
    "workers": control("Pendulum-v1", total_steps=8192, vector_backend="workers", num_workers=2, **BASE),
    "vector": control("CartPole-v1", total_steps=8192, vector_backend="vector", **BASE),
    "gsde": control("Pendulum-v1", total_steps=8192, std="gsde", gsde_steps=7, **BASE),
    "halfcheetah": control(
        "HalfCheetah-v5", total_steps=8192, vector_backend="workers", num_workers=2, **BASE
    ),
    "bipedal": control("BipedalWalker-v3", total_steps=8192, vector_backend="serial", **BASE, **NORMALISED),
    "masks": control(masked, total_steps=8192, **BASE),
    "wrappers": control(normalised, total_steps=8192, **BASE),
    "cnn": control(pictures, total_steps=2048, **{**BASE, "num_steps": 32, "minibatch_size": 64}),
    "minigrid": control(minigrid, total_steps=8192, **BASE),
    "language": language,
}
NEEDS = {"halfcheetah": "mujoco", "bipedal": "Box2D", "minigrid": "minigrid"}  # left out without the package


# ------------------------------------------------------------------------------------- processes


class Process:
    """A forked process that trains ``folder``; it reports its start, each update, each save and its end."""

    def __init__(self, story: str, folder: Path, slow: bool) -> None:
        ours, theirs = os.pipe()
        self.pid = os.fork()
        if not self.pid:
            os.close(ours)
            os._exit(_live(story, folder, slow, theirs))
        os.close(theirs)
        self._lines = _lines(ours)

    def events(self) -> Iterator[tuple[str, int]]:
        """(what, step) until the process has ended; RuntimeError if it failed."""
        for line in self._lines:
            what, step = line.split()
            yield what, int(step)
        _, status = os.waitpid(self.pid, 0)
        if status:
            raise RuntimeError(f"a process of the storm failed with status {status}; what it said is above")

    def end(self, by: str) -> tuple[list[tuple[str, int]], int]:
        """Send a signal and wait for the end; what had not been read, and the exit code (-n: by signal n)."""
        os.kill(self.pid, signal.Signals[by])
        late = threading.Timer(LEAVE, os.kill, (self.pid, signal.SIGKILL))
        late.start()
        unread = [line.split() for line in self._lines]
        code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        late.cancel()
        return [(what, int(step)) for what, step in unread], code


def _lines(descriptor: int) -> Iterator[str]:
    with os.fdopen(descriptor, encoding="ascii") as file:
        yield from file


def _live(story: str, folder: Path, slow: bool, out: int) -> int:
    """The code that a forked process runs."""
    from tightrope.runs import checkpoint
    from tightrope.runs.signals import Stopped

    def tell(what: str, step: int) -> None:
        os.write(out, f"{what} {step}\n".encode())

    def report(event: Any) -> None:
        from tightrope.training.events import Started, Updated

        if isinstance(event, Started | Updated):
            tell("start" if isinstance(event, Started) else "update", event.step)

    save, sync = checkpoint.save, os.fsync

    def told(place: Path, *arguments: Any, **more: Any) -> Path:
        tell("save", max(0, checkpoint.step_of(Path(place))))
        if slow:
            os.fsync = lambda descriptor: (time.sleep(SLOW), sync(descriptor))[1]
        found = save(place, *arguments, **more)
        tell("saved", max(0, checkpoint.step_of(Path(place))))
        return found

    checkpoint.save = told
    try:
        STORIES[story](folder, report)
        return 0
    except Stopped as stop:
        return stop.code
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        return 1


# ------------------------------------------------------------------------------------- the storm


def newest(folder: Path) -> tuple[int, bool]:
    """The step of the newest valid checkpoint, 0 without one, and whether its row is not recorded yet."""
    from tightrope.runs import checkpoint
    from tightrope.runs.run import Run

    try:
        point = Run.open(folder).newest()
    except ValueError:
        return 0, False
    return checkpoint.step_of(point.folder), bool(point.state.get("pending"))


def storm(story: str, kills: int, seed: int, deadline: float, base: Path) -> dict[str, Any]:
    """Kill runs of one story ``kills`` times, or until the deadline; every started run is finished."""
    draw = random.Random(f"{story} {seed}")
    whole = base / story / "whole"
    list(Process(story, whole, slow=False).events())
    wanted, log, rounds = left(whole), [], 0
    steps = [row["step"] for row in wanted["rows"]["metrics.jsonl"]]
    while killed_in(log) < kills and time.monotonic() < deadline:
        folder, rounds, ended = base / story / f"run-{rounds}", rounds + 1, False
        while not ended:
            more = killed_in(log) < kills and time.monotonic() < deadline
            plan = planned(draw) if more else None
            begin, pending = newest(folder) if folder.exists() else (0, False)
            process = Process(story, folder, slow=bool(plan and plan["inside"]))
            first, killed = follow(process, plan)
            check_first(story, begin, first, [begin] if pending else steps)
            if killed is None:
                ended = True
                continue
            found, _ = newest(folder)
            if plan["by"] != "SIGKILL":
                check_left(story, folder, plan, killed, found)
            log.append({"kill": killed_in(log) + 1, "run": rounds, **plan, **killed, "newest": found})
            print(f"{story}: {json.dumps(log[-1])}", flush=True)
        compare(story, wanted, left(folder))
        shutil.rmtree(folder)
    count, inside = killed_in(log), sum(entry["inside"] and entry["by"] == "SIGKILL" for entry in log)
    others = len(log) - count
    print(
        f"{story}: {count} kills, {inside} inside a save, {others} other signals, {rounds} runs, every one "
        "bit-equal",
        flush=True,
    )
    counts = {"kills": count, "inside_a_save": inside, "signals": others, "runs": rounds, "all_equal": True}
    return {**counts, "rows": len(steps), "sha256": wanted["sha256"], "log": log}


def planned(draw: random.Random) -> dict[str, Any]:
    """The next kill: in the k-th save from the start of the process, or after its k-th update."""
    inside = draw.random() < 0.65  # some of these saves end before the kill
    after = draw.choice([1, 2, 2, 3]) if inside else draw.choice([0, 1, 2, 3, 5, 7])
    return {
        "inside": inside,
        "after": after,
        "delay": round(draw.uniform(0, 6 * SLOW if inside else 0.05), 4),
        "by": draw.choice(["SIGKILL", "SIGKILL", "SIGKILL", "SIGTERM", "SIGINT"]),
    }


def killed_in(log: list[dict[str, Any]]) -> int:
    """How many of the entries are kills."""
    return sum(entry["by"] == "SIGKILL" for entry in log)


def follow(process: Process, plan: dict[str, Any] | None) -> tuple[dict[str, int], dict[str, Any] | None]:
    """Watch a process and kill it as planned; returns its first step, its first row and the kill."""
    first, count, reported = dict[str, int](), 0, 0
    for what, step in process.events():
        if what in ("start", "update"):
            first.setdefault(what, step)
            reported = step
        if plan is None:
            continue
        count += what == ("save" if plan["inside"] else "update")
        if count == plan["after"] and what in (("save",) if plan["inside"] else ("start", "update")):
            time.sleep(plan["delay"])
            unread, code = process.end(plan["by"])
            # a save that had already ended does not count as a kill inside a save
            inside = plan["inside"] and "saved" not in dict(unread)
            reported = max([reported, *(step for what, step in unread if what == "update")])
            return first, {"step": step, "inside": inside, "code": code, "reported": reported}
    return first, None


def check_left(story: str, folder: Path, plan: dict[str, Any], left: dict[str, Any], found: int) -> None:
    """Fail unless a process that was asked to stop ended in order and lost no update that it had recorded."""
    wanted = 128 + signal.Signals[plan["by"]]
    if not (left["code"] == wanted or (folder / "summary.json").exists()) or found < left["reported"]:
        raise SystemExit(f"{story}: {plan} ended with {left}, the newest checkpoint is that of step {found}")


def check_first(story: str, begin: int, first: dict[str, int], steps: list[int]) -> None:
    """Fail unless a process began at the newest checkpoint and its first row is the next one, or that of the
    checkpoint itself where it was not recorded yet (``steps``: it alone).
    """
    row = steps[0] if steps == [begin] else next((step for step in steps if step > begin), None)
    if first.get("start", begin) != begin or first.get("update", row) != row:
        raise SystemExit(f"{story}: a resume from checkpoint {begin} began with {first}, expected row {row}")


def left(folder: Path) -> dict[str, Any]:
    """The results of a finished run: rows, and hashes of tensors and of the state without clock times."""
    from tightrope.runs.run import Run

    last = Run.open(folder).newest().folder
    found = {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in last.glob("*.safetensors")}
    state = without_clocks(json.loads((last / "state.json").read_text()))
    found["state"] = hashlib.sha256(json.dumps(state, sort_keys=True).encode()).hexdigest()
    rows = {}
    for path in sorted(folder.glob("*.jsonl")):
        if path.name == "actions.jsonl":  # it grows by checkpoints; what it is for shows in the rest
            continue
        rows[path.name] = [without_clocks(json.loads(line)) for line in path.read_text().splitlines()]
    return {"checkpoint": last.name, "sha256": found, "rows": rows}


def without_clocks(value: Any) -> Any:
    """A JSON value without clock times."""
    if isinstance(value, list):
        return [without_clocks(item) for item in value]
    if not isinstance(value, dict):
        return value
    # a checkpoint stores the lengths of the files, and rows with other durations have other lengths
    kept = {k: v for k, v in value.items() if k not in (*CLOCKS, "records") and not k.startswith("time/")}
    return {k: without_clocks(v) for k, v in kept.items()}


def compare(story: str, wanted: dict[str, Any], found: dict[str, Any]) -> None:
    """Fail at the first difference."""
    for name in ("checkpoint", "sha256", "rows"):
        if wanted[name] != found[name]:
            raise SystemExit(
                f"{story}: {name} differ from the run without a break:\n{wanted}\n{found}"[:4000]
            )


# ------------------------------------------------------------------------------------- what a save costs


def cost(base: Path, steps: int) -> dict[str, Any]:
    """Seconds of a checkpoint of CartPole-v1 at default settings: save and sync."""
    from tightrope.control import train
    from tightrope.control.resolve import resolve
    from tightrope.runs.run import Run

    spent: list[float] = []
    save = Run.save

    def timed(*arguments: Any, **more: Any) -> None:
        begin = time.perf_counter()
        save(*arguments, **more)
        spent.append(time.perf_counter() - begin)

    Run.save = timed  # type: ignore[method-assign]
    settings = resolve("CartPole-v1", "ppo", {"total_steps": steps, "seed": 1, "evaluate_every": None})
    begin = time.perf_counter()
    train.train(settings, run_dir=base / "cost")
    wall = time.perf_counter() - begin
    point = sum(spent) / len(spent)
    return {
        "steps": steps, "wall_seconds": round(wall, 2), "points": len(spent),
        "seconds_a_point": round(point, 5), "share_of_this_run": round(sum(spent) / wall, 5),
        "share_of_ten_minutes": round(20 * point / 600, 6),
    }  # fmt: skip


def main(words: list[str] | None = None) -> int:
    """Run the requested storms and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    here = [name for name in STORIES if name not in NEEDS or importlib.util.find_spec(NEEDS[name])]
    parser.add_argument("--stories", nargs="+", choices=[*STORIES], default=here)
    parser.add_argument("--kills", type=int, default=12, help="of each story")
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no more is killed")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cost", type=int, metavar="STEPS", help="measure checkpoints instead")
    parser.add_argument("--out", type=Path, help="JSON to write, or to add to")
    given = parser.parse_args(words)
    for name in sorted(set(STORIES) - set(here)):
        print(f"{name} needs {NEEDS[name]}, which is not installed: left out unless named", file=sys.stderr)
    import torch

    torch.set_num_threads(1)
    from tightrope.runs.versions import known

    found = json.loads(given.out.read_text()) if given.out and given.out.exists() else {"stories": {}}
    deadline = time.monotonic() + 60 * given.minutes
    command = " ".join(["python", "benchmarks/storm.py", *(sys.argv[1:] if words is None else words)])
    with tempfile.TemporaryDirectory(prefix="storm-") as base:
        if given.cost:
            found["cost"] = {"command": command, **cost(Path(base), given.cost)}
            print(json.dumps(found["cost"]))
        for story in () if given.cost else given.stories:
            warm(story)
            begin = time.monotonic()
            result = storm(story, given.kills, given.seed, deadline, Path(base))
            seconds = round(time.monotonic() - begin, 1)
            found["stories"][story] = {"command": command, "seconds": seconds, **known(), **result}
            write(given.out, found)
    write(given.out, found)
    return 0


def write(out: Path | None, found: dict[str, Any]) -> None:
    """The results as JSON, one line for every kill."""
    if out is not None:
        text = json.dumps(found, indent=1)
        out.write_text(
            re.sub(r"\{\s+(\"kill\":[^}]*?)\s+\}", lambda m: "{" + " ".join(m[1].split()) + "}", text) + "\n"
        )


def warm(story: str) -> None:
    """Import everything that the story's processes need."""
    if story == "language":
        import transformers

        import tightrope.language.alignment.align

        transformers.utils.logging.disable_progress_bar()
    else:
        import gymnasium

        import tightrope.control.engine.compiled_engine
        import tightrope.control.train  # noqa: F401

        gymnasium.make("CartPole-v1").close()


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "src"))
    sys.exit(main())
