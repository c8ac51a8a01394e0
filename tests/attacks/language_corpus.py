"""Attacks on model folders, adapters and runs of sft, reward and align, run against their readers."""

from __future__ import annotations

import json
import resource
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from attacks import corpus
from attacks.corpus import (
    DEEP,
    HUGE,
    Attack,
    both,
    edit,
    forge,
    forge_file,
    link,
    pickled,
    pipe,
    put,
    staged,
    torch_zip,
    twice,
)
from attacks.watch import MARK, Watch
from language.tiny import saved, tiny_llama

NAMED = f"{MARK}.Model"
MAPPED = {"AutoConfig": NAMED, "AutoModelForCausalLM": NAMED, "AutoTokenizer": [NAMED, None]}
TEMPLATE = (
    "{{ ''.__class__.__mro__[1].__subclasses__() }}{{ cycler.__init__.__globals__.os.system('"
    + MARK
    + "') }}"
)
ADAPTER = {
    "peft_type": "LORA", "r": 2, "lora_alpha": 4, "target_modules": ["q_proj"], "task_type": "CAUSAL_LM",
    "auto_mapping": {"base_model_class": "Model", "parent_library": MARK},
    "megatron_config": {"a": 1}, "megatron_core": MARK, "base_model_name_or_path": "../hostile",
}  # fmt: skip
FAST = [
    "--total-episodes",
    "8",
    "--batch-size",
    "4",
    "--minibatch-size",
    "4",
    "--num-epochs",
    "1",
    "--max-new-tokens",
    "2",
    "--max-prompt-tokens",
    "16",
    "--lora-rank",
    "2",
    "--threads",
    "1",
    "--quiet",
]


PLACE = "may name a place or code elsewhere"


def index(name: str) -> Callable[[Path], None]:
    """Weights by an index, all in the file of this name."""

    def plant(folder: Path) -> None:
        weights = dict.fromkeys(tiny_llama().state_dict(), name)
        (folder / "model.safetensors").unlink()
        put("model.safetensors.index.json", json.dumps({"metadata": {}, "weight_map": weights}))(folder)

    return plant


def of_models() -> list[Attack]:
    """On a folder that is read as a model, as a reward model or as a judge."""
    code = both(put(f"{MARK}.py", corpus.MODULE), edit("config.json", auto_map=MAPPED))
    only_pickle = both(put("pytorch_model.bin", torch_zip()), lambda f: (f / "model.safetensors").unlink())
    found = [
        Attack("custom code", code, "auto_map"),
        Attack(
            "custom code of an unknown kind", both(code, edit("config.json", model_type=MARK)), "auto_map"
        ),
        Attack("custom code inside", edit("config.json", text_config={"auto_map": MAPPED}), "auto_map"),
        Attack(
            "custom tokenizer",
            edit("tokenizer_config.json", auto_map={"AutoTokenizer": [NAMED, NAMED]}),
            "auto_map",
        ),
        Attack(
            "custom code hidden by a twin", both(code, twice("config.json", "auto_map", "{}")), "stands twice"
        ),
        Attack("unknown kind", edit("config.json", model_type=MARK), "cannot be loaded"),
        Attack("tokenizer of a module", edit("tokenizer_config.json", tokenizer_class=NAMED), None),
        Attack("_target_", edit("config.json", _target_=f"{MARK}.function"), None),
        *(
            Attack(f"attention by {key}", edit("config.json", **{key: f"{MARK}/kernel:function"}), PLACE)
            for key in ("_attn_implementation", "_attn_implementation_internal", "attn_implementation")
        ),
        Attack("a place inside", edit("config.json", text_config={"backbone": f"../{MARK}"}), PLACE),
        Attack(
            "experts of a kernel", edit("config.json", _experts_implementation="sonicmoe"), "expected one of"
        ),
        Attack(
            "quantised by", edit("config.json", quantization_config={"quant_method": MARK}), "chooses code"
        ),
        Attack("weights by name", edit("config.json", transformers_weights="x.safetensors"), "chooses code"),
        Attack(
            "an index of pickles",
            both(put("x.bin", torch_zip()), index("x.bin")),
            "names the weights 'x.bin'",
        ),
        Attack("an index of what lies outside", index("../outside.safetensors"), "names the weights"),
        Attack("weights that lie outside", link("model.safetensors", "elsewhere"), "is a link to"),
        Attack("a tokenizer that lies outside", link("tokenizer.json", "elsewhere"), "is a link to"),
        Attack("weights that are a pipe", pipe("model.safetensors"), "not a regular file"),
        Attack("a tokenizer that is a pipe", pipe("tokenizer.json"), "not a regular file"),
        Attack(
            "words that lie outside",
            edit("tokenizer_config.json", vocab_file="../outside.txt"),
            "expected a file in the same folder",
        ),
        Attack("adapter inside", put("adapter_config.json", json.dumps(ADAPTER)), "PEFT adapter"),
        Attack("only pickled weights", only_pickle, "a pickle, which is never read"),
        Attack("weights of 10 GB", put("model.safetensors", HUGE), "cannot be loaded"),
        Attack("deep config", put("config.json", DEEP), "config.json"),
        Attack("module beside", put(f"{MARK}.py", corpus.MODULE), None),
    ]
    for name in (
        "model.safetensors",
        "config.json",
        "tokenizer.json",
        "tokenizer_config.json",
        "generation_config.json",
    ):
        words = name if name.endswith("config.json") else "cannot be loaded"
        found.append(Attack(f"pickle as {name}", put(name, pickled()), words))
    found += [
        Attack(f"pickle beside, {name}", put(name, torch_zip()), None)
        for name in (
            "pytorch_model.bin",
            "training_args.bin",
            "optimizer.pt",
            "rng_state.pth",
            "vocab.pkl",
            "model.pt",
        )
    ]
    return found


