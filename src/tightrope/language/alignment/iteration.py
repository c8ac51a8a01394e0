"""The state and the iteration of an alignment run: sample -> score -> advantages -> update."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms import ppo
from tightrope.algorithms.batch import Batch, scale_metrics
from tightrope.algorithms.optimise import make_optimiser, set_learning_rates
from tightrope.language.alignment.experience import (
    PromptOrder,
    batch_of,
    gather,
    has_baseline,
    respond,
    rewards_of,
    to_scale,
)
from tightrope.language.alignment.figures import refuse_bad_numbers, rollout_metrics, warn_of_mismatch
from tightrope.language.alignment.kl import adapted, kl_loss, shared_scale
from tightrope.language.alignment.monitor import Monitor
from tightrope.language.alignment.ptx import Pretraining
from tightrope.language.alignment.samples import sample_rows
from tightrope.language.data.examples import Prompt, Rows, hold_out_prompts, read_prompts, read_rows
from tightrope.language.model.architecture import context_length
from tightrope.language.model.load import known_ids
from tightrope.language.model.packaged import find_model
from tightrope.language.model.saving import save_model
from tightrope.language.policy.policy_model import Experience, FirstPass, PolicyModel
from tightrope.language.policy.roles import Roles, make_roles
from tightrope.language.reward.call import RewardError
from tightrope.language.reward.functions import Scores
from tightrope.language.reward.judge import (
    Judge,
    RewardSources,
    critic_from_reward,
    folder_of,
    make_judge,
    reward_adapter,
    shares_trunk,
)
from tightrope.language.settings import AlignSettings, RLHFSettings
from tightrope.maths.values import ReturnScale, explained_variance
from tightrope.runs import signals
from tightrope.runs.checkpoint import counted, understood
from tightrope.runs.records import figures
from tightrope.runs.retention import Checkpoint
from tightrope.runs.run import Run
from tightrope.training.events import Listeners
from tightrope.training.learner import Update, crosses
from tightrope.training.parameters import Tensors, restore_tensors, tensors_of, whole_update

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

# what a checkpoint holds of a trainer as it is, and how it is read back
SAVED: dict[str, Callable[[Any], Any]] = {
    "episodes": counted, "iteration": counted, "kl_beta": float, "stopped": bool, "seconds": float,
    "newest": figures,
}  # fmt: skip


class Taken(NamedTuple):
    """What an iteration learns from: the prompts, one for each response; responses, scores, which of them
    count, and the batch made of them. ``scale``: of whiten_rewards. ``pause``: seconds of gold scores.
    """

    asked: list[Prompt]
    experience: Experience
    scores: Scores
    valid: Tensor
    batch: Batch
    scale: Any
    metrics: dict[str, float]
    pause: float
    seconds: float
    score_seconds: float

    @property
    def counts(self) -> bool:
        """Whether there is a response to learn from."""
        return bool(self.scores.valid.any())

    def rows(
        self, tokenizer: PreTrainedTokenizerBase, episodes: int, stop: Sequence[str]
    ) -> list[dict[str, Any]]:
        """The responses as samples.jsonl holds them."""
        return sample_rows(
            tokenizer, self.asked, self.experience, self.scores, self.batch, self.valid, episodes, stop
        )


class Trainer:
    """The state of an alignment run, a `Learner`."""

    def __init__(
        self,
        settings: AlignSettings,
        prompts: Rows,
        reward: RewardSources,
        gold: RewardSources | None,
        listeners: Listeners,
    ) -> None:
        self.settings, self.listeners = settings, listeners
        adapter = reward_adapter(reward)
        lora = settings.tune == "lora"
        shared = adapter is not None and lora and shares_trunk(adapter, find_model(settings.model))
        on_trunk = adapter if shared else None
        self.roles: Roles = make_roles(
            settings,
            on_trunk,
            listeners.info,
            warn=listeners.warn,
            own_reward=on_trunk is None and folder_of(reward) is not None,
        )
        self.roles.trunk.require_padding_unread()
        self.prompts = self._read_prompts(prompts)
        self.judge = make_judge(reward, self.roles, on_trunk=on_trunk, timeout=settings.reward_timeout)
        self.held_out: list[Prompt] = []
        self.gold: Judge | None = None
        if gold is not None:
            self.gold = make_judge(gold, self.roles, on_trunk=None, timeout=settings.reward_timeout)
            self.prompts, self.held_out = hold_out_prompts(self.prompts, settings.held_out_prompts)
        if settings.critic_from_reward:
            critic_from_reward(self.judge, self.roles, reward)
        self.optimiser = make_optimiser(
            self.roles.parameters(), self.roles.critic_parameters(), settings.update
        )
        self.return_scale: ReturnScale | None = None
        if settings.update.normalise_values and settings.critic != "none":
            # what the critic knows from the reward model is known in units of the reward
            self.return_scale = ReturnScale(deviation=1.0 if settings.critic_from_reward else 0.0)
        self.order = PromptOrder(len(self.prompts), settings.seed)
        self.update_rng = np.random.default_rng([settings.seed, 9])
        self.kl_beta = settings.kl_beta
        self.pretraining = (
            Pretraining.make(settings, self.roles, listeners.warn) if settings.ptx_weight else None
        )
        self.monitor = Monitor(kl_budget=settings.kl_budget)
        self.episodes, self.iteration, self.stopped = 0, 0, False
        self.seconds, self.rollbacks, self.newest = 0.0, 0, dict[str, float]()
        self.changes: dict[str, Any] = {}
        self.micro_batch_size = settings.update.micro_batch_size  # halved when memory runs out
        self.pending: Update | None = None
        self._update_seconds: float | None = None  # of the newest update
        self._warned = set[tuple[str, str]]()

    def _read_prompts(self, source: Rows) -> list[Prompt]:
        settings, limit = self.settings, context_length(self.roles.model)
        if limit is not None and settings.max_prompt_tokens + settings.max_new_tokens > limit:
            raise ValueError(
                f"max_prompt_tokens {settings.max_prompt_tokens} + max_new_tokens {settings.max_new_tokens} "
                f"exceed the model's context of {limit} tokens. Choose less of either."
            )
        return read_prompts(
            read_rows(source), self.roles.tokenizer, max_tokens=settings.max_prompt_tokens,
            vocabulary=known_ids(self.roles.model), notify=self.listeners.warn,
        )  # fmt: skip

    # ---------------------------------------------------------------------------------------------- the run

    @property
    def position(self) -> int:
        """Responses so far."""
        return self.episodes

    @property
    def total(self) -> int:
        """Responses of the whole run."""
        return self.settings.total_episodes

    @property
    def complete(self) -> bool:
        """Whether the budget is spent, of responses or of KL."""
        return not self._next_prompts()

    @property
    def merit(self) -> float | None:
        """The newest gold score."""
        return self.monitor.newest_gold

    def begin(self) -> list[str]:
        """The lines that describe the models."""
        return self.roles.lines()

    def evaluate(self, update: Update | None) -> dict[str, float]:
        """Nothing: gold scores are taken before an iteration, so that score and KL belong to one policy."""
        if update is not None:
            self.newest = update.metrics
        return {}

    def conclude(self) -> dict[str, float]:
        """Nothing: the figures of the last iteration are the final ones."""
        return {}

    def finish(self, run: Run) -> dict[str, Any]:
        """Write the model; returns the summary."""
        roles, source = self.roles, find_model(self.settings.model)
        save_model(roles.model, roles.tokenizer, run.path, roles.policy.adapter, source, self.listeners.warn)
        rows = run.read_metrics()
        if rows and not any("train/minibatches" in row for row in rows):
            self.listeners.warn(
                "not one step was taken: no response had a score that counts. The model is unchanged."
            )
        shown = ("objective/", "eval/")
        return {
            "model": self.settings.model,
            "seed": self.settings.seed,
            "episodes": self.episodes,
            "iterations": self.iteration,
            "wall_seconds": self.newest.get("time/seconds", 0.0),
            "stopped_early": self.stopped,
            "run_dir": str(run.path),
            "final": {name: value for name, value in self.newest.items() if name.startswith(shown)},
        }

    def _next_prompts(self) -> int:
        """Prompts of the next iteration; 0 at the end of the budget."""
        if self.stopped:
            return 0
        left = self.settings.total_episodes - self.episodes
        return max(0, min(self.settings.batch_size, left)) // self.settings.samples_per_prompt

    def _reached(self, fraction: float | None) -> bool:
        """Whether the newest iteration reached a point of this grid. All iterations but the last are of the
        full size.
        """
        samples = self.settings.samples_per_prompt
        before = self.episodes - self.settings.batch_size // samples * samples
        return crosses(max(0, before), self.episodes, self.settings.total_episodes, fraction)

    def _watch(self, metrics: dict[str, float]) -> None:
        """Over-optimisation: warn, and stop at the KL budget before another step is taken."""
        seen = (metrics["objective/kl"], metrics["objective/scores"], metrics.get("eval/gold"))
        for alarm in self.monitor.add(*seen):
            self.listeners.warn(alarm.text)
            self.stopped = self.stopped or alarm.stop
        if self.monitor.fit.decided:
            metrics["objective/gold_predicted_peak_kl"] = self.monitor.fit.peak_kl

    # ------------------------------------------------------------------------------------------ the state

    def snapshot(self) -> tuple[Tensors, dict[str, Any]]:
        """Everything that `restore` needs, as tensors and JSON. The tensors are not copied."""
        state = {**self._numbers(), "story": "align", "prompts_sha256": self._hash_of_prompts()}
        return self._learned(), state

    def _learned(self) -> Tensors:
        """What an update changes in place."""
        return tensors_of(self.roles.parameters(), self.optimiser)

    def _unlearn(self, tensors: Tensors) -> None:
        """Put back what `_learned` gave."""
        restore_tensors(tensors, self.roles.parameters(), self.optimiser)

    def _numbers(self) -> dict[str, Any]:
        """What an iteration changes beside tensors, as JSON."""
        state: dict[str, Any] = {name: getattr(self, name) for name in SAVED} | {
            "rollbacks": self.rollbacks,
            "micro_batch_size": self.micro_batch_size,
            "prompt_position": self.order.position,
            "rng": {"update": self.update_rng.bit_generator.state},
            "monitor": self.monitor.state(),
        }
        if self.return_scale is not None:
            state["return_scale"] = vars(self.return_scale)
        if self.pretraining is not None:
            state["rng"]["ptx"] = self.pretraining.rng.bit_generator.state
        return state

    def _put_back(self, state: dict[str, Any]) -> None:
        """Put back what `_numbers` gave."""
        for name, read in SAVED.items():
            setattr(self, name, read(state[name]))
        self.rollbacks = counted(state.get("rollbacks", 0))
        self.micro_batch_size = state.get("micro_batch_size", self.micro_batch_size)
        self.order.position = counted(state["prompt_position"])
        self.update_rng.bit_generator.state = state["rng"]["update"]
        self.monitor.restore(state["monitor"])
        if self.return_scale is not None:
            self.return_scale = ReturnScale(**state["return_scale"])
        if self.pretraining is not None:
            self.pretraining.rng.bit_generator.state = state["rng"]["ptx"]

    def restore(self, point: Checkpoint) -> None:
        """Put back a checkpoint of a run with the same settings. ValueError for one of another command or
        of other prompts.
        """
        folder, tensors, state = point
        if state.get("story") != "align":
            raise ValueError(f"{folder} is not a checkpoint of an alignment run.")
        if state.get("prompts_sha256") != self._hash_of_prompts():
            raise ValueError(
                f"{folder} is of a run with other prompts than these {len(self.prompts):,}. Give those that "
                "the run started with, or start a new run."
            )
        with understood(folder):
            self._unlearn(tensors)
            self._put_back(state)

    def roll_back(self, point: Checkpoint) -> None:
        """Go back to a checkpoint of this run; random numbers from there on depend on the seed, the episode
        and the number of rollbacks. The micro-batch that fits into memory is kept.
        """
        rollbacks, size = self.rollbacks + 1, self.micro_batch_size
        self.restore(point)
        self.rollbacks = rollbacks
        self.micro_batch_size = size
        other = np.random.default_rng([self.settings.seed, 9, self.episodes, rollbacks])
        self.update_rng.bit_generator.state = other.bit_generator.state

    def _hash_of_prompts(self) -> str:
        digest = hashlib.sha256()
        for prompt in (*self.prompts, *self.held_out):
            digest.update(repr(prompt.tokens).encode())
        return digest.hexdigest()

    # ---------------------------------------------------------------------------------------- an iteration

    def iterate(self) -> Iterator[Update]:
        """One iteration at a time. One that a signal ends is as if it had not begun."""
        adapters = self.settings.tune == "lora" and self.settings.critic != "separate"
        while count := self._next_prompts():
            before = self._numbers()
            try:
                # a copy of every weight of a model would be too large
                with whole_update(self._update_seconds, self._learned, self._unlearn if adapters else None):
                    update = self._one_iteration([self.prompts[i] for i in self.order.take(count)])
            except KeyboardInterrupt:
                self._put_back(before)
                raise
            yield update

    def _one_iteration(self, prompts: Sequence[Prompt]) -> Update:
        """sample -> score -> advantages -> update."""
        settings, before = self.settings, self.episodes
        present = settings.update.unchecked(**self.changes).at(self.episodes / settings.total_episodes)
        set_learning_rates(self.optimiser, present)
        with signals.interruptible():
            taken = self._take_experience(prompts)
        experience, metrics = taken.experience, taken.metrics
        begin = time.perf_counter()
        if taken.counts and not self.stopped:
            # a KL in the loss is scaled as the rewards were
            metrics |= self._update(taken.batch, present, experience, self.kl_beta * taken.scale)
            if settings.critic != "none":
                metrics["train/explained_variance"] = float(
                    explained_variance(taken.batch.old_values, taken.batch.returns, taken.batch.mask)
                )
        metrics["objective/kl_beta"] = self.kl_beta
        metrics["train/learning_rate"] = present.learning_rate
        metrics["time/score_seconds"] = taken.score_seconds
        metrics["time/update_seconds"] = self._update_seconds = time.perf_counter() - begin
        if settings.kl_goal is not None and taken.counts:
            goal = {"target": settings.kl_goal, "horizon": settings.kl_horizon}
            self.kl_beta = adapted(self.kl_beta, metrics["objective/kl"], len(taken.asked), **goal)
        self.episodes += len(taken.asked)
        self.iteration += 1
        seconds = metrics["time/update_seconds"] + taken.seconds
        metrics["time/fps"] = float(experience.responses.mask.sum()) / seconds
        rows = taken.rows(self.roles.tokenizer, self.episodes, settings.stop)
        on_grid = self._reached(settings.checkpoint_every)
        return Update(self.episodes, self.total, metrics, before, on_grid, samples=rows, pause=taken.pause)

    def _take_experience(self, prompts: Sequence[Prompt]) -> Taken:
        """Responses, their scores and advantages, and the metrics of these. No weight is changed."""
        settings, gold = self.settings, dict[str, float]()
        pause = time.perf_counter()
        if self.gold is not None and (not self.episodes or self._reached(settings.evaluate_every)):
            gold = self.gold_scores()  # of the policy that samples next, whose KL is in the same row
        begin = time.perf_counter()
        stream = settings.seed + 2**40 * self.rollbacks  # not the numbers that led to a NaN
        keep = (
            settings.one_pass and self.micro_batch_size is None and self.iteration >= settings.critic_warmup
        )
        given = (stream, self.iteration, settings.samples_per_prompt)
        experience = gather(self.roles, prompts, *given, keep=keep)
        if experience.short_of_memory:
            self._smaller(len(experience.tokens))
        refuse_bad_numbers(experience, self.roles)
        gathered = time.perf_counter()
        asked = [prompt for prompt in prompts for _ in range(settings.samples_per_prompt)]
        scores = self.judge(asked, experience, self._trainer_state())
        scored = time.perf_counter()
        self._warn_of_faults(scores)
        if settings.critic == "none":
            scores.valid[:] = has_baseline(scores.valid, settings.samples_per_prompt)
        found = rewards_of(experience, scores, settings, self.kl_beta)
        valid = torch.from_numpy(scores.valid).to(experience.tokens.device)
        batch = batch_of(experience, found.rewards, valid, settings, self.return_scale)
        plain = found.rewards / found.scale  # the metrics are those before whiten_rewards
        metrics = rollout_metrics(experience, scores, plain, found.kl_share, valid) | scores.metrics | gold
        warn_of_mismatch(metrics, self.roles, self._warned, self.listeners.warn, first=not self.iteration)
        self._watch(metrics)
        times = {"pause": begin - pause, "seconds": scored - begin, "score_seconds": scored - gathered}
        return Taken(asked, experience, scores, valid, batch, found.scale, metrics, **times)

    def _update(
        self, batch: Batch, present: RLHFSettings, experience: Experience, kl_weight: float
    ) -> dict[str, float]:
        """PPO, or only the critic while it warms up. ``kl_weight``: of a KL in the loss."""
        warming = self.iteration < self.settings.critic_warmup
        batch, self.return_scale = to_scale(batch, experience, self.return_scale, self.roles.critic_head)
        model = PolicyModel(self.roles, critic_only=warming, first_pass=experience.first_pass)
        experience.first_pass = None  # where memory runs out, nothing else may hold on to its graph
        if warming:
            batch = dataclasses.replace(batch, advantages=torch.zeros_like(batch.advantages))
            present = present.unchecked(entropy_weight=0.0, target_kl=None)
        if present.normalise_advantages and not self.settings.kl.endswith("reward"):
            # one scale for the whole rollout, so that a KL in the loss keeps its price in units of the reward
            advantages, scale = shared_scale(batch.advantages, batch.mask)
            batch = dataclasses.replace(batch, advantages=advantages)
            kl_weight, present = kl_weight * float(scale), present.unchecked(normalise_advantages=False)
        extra = None if warming else self._extra_loss(kl_weight)
        metrics = ppo.update(
            model,
            self.optimiser,
            batch,
            present.unchecked(micro_batch_size=self.micro_batch_size),
            self.update_rng,
            extra_loss=extra,
            draw=None if extra is None or self.pretraining is None else self.pretraining.draw,
            log_ratio_limit=self.roles.gap_limits.stop,
        )
        if "train/micro_batch_size" in metrics:
            self._smaller(int(metrics["train/micro_batch_size"]))
        return metrics | scale_metrics(self.return_scale)

    def _smaller(self, size: int) -> None:
        """Memory ran out: ``size`` responses a pass from now on."""
        self.micro_batch_size = size
        self.listeners.warn(
            f"memory ran out; from now on {size} responses a pass, and none is kept for the update. The "
            f"gradient is the same. Use --micro-batch-size {size} to start with that size."
        )

    def _extra_loss(self, kl_weight: float) -> Any:
        """The KL's share in the loss and the pretraining loss; None when neither is asked for."""
        form, pretraining = self.settings.kl, self.pretraining

        def extra(model: object, part: Batch, now: FirstPass, count: Tensor) -> tuple[Tensor, dict[str, Any]]:
            total, figures = now.logp.new_zeros(()), dict[str, Any]()
            log_ratio = now.logp.detach() - part.old_logp
            kl = kl_loss(form, now.logp, part.inputs["ref_logp"], now.kl, part.mask, count, log_ratio)
            if kl is not None:
                total = total + kl_weight * kl
                figures["kl_loss"] = kl.detach() * count / part.mask.sum().clamp(min=1) * part.mask
            if pretraining is not None:
                # a sum over the texts of one response beside a sum over the response, as in InstructGPT
                loss, tokens = pretraining.loss(part.inputs["ptx"])
                total = total + self.settings.ptx_weight * loss / (pretraining.per_response * count)
                figures["ptx_loss"] = loss, tokens
            return total, figures

        return extra if not form.endswith("reward") or pretraining is not None else None

    def _warn_of_faults(self, scores: Scores, judge: str = "") -> None:
        """Warn once per run, function and kind why samples are left out; their number is a metric."""
        for fault in scores.faults:
            if (judge + fault.function, fault.kind) not in self._warned:
                self._warned.add((judge + fault.function, fault.kind))
                self.listeners.warn(judge + fault.text)

    def _trainer_state(self) -> SimpleNamespace:
        """What TRL's reward functions may read: iterations so far and in total, passes over the prompts."""
        return SimpleNamespace(
            global_step=self.iteration,
            max_steps=-(-self.settings.total_episodes // self.settings.batch_size),
            epoch=self.order.position / self.order.count,
            episode=self.episodes,
        )

    def gold_scores(self) -> dict[str, float]:
        """The mean gold score of responses to held-out prompts, which are sampled as in training, a batch at
        a time; and how many of them got no score.
        """
        assert self.gold is not None
        size, seed, found = self.settings.batch_size, self.settings.seed + 1_000_003, list[np.ndarray]()
        for number, start in enumerate(range(0, len(self.held_out), size)):
            prompts = self.held_out[start : start + size]
            answers = respond(self.roles, prompts, [seed, 8, number], 1)
            try:
                scores = self.gold(prompts, answers, self._trainer_state())
            except RewardError as error:
                raise RewardError(f"The gold judge: {error}") from error
            self._warn_of_faults(scores, "the gold judge: ")
            found.append(scores.total[scores.valid])
        judged = np.concatenate(found)
        mean = float(judged.mean()) if len(judged) else float("nan")
        return {"eval/gold": mean, "eval/gold_masked": float(len(self.held_out) - len(judged))}
