"""The commands that train, in both stories: train, sft, reward, align, and resume."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import shlex
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from tightrope.cli import display
from tightrope.cli.display import Display
from tightrope.cli.flags import UsageError
from tightrope.cli.options import (
    PROGRAM,
    SETTINGS_CLASSES,
    Options,
    dry_run,
    print_json,
    resume_parser,
    training_options,
)
from tightrope.runs import checkpoint, signals
from tightrope.runs.durable import CannotWrite
from tightrope.runs.folders import command_of
from tightrope.runs.records import printable, retyped
from tightrope.runs.run import Run
from tightrope.settings.values import Settings

VIEWS = {"train": display.CONTROL, "sft": display.SFT, "reward": display.REWARD, "align": display.ALIGN}
# settings that must be given, and how they are typed
REQUIRED = {
    "sft": {"data": "--data FILE.jsonl"},
    "reward": {"data": "--data FILE.jsonl"},
    "align": {"data": "--data PROMPTS.jsonl", "reward": "--reward length"},
}
# what is typed after a command; RUN and MODEL are replaced
FOLLOWS = {
    "train": ("evaluate RUN", "record RUN"),
    "sft": (
        "reward --model RUN --data PAIRS.jsonl",
        "align --model RUN --data PROMPTS.jsonl --reward length",
    ),
    "reward": ("align --model MODEL --data PROMPTS.jsonl --reward RUN",),
    "align": ("sample RUN",),
}
START, RESUME = 0, 1  # places in `_functions`
Training = Callable[..., Any]


def train(command: str, words: list[str]) -> int:
    """``tightrope train ENV``, ``sft``, ``reward``, ``align``: resolve the settings, train, print the end."""
    given, values, origins = training_options(command, words)
    if command == "train":
        env = values.pop("env", None)
        if env is None:
            raise UsageError("Which task? Give a Gymnasium id: tightrope train CartPole-v1")
        if given.get("run_dir"):
            given["run_dir"] = os.path.abspath(given["run_dir"])  # user code may change the working directory
        import_env_module(given)
        from tightrope.control.environments.make import look_first
        from tightrope.control.resolve import resolve_with_preset

        look_first(env, values.get("env_kwargs"))
        settings: Settings
        settings, preset = resolve_with_preset(env, values.pop("algorithm", "ppo"), values)
        origins = dict.fromkeys(preset, "preset") | origins
    else:
        settings = SETTINGS_CLASSES[command]().with_values(**values)
    if dry_run(settings, given, origins):
        return 0
    for name, example in REQUIRED.get(command, {}).items():
        if not getattr(settings, name):
            raise UsageError(f"--{name} is missing. For example: {PROGRAM} {command} {example}")
    return _watched(command, given, START, settings, run_dir=given.get("run_dir"))


def resume(words: list[str]) -> int:
    """``tightrope resume RUN``: continue from the newest checkpoint."""
    given = resume_parser().read(words)
    try:
        settings = Run.open(given["run"]).settings
    except ValueError:  # who writes there now comes first: RunInUse
        with Run.open(given["run"], own=True) as run:
            settings = run.settings
    command = command_of(settings) or "align"
    total = given.get("total_steps")
    if command == "train":
        given["run"] = os.path.abspath(given["run"])
        import_env_module(given)
        look_again(given, settings)
        values = {"total_steps": total, "env": given.get("env")}
    elif command == "align":
        values = {"total_episodes": total, "prompts": given.get("data")}
        values |= {name: given.get(name) for name in ("reward", "gold")}
    else:
        for option in ("total_steps", "reward"):
            if option in given:
                raise UsageError(
                    f"{given['run']} is a run of {command}, which has no --{option.replace('_', '-')}. Leave "
                    "it out: the settings of the run hold how long it trains, and on what."
                )
        values = {"data": given.get("data")}
    return _watched(command, given, RESUME, given["run"], **values)


def import_env_module(given: Options) -> None:
    """Import the module of --env-module, a name or a file of the user, so that it registers environments."""
    name = given.get("env_module")
    if name is None:
        return
    if not name:
        raise UsageError("--env-module is empty. Give a module or FILE.py.")

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


def look_again(given: Options, settings: dict[str, Any] | None = None) -> None:
    """`look_first` for the task of a run, or the one of --env in its place."""
    from tightrope.control.environments.make import look_first

    if settings is None:
        try:
            settings = Run.open(given["run"]).settings
        except ValueError:  # a folder of agent.save, or none
            return
    env = given.get("env", settings.get("env"))
    if isinstance(env, str) and ("env" in given or ":" not in env):  # no file may name what is imported
        kept = (settings.get("env_kwargs") if env == settings.get("env") else None) or {}
        look_first(env, {**kept, **(given.get("env_kwargs") or {})})


def _functions(command: str) -> tuple[Training, Training]:
    """What starts a run of a command, and what resumes it. torch is imported here."""
    if command == "train":
        from tightrope.control.train import resume as resume_policy
        from tightrope.control.train import train as train_policy

        return train_policy, resume_policy
    require_transformers()
    if command == "sft":
        from tightrope.language.supervised.sft import resume_sft, train_sft

        return train_sft, resume_sft
    if command == "reward":
        from tightrope.language.supervised.preferences import resume_reward, train_reward

        return train_reward, resume_reward
    from tightrope.language.alignment.align import align, resume_align

    return align, resume_align


def require_transformers() -> None:
    """UsageError where the package of the language story is missing."""
    if importlib.util.find_spec("transformers") is None:
        raise UsageError(
            "The language story needs transformers. Install it with: pip install 'tightrope[language]'"
        )


def _watched(command: str, given: Options, which: int, *args: Any, **values: object) -> int:
    """START or RESUME a run with the display, and print its end; returns the exit code."""
    as_json, quiet = bool(given.get("json")), bool(given.get("quiet"))
    stream = sys.stderr if as_json else sys.stdout
    live = not as_json and display.can_live(sys.stdout, dict(os.environ))
    view = VIEWS[command]
    name = getattr(args[0], "env", "") or getattr(args[0], "model", args[0])
    title = printable(f"{PROGRAM} {command if which == START else 'resume'} · {name}")
    shown = Display(view, stream, quiet=quiet, live=live, title=title)
    try:
        with shown:
            ended = _functions(command)[which](*args, **values, listeners=[shown])
    except KeyboardInterrupt as error:
        run = args[0] if which == RESUME else shown.run
        again = _command("resume RUN", run, given) if run else ""
        code, reached = (error.code, error.position) if isinstance(error, signals.Stopped) else (130, 0)
        # the display may be behind
        print(farewell(error, run, max(shown.step, reached), view.counted, again), file=sys.stderr)
        return code
    except CannotWrite as error:
        if shown.run and error.command:
            with contextlib.suppress(ValueError, OSError):  # the folder may be gone
                # with the user's own code that it needs
                error.command = _command("resume RUN", shown.run, given)
        raise
    summary = ended if isinstance(ended, dict) else ended.summary
    if as_json:
        print_json({**summary, "run_dir": shown.run})
    else:
        _print_end(command, summary, str(shown.run), given, stream)
    return 0


def farewell(error: BaseException, run: str | None, step: int, counted: str, command: str) -> str:
    """The message for a ``run`` (None: not begun) that was stopped at ``step``: its newest valid checkpoint,
    what will be repeated, and the ``command`` that resumes it. ``counted``: steps, responses.
    """
    by = f" by {error}" if isinstance(error, signals.Stopped) else ""
    if run is None:
        return f"Stopped{by} before the run began."
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `resume` reports damaged checkpoints
            folder = Run.open(run).newest().folder
    except ValueError:
        saved, text = 0, f"There is no checkpoint yet: all {step:,} {counted} will be repeated."
    else:
        saved = checkpoint.step_of(folder)
        text = f"It is saved in {folder}; what was under way is repeated."
        if saved < step:
            lost = f"{step - saved:,} {counted} since then will be repeated"
            text = f"The newest valid checkpoint is {folder}; {lost}."
    at = f"{counted.removesuffix('s')} {max(step, saved):,}"
    return f"Stopped{by} at {at}. {text} Go on with:\n  {command}"


def _command(typed: str, run: str, given: Options, model: str = "") -> str:
    """A command to type about a run, with the code of the user that it needs. ``typed``: with the words RUN
    and MODEL in place of these.
    """
    known = {"RUN": run, "MODEL": model}
    words = [PROGRAM, *(known.get(word, word) for word in typed.split())]
    if "env_module" in given:
        words += ["--env-module", given["env_module"]]
    if ":" in given.get("env", ""):
        words += ["--env", given["env"]]
    if typed == "resume RUN":
        settings = Run.open(run).settings
        for judge in ("reward", "gold"):
            named = settings.get(judge) or ()
            if ".py:" in str(named):
                for word in [named] if isinstance(named, str) else named:
                    words += [f"--{judge}", word]
    return shlex.join(words)


def _print_end(command: str, summary: dict[str, Any], run: str, given: Options, stream: TextIO) -> None:
    """The final figures, where the run lies, and what to type next."""
    quiet, final = given.get("quiet"), summary.get("final") or {}
    if command == "train":
        _print_returns(summary, final, None if quiet else run, stream)
    elif not quiet:
        for name, value in final.items():
            if isinstance(value, int | float):
                print(f"{name:<32} {value:.4g}", file=stream)
    print(f"run          {run}", file=stream)
    if quiet:
        return
    if command != "train":
        print(f"model        {Path(run) / 'model'}", file=stream)
    model = retyped(summary.get("model"), "MODEL")
    for title, follows in zip(("next", ""), FOLLOWS[command], strict=False):
        print(f"{title:<12} {_command(follows, run, given, model)}", file=stream)


def _print_returns(summary: dict[str, Any], final: dict[str, Any], run: str | None, stream: TextIO) -> None:
    """The learning curve of a control ``run`` (None: no curve), its final evaluation and its speed."""
    if run is not None:
        points = [(row["step"], row.get("rollout/ep_rew_mean")) for row in Run.open(run).read_metrics()]
        if lines := display.curve([(step, value) for step, value in points if value is not None]):
            print("\nreturn of the training episodes", *lines, sep="\n", file=stream)
        print(file=stream)
    mean, deviation, count = (final.get(f"eval/{name}") for name in ("mean_reward", "std_reward", "episodes"))
    steps, seconds = summary.get("steps"), summary.get("wall_seconds")
    if mean is not None:
        spread = f" ± {display.number(deviation)}" if deviation is not None else ""
        over = f" over {count:.0f} episodes" if count else ""
        if cut := final.get("eval/cut_episodes"):
            over += f", {cut:.0f} of them cut"
        if (rate := final.get("eval/success_rate")) is not None:
            over += f", success rate {rate:.2f}"
        print(f"evaluation   mean return {display.number(mean)}{spread}{over}", file=stream)
    if steps is not None and seconds:
        speed = f"{steps / seconds:,.0f} steps/s"
        print(f"training     {steps:,} steps in {display.clock(seconds)} ({speed})", file=stream)