def of_judges() -> list[Attack]:
    """On a reward model; of the harmless ones, which cost a whole run, only those for its own loader."""
    return [a for a in of_models() if a.words is not None or a.name == "pickle beside, pytorch_model.bin"]


def of_adapters() -> list[Attack]:
    """On the run of a reward model whose adapter is put on the policy's trunk."""
    modules = {name: value for name, value in ADAPTER.items() if name != "base_model_name_or_path"}
    found = [
        Attack("rank of a billion", edit("adapter/adapter_config.json", r=10**9), "expected the rank"),
        Attack(
            "layers of another model", edit("adapter/adapter_config.json", layers_to_transform=[7]), "layers"
        ),
        Attack("adapter names modules", edit("adapter/adapter_config.json", **modules), None),
        Attack("head of 10 GB", put("adapter/head.safetensors", HUGE), "head.safetensors"),
    ]
    found += [
        Attack(f"pickle as {name}", put(f"adapter/{name}", pickled()), name)
        for name in ("adapter_config.json", "adapter_model.safetensors", "head.safetensors")
    ]
    found.append(Attack("pickled adapter beside", put("adapter/adapter_model.bin", torch_zip()), None))
    return found


def of_runs() -> list[Attack]:
    """On the run of an alignment."""
    code = f"{MARK}.py:function"
    file = put(f"{MARK}.py", corpus.MODULE)
    found = [
        Attack("reward names code", both(file, edit("settings.json", reward=code)), f"--reward {code}"),
        Attack(
            "reward writes a command",
            edit("settings.json", reward=f"x.py:f; {MARK}"),
            "--reward FILE.py:function",
        ),
        Attack("rewards in a list", edit("settings.json", reward=[code]), f"--reward {code}"),
        Attack("gold names code", both(file, edit("settings.json", gold=code)), f"--gold {code}"),
        Attack("gold is a lambda", edit("settings.json", gold="<lambda>"), "--gold FILE.py:function"),
        Attack("unknown setting", edit("settings.json", _target_=code), "no setting named '_target_'"),
        Attack("update is text", edit("settings.json", update=code), "expected an object with the settings"),
        Attack("prompts name code", both(file, edit("settings.json", data=f"{MARK}.py")), "ends with '.py'"),
        Attack("ptx names code", edit("settings.json", ptx_data=f"{MARK}.py:x", ptx_weight=1.0), MARK),
        Attack("model names nothing", edit("settings.json", model=f"../{MARK}.py"), "There is no model"),
        Attack("empty state", forge(monitor=..., rng=...), "does not hold"),
        Attack("gold_point is text", forge(gold_point=MARK, kl_beta=MARK), "does not hold"),
        Attack("another story", forge(story=MARK), "not a checkpoint of an alignment run"),
        Attack("forged pickle as state.json", forge_file("state.json", pickled()), "state.json"),
        Attack(
            "forged pickle as trained.safetensors", forge_file("trained.safetensors", pickled()), "trained"
        ),
        Attack("forged header of 10 GB", forge_file("optimiser.safetensors", HUGE), "optimiser"),
        Attack("model is a link", link("model", "elsewhere"), "is a link"),
        Attack("samples are a link", link("samples.jsonl", "victim"), "is a link"),
        Attack("pickle as samples.jsonl", put("samples.jsonl", pickled() + b"\n{}\n"), "samples.jsonl"),
    ]
    found += [
        Attack(f"pickle as {name}", put(name, pickled()), name.rpartition("/")[2])
        for name in (
            "settings.json",
            "metrics.jsonl",
            "*/manifest.json",
            "*/state.json",
            "*/trained.safetensors",
        )
    ]
    return found


