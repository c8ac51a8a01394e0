"""Write the run folders of a day and their expected results.

The folder 2026-11-22 was written by the code of commit e364bf9 and this script as it was at 272412e:

    git worktree add /tmp/old e364bf9
    git worktree add /tmp/then 272412e
    cd /tmp/then
    PYTHONPATH=/tmp/old/src:tests python -W ignore tests/old_runs/write.py /tmp/2026-11-22

A new one, with the code of today, beside the old ones:

    PYTHONPATH=src:tests python tests/old_runs/write.py tests/old_runs/YYYY-MM-DD

``--expected`` does not touch the runs, which are never rewritten, and records their results again: for a
change that alters them on purpose. expected/machine.json records Python, libraries and processor.

Runs that end in ``-killed``, and the control runs, were killed by SIGKILL after a checkpoint: they have rows
after it and the lock note of a writer that is gone. sft, reward and align are finished. Before anything is
recorded, each killed run is resumed and compared, bit for bit, with an uninterrupted one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from language.tiny import WORDS, tokenizer
from old_runs.comparison import How, machine, require_same
from old_runs.outcomes import ASKED, ENVIRONMENTS, Outcome, end_of
from safetensors.torch import save_file

import tightrope
from tightrope.control.resolve import resolve
from tightrope.control.train import train
from tightrope.language.alignment.align import align
from tightrope.language.settings import RewardSettings, SFTSettings
from tightrope.language.supervised.preferences import train_reward
from tightrope.language.supervised.sft import train_sft
from tightrope.training.events import Event, Updated

SHORT = {"num_envs": 4, "hidden": (8,), "seed": 3, "threads": 1, "evaluation_episodes": 2}
CONTROL: dict[str, tuple[Any, str, dict[str, Any], int]] = {  # environment, algorithm, settings, killed at
    "cartpole": (
        "CartPole-v1",
        "ppo",
        {
            **SHORT, "engine": "fused", "total_steps": 2000, "num_steps": 50, "minibatch_size": 50,
            "num_epochs": 3, "learning_rate": 3e-3, "checkpoint_every": 0.4, "evaluate_every": 0.2,
        },
        1400,
    ),
    "pendulum": (
        "Pendulum-v1",
        "ppo",
        {
            **SHORT, "engine": "torch", "total_steps": 1600, "num_steps": 50, "minibatch_size": 100,
            "num_epochs": 2, "std": "gsde", "gsde_steps": 7, "normalise_observations": True,
            "normalise_rewards": True, "kl_beta": 0.1, "kl_adapt": 0.01, "checkpoint_every": 0.5,
            "evaluate_every": 0.5,
        },
        1000,
    ),
    "walk": (
        ENVIRONMENTS["walk"],
        "a2c",
        {
            **SHORT, "engine": "torch", "total_steps": 1000, "num_steps": 25, "checkpoint_every": 0.41,
            "evaluate_every": 0.41, "normalise_observations": True,
        },
        700,
    ),
}  # fmt: skip
STAGE = {
    "max_tokens": 24, "held_out": 0.25, "learning_rate": 1e-2, "threads": 1, "seed": 2,
    "num_epochs": 2, "minibatch_size": 2, "checkpoint_every": 0.5, "keep_checkpoints": 2,
}  # fmt: skip
SFT = {**STAGE, "model": "base", "tune": "full", "data": "texts.jsonl"}
REWARD = {**STAGE, "model": "sft/model", "lora_rank": 2, "data": "pairs.jsonl"}
ALIGN = {
    "model": "sft/model", "data": "prompts.txt", "reward": "reward", "gold": "length", "total_episodes": 40,
    "batch_size": 8, "minibatch_size": 4, "num_epochs": 2, "max_new_tokens": 5, "max_prompt_tokens": 12,
    "lora_rank": 2, "seed": 1, "learning_rate": 1e-2, "checkpoint_every": 0.5, "evaluate_every": 0.4,
    "kl_goal": 1.0, "kl_horizon": 50.0, "threads": 1, "held_out_prompts": 1, "ptx_weight": 0.1,
    "ptx_data": "texts.jsonl", "critic": "adapter", "keep_checkpoints": 2,
}  # fmt: skip
KILLED = {"sft": 4, "reward": 4, "align": 32}  # at this step, or response


def stories() -> dict[str, Any]:
    """Name -> what trains it, given ``run_dir`` and ``report``."""

    def control(name: str) -> Any:
        env, algorithm, values, _ = CONTROL[name]
        source = env if not isinstance(env, str) else None
        return lambda **how: train(resolve(env, algorithm, values), env=source, **how)

    return {
        **{name: control(name) for name in CONTROL},
        "sft": lambda **how: train_sft(SFTSettings(**SFT), **how),
        "reward": lambda **how: train_reward(RewardSettings(**REWARD), **how),
        "align": lambda **how: align(**ALIGN, **how),
    }


def base_model(folder: Path) -> None:
    """A Llama of 5,000 parameters with predictions that are far from uniform."""
    from transformers import LlamaConfig, LlamaForCausalLM

    torch.manual_seed(0)
    config = LlamaConfig(
        vocab_size=len(WORDS), hidden_size=16, intermediate_size=24, num_hidden_layers=2,
        num_attention_heads=2, num_key_value_heads=1, head_dim=8, max_position_embeddings=48,
        tie_word_embeddings=True, bos_token_id=2, eos_token_id=3, pad_token_id=0, initializer_range=0.1,
    )  # fmt: skip
    model = LlamaForCausalLM(config)
    with torch.no_grad():
        model.model.norm.weight.mul_(3.0)
    model.save_pretrained(folder)
    tokenizer().save_pretrained(folder)


def write_data() -> None:
    """Texts, pairs and prompts, in the current folder."""
    texts = [f"{a} is {b}." for a, b in zip("abcdefgh", "ponmlkji", strict=True)]
    pairs = [{"prompt": f"{c} is ", "chosen": "good.", "rejected": "bad, why?"} for c in "abcdefgh"]
    for name, rows in (("texts.jsonl", [{"text": text} for text in texts]), ("pairs.jsonl", pairs)):
        Path(name).write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    Path("prompts.txt").write_text("ab\ncde\nf\nghij\nkl\nmno\np\n", encoding="utf-8")


def die_at(name: str, run: str, at: int) -> None:
    """Train, and leave this process at a step as SIGKILL would."""

    def listen(event: Event) -> None:
        if isinstance(event, Updated) and event.step >= at:
            os._exit(9)

    stories()[name](run_dir=run, listeners=[listen])
    raise AssertionError(f"{name} came to its end before {at}")


def killed(name: str, run: str, at: int) -> None:
    """A run that was killed; the note of its writer names no machine."""
    words = [sys.executable, *sys.orig_argv[1 : sys.orig_argv.index(sys.argv[0])], __file__]
    there = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # absolute: we moved
    ended = subprocess.run([*words, "--die", name, run, str(at)], check=False, env=there)
    assert ended.returncode == 9, ended
    note = {"pid": 4711, "host": "gpu1", "started": "2026-11-22 14:30:00"}
    Path(run, "writer.lock").write_text(json.dumps(note) + "\n", encoding="utf-8")


def write_runs() -> None:
    """Every run, in the current folder, each killed one compared with an uninterrupted one."""
    base_model(Path("base"))
    write_data()
    for name, make in stories().items():
        at = CONTROL[name][3] if name in CONTROL else KILLED[name]
        run = name if name in CONTROL else f"{name}-killed"
        make(run_dir="whole")
        killed(name, run, at)
        with copied(Path.cwd()):
            require_same(*map(everything, (end_of("whole"), ASKED[f"{name}-resumed"][1](run))), ALONE, name)
        if name in CONTROL:
            shutil.rmtree("whole")
        else:
            os.rename("whole", name)


ALONE = How(True, "a killed run ends where one without a break does")


def everything(found: Outcome) -> dict[str, Any]:
    """An outcome as one thing to compare."""
    return {"numbers": found.numbers, "tensors": found.tensors}


@contextlib.contextmanager
def copied(folder: Path) -> Iterator[None]:
    """Change into a copy of a folder."""
    with tempfile.TemporaryDirectory() as place:
        shutil.copytree(folder, Path(place, "copy"))
        with contextlib.chdir(Path(place, "copy")):
            yield


def write_expected(folder: Path) -> None:
    """expected/ of the runs of a day; each question uses a fresh copy."""
    shutil.rmtree(folder / "expected", ignore_errors=True)
    kept: dict[str, Outcome] = {}
    for name, (run, question) in ASKED.items():
        with copied(folder):
            kept[name] = question(run)
    (folder / "expected").mkdir()
    for name, found in kept.items():
        text = json.dumps(found.numbers, indent=1, allow_nan=False) + "\n"
        (folder / "expected" / f"{name}.json").write_text(text, encoding="utf-8")
        if found.tensors:
            tensors = {key: tensor.contiguous().clone() for key, tensor in found.tensors.items()}
            save_file(tensors, folder / "expected" / f"{name}.safetensors")
    text = json.dumps(machine(), indent=1) + "\n"
    (folder / "expected" / "machine.json").write_text(text, encoding="utf-8")


def main() -> None:
    """Read the arguments and write the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, help="the folder of the day")
    parser.add_argument("--expected", action="store_true", help="leave the runs, record again what they give")
    parser.add_argument("--die", nargs=3, metavar=("NAME", "RUN", "STEP"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.die:
        die_at(given.die[0], given.die[1], int(given.die[2]))
    folder = given.folder.resolve()
    print(f"with {tightrope.__file__}")
    if not given.expected:
        folder.mkdir()
        with contextlib.chdir(folder):
            write_runs()
    write_expected(folder)


if __name__ == "__main__":
    main()
