"""The command line: one table of commands, those that read a run, and what happens to errors. torch and
environments are imported when needed.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tightrope.cli.flags import UsageError, nearest
from tightrope.cli.options import (
    PROGRAM,
    Options,
    doctor_parser,
    evaluate_parser,
    print_json,
    record_parser,
    sample_parser,
    stdout_for_json,
)
from tightrope.cli.train_commands import (
    import_env_module,
    look_again,
    require_transformers,
    resume,
    train,
)
from tightrope.errors import TightropeError
from tightrope.runs import signals
from tightrope.runs.durable import CannotWrite
from tightrope.runs.records import printable

CANNOT_WRITE = 74  # EX_IOERR of sysexits.h


def _evaluate(words: list[str]) -> int:
    """``tightrope evaluate RUN``: how good the saved policy is."""
    given = evaluate_parser().read(words)
    if os.path.exists(given["run"]):
        given["run"] = os.path.abspath(given["run"])  # user code may change the working directory
    import_env_module(given)
    look_again(given)
    from tightrope.control.evaluate import evaluate_run

    names = ("episodes", "stochastic", "best", "seed", "env", "env_kwargs", "device", "evaluation_max_steps")
    result = evaluate_run(given["run"], **{name: given[name] for name in names if name in given})
    if given.get("json"):
        print_json(result)
    else:
        mean, half_width, count = (result[name] for name in ("mean_return", "ci95", "episodes"))
        print(f"mean return {mean:.2f}, deviation {result['std_return']:.2f}, {count} episodes")
        print(f"95 % interval of the mean: {mean - half_width:.2f} to {mean + half_width:.2f}")
        if "success_rate" in result:
            print(f"success rate {result['success_rate']:.2f}")
    return 0


def _record(words: list[str]) -> int:
    """``tightrope record RUN``: an mp4 of the saved policy."""
    given = record_parser().read(words)
    if os.path.exists(given["run"]):
        given["run"] = os.path.abspath(given["run"])  # user code may change the working directory
    import_env_module(given)
    look_again(given)
    from tightrope.control.record import record_run

    names = ("out", "best", "episodes", "seed", "env", "env_kwargs")
    result = record_run(given["run"], **{name: given[name] for name in names if name in given})
    if given.get("json"):
        print_json(result)
    else:
        print(f"{result['path']}  ({result['frames']} frames)")
    return 0


def _sample(words: list[str]) -> int:
    """``tightrope sample RUN``: responses of the aligned model beside the reference's."""
    given = sample_parser().read(words)
    if given.get("recorded"):
        return _recorded(given)
    require_transformers()
    from tightrope.language.compare import sample_run

    names = ("prompt", "count", "seed", "reward")
    rows = sample_run(given["run"], figures=True, **{k: given[k] for k in names if k in given})
    if given.get("json"):
        print_json({"samples": rows})
    else:
        from tightrope.language.alignment.samples import print_comparison

        print_comparison(rows)
        if "score_after" not in rows[0]:
            print("no score: the reward was code, which no file may name; add --reward FILE.py:function")
    return 0


def _recorded(given: Options) -> int:
    """The newest rollout in samples.jsonl, from the best score to the worst."""
    from tightrope.language.alignment.samples import print_samples, read_samples, spread

    for option in ("prompt", "seed", "reward"):
        if option in given:
            raise UsageError(f"--recorded samples nothing, so that --{option} has no meaning. Leave one out.")
    rows = read_samples(given["run"])
    newest = [row for row in rows if row["step"] == rows[-1]["step"]]
    shown = spread(newest, given.get("count", 8))
    if given.get("json"):
        print_json({"samples": shown})
    else:
        print_samples(shown, title=f"after {rows[-1]['step']:,} responses" if rows else "")
    return 0


def _doctor(words: list[str]) -> int:
    """``tightrope doctor``: this machine, this installation, and with --model a language model's
    self-check.
    """
    given = doctor_parser().read(words)
    from tightrope.cli.doctor import examine_installation

    findings = examine_installation(given.get("model"))
    if given.get("json"):
        print_json({"findings": [finding._asdict() for finding in findings]})
    else:
        for finding in findings:
            print(f"{'ok  ' if finding.good else 'BAD '} {finding.what}: {finding.seen}")
            if not finding.good:
                print(f"     {finding.advice}")
    return 0 if all(finding.good for finding in findings) else 1


COMMANDS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "train": (partial(train, "train"), "ENV   train a policy on a Gymnasium task"),
    "evaluate": (_evaluate, "RUN   episodes with the saved policy: mean, deviation, 95 % interval"),
    "record": (_record, "RUN   an mp4 of the saved policy"),
    "resume": (resume, "RUN   continue from the newest checkpoint"),
    "sft": (partial(train, "sft"), "--data FILE   fine-tune a language model"),
    "reward": (partial(train, "reward"), "--data FILE   train a reward model on preference pairs"),
    "align": (partial(train, "align"), "--data FILE --reward R   PPO on a language model"),
    "sample": (_sample, "RUN   responses of the aligned model beside the reference's"),
    "doctor": (_doctor, "check this installation; --model M: a language model"),
}


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
    """Whether the message is written for the user, so that no traceback is needed: one of our error classes,
    or another error that our own code raised (a ValueError about a setting).
    """
    if isinstance(error, TightropeError | OSError):
        return True
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    package = str(Path(__file__).resolve().parents[1])
    return trace is not None and str(Path(trace.tb_frame.f_code.co_filename).resolve()).startswith(
        package + os.sep
    )


def _show_warning(message: Warning | str, *_args: object, **_kwargs: object) -> None:
    print(f"warning: {message}", file=sys.stderr)


def main(words: list[str] | None = None) -> int:
    """Run a command line and return its exit code: 0, 2 for a user's mistake, CANNOT_WRITE where the disk
    refuses, 130 after Ctrl-C, 143 after SIGTERM.
    """
    words = sys.argv[1:] if words is None else words
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without these characters must not end a run
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            with signals.stoppable(), stdout_for_json(words):
                return _dispatch(words)
    except (TightropeError, ValueError, OSError, RuntimeError, FloatingPointError) as error:
        if isinstance(error, BrokenPipeError):
            # the reader of our output is gone; Python must not flush to it at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        if not _is_ours(error):
            raise
        print(f"{PROGRAM}: {printable(str(error))}", file=sys.stderr)
        return CANNOT_WRITE if isinstance(error, CannotWrite) else 2
    except KeyboardInterrupt as error:
        return error.code if isinstance(error, signals.Stopped) else 130
