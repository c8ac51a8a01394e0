"""Attacks on a run folder of ``tightrope train``, run against every command that reads one."""

from __future__ import annotations

import json
import resource
import shutil
import sys
from pathlib import Path
from typing import Any

from attacks import corpus
from attacks.corpus import (
    DEEP,
    HUGE,
    Attack,
    both,
    declare,
    edit,
    forge,
    forge_file,
    forge_tensor,
    link,
    pickled,
    pipe,
    put,
    staged,
    twice,
)
from attacks.watch import MARK, Watch

ID = f"{MARK}:Env-v0"
COMMANDS = ("evaluate", "resume", "load", "settings")
CHECKPOINT = (
    "manifest.json",
    "state.json",
    "policy.safetensors",
    "optimiser.safetensors",
    "normalisers.safetensors",
)
CALLABLES = {
    "activation": f"{MARK}.function",
    "engine": f"{MARK}:function",
    "vector_backend": f"{MARK}:function",
    "algorithm": f"{MARK}:function",
    "device": f"{MARK}:function",
    "hidden": {"_target_": f"{MARK}.function"},
}


MEAN = "observations.mean"
TERMINAL = json.dumps({"pid": 1, "host": "\x1b[2J", "started": "\x9b2J"})


def mark(size: int) -> dict[str, Any]:
    """A record file of that size, on which a checkpoint relies."""
    return {"metrics.jsonl": {"bytes": size}}


def setting_attacks() -> list[Attack]:
    """Settings that name code, in settings.json and in the state of every checkpoint."""
    found = []
    for name, value in CALLABLES.items():
        plant = both(edit("settings.json", **{name: value}), forge(settings={name: value}))
        found.append(Attack(f"{name} names a callable", plant, f"{name} is"))
    for name in ("_target_", "policy", "env_module", "reward"):
        plant = both(
            edit("settings.json", **{name: f"{MARK}.function"}), forge(settings={name: f"{MARK}.function"})
        )
        found.append(Attack(f"{name} names a callable", plant, f"no setting named '{name}'"))
    ids = both(edit("settings.json", env=ID), forge(settings={"env": ID}))
    nul = both(edit("settings.json", env="CartPole\0-v1"), forge(settings={"env": "CartPole\0-v1"}))
    return [
        *found,
        Attack("id with a module", ids, ID),
        Attack("own environment", forge(own_environment=True), "name it again"),
        Attack("own policy", forge(own_policy=True), "a policy module of"),
        Attack("NUL in the id", nul, "CartPole\\x00-v1"),
    ]


