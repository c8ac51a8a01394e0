"""The command line: train, evaluate, record, resume. torch and environments are imported when needed."""

from __future__ import annotations

import os
import shlex
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from tightrope.cli.flags import UsageError, nearest
from tightrope.cli.options import (
    PROGRAM,
    Options,
    dry_run,
    evaluate_parser,
    print_json,
    record_parser,
    resume_parser,
    training_options,
)
from tightrope.runs.records import printable

# ---------------------------------------------------------------------------- commands


def train(words: list[str]) -> int:
    """``tightrope train ENV``: resolve the settings, train, print how it went."""
    given, values = training_options("train", words)
    env = values.pop("env", None)
    if env is None:
        raise UsageError("Which task? Give a Gymnasium id: tightrope train CartPole-v1")
    _import_named(given.get("env_module"))
    from tightrope.control.resolve import resolve

    settings = resolve(env, values.pop("algorithm", "ppo"), values)
    if dry_run(settings, given):
        return 0

    def run(report: Any) -> dict[str, Any]:
        from tightrope.control.train import train as run_training

        return run_training(settings, run_dir=given.get("run_dir"), listeners=[report])

    return _watched(run, given)


def resume(words: list[str]) -> int:
    """``tightrope resume RUN``: go on from the newest checkpoint."""
    given = resume_parser().read(words)
    from tightrope.runs.run import Run

    try:
        settings = Run.open(given["run"]).settings
    except ValueError:  # who writes there now comes first: RunInUse
        with Run.open(given["run"], own=True) as run_folder:
            settings = run_folder.settings
    if "env" not in settings:
        from tightrope.cli.language import resume as resume_language

        return resume_language(given, settings)
    _import_named(given.get("env_module"))

    def run(report: Any) -> dict[str, Any]:
        from tightrope.control.train import resume as run_training

        env, total_steps = given.get("env"), given.get("total_steps")
        return run_training(given["run"], total_steps=total_steps, listeners=[report], env=env)

    return _watched(run, given)


def evaluate(words: list[str]) -> int:
    """``tightrope evaluate RUN``: how good the saved policy is."""
    given = evaluate_parser().read(words)
    _import_named(given.get("env_module"))
    from tightrope.control.saving import evaluate_run

    names = ("episodes", "stochastic", "best", "seed", "env", "device")
    result = evaluate_run(given["run"], **{name: given[name] for name in names if name in given})
    if given.get("json"):
        print_json(result)
    else:
        mean, half_width, count = (result[name] for name in ("mean_return", "ci95", "episodes"))
        print(f"mean return {mean:.2f}, deviation {result['std_return']:.2f}, {count} episodes")
        print(f"95 % interval of the mean: {mean - half_width:.2f} to {mean + half_width:.2f}")
    return 0


def record(words: list[str]) -> int:
    """``tightrope record RUN``: an mp4 of the saved policy."""
    given = record_parser().read(words)
    _import_named(given.get("env_module"))
    from tightrope.control.record import record_run

    names = ("out", "best", "episodes", "seed", "env")
    result = record_run(given["run"], **{name: given[name] for name in names if name in given})
    if given.get("json"):
        print_json(result)
    else:
        print(f"{result['path']}  ({result['frames']} frames)")
    return 0


def _language(name: str) -> Callable[[list[str]], int]:
    """A command of the language story, whose module is imported when it is used."""

    def command(words: list[str]) -> int:
        from tightrope.cli import language as cli_language

        return int(getattr(cli_language, name)(words))

    return command


COMMANDS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "train": (train, "ENV   train a policy on a Gymnasium task"),
    "evaluate": (evaluate, "RUN   episodes with the saved policy: mean, deviation, 95 % interval"),
    "record": (record, "RUN   an mp4 of the saved policy"),
    "resume": (resume, "RUN   go on from the newest checkpoint"),
    "sft": (_language("sft"), "--data FILE   fine-tune a language model"),
    "reward": (_language("reward"), "--data FILE   train a reward model on preference pairs"),
    "align": (_language("align"), "--data FILE --reward R   PPO on a language model"),
    "sample": (_language("sample"), "RUN   responses of the aligned model beside the reference's"),
    "doctor": (_language("doctor"), "check this installation; --model M: a language model"),
}


