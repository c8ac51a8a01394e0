"""The loop of an alignment run: sample -> score -> advantages -> update -> record -> evaluate -> save."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms import ppo
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.optimise import make_optimiser, set_learning_rates
from tightrope.language.alignment.experience import (
    PromptOrder,
    comparable,
    gather,
    kl_share,
    respond,
    rewards_of,
    to_batch,
)
from tightrope.language.alignment.figures import describe, refuse_bad_numbers, refuse_mismatch
from tightrope.language.alignment.kl import AdaptiveKL, kl_loss, shared_scale
from tightrope.language.alignment.monitor import Monitor
from tightrope.language.alignment.ptx import Pretraining
from tightrope.language.alignment.samples import sample_rows
from tightrope.language.alignment.state import save_model, save_state, updates
from tightrope.language.data.examples import Prompt, hold_out_prompts, read_prompts, read_rows
from tightrope.language.generation.sample import log_ratio_limit
from tightrope.language.model.packaged import find_model
from tightrope.language.model.parts import context_length
from tightrope.language.policy.policy_model import PolicyModel
from tightrope.language.policy.roles import Roles, make_roles
from tightrope.language.policy.rollout import Experience, FirstPass
from tightrope.language.reward.call import RewardError
from tightrope.language.reward.judge import (
    Judge,
    critic_from_reward,
    is_folder,
    make_judge,
    reward_adapter,
    shares_trunk,
)
from tightrope.language.settings import AlignSettings
from tightrope.maths.values import explained_variance
from tightrope.runs import signals
from tightrope.runs.run import Run
from tightrope.training.grid import crosses
from tightrope.training.report import Reporter, teller, warn


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


class Trainer:
    """The state of an alignment run; `iterate` is the loop."""

    def __init__(
        self, settings: AlignSettings, prompts: Any, reward: Any, gold: Any, report: Reporter
    ) -> None:
        self.settings, self.report = settings, report
        adapter = reward_adapter(reward)
        lora = settings.tune == "lora"
        shared = adapter is not None and lora and shares_trunk(adapter, find_model(settings.model))
        on_trunk = adapter if shared else None
        self.roles: Roles = make_roles(
            settings,
            on_trunk,
            teller(report),
            own_reward=on_trunk is None and is_folder(reward),
        )
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
        self.order = PromptOrder(len(self.prompts), settings.seed)
        self.update_rng = np.random.default_rng([settings.seed, 9])
        self.kl_beta = settings.kl_beta
        self.pretraining = Pretraining.make(settings, self.roles, self._warn) if settings.ptx_weight else None
        self.monitor = Monitor(kl_budget=settings.kl_budget)
        self.episodes, self.iteration, self.stopped, self.reward_scale = 0, 0, False, 1.0
        self.seconds, self.rollbacks, self.newest = 0.0, 0, dict[str, float]()
        self.micro_batch_size = settings.update.micro_batch_size  # halved when memory runs out
        self._told = set[tuple[str, str]]()

    def _read_prompts(self, source: Any) -> list[Prompt]:
        settings, limit = self.settings, context_length(self.roles.model)
        if limit is not None and settings.max_prompt_tokens + settings.max_new_tokens > limit:
            raise ValueError(
                f"max_prompt_tokens {settings.max_prompt_tokens} + max_new_tokens {settings.max_new_tokens} "
                f"exceed the model's context of {limit} tokens. Choose less of either."
            )
        rows, longest = read_rows(source), settings.max_prompt_tokens
        found = read_prompts(rows, self.roles.tokenizer, max_tokens=longest, notify=self._warn)
        if not found:
            raise ValueError("There are no prompts. Give a list of texts, or a file with a 'prompt' a row.")
        return found

    def _warn(self, text: str) -> None:
        warn(self.report, text)

    # ------------------------------------------------------------------------------------------ the loop

    def run(self, run: Run) -> Aligned:
        """Train until the budget is spent; the run folder then holds everything."""
        settings = self.settings
        total = {"total_steps": settings.total_episodes}
        facts = {"run_dir": str(run.path), "step": self.episodes, "lines": self.roles.lines()}
        self.report("start", {"settings": dataclasses.asdict(settings), **facts, **total})
        with run, signals.stoppable():
            for metrics, rows in updates(self, run):
                signals.check()
                self.newest = metrics
                run.record(self.episodes, metrics["time/seconds"], metrics)
                run.record_samples(rows)
                event = {"step": self.episodes, "metrics": metrics, "seconds": metrics["time/seconds"]}
                self.report("update", {**event, **total})
                if self._reached(settings.checkpoint_every):
                    if self._next_prompts():
                        save_state(self, run)
                    self.report("samples", {"step": self.episodes, "rows": rows})
            save_state(self, run, final=True)
            save_model(self.roles, run.path, settings)
            summary = self._summary(run, self.newest)
            run.finish(summary)
        rows = run.read_metrics()
        if rows and not any("train/minibatches" in row for row in rows):
            self._warn("not one step was taken: no response had a score that counts. The model is as it was.")
        self.report("finish", summary)
        return Aligned(run.path, summary, rows)

    def _next_prompts(self) -> int:
        """Prompts of the next iteration; 0 at the end of the budget."""
        if self.stopped:
            return 0
        left = self.settings.total_episodes - self.episodes
        return max(0, min(self.settings.batch_size, left)) // self.settings.samples_per_prompt

    def _reached(self, fraction: float | None) -> bool:
        """Whether the newest iteration, which like all but the last one was of the full size, came to a point
        of this grid.
        """
        samples = self.settings.samples_per_prompt
        before = self.episodes - self.settings.batch_size // samples * samples
        return crosses(max(0, before), self.episodes, self.settings.total_episodes, fraction)

    def _watch(self, metrics: dict[str, float]) -> None:
        """Over-optimisation: warn, and stop at the KL budget before another step is taken."""
        seen = (metrics["objective/kl"], metrics["objective/scores"], metrics.get("eval/gold"))
        for alarm in self.monitor.add(*seen):
            self._warn(alarm.text)
            self.stopped = self.stopped or alarm.stop
        metrics |= self.monitor.metrics()

    def _summary(self, run: Run, metrics: dict[str, float]) -> dict[str, Any]:
        shown = ("objective/", "eval/")
        return {
            "model": self.settings.model,
            "seed": self.settings.seed,
            "episodes": self.episodes,
            "iterations": self.iteration,
            "wall_seconds": metrics.get("time/seconds", 0.0),
            "stopped_early": self.stopped,
            "run_dir": str(run.path),
            "final": {name: value for name, value in metrics.items() if name.startswith(shown)},
        }

    def iterate(self) -> Iterator[tuple[dict[str, float], list[dict[str, Any]]]]:
        """One iteration at a time: its metrics, and its rows for samples.jsonl."""
        while count := self._next_prompts():
            yield self._one_iteration([self.prompts[i] for i in self.order.take(count)])

    def _one_iteration(self, prompts: Sequence[Prompt]) -> tuple[dict[str, float], list[dict[str, Any]]]:
        """sample -> score -> advantages -> update."""
        settings, gold = self.settings, dict[str, float]()
        if self.gold is not None and (not self.episodes or self._reached(settings.evaluate_every)):
            gold = self.evaluate()  # of the policy whose KL this rollout tells
        begin = time.perf_counter()
        present = settings.update.at(self.episodes / settings.total_episodes)
        set_learning_rates(self.optimiser, present)
        stream = settings.seed + 2**40 * self.rollbacks  # not the numbers that led to a NaN
        keep = (
            settings.one_pass and self.micro_batch_size is None and self.iteration >= settings.critic_warmup
        )
        given = (stream, self.iteration, settings.samples_per_prompt)
        experience = gather(self.roles, prompts, *given, keep=keep)
        if experience.short_of_memory:
            self._smaller(len(experience.tokens))
        refuse_bad_numbers(experience, self.roles.named_parameters())
        gathered = time.perf_counter()
        asked = [prompt for prompt in prompts for _ in range(settings.samples_per_prompt)]
        scores = self.judge(asked, experience, self._trainer_state())
        scored = time.perf_counter()
        self._tell_faults(scores)
        if settings.critic == "none":
            scores.valid[:] = comparable(scores.valid, settings.samples_per_prompt)
        rewards, self.reward_scale = rewards_of(experience, scores, settings, self.kl_beta)
        valid = torch.from_numpy(scores.valid).to(experience.tokens.device)
        batch = to_batch(experience, rewards, valid, settings)
        share = kl_share(experience, settings, self.kl_beta)
        plain = rewards / self.reward_scale  # the metrics are those before whiten_rewards
        metrics = describe(experience, scores, plain, share, valid) | scores.metrics | gold
        refuse_mismatch(metrics["objective/sampling_gap"], settings.dtype, first=not self.iteration)
        self._watch(metrics)
        judged = time.perf_counter()
        if len(batch) and not self.stopped:
            metrics |= self._update(batch, present, experience)
            if settings.critic != "none":
                metrics["train/explained_variance"] = float(
                    explained_variance(batch.old_values, batch.returns, batch.mask)
                )
        if self.rollbacks:
            metrics["train/rollbacks"] = float(self.rollbacks)
        metrics["objective/kl_beta"] = self.kl_beta
        metrics["train/learning_rate"] = present.learning_rate
        metrics["time/score_seconds"] = scored - gathered
        metrics["time/update_seconds"] = time.perf_counter() - judged
        if settings.kl_goal is not None and len(batch):
            controller = AdaptiveKL(self.kl_beta, settings.kl_goal, settings.kl_horizon)
            self.kl_beta = controller.next(metrics["objective/kl"], len(asked)).kl_beta
        self.episodes += len(asked)
        self.iteration += 1
        seconds = metrics["time/update_seconds"] + scored - begin
        self.seconds += seconds
        metrics["time/seconds"] = self.seconds
        metrics["time/fps"] = float(experience.responses.mask.sum()) / seconds
        told = (asked, experience, scores, batch, valid, self.episodes)
        return metrics, sample_rows(self.roles.tokenizer, *told)

    def _update(self, batch: Batch, present: Any, experience: Experience) -> dict[str, float]:
        """PPO, or the critic alone while it warms up."""
        warming = self.iteration < self.settings.critic_warmup
        exact = self.settings.exact_in_loss
        model = PolicyModel(
            self.roles, exact=exact, critic_only=warming, first_pass=experience.take_first_pass()
        )
        if warming:
            batch = dataclasses.replace(batch, advantages=torch.zeros_like(batch.advantages))
            present = present.unchecked(entropy_weight=0.0, target_kl=None)
        limit = log_ratio_limit(self.settings.dtype)
        kl_weight = self.kl_beta * self.reward_scale  # a KL in the loss is scaled as the rewards were
        if present.normalise_advantages and not self.settings.kl.endswith("reward"):
            # one scale for the whole rollout, so that a KL in the loss keeps its price in units of the reward
            advantages, scale = shared_scale(batch.advantages, batch.mask)
            batch = dataclasses.replace(batch, advantages=advantages)
            kl_weight, present = kl_weight * float(scale), present.unchecked(normalise_advantages=False)
        extra = None if warming else self._extra_loss(kl_weight)
        present = present.unchecked(micro_batch_size=self.micro_batch_size)
        given = (model, self.optimiser, batch, present, self.update_rng)
        draw = None if extra is None or self.pretraining is None else self.pretraining.draw
        metrics = ppo.update(*given, extra_loss=extra, draw=draw, log_ratio_limit=limit)
        if "train/micro_batch_size" in metrics:
            self._smaller(int(metrics["train/micro_batch_size"]))
        return metrics

    def _smaller(self, size: int) -> None:
        """Memory ran out: ``size`` responses a pass from now on."""
        self.micro_batch_size = size
        self._warn(
            f"memory ran out; from now on {size} responses a pass, and none is kept for the update. The "
            f"gradient is the same. Say --micro-batch-size {size} to begin with it."
        )

    def _extra_loss(self, kl_weight: float) -> Any:
        """The KL's share in the loss and the pretraining loss; None when neither is asked for."""
        form, pretraining = self.settings.kl, self.pretraining

        def extra(model: Any, part: Batch, now: FirstPass, count: Tensor) -> tuple[Tensor, dict[str, Any]]:
            total, booked = now.logp.new_zeros(()), dict[str, Any]()
            log_ratio = now.logp.detach() - part.old_logp
            kl = kl_loss(form, now.logp, part.inputs["ref_logp"], now.kl, part.mask, count, log_ratio)
            if kl is not None:
                total = total + kl_weight * kl
                booked["kl_loss"] = kl.detach() * count / part.mask.sum().clamp(min=1) * part.mask
            if pretraining is not None:
                # a sum over the texts of one response beside a sum over the response, as in InstructGPT
                loss, tokens = pretraining.loss(part.inputs["ptx"])
                total = total + self.settings.ptx_weight * loss / (pretraining.per_response * count)
                booked["ptx_loss"] = loss, tokens
            return total, booked

        return extra if not form.endswith("reward") or pretraining is not None else None

    def _tell_faults(self, scores: Any, judge: str = "") -> None:
        """Say once a run for each function and kind why samples are left out; the count is a metric."""
        for fault in scores.faults:
            if (judge + fault.function, fault.kind) not in self._told:
                self._told.add((judge + fault.function, fault.kind))
                self._warn(judge + fault.text)

    def _trainer_state(self) -> SimpleNamespace:
        """What TRL's reward functions may look at: iterations so far and in all, passes over the prompts."""
        return SimpleNamespace(
            global_step=self.iteration,
            max_steps=-(-self.settings.total_episodes // self.settings.batch_size),
            epoch=self.order.position / self.order.count,
            episode=self.episodes,
        )

    def evaluate(self) -> dict[str, float]:
        """The mean gold score of responses to held-out prompts, sampled as in training, as many at a time;
        and how many of them the judge gave no score.
        """
        assert self.gold is not None
        size, seed, found = self.settings.batch_size, self.settings.seed + 1_000_003, list[np.ndarray]()
        for number, start in enumerate(range(0, len(self.held_out), size)):
            prompts = self.held_out[start : start + size]
            answers = respond(self.roles, prompts, seed, number, 1)
            try:
                scores = self.gold(prompts, answers, self._trainer_state())
            except RewardError as error:
                raise RewardError(f"The gold judge: {error}") from error
            self._tell_faults(scores, "the gold judge: ")
            found.append(scores.total[scores.valid])
        judged = np.concatenate(found)
        mean = float(judged.mean()) if len(judged) else float("nan")
        return {"eval/gold": mean, "eval/gold_masked": float(len(self.held_out) - len(judged))}
