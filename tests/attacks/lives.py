"""Whole commands in a process that is audited from its start: normal runs of control and language.

The place, the folders, the texts and the names in them contain MARK: nothing of them can be compiled,
executed or imported unnoticed. Only files that a command line names may run, and only in that command.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from attacks.watch import MARK, Watch, outcome

PLACE = Path(sys.argv[1])
SPAWNED = __name__ == "__mp_main__"  # a worker that has not yet taken over the user's factory
WATCH = Watch(PLACE, strict=True, worker=SPAWNED)
WATCH.armed = SPAWNED

TASKS = f"""
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv
if "{MARK}/Own-v0" not in gymnasium.registry:
    gymnasium.register("{MARK}/Own-v0", CartPoleEnv, max_episode_steps=50)
"""
SMALL = [
    "--num-envs", "4", "--num-steps", "32", "--minibatch-size", "64", "--hidden", "8",
    "--evaluation-episodes", "1", "--checkpoint-every", "0.5", "--quiet",
]  # fmt: skip
TINY = ["--threads", "1", "--lora-rank", "2", "--quiet"]
FAST = [
    "--total-episodes", "8", "--batch-size", "4", "--minibatch-size", "4", "--num-epochs", "1",
    "--max-new-tokens", "2", "--max-prompt-tokens", "16", "--checkpoint-every", "0.5", *TINY,
]  # fmt: skip
WORKERS = ["--vector-backend", "workers", "--num-workers", "2"]
KINDS = ("AutoConfig", "AutoTokenizer", "AutoModelForCausalLM", "AutoModelForSequenceClassification")


def run(*words: Any) -> dict[str, Any]:
    """The outcome of one command."""
    texts = [str(word) for word in words]
    WATCH.allowed = tuple(text.partition(":")[0] for text in texts if ".py" in text)

    def command() -> int:
        from tightrope.cli.main import main  # heard, too

        return main(texts)

    with WATCH.forbid_pickle():
        return outcome(WATCH, command)


def control() -> dict[str, Any]:
    """Both engines, worker processes, a custom task."""
    life, again, own = (PLACE / f"{MARK}-{name}" for name in ("life", "again", "own"))
    tasks = PLACE / f"{MARK}_tasks.py"
    tasks.write_text(TASKS)
    named = ("--env-module", tasks)
    short = ("--total-steps", "512")
    return {
        "train": run(
            "train", "CartPole-v1", "--run-dir", life, *short, *SMALL, *WORKERS,
            "--engine", "fused", "--normalise-observations",
        ),
        "evaluate": run("evaluate", life, "--episodes", "2"),
        "resume": run("resume", life, "--total-steps", "640", "--quiet"),
        "train again": run(
            "train", "--settings", life, "--run-dir", again, "--engine", "torch", "--vector-backend",
            "serial", "--quiet",
        ),
        "resume again": run("resume", again, "--total-steps", "768", "--quiet"),
        "train own": run(
            "train", f"{MARK}/Own-v0", *named, "--run-dir", own, *short, *SMALL, *WORKERS, "--engine", "torch"
        ),
        "evaluate own": run("evaluate", own, *named, "--episodes", "2"),
        "resume own": run("resume", own, *named, "--total-steps", "640", "--quiet"),
    }  # fmt: skip


def spawned() -> dict[str, Any]:
    """After `control`, in a process that has not imported the task: workers as they start elsewhere."""
    own, life = PLACE / f"{MARK}-own", PLACE / f"{MARK}-spawned"
    found = {
        "evaluate unnamed": run("evaluate", own, "--episodes", "2"),
        "resume unnamed": run("resume", own, "--total-steps", "768", "--quiet"),
    }
    context = multiprocessing.get_context("spawn")
    with mock.patch("tightrope.control.environments.pool.start_context", lambda: context):
        found["train"] = run(
            "train", "CartPole-v1", "--run-dir", life, "--total-steps", "256", *SMALL, *WORKERS,
            "--engine", "torch",
        )  # fmt: skip
    return found


def language() -> dict[str, Any]:
    """The three stages, each resumed, and a custom reward function."""
    from language.tiny import saved, tiny_llama

    saved(PLACE / "model", tiny_llama(1), chat=True)
    judge = PLACE / f"{MARK}_judge.py"
    judge.write_text(f"def score(completions, **_): return [1.0] * len(completions)  # {MARK}\n")
    data = {
        "texts": [{"text": f"{MARK} {letter}"} for letter in "cdefgh"],
        "pairs": [{"prompt": MARK, "chosen": letter, "rejected": "x"} for letter in "cdefgh"],
        "prompts": [{"prompt": f"{MARK} {letter}"} for letter in "abcd"],
    }
    for name, rows in data.items():
        (PLACE / f"{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    sft, reward, align = (PLACE / f"{MARK}-{name}" for name in ("sft", "reward", "align"))
    own = ("--reward", f"{judge}:score")

    def stage(name: str, model: Path, data: str, run_dir: Path, *words: Any) -> dict[str, Any]:
        return run(name, "--model", model, "--data", PLACE / data, "--run-dir", run_dir, *words)

    supervised = ("--max-tokens", "16", "--checkpoint-every", "0.5", *TINY)
    return {
        "sft": stage("sft", PLACE / "model", "texts.jsonl", sft, *supervised),
        "resume sft": run("resume", sft, "--quiet"),
        "reward": stage("reward", sft / "model", "pairs.jsonl", reward, *supervised),
        "resume reward": run("resume", reward, "--quiet"),
        "align": stage("align", sft / "model", "prompts.jsonl", align, *own, "--gold", reward, *FAST),
        "sample": run("sample", align, "--count", "1"),
        "resume align": run("resume", align, "--total-steps", "12", "--quiet", *own),
        "resume unnamed": run("resume", align, "--quiet"),
        "align unnamed": run("align", "--settings", align, "--dry-run"),
    }


@contextlib.contextmanager
def spied(calls: list[dict[str, Any]]) -> Iterator[None]:
    """Inside, the arguments of every from_pretrained of transformers' Auto classes are recorded."""
    import transformers

    with contextlib.ExitStack() as stack:
        for kind in KINDS:
            real = getattr(transformers, kind).from_pretrained

            def call(*arguments: Any, real: Any = real, kind: str = kind, **options: Any) -> Any:
                told = {key: options.get(key, "unset") for key in ("trust_remote_code", "use_safetensors")}
                calls.append({"kind": kind, **told})
                return real(*arguments, **options)

            stack.enter_context(mock.patch.object(getattr(transformers, kind), "from_pretrained", call))
        yield


def play(story: str) -> dict[str, Any]:
    """The outcomes of a story by command, and the audited events."""
    calls: list[dict[str, Any]] = []
    with spied(calls) if story == "language" else contextlib.nullcontext():
        commands = {"control": control, "spawned": spawned, "language": language}[story]()
    files = [getattr(module, "__file__", None) or "" for module in list(sys.modules.values())]
    workers = WATCH.from_workers
    return {
        "commands": commands,
        "excepted": WATCH.excepted,
        "workers": workers.read_text().splitlines() if workers.exists() else [],
        "imported": [Path(file).name for file in files if file.startswith(str(PLACE))],
        "pretrained": calls,
    }


if __name__ == "__main__":
    (PLACE / "results.json").write_text(json.dumps(play(sys.argv[2])))
