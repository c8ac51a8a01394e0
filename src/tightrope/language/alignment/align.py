"""The third stage: PPO on a causal language model, as one function.

from tightrope.language import align
run = align(model="path/to/model", prompts=prompts, reward=reward, total_episodes=4096, seed=1)
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tightrope.language.alignment.iteration import Trainer
from tightrope.language.data.examples import FILES, Rows
from tightrope.language.model.architecture import ROUTER_UNUSED, router_weight
from tightrope.language.model.load import quiet_libraries
from tightrope.language.reward.judge import RewardSources
from tightrope.language.settings import AlignSettings, may_stand_in_a_file, recorded, typed_again, weighted
from tightrope.language.supervised.prepare import threads
from tightrope.runs import signals
from tightrope.runs.folders import require_kind
from tightrope.runs.run import Run
from tightrope.training import loop
from tightrope.training.events import Listener, Listeners
from tightrope.training.loop import continue_from, newest_point
from tightrope.training.tensorboard import require_tensorboard

__all__ = ["Aligned", "align", "resume_align"]


@dataclass(frozen=True)
class Aligned:
    """A finished run: its folder, its summary, and a row of metrics per iteration."""

    path: Path
    summary: dict[str, Any]
    metrics: list[dict[str, Any]]

    @property
    def model(self) -> Path:
        """The folder that AutoModelForCausalLM.from_pretrained loads."""
        return self.path / "model"


@quiet_libraries()
@signals.stoppable()
def align(
    settings: AlignSettings | None = None,
    *,
    prompts: Rows | None = None,
    reward: RewardSources | None = None,
    gold: RewardSources | None = None,
    run_dir: str | Path | None = None,
    listeners: Sequence[Listener] = (),
    **values: object,
) -> Aligned:
    """Train a language model against a reward; returns the run.

    ``prompts``: texts, message lists or rows with a "prompt", or a file of them. ``reward``: a function as
    TRL calls it, (function, weight), "length", FILE.py:function, the folder of a reward model, or a list of
    these, whose scores are added up. ``gold``: another judge of the same kinds, asked on held-out prompts and
    never trained on. Everything else is a field of AlignSettings or RLHFSettings. Raises ValueError for what
    cannot work, before anything is trained.
    """
    settings = (settings or AlignSettings()).with_values(**values)
    settings = recorded(settings, data=prompts, reward=reward, gold=gold)
    events = Listeners(listeners)
    for risk in (*settings.risks(), *settings.without_effect()):
        events.warn(risk)
    require_tensorboard(settings.tensorboard)
    with threads(settings.threads):
        trainer = _trainer(settings, prompts, reward, gold, events)
        if router_weight(trainer.roles.model):
            events.warn(ROUTER_UNUSED.format("align does not have it in its loss"))
        name = f"align-{Path(settings.model).name}-{settings.seed}"
        with Run.create(run_dir, trainer.settings.to_json(), name) as run:
            return _train(trainer, run)


def _trainer(
    settings: AlignSettings,
    prompts: Rows | None,
    reward: RewardSources | None,
    gold: RewardSources | None,
    events: Listeners,
) -> Trainer:
    """A trainer on what was given, and on what the settings name where nothing was."""
    return Trainer(
        settings,
        settings.data if prompts is None else prompts,
        list(settings.reward) if reward is None else reward,
        settings.gold if gold is None else gold,
        events,
    )


def _train(trainer: Trainer, run: Run) -> Aligned:
    summary = loop.train(trainer, run, trainer.listeners)
    return Aligned(run.path, summary, run.read_metrics())


@quiet_libraries()
@signals.stoppable()
def resume_align(
    run_dir: str | Path,
    *,
    prompts: Rows | None = None,
    reward: RewardSources | None = None,
    gold: RewardSources | None = None,
    total_episodes: int | None = None,
    listeners: Sequence[Listener] = (),
) -> Aligned:
    """Continue from a run's newest checkpoint, or from the start where there is none yet. It ends like an
    uninterrupted run, bit for bit.

    Code is never named by a file: a reward that was a function must be given again, and so must prompts that
    were no file. ValueError where they are seen to be others, or to weigh otherwise. ``total_episodes``
    extends a finished run.
    """
    with Run.open(run_dir, own=True) as run:
        require_kind(run.path, run.settings, "align")
        settings = AlignSettings.from_json(run.settings, run.path / "settings.json")
        if total_episodes is not None:
            settings = settings.with_values(total_episodes=total_episodes)
        _require_what_no_file_gives(run_dir, settings, prompts, reward, gold)
        with threads(settings.threads):
            trainer = _trainer(settings, prompts, reward, gold, Listeners(listeners))
            _go_back(trainer, run, total_episodes)
            return _train(trainer, run)


def _require_what_no_file_gives(
    run_dir: str | Path,
    settings: AlignSettings,
    prompts: Rows | None,
    reward: RewardSources | None,
    gold: RewardSources | None,
) -> None:
    """ValueError for prompts and judges that were objects and are not given again."""
    for name, value in (("reward", reward), ("gold", gold)):
        known = getattr(settings, name) or ()
        words = (known,) if isinstance(known, str) else known
        if value is not None:
            _require_same(run_dir, settings, name, value)
        elif not all(map(may_stand_in_a_file, words)):
            raise ValueError(
                f"The {name} of {run_dir} was {' '.join(map(repr, words))}: code, which no file may import, "
                "or a folder that is not there any more. If it is yours, or you have read it, name it again: "
                f"tightrope resume {shlex.quote(str(run_dir))} {typed_again(f'--{name}', words)}"
            )
    moved = Path(settings.data).suffix.lower() in FILES and not Path(settings.data).is_file()
    if prompts is None and (moved or settings.data.startswith("<")):
        raise ValueError(
            f"The prompts of {run_dir} were {settings.data!r}, which is not a file. Give them again: "
            f"tightrope resume {shlex.quote(str(run_dir))} --data PROMPTS.jsonl"
        )


def _require_same(run_dir: str | Path, settings: AlignSettings, name: str, value: RewardSources) -> None:
    """ValueError for judges that are seen to be others than the run's: another number, other weights, another
    built-in one or function of a file. Of an object or a folder, which may have moved, the weight is seen.
    """
    known, given = (getattr(one, name) or () for one in (settings, recorded(settings, **{name: value})))
    was, now = ((words,) if isinstance(words, str) else tuple(words) for words in (known, given))
    pairs = [(weighted(old), weighted(new)) for old, new in zip(was, now, strict=False)]
    if len(was) != len(now) or not all(old[1] == new[1] and _may_be(old[0], new[0]) for old, new in pairs):
        raise ValueError(
            f"The {name} of {run_dir} was {', '.join(was) or 'none'}, got {', '.join(now)}; a run keeps what "
            "it is trained on and judged by: expected the same, in the same order, with the same weights. "
            f"For another, start a new run: tightrope align --model {shlex.quote(str(run_dir))}"
        )


def _may_be(old: str, new: str) -> bool:
    """Whether two names may be those of one judge."""
    if {old, new} & set(AlignSettings.BUILT_IN_REWARDS):
        return old == new
    functions = [word.rpartition(":")[2] for word in (old, new) if ".py:" in word]
    return len(functions) < 2 or functions[0] == functions[1]


def _go_back(trainer: Trainer, run: Run, total_episodes: int | None) -> None:
    """Put trainer and run to the newest checkpoint, or to the start where there is none."""
    settings = trainer.settings
    point = newest_point(run, trainer.listeners)
    if point is not None:
        trainer.restore(point)
    if total_episodes is not None and total_episodes < trainer.episodes:
        raise ValueError(
            f"{run.path} has had {trainer.episodes:,} responses already; expected total_episodes of as "
            f"many or more, got {total_episodes:,}."
        )
    if point is not None and trainer.episodes >= settings.total_episodes:
        text = f"{run.path} has its {trainer.episodes:,} responses; --total-episodes N continues from there."
        trainer.listeners.info(text)
    trainer.stopped = (
        trainer.stopped and total_episodes is None
    )  # a new end means that the user wants to continue
    continue_from(trainer, run, point)
