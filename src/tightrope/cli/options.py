"""The options of each command, and what flags and a settings file together say about a training run."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from tightrope.cli.flags import (
    Parser,
    UsageError,
    add_fields,
    settings_fields,
    suggestion,
    unknown_flag,
    whole,
    with_dashes,
)
from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings
from tightrope.runs.records import retyped
from tightrope.settings.values import Settings

PROGRAM = "tightrope"

# Which flags stand together in --help; a field in no group is listed under "more".
GROUPS = {
    "task": ("algorithm", "total_steps", "seed"),
    "rollout": ("num_envs", "num_steps", "normalise_observations", "normalise_rewards"),
    "networks": ("hidden", "activation", "shared", "std", "log_std_init", "gsde_steps", "squash"),
    "update rule": (),
    "evaluation and saving": (
        "evaluate_every",
        "evaluation_episodes",
        "checkpoint_every",
        "keep_checkpoints",
        "tensorboard",
    ),
    "faults": ("on_env_fault", "max_env_restarts", "env_timeout", "max_rollbacks"),
    "machine": ("vector_backend", "num_workers", "engine", "device", "threads", "compile"),
}

Options = dict[str, Any]
# a setting that tells a command's settings.json from the others'
OWN_FIELDS = {"sft": "on_completions", "reward": "demonstrations", "align": "max_new_tokens", "train": "env"}


def print_json(value: dict[str, Any]) -> None:
    """A line of JSON on standard output: what --json promises, numbers that JSON cannot hold as null."""
    from tightrope.runs.records import dumps

    print(dumps(value), flush=True)


def output(parser: Parser) -> None:
    """The options about what is printed, which every command has."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "--json", action="store_true", help="Last line of stdout: one JSON object; the rest on stderr."
    )
    group.add_argument("--quiet", action="store_true", help="Print the end only.")


def settings_option(group: Any) -> None:
    """The option that begins with the settings of another run."""
    group.add_argument(
        "--settings", metavar="FILE", help="Run RUN/settings.json again; flags on top of it (default: none)."
    )


def _common(parser: Parser, *, run: bool) -> None:
    """The options that several commands have."""
    output(parser)
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
            help="The task again; needed where its id names a module (default: the run's own).",
        )


def train_parser(algorithm: str = "ppo") -> Parser:
    """The options of ``train`` with this update rule."""
    parser = Parser(
        f"{PROGRAM} train",
        "%(prog)s ENV [options]",
        "Train a policy on a Gymnasium task, and leave a run folder with everything about it.",
        "Defaults shown are those of an unknown task; presets change some of them for the tasks they know. "
        "--dry-run prints what holds. Each setting may be given after a settings file, too: the flag wins.",
    )
    parser.add_argument("env", nargs="?", metavar="ENV", help="Gymnasium id, like CartPole-v1.")
    fields = settings_fields(TrainSettings)
    listed = {name for names in GROUPS.values() for name in names}
    groups = {**GROUPS, "more": tuple(name for name in fields if name not in listed)}
    for title, names in groups.items():
        if title == "update rule":
            kind = ALGORITHM_SETTINGS[algorithm]
            others = ", ".join(name for name in ALGORITHM_SETTINGS if name != algorithm)
            group = parser.add_argument_group(
                f"update rule: {algorithm}", f"For those of {others}: --algorithm NAME --help."
            )
            add_fields(group, kind, settings_fields(kind))
        elif names:
            add_fields(parser.add_argument_group(title), TrainSettings, names)
    group = parser.add_argument_group("run")
    group.add_argument(
        "--run-dir", metavar="FOLDER", help="Where the run lies (default runs/ENV-ALGORITHM-SEED-TIME)."
    )
    settings_option(group)
    group.add_argument("--dry-run", action="store_true", help="Print the resolved settings as JSON and stop.")
    _common(parser, run=False)
    return parser


