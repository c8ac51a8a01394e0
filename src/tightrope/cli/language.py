"""The commands of the language story: sft, reward, align, sample, doctor."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from tightrope.cli.flags import Parser, UsageError
from tightrope.cli.options import (
    KINDS,
    OWN_FIELDS,
    PROGRAM,
    at_least_one,
    dry_run,
    output,
    print_json,
    run_parser,
    training_options,
)
from tightrope.language.settings import AlignSettings

NEEDED = "The language story needs transformers. Install it with: pip install 'tightrope[language]'"


def sft(words: list[str]) -> int:
    """``tightrope sft``: supervised fine-tuning."""
    return _supervised("sft", words)


def reward(words: list[str]) -> int:
    """``tightrope reward``: a reward model from preference pairs."""
    return _supervised("reward", words)


def _supervised(name: str, words: list[str]) -> int:
    given, values = training_options(name, words)
    settings = KINDS[name]().with_values(**values)
    if dry_run(settings, given):
        return 0
    if not values.get("data"):
        raise UsageError(f"What to learn from? Give --data FILE.jsonl: {PROGRAM} {name} --data FILE.jsonl")
    train, _, columns = _stage(name)

    def run(report: Any) -> dict[str, Any]:
        return train(settings, run_dir=given.get("run_dir"), listeners=[report])

    return _watched(run, columns, "steps", given)


def _stage(name: str) -> tuple[Callable[..., dict[str, Any]], Callable[..., dict[str, Any]], Any]:
    """How stage one or two is trained and resumed, and the columns that show it."""
    _require_transformers()
    from tightrope.cli import display

    if name == "sft":
        from tightrope.language.supervised.sft import resume_sft, train_sft

        return train_sft, resume_sft, display.SFT
    from tightrope.language.supervised.preferences import resume_reward, train_reward

    return train_reward, resume_reward, display.REWARD


def align(words: list[str]) -> int:
    """``tightrope align``: PPO against any reward."""
    given, values = training_options("align", words)
    settings = AlignSettings().with_values(**values)
    if dry_run(settings, given):
        return 0
    for name, example in (("data", "--data PROMPTS.jsonl"), ("reward", "--reward length")):
        if not getattr(settings, name):
            raise UsageError(f"--{name} is missing. For example: {PROGRAM} align {example}")
    _require_transformers()
    from tightrope.cli import display
    from tightrope.language.alignment.align import align as run_align

    def run(report: Any) -> dict[str, Any]:
        return run_align(settings, run_dir=given.get("run_dir"), listeners=[report]).summary

    return _watched(run, display.ALIGN, "responses", given)


def resume(given: dict[str, Any], settings: dict[str, Any]) -> int:
    """``tightrope resume RUN`` of a run of sft, reward or align: its ``settings`` tell which."""
    for name in ("sft", "reward"):
        if OWN_FIELDS[name] in settings:
            return _resume_supervised(name, given)
    _require_transformers()
    from tightrope.cli import display
    from tightrope.language.alignment.align import resume_align

    def run(report: Any) -> dict[str, Any]:
        more = {"prompts": given.get("data"), "reward": given.get("reward"), "gold": given.get("gold")}
        return resume_align(
            given["run"], total_episodes=given.get("total_steps"), listeners=[report], **more
        ).summary

    return _watched(run, display.ALIGN, "responses", given)


def _resume_supervised(name: str, given: dict[str, Any]) -> int:
    for option in ("total_steps", "reward"):
        if option in given:
            flag = option.replace("_", "-")
            raise UsageError(
                f"{given['run']} is a run of {name}, which has no --{flag}. Leave it out: its settings say "
                "how long it learns, and from what."
            )
    _, go_on, columns = _stage(name)

    def run(report: Any) -> dict[str, Any]:
        return go_on(given["run"], data=given.get("data"), listeners=[report])

    return _watched(run, columns, "steps", given)


def sample(words: list[str]) -> int:
    """``tightrope sample RUN``: responses of the aligned model beside the reference's."""
    parser = run_parser(
        "sample", "Responses of the aligned model beside the reference's.", "Run folder of align."
    )
    group = parser.add_argument_group("sampling")
    group.add_argument(
        "--prompt", action="append", metavar="TEXT", help="A prompt of your own; may be repeated."
    )
    group.add_argument(
        "--count", type=at_least_one, metavar="N", help="How many prompts of the run's data (default 8)."
    )
    group.add_argument("--seed", type=int, metavar="N", help="Seed of sampling (default: the run's + 1).")
    group.add_argument(
        "--recorded",
        action="store_true",
        help="Sample nothing: show the last responses of training with their rewards, KL and advantage.",
    )
    output(parser)
    given = parser.read(words)
    if given.get("recorded"):
        return _recorded(given)
    _require_transformers()
    from tightrope.language.compare import sample_run

    rows = sample_run(given["run"], **{k: given[k] for k in ("prompt", "count", "seed") if k in given})
    if given.get("json"):
        print_json({"samples": rows})
    else:
        from tightrope.language.alignment.samples import print_comparison

        print_comparison(rows)
    return 0