def of_supervised() -> list[Attack]:
    """On runs of sft and reward."""
    return [
        Attack("empty state", forge(step=MARK), "does not hold"),
        Attack("unknown field", forge(_target_=MARK), None),
        Attack("another story", forge(story=MARK), "expected"),
        Attack("settings name code", edit("settings.json", _target_=MARK), "_target_"),
        Attack("settings of another kind", edit("settings.json", num_epochs=MARK), "num_epochs is"),
        Attack(
            "pickle as trained.safetensors", put("*/trained.safetensors", pickled()), "trained.safetensors"
        ),
    ]


def cases(place: Path) -> Iterator[tuple[str, str, Path, Attack, Callable[[Path], Any]]]:
    """Group, command, good folder, attack and call for every attack."""
    from tightrope.cli.main import main

    model, prompts, chats = (str(place / name) for name in ("model", "prompts.jsonl", "chats.jsonl"))

    def align(*words: str, data: str = prompts) -> Any:
        shutil.rmtree(place / "out", ignore_errors=True)
        return main(["align", "--data", data, "--run-dir", str(place / "out"), *FAST, *words])

    commands = {
        "model": lambda folder: align("--model", str(folder), "--reward", "length"),
        "doctor": lambda folder: main(["doctor", "--model", str(folder)]),
        "reward": lambda folder: align("--model", model, "--reward", str(folder)),
        "gold": lambda folder: align("--model", model, "--reward", "length", "--gold", str(folder)),
        "resume": lambda folder: main(["resume", str(folder), "--quiet"]),
        "sample": lambda folder: main(["sample", str(folder), "--count", "1"]),
        "recorded": lambda folder: main(["sample", str(folder), "--recorded"]),
        "settings": lambda folder: main(["align", "--settings", str(folder), "--dry-run"]),
        "chat": lambda folder: align("--model", str(folder), "--reward", "length", data=chats),
    }  # fmt: skip
    none = Attack("none", lambda folder: None, None)
    groups = {
        "model": ("model", ("model", "doctor"), of_models()),
        "judge": ("reward/model", ("reward", "gold"), of_judges()),
        "adapter": ("reward", ("reward",), of_adapters()),
        "align": ("align", ("resume", "sample", "recorded", "settings"), of_runs()),
        "sft": ("sft", ("resume",), of_supervised()),
        "rewarding": ("reward", ("resume",), of_supervised()),
        "template": (
            "model",
            ("chat",),
            [Attack("template", put("chat_template.jinja", TEMPLATE), "chat template")],
        ),
    }
    for group, (good, names, attacks) in groups.items():
        for attack in (none, *attacks):
            # what is harmless costs a whole run: one command shows it
            for name in names[:1] if attack.words is None and attack.name != "none" else names:
                yield group, name, place / good, attack, commands[name]


def prepare(place: Path) -> None:
    """A tiny model, a run of each stage, and data."""
    from tightrope.cli.main import main

    saved(place / "model", tiny_llama(1), chat=True)
    rows = [{"prompt": text} for text in ("ab", "cd", "efg", "hi")]
    chats = [{"prompt": [{"role": "user", "content": row["prompt"]}]} for row in rows]
    texts = [{"text": f"ab {letter}"} for letter in "cdefgh"]
    pairs = [{"prompt": "ab", "chosen": letter, "rejected": "x"} for letter in "cdefgh"]
    for name, content in (("prompts", rows), ("chats", chats), ("texts", texts), ("pairs", pairs)):
        (place / f"{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in content))
    usual = [
        "--model",
        str(place / "model"),
        "--max-tokens",
        "16",
        "--lora-rank",
        "2",
        "--threads",
        "1",
        "--quiet",
    ]
    for command, data in (("sft", "texts"), ("reward", "pairs")):
        words = ["--data", str(place / f"{data}.jsonl"), "--run-dir", str(place / command)]
        assert main([command, *words, *usual]) == 0
    words = ["--data", str(place / "prompts.jsonl"), "--reward", "length", "--run-dir", str(place / "align")]
    assert main(["align", "--model", str(place / "model"), *words, *FAST]) == 0


def play(place: Path) -> dict[str, Any]:
    """Every attack; outcomes by group, attack and command."""
    prepare(place)
    watch, found = Watch(place), dict[str, Any]()
    for group, name, good, attack, command in cases(place):
        result = staged(watch, place / "case", good, attack, command)
        found.setdefault(f"{group}: {attack.name}", {})[name] = result
    return found


if __name__ == "__main__":
    limit = 16 * 2**30
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    place = Path(sys.argv[1])
    (place / "results.json").write_text(json.dumps({"attacks": play(place)}))
