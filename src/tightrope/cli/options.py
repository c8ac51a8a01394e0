"""The options of each command, and the settings that a file and flags together give."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from tightrope.cli.flags import (
    Pairs,
    Parser,
    UsageError,
    add_fields,
    pair,
    settings_fields,
    suggestion,
    unknown_flag,
    whole_number,
    with_dashes,
)
from tightrope.control.presets import decided
from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings
from tightrope.language.settings import (
    RECIPES,
    AlignSettings,
    ModelSettings,
    RewardSettings,
    SFTSettings,
    may_stand_in_a_file,
    typed_again,
)
from tightrope.runs.folders import command_of
from tightrope.runs.records import retyped
from tightrope.settings.values import ORIGINS, Settings, rule_of

PROGRAM = "tightrope"

# The groups of train --help; every setting is in one.
GROUPS = {
    "task": ("env_kwargs", "observation_keys", "algorithm", "total_steps", "seed"),
    "rollout": ("num_envs", "num_steps", "action_bounds", "normalise_observations"),
    "returns": ("normalise_rewards", "critic_lambda"),
    "networks": ("hidden", "activation", "shared", "encoder", "std", "log_std_init", "gsde_steps"),
    "update rule": (),
    "evaluation and saving": (
        "evaluate_every",
        "evaluation_episodes",
        "evaluation_max_steps",
        "checkpoint_every",
        "checkpoint_minutes",
        "keep_checkpoints",
        "tensorboard",
    ),
    "episodes": ("reseed_after", "replay_limit", "carried", "repeats"),
    "faults": ("on_env_fault", "max_env_restarts", "env_timeout", "max_rollbacks"),
    "machine": ("vector_backend", "num_workers", "engine", "device", "threads", "compile"),
}

Options = dict[str, Any]
SETTINGS_CLASSES: dict[str, type[Settings]] = {
    "train": TrainSettings,
    "sft": SFTSettings,
    "reward": RewardSettings,
    "align": AlignSettings,
}
NOT_SETTINGS = ("run_dir", "settings", "dry_run", "json", "quiet", "recipe", "env_module")
# usage, description and the text below the options
DESCRIPTIONS: dict[str, tuple[str, str, str | None]] = {
    "train": (
        "ENV",
        "Train a policy on a Gymnasium task, and leave a run folder with everything about it.",
        "Defaults that depend on the task say preset. --dry-run prints each value that holds, and its "
        "origin: default, preset, settings file or flag. Each setting may be given after a settings file, "
        "too: the flag wins.",
    ),
    "sft": (
        "--model M --data FILE",
        "Fine-tune a causal language model on text, completions or chats.",
        None,
    ),
    "reward": (
        "--model M --data FILE",
        "Train a reward model on pairs of a better and a worse text.",
        None,
    ),
    "align": (
        "--model M --data PROMPTS --reward R",
        "PPO on a causal language model against any reward.",
        "Recipes: " + "; ".join(f"{name} ({recipe.source})" for name, recipe in RECIPES.items()),
    ),
}


_json_stream: TextIO | None = None  # where --json goes while standard output is kept for it


def print_json(value: Mapping[str, object]) -> None:
    """Print a line of JSON to standard output, for --json; numbers that JSON cannot hold become null."""
    from tightrope.runs.records import dumps

    print(dumps(value), file=_json_stream or sys.stdout, flush=True)


@contextlib.contextmanager
def stdout_for_json(words: list[str]) -> Iterator[None]:
    """With --json, what anything else prints to standard output goes to standard error: a line of an
    environment or a reward function must not break the JSON. The file descriptor too: C code and worker
    processes write there.
    """
    global _json_stream
    if "--json" not in words:
        yield
        return
    out, descriptor = sys.stdout, _descriptor(sys.stdout)
    try:
        if descriptor is None or _descriptor(sys.stderr) is None:
            _json_stream = out
        else:
            out.flush()
            _json_stream = os.fdopen(os.dup(descriptor), "w", encoding="utf-8", errors="replace")
            os.dup2(sys.stderr.fileno(), descriptor)
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        if descriptor is not None and _json_stream is not None and _json_stream is not out:
            os.dup2(_json_stream.fileno(), descriptor)
            with contextlib.suppress(OSError):  # the reader is gone, which print_json has reported
                _json_stream.close()
        _json_stream = None


def _descriptor(stream: TextIO) -> int | None:
    try:
        return stream.fileno()
    except (AttributeError, OSError, ValueError):  # replaced by one that has none, as in a test
        return None


def _output(parser: Parser) -> None:
    """The options about what is printed, which every command has."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "--json", action="store_true", help="Last line of stdout: one JSON object; the rest on stderr."
    )
    group.add_argument("--quiet", action="store_true", help="Print the end only.")