def _recorded(given: dict[str, Any]) -> int:
    """The newest rollout in samples.jsonl, from the best score to the worst."""
    from tightrope.language.alignment.samples import print_samples, read_samples, spread

    for option in ("prompt", "seed"):
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


def doctor(words: list[str]) -> int:
    """``tightrope doctor``: this machine, this installation, and with --model a language model's
    self-check.
    """
    parser = Parser(
        f"{PROGRAM} doctor", "%(prog)s [--model M]", "Check this installation; with --model a language model."
    )
    parser.add_argument(
        "--model", metavar="M", help="Folder, hub id or packaged name of a causal language model."
    )
    output(parser)
    given = parser.read(words)
    from tightrope.cli.doctor import examine

    findings = examine(given.get("model"))
    if given.get("json"):
        print_json({"findings": [finding._asdict() for finding in findings]})
    else:
        for finding in findings:
            print(f"{'ok  ' if finding.good else 'BAD '} {finding.what}: {finding.seen}")
            if not finding.good:
                print(f"     {finding.advice}")
    return 0 if all(finding.good for finding in findings) else 1


def _require_transformers() -> None:
    import importlib.util

    if importlib.util.find_spec("transformers") is None:
        raise UsageError(NEEDED)


# ---------------------------------------------------------------------------- output


def _given_again(run: str | None) -> list[str]:
    """The flags that `resume` of an alignment run asks for again: its judges, where they were code."""
    from tightrope.runs.run import Run

    settings = {} if run is None else Run.open(run).settings
    judges = {name: settings.get(name) for name in ("reward", "gold")}
    code = {name: judge for name, judge in judges.items() if isinstance(judge, str) and ".py:" in judge}
    return [word for name, judge in code.items() for word in (f"--{name}", judge)]


def _watched(run: Callable[[Any], dict[str, Any]], columns: Any, what: str, given: dict[str, Any]) -> int:
    """Train with the display of language runs."""
    from tightrope.cli.display import Display
    from tightrope.cli.farewell import watched

    return watched(
        run,
        functools.partial(Display, columns, what),
        given,
        what=what,
        resume=lambda folder: shlex.join([PROGRAM, "resume", folder or "", *_given_again(folder)]),
        print_end=functools.partial(_print_end, what),
    )


def _print_end(what: str, summary: dict[str, Any], folder: str | None, quiet: bool, stream: TextIO) -> None:
    """The final figures, where the run lies, and what to type next."""
    for name, value in (summary.get("final") or {}).items():
        if isinstance(value, int | float) and not quiet:
            print(f"{name:<32} {value:.4g}", file=stream)
    print(f"run          {folder}", file=stream)
    if not quiet and folder:
        if what == "responses":
            print(f"next         {shlex.join([PROGRAM, 'sample', folder])}", file=stream)
        print(f"model        {Path(folder) / 'model'}", file=stream)