def _import_named(name: str | None) -> None:
    """Import the user's own module, by name or as a file, so that it can register environments."""
    if name is None:
        return
    import importlib
    import importlib.util

    path = Path(name)
    if path.suffix != ".py":
        sys.path.insert(0, os.getcwd())
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not (name + ".").startswith(error.name + "."):
                raise
            raise UsageError(
                f"--env-module {name}: there is no such module. Give a module or FILE.py."
            ) from error
        return
    if not path.is_file():
        raise UsageError(f"--env-module {name}: there is no such file.")
    sys.path.insert(0, str(path.resolve().parent))
    spec = importlib.util.spec_from_file_location(path.stem, path.resolve())
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)


# ---------------------------------------------------------------------------- output


def _watched(run: Callable[[Any], dict[str, Any]], given: Options) -> int:
    """Train with the display of control runs."""
    from tightrope.cli.display import choose
    from tightrope.cli.farewell import watched

    return watched(
        run,
        choose,
        given,
        what="steps",
        resume=lambda folder: _command("resume", folder or "", given),
        print_end=lambda summary, folder, quiet, stream: _print_end(
            summary, folder or "", given, quiet, stream
        ),
    )


def _print_end(summary: dict[str, Any], run: str, given: Options, quiet: bool, stream: TextIO) -> None:
    """The learning curve, the final evaluation, where the run lies and what to type next."""
    from tightrope.cli import display
    from tightrope.runs.run import Run

    if not quiet:
        rows = Run.open(run).read_metrics()
        points = [(row["step"], row.get("rollout/ep_rew_mean")) for row in rows]
        lines = display.curve([(step, value) for step, value in points if value is not None])
        if lines:
            print("\nreturn of the training episodes", *lines, sep="\n", file=stream)
        print(file=stream)
    final = summary.get("final") or {}
    mean, deviation = final.get("eval/mean_reward"), final.get("eval/std_reward")
    steps, seconds = summary.get("steps"), summary.get("wall_seconds")
    if mean is not None:
        spread = f" ± {display.number(deviation)}" if deviation is not None else ""
        count = final.get("eval/episodes")
        over = f" over {count:.0f} episodes" if count else ""
        print(f"evaluation   mean return {display.number(mean)}{spread}{over}", file=stream)
    if steps is not None and seconds:
        print(
            f"training     {steps:,} steps in {display.clock(seconds)} ({steps / seconds:,.0f} steps/s)",
            file=stream,
        )
    print(f"run          {run}", file=stream)
    if not quiet:
        print(f"next         {_command('evaluate', run, given)}", file=stream)
        print(f"             {_command('record', run, given)}", file=stream)


def _command(name: str, run: str, given: Options) -> str:
    """A command to type about a run, with what of the user's code it needs."""
    words = [PROGRAM, name, run]
    if "env_module" in given:
        words += ["--env-module", given["env_module"]]
    if ":" in given.get("env", ""):
        words += ["--env", given["env"]]
    return shlex.join(words)


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {PROGRAM} {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items()]
    return "\n".join(
        [
            "tightrope: PPO from CartPole to RLHF on one verified core",
            "",
            *lines,
            "",
            f"Options of a command: {PROGRAM} COMMAND --help. First run: {PROGRAM} train CartPole-v1",
        ]
    )


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("tightrope")
    except metadata.PackageNotFoundError:
        return "not installed"


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if words else 2
    if words[0] == "--version":
        print(f"tightrope {_version()}")
        return 0
    if words[0] not in COMMANDS:
        near = nearest(words[0], COMMANDS)
        hint = f"Did you mean {PROGRAM} {near}?" if near else f"Commands: {', '.join(COMMANDS)}."
        raise UsageError(f"There is no command {words[0]!r}. {hint}")
    return COMMANDS[words[0]][0](words[1:])


def _is_ours(error: BaseException) -> bool:
    """Whether an error was raised by this package's own code: worded for the user, no traceback needed."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    package = str(Path(__file__).resolve().parents[1])
    return trace is not None and str(Path(trace.tb_frame.f_code.co_filename).resolve()).startswith(
        package + os.sep
    )


def _show_warning(message: Warning | str, *_args: Any, **_kwargs: Any) -> None:
    print(f"warning: {message}", file=sys.stderr)


def main(words: list[str] | None = None) -> int:
    """Run a command line and return its exit code: 0, 2 for a user's mistake, 130 after Ctrl-C, 143 after
    SIGTERM.
    """
    words = sys.argv[1:] if words is None else words
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without these characters must not end a run
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return _dispatch(words)
    except (ValueError, OSError, RuntimeError, FloatingPointError) as error:
        if isinstance(error, BrokenPipeError):
            # whoever read our output is gone; Python must not try to flush to it on its way out
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        if not isinstance(error, OSError) and not _is_ours(error):
            raise
        print(f"{PROGRAM}: {printable(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