def dry_run(settings: Settings, given: Options, origins: Mapping[str, str]) -> bool:
    """Whether --dry-run was given; then the settings are printed, and the origin of each: that in
    ``origins``, else it is the default.
    """
    if given.get("dry_run"):
        shown = settings.to_json()
        every = [*(name for name in shown if name != "update"), *shown.get("update", {})]
        shown[ORIGINS] = {name: origins.get(name, "default") for name in every}
        if given.get("json"):
            print_json(shown)
        else:
            print(json.dumps(shown, indent=2))
    return bool(given.get("dry_run"))


def _common(parser: Parser, *, run: bool) -> None:
    """The options that several commands have."""
    _output(parser)
    group = parser.add_argument_group("code of your own")
    group.add_argument(
        "--env-module",
        metavar="FILE.py",
        help="Python file or module to import first: it registers environments (default: none).",
    )
    if run:
        group.add_argument(
            "--env",
            metavar="ID",
            help="The task again; needed if its id names a module (default: the run's own).",
        )


def _playing(group: argparse._ArgumentGroup) -> None:
    """The options of a command that plays episodes: which policy, in which episodes."""
    group.add_argument("--best", action="store_true", help="The policy that evaluated best, not the newest.")
    group.add_argument(
        "--seed", type=_not_negative, metavar="N", help="Seed of the episodes (default: fixed, unused)."
    )
    group.add_argument(
        "--env-kwargs",
        nargs="*",
        type=pair,
        action=Pairs,
        metavar="NAME=VALUE",
        help="Other arguments for the constructor of the task; those of the run stay (default: none).",
    )


def training_parser(command: str, algorithm: str = "ppo") -> Parser:
    """The options of a command that trains; those of ``train`` with this update rule."""
    usage, description, epilog = DESCRIPTIONS[command]
    kind = SETTINGS_CLASSES[command]
    parser = Parser(f"{PROGRAM} {command}", f"%(prog)s {usage} [options]", description, epilog)
    if command == "train":
        parser.add_argument("env", nargs="?", metavar="ENV", help="Gymnasium id, like CartPole-v1.")
    presets = _presets(algorithm) if command == "train" else {}
    for title, names in _groups(command).items():
        rule = rule_of(kind, algorithm) if title == "update rule" else None
        if rule is None:
            add_fields(parser.add_argument_group(title), kind, names, presets)
        else:
            others = ", ".join(name for name in ALGORITHM_SETTINGS if name != algorithm)
            hint = f"For those of {others}: --algorithm NAME --help." if command == "train" else None
            group = parser.add_argument_group(f"update rule: {algorithm}", hint)
            add_fields(group, rule, settings_fields(rule), presets)
    folder = "ENV-ALGORITHM-SEED-TIME" if command == "train" else "COMMAND-MODEL-TIME"
    group = parser.add_argument_group("run")
    group.add_argument("--run-dir", metavar="FOLDER", help=f"Where the run is saved (default runs/{folder}).")
    group.add_argument(
        "--settings", metavar="FILE", help="Run RUN/settings.json again; flags on top of it (default: none)."
    )
    group.add_argument(
        "--dry-run",
        action="store_true",
        help="Print the resolved settings and their origins as JSON and stop.",
    )
    if command == "train":
        _common(parser, run=False)
    else:
        _output(parser)
    if command == "align":
        parser.add_argument_group("recipes and judges").add_argument(
            "--recipe", choices=tuple(RECIPES), metavar="NAME", help=f"One of: {', '.join(RECIPES)}."
        )
    return parser


def _presets(algorithm: str) -> dict[str, str]:
    """How --help writes the defaults that presets change."""
    listed, always = decided(algorithm)
    return dict.fromkeys(listed, "{}, or preset") | dict.fromkeys(always, "preset")


def _groups(command: str) -> Mapping[str, Iterable[str]]:
    """The titles of --help and the settings under each."""
    if command == "train":
        return GROUPS
    shared = settings_fields(ModelSettings)
    first = [name for name in settings_fields(SETTINGS_CLASSES[command]) if name not in shared]
    if command == "align":
        return {"alignment": first, "update rule": (), "model and machine": shared}
    return {"data and training": first, "model and machine": shared}