def evaluate_parser() -> Parser:
    """The options of ``evaluate``."""
    parser = Parser(
        f"{PROGRAM} evaluate",
        "%(prog)s RUN [options]",
        "Play episodes with the saved policy of a run: mean return, deviation, 95 % interval.",
    )
    parser.add_argument("run", metavar="RUN", help="Run folder, or a folder that agent.save wrote.")
    group = parser.add_argument_group("evaluation")
    group.add_argument("--episodes", type=at_least_one, metavar="N", help="How many (default 100).")
    group.add_argument(
        "--stochastic", action="store_true", help="Sample actions; default: the most likely one."
    )
    group.add_argument("--best", action="store_true", help="The policy that evaluated best, not the newest.")
    group.add_argument(
        "--seed", type=_not_negative, metavar="N", help="Seed of the episodes (default: fixed, unused)."
    )
    group.add_argument("--device", metavar="WORD", help="Torch device of the networks (default cpu).")
    _common(parser, run=True)
    return parser


def record_parser() -> Parser:
    """The options of ``record``."""
    parser = Parser(
        f"{PROGRAM} record",
        "%(prog)s RUN [options]",
        "Write an mp4 of the saved policy of a run; no display is needed.",
    )
    parser.add_argument("run", metavar="RUN", help="Run folder, or a folder that agent.save wrote.")
    group = parser.add_argument_group("recording")
    group.add_argument("--out", metavar="FILE.mp4", help="Where to (default RUN/videos/).")
    group.add_argument("--episodes", type=at_least_one, metavar="N", help="How many (default 1).")
    group.add_argument("--best", action="store_true", help="The policy that evaluated best, not the newest.")
    group.add_argument(
        "--seed",
        type=_not_negative,
        metavar="N",
        help="Seed of the episodes (default: fixed, unused in training).",
    )
    _common(parser, run=True)
    return parser


def resume_parser() -> Parser:
    """The options of ``resume``."""
    parser = Parser(
        f"{PROGRAM} resume",
        "%(prog)s RUN [options]",
        "Go on with a run from its newest checkpoint, in the same folder.",
    )
    parser.add_argument("run", metavar="RUN", help="Run folder.")
    group = parser.add_argument_group("going on")
    group.add_argument(
        "--total-steps",
        type=at_least_one,
        metavar="N",
        help="A new end (align: responses); also continues a finished run (default: the run's own).",
    )
    group.add_argument(
        "--reward",
        metavar="R",
        help="align: the reward again, where it was your own code (default: the run's).",
    )
    group.add_argument(
        "--gold",
        metavar="R",
        help="align: the gold judge again, where it was your own code (default: the run's).",
    )
    group.add_argument(
        "--data",
        metavar="FILE",
        help="Language: the data again, where they were no file, or lie elsewhere (default: the run's).",
    )
    _common(parser, run=True)
    return parser


def at_least_one(word: str) -> int:
    """A whole number above 0, as argparse reads it."""
    return _bounded(word, 1)


def _not_negative(word: str) -> int:
    return _bounded(word, 0)