def attacks() -> list[Attack]:
    """All of them."""
    found = setting_attacks()
    for name in ("settings.json", "metrics.jsonl", "episodes.jsonl", "summary.json"):
        words = None if name == "summary.json" else name  # nobody reads it
        found.append(Attack(f"pickle as {name}", put(name, pickled()), words))
        found.append(Attack(f"{name} is a link", link(name, "elsewhere"), "is a link"))
    for name in CHECKPOINT:
        found.append(Attack(f"pickle as {name}", put(f"*/{name}", pickled()), name))
        found.append(Attack(f"{name} is a link in a checkpoint", link(f"*/{name}", "elsewhere"), "is a link"))
    for name in CHECKPOINT[1:]:  # hashed again: the hashes agree, so the content itself is refused
        words = "is not readable as JSON" if name == "state.json" else f"{name} is not a safetensors file"
        found.append(Attack(f"forged pickle as {name}", forge_file(name, pickled()), words))
    for name in ("policy.pt", "optimizer.pt", "training_args.bin", "weights.zip", "checkpoint.pkl"):
        found.append(Attack(f"{name} beside", put(name, corpus.torch_zip()), None))
        found.append(Attack(f"{name} in a checkpoint", put(f"*/{name}", corpus.torch_zip()), name))
    for name in (
        "conftest.py",
        "sitecustomize.py",
        "__init__.py",
        f"{MARK}.py",
        "numba/tightrope.x",
        "__pycache__/a.pyc",
    ):
        found.append(Attack(f"{name} beside", put(name, corpus.MODULE), None))
    for name in (
        "../outside.safetensors",
        "/etc/passwd",
        "..\\x.safetensors",
        "a\0.safetensors",
        "policy.pkl",
    ):
        found.append(Attack(f"manifest names {name!r}", declare(name), "is no plain NAME.safetensors"))
    found += [
        Attack("header of 10 GB", forge_file("policy.safetensors", HUGE), "is not a safetensors file"),
        Attack("deep state", forge_file("state.json", DEEP), "state.json"),
        Attack("deep settings", put("settings.json", DEEP), "settings.json"),
        Attack("deep metrics", put("metrics.jsonl", DEEP + b"\n{}\n"), "metrics.jsonl"),
        Attack("settings twice", twice("settings.json", "env", f'"{ID}"'), "'env' stands twice"),
        Attack("state twice", forge_file("state.json", b'{"steps": 1, "steps": 2}'), "'steps' stands twice"),
        Attack("manifest twice", twice("*/manifest.json", "files", "{}"), "'files' stands twice"),
        Attack(
            "empty state", forge(**dict.fromkeys(("settings", "rng", "steps", "best"), ...)), "does not hold"
        ),
        Attack("foreign generator", forge(rng={"sampling": {"bit_generator": MARK}}), "does not hold"),
        Attack("steps is text", forge(steps=MARK), "does not hold"),
        Attack("kl_beta is text", forge(kl_beta=MARK), "does not hold"),
        Attack("records of a negative length", forge(records=mark(-5)), "what had been recorded"),
        Attack("records of no length", forge(records={"metrics.jsonl": MARK}), "what had been recorded"),
        Attack("moments of another shape", forge_tensor("optimiser", "0.exp_avg", 3), "does not hold"),
        Attack("statistics of another shape", forge_tensor("normalisers", MEAN, 1), "does not hold"),
        Attack("weights of another shape", forge_tensor("policy", None, 1), "does not hold"),
        Attack("deep lock", put("writer.lock", DEEP), None),
        Attack("lock rules the terminal", put("writer.lock", TERMINAL), None),
        Attack("metrics is a pipe", pipe("metrics.jsonl"), "is a link or a device"),
        Attack("checkpoints is a link", link("checkpoints", "elsewhere"), "is a link"),
        Attack("best is a link", link("best", "elsewhere"), "is a link"),
        Attack("rewriting goes elsewhere", link(".metrics.jsonl", "victim"), "is a link"),
        Attack(
            "appending goes elsewhere",
            both(put("metrics.jsonl", ""), link("metrics.jsonl", "victim")),
            "is a link",
        ),
    ]
    return found


def play(place: Path) -> dict[str, Any]:
    """Every attack on every command; outcomes by attack and command."""
    import tightrope
    from tightrope.cli.main import main

    small = [
        "--total-steps",
        "256",
        "--num-envs",
        "2",
        "--num-steps",
        "32",
        "--minibatch-size",
        "32",
        "--engine",
        "torch",
        "--hidden",
        "8",
    ]
    small += ["--evaluation-episodes", "1", "--vector-backend", "serial", "--normalise-observations"]
    good, watch, found = place / "good", Watch(place), {}
    assert (
        main(["train", "CartPole-v1", *small, "--checkpoint-every", "0.5", "--run-dir", str(good), "--quiet"])
        == 0
    )
    commands = {
        "evaluate": lambda run: main(["evaluate", str(run), "--episodes", "1"]),
        "resume": lambda run: main(["resume", str(run), "--total-steps", "320", "--quiet"]),
        "load": lambda run: tightrope.load(run).close(),
        "settings": lambda run: main(["train", "--settings", str(run), "--dry-run"]),
    }
    for attack in [Attack("none", lambda folder: None, None), *attacks()]:
        found[attack.name] = {}
        # what is harmless costs a whole run: one command shows it
        names = ("resume",) if attack.words is None and attack.name != "none" else COMMANDS
        for name in names:
            found[attack.name][name] = staged(watch, place / "case", good, attack, commands[name])
    shutil.rmtree(place / "case")
    return found


if __name__ == "__main__":
    limit = 12 * 2**30  # address space, not memory: a buffer of 10 GB on top of torch would not fit
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    place = Path(sys.argv[1])
    (place / "results.json").write_text(json.dumps({"attacks": play(place)}))