def _run_parser(
    command: str, description: str, folder: str = "Run folder, or a folder that agent.save wrote."
) -> Parser:
    """A parser for a command about a run, with the argument RUN; ``folder`` is its help."""
    parser = Parser(f"{PROGRAM} {command}", "%(prog)s RUN [options]", description)
    parser.add_argument("run", metavar="RUN", help=folder)
    return parser


def evaluate_parser() -> Parser:
    """The options of ``evaluate``."""
    parser = _run_parser(
        "evaluate", "Play episodes with the saved policy of a run: mean return, deviation, 95 % interval."
    )
    group = parser.add_argument_group("evaluation")
    group.add_argument("--episodes", type=_at_least_one, metavar="N", help="How many (default 100).")
    group.add_argument(
        "--evaluation-max-steps",
        type=_at_least_one,
        metavar="N",
        help="Steps after which an episode is cut (default: as in the run).",
    )
    group.add_argument(
        "--stochastic", action="store_true", help="Sample actions; default: the most likely one."
    )
    _playing(group)
    group.add_argument("--device", metavar="WORD", help="Torch device of the networks (default cpu).")
    _common(parser, run=True)
    return parser


def record_parser() -> Parser:
    """The options of ``record``."""
    parser = _run_parser("record", "Write an mp4 of the saved policy of a run; no display is needed.")
    group = parser.add_argument_group("recording")
    group.add_argument("--out", metavar="FILE.mp4", help="Where to (default RUN/videos/).")
    group.add_argument("--episodes", type=_at_least_one, metavar="N", help="How many (default 1).")
    _playing(group)
    _common(parser, run=True)
    return parser


def resume_parser() -> Parser:
    """The options of ``resume``."""
    parser = _run_parser("resume", "Continue a run from its newest checkpoint, in its folder.", "Run folder.")
    group = parser.add_argument_group("continuing")
    group.add_argument(
        "--total-steps",
        type=_at_least_one,
        metavar="N",
        help="A new end (align: responses); also continues a finished run (default: the run's own).",
    )
    group.add_argument(
        "--reward",
        action="extend",
        nargs="*",
        metavar="R",
        help="align: the reward again, all of it, if your own code was in it (default: the run's).",
    )
    group.add_argument(
        "--gold",
        metavar="R",
        help="align: the gold judge again, if it was your own code (default: the run's).",
    )
    group.add_argument(
        "--data",
        metavar="FILE",
        help="Language: the data again, if they were not a file or have moved (default: the run's).",
    )
    _common(parser, run=True)
    return parser


def sample_parser() -> Parser:
    """The options of ``sample``."""
    text = "Responses of the aligned model beside the reference's, with score, KL and length."
    parser = _run_parser("sample", text, "Run folder of align.")
    group = parser.add_argument_group("sampling")
    group.add_argument(
        "--prompt", action="append", metavar="TEXT", help="A prompt of your own; may be repeated."
    )
    group.add_argument(
        "--count", type=_at_least_one, metavar="N", help="How many prompts of the run's data (default 8)."
    )
    group.add_argument("--seed", type=int, metavar="N", help="Seed of sampling (default: the run's + 1).")
    group.add_argument(
        "--reward",
        action="extend",
        nargs="*",
        metavar="R",
        help="Score with this; as in align (default: the run's, unless that was your own code).",
    )
    group.add_argument(
        "--recorded",
        action="store_true",
        help="Sample nothing: show the last responses of training with their rewards, KL and advantage.",
    )
    _output(parser)
    return parser


def doctor_parser() -> Parser:
    """The options of ``doctor``."""
    parser = Parser(
        f"{PROGRAM} doctor", "%(prog)s [--model M]", "Check this installation; with --model a language model."
    )
    parser.add_argument(
        "--model", metavar="M", help="Folder, hub id or packaged name of a causal language model."
    )
    _output(parser)
    return parser


def _at_least_one(word: str) -> int:
    """A whole number above 0, as argparse reads it."""
    return _bounded(word, 1)


def _not_negative(word: str) -> int:
    return _bounded(word, 0)