def _bounded(word: str, low: int) -> int:
    try:
        number = whole(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{word!r} is not a whole number.") from None
    if number < low:
        raise argparse.ArgumentTypeError(f"{number} is too small; expected at least {low}.")
    return number


def train_options(words: list[str]) -> tuple[Options, Options]:
    """What the flags say and what the settings file says; the update rule decides which flags there are."""
    words = [with_dashes(word) for word in words]
    path = _value_of("--settings", words)
    file_values = TrainSettings.values_from_json(read_settings(path), path) if path else {}
    algorithm = _value_of("--algorithm", words) or file_values.get("algorithm", "ppo")
    if algorithm not in ALGORITHM_SETTINGS:
        algorithm = "ppo"  # the parser words the error
    given = train_parser(algorithm).read(words, lambda name, known: _unknown_setting(name, known, algorithm))
    if file_values.get("algorithm", algorithm) != algorithm:  # the settings of another update rule do not fit
        outer = settings_fields(TrainSettings).keys() | {"env"}
        file_values = {name: value for name, value in file_values.items() if name in outer}
    return given, file_values


def _value_of(flag: str, words: list[str]) -> str | None:
    for i, word in enumerate(words):
        if word.startswith(flag + "="):
            return word.partition("=")[2]
        if word == flag and i + 1 < len(words):
            return words[i + 1]
    return None


def _unknown_setting(name: str, known: list[str], algorithm: str) -> str:
    """The answer to an unknown flag of train; one that another update rule has is said to be that."""
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


def read_settings(path: str) -> Any:
    """What a settings.json holds, given as the file or as the folder of its run. UsageError for neither."""
    from tightrope.runs.records import read_json
    from tightrope.runs.signed import unsigned

    file = Path(path)
    file = file / "settings.json" if file.is_dir() else file
    if not file.is_file():
        raise UsageError(f"--settings {path}: there is no such file. Give RUN/settings.json.")
    found = read_json(file)
    return unsigned(found) if isinstance(found, dict) else found


def overrides(given: Options, file_values: Options) -> tuple[str, Options]:
    """The task, and every setting that the file or a flag names (the flag wins)."""
    names = settings_fields(TrainSettings).keys() | {
        n for k in ALGORITHM_SETTINGS.values() for n in settings_fields(k)
    }
    flags = {name: value for name, value in given.items() if name in names}
    flags = {name: tuple(value) if isinstance(value, list) else value for name, value in flags.items()}
    values = {**file_values, **flags}
    env_of_file = values.pop("env", None)
    env = given.get("env") or env_of_file
    if env is None:
        raise UsageError("Which task? Give a Gymnasium id: tightrope train CartPole-v1")
    if "env" not in given and ":" in env:
        raise UsageError(
            f"The settings file names the task {env!r}, whose module would be imported. Code is named by you "
            f"and never by a file: {PROGRAM} train {retyped(env, 'ID')} --settings FILE"
        )
    return env, values


def file_values(name: str, path: str | None, flags: Options) -> Options:
    """What --settings of a language command says that no flag does, names and types checked; nothing without.

    UsageError for the settings of another command, and for what a file cannot hold and no flag gives again:
    an object, or code, which is named by the user alone.
    """
    from tightrope.language.settings import AlignSettings, RewardSettings, SFTSettings

    if path is None:
        return {}
    kinds: dict[str, type[Settings]] = {"sft": SFTSettings, "reward": RewardSettings, "align": AlignSettings}
    data = read_settings(path)
    if not isinstance(data, dict):
        raise UsageError(f"--settings {path} holds {type(data).__name__}, expected an object with settings.")
    own = next((command for command, field in OWN_FIELDS.items() if field in data), name)
    if own != name:
        raise UsageError(
            f"--settings {path} holds the settings of {own}, expected those of {name}. Give settings.json "
            f"of a run of {name}, or type: {PROGRAM} {own} --settings {path}"
        )
    values = kinds[name].values_from_json(data, f"--settings {path}")
    values = {key: x for key, x in values.items() if key not in flags}
    for key, value in values.items():
        if _must_be_named(key, value):
            word = "FILE.py:function" if key in ("reward", "gold") else "FILE"
            raise UsageError(
                f"--settings {path}: {key} was {value!r}, which no file may name: an object, code, or a "
                f"folder that is gone. Give it again: {PROGRAM} {name} --settings {shlex.quote(path)} "
                f"--{key.replace('_', '-')} {retyped(value, word)}"
            )
    return values


def _must_be_named(key: str, value: Any) -> bool:
    """Whether a setting stands for a Python object, or for code, which no file may name."""
    judge = key in ("reward", "gold") and value not in (None, "", "length") and not Path(value).is_dir()
    return judge or (isinstance(value, str) and value.startswith("<"))