def _bounded(word: str, low: int) -> int:
    try:
        number = whole_number(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{word!r} is not a whole number.") from None
    if number < low:
        raise argparse.ArgumentTypeError(f"{number} is too small; expected at least {low}.")
    return number


def training_options(command: str, words: list[str]) -> tuple[Options, Options, dict[str, str]]:
    """The options given, the value of each setting that --settings, --recipe or a flag names, and which of
    the three it was. Flags win over the recipe, the recipe over the file.
    """
    words = [with_dashes(word) for word in words]
    path = _value_of("--settings", words)
    of_file = {} if path is None else _values_of_file(command, path)
    algorithm = "ppo"
    if command == "train":
        algorithm = _value_of("--algorithm", words) or of_file.get("algorithm", "ppo")
    if algorithm not in ALGORITHM_SETTINGS:
        algorithm = "ppo"  # the parser words the error

    def unknown(name: str, known: list[str]) -> str:
        return _unknown_setting(name, known, algorithm) if command == "train" else unknown_flag(name, known)

    given = training_parser(command, algorithm).read(words, unknown)
    if of_file.get("algorithm", algorithm) != algorithm:  # the settings of another update rule do not fit
        outer = settings_fields(TrainSettings).keys() | {"env"}
        of_file = {name: value for name, value in of_file.items() if name in outer}
    recipe = RECIPES[given["recipe"]].values if "recipe" in given else {}
    flags = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in given.items()
        if name not in NOT_SETTINGS
    }
    if "stop" in flags:  # a shell gives the two characters \\n for a line end
        flags["stop"] = tuple(re.sub(r"\\([ntr\\])", _escaped, word) for word in flags["stop"])
    for name, value in of_file.items():
        if name not in flags:
            _refuse_code(command, str(path), name, value)
    origins = {"settings file": of_file, "recipe": recipe, "flag": flags}
    origin_of = {name: origin for origin, values in origins.items() for name in values}
    return given, {**of_file, **recipe, **flags}, origin_of


def _escaped(found: re.Match[str]) -> str:
    return {"n": "\n", "t": "\t", "r": "\r"}.get(found[1], found[1])


def _value_of(flag: str, words: list[str]) -> str | None:
    for i, word in enumerate(words):
        if word.startswith(flag + "="):
            return word.partition("=")[2]
        if word == flag and i + 1 < len(words):
            return words[i + 1]
    return None


def _unknown_setting(name: str, known: list[str], algorithm: str) -> str:
    """The error text for an unknown flag of train. It names the update rule that has the flag, if one has."""
    own = " ".join("--" + field.replace("_", "-") for field in settings_fields(ALGORITHM_SETTINGS[algorithm]))
    for other, kind in ALGORITHM_SETTINGS.items():
        flags = [field.replace("_", "-") for field in settings_fields(kind)]
        meant = name.removeprefix("no-") if name.removeprefix("no-") in flags else None
        if meant is None and suggestion(name, known) is None:
            meant = suggestion(name, flags)
        if meant is not None and meant not in known:
            seen = "" if meant == name.removeprefix("no-") else f"There is no flag --{name}; "
            return (
                f"{seen}--{meant} is a setting of {other}, not of {algorithm}. Settings of {algorithm}: {own}"
            )
    return unknown_flag(name, known)


def _settings_in(path: str) -> Any:
    """What a settings.json holds, given as a file or as the folder of a run. UsageError if there is none."""
    from tightrope.runs.records import read_json, unsigned

    if not path:
        raise UsageError("--settings is empty. Give RUN/settings.json.")
    file = Path(path)
    file = file / "settings.json" if file.is_dir() else file
    if not file.is_file():
        raise UsageError(f"--settings {path}: there is no such file. Give RUN/settings.json.")
    found = read_json(file)
    return unsigned(found) if isinstance(found, dict) else found


def _values_of_file(command: str, path: str) -> Options:
    """The values in a settings file, names and types checked. UsageError for those of another command."""
    data = _settings_in(path)
    other = (command_of(data) if isinstance(data, dict) else None) or command
    if other != command:
        raise UsageError(
            f"--settings {path} holds the settings of {other}, expected those of {command}. Give "
            f"settings.json of a run of {command}, or type: {PROGRAM} {other} --settings {path}"
        )
    return SETTINGS_CLASSES[command].values_from_json(data, f"--settings {path}")


def _refuse_code(command: str, path: str, name: str, value: Any) -> None:
    """UsageError for a value that only the user may give: a Python object or code."""
    words = value if isinstance(value, tuple) else (value,)
    judge = name in ("reward", "gold") and not all(may_stand_in_a_file(word) for word in words if word)
    module = name == "env" and ":" in value
    if judge or module or (isinstance(value, str) and value.startswith("<")):
        flag = "" if name == "env" else f"--{name.replace('_', '-')} "
        word = "ID" if name == "env" else "FILE"
        again = (
            typed_again(flag.strip(), words) if name in ("reward", "gold") else flag + retyped(value, word)
        )
        raise UsageError(
            f"--settings {path}: {name} was {' '.join(map(repr, words))}, which no file may name: an object, "
            f"code, or a folder that is gone. Give it again: {PROGRAM} {command} --settings "
            f"{shlex.quote(path)} {again}"
        )
