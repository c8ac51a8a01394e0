"""What a run leaves: the model that plain transformers loads, the adapter that PEFT loads, and the state from
which the run goes on.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tightrope.language.data.examples import Prompt
from tightrope.language.model.packaged import find_model
from tightrope.language.model.saving import save_adapter, write_model
from tightrope.language.policy.roles import Roles
from tightrope.language.settings import AlignSettings
from tightrope.runs.checkpoint import understood
from tightrope.runs.durable import whole
from tightrope.runs.history import Checkpoint
from tightrope.runs.run import Run
from tightrope.training.parameters import put_back, tensors_of
from tightrope.training.report import teller
from tightrope.training.rollback import rolling_back

if TYPE_CHECKING:
    from tightrope.language.alignment.iteration import Trainer


def save_model(roles: Roles, path: Path, settings: AlignSettings) -> None:
    """RUN/model for AutoModelForCausalLM.from_pretrained, tokenizer and chat template included; with LoRA the
    adapter is folded in, and lies in RUN/adapter for PEFT as well.
    """
    name = "policy" if settings.tune == "lora" else None
    write_model(roles.model, roles.tokenizer, path / "model", name)
    if name is not None:
        with whole(path / "adapter") as folder:
            save_adapter(roles.model, name, folder, base_model=find_model(settings.model))


def _hash_of(prompts: Sequence[Prompt]) -> str:
    digest = hashlib.sha256()
    for prompt in prompts:
        digest.update(repr(prompt.tokens).encode())
    return digest.hexdigest()


def save_state(trainer: Trainer, run: Run, *, final: bool = False) -> None:
    """A checkpoint at the present episode; see `Run.save`. The best one has the highest gold score."""
    tensors = tensors_of(trainer.roles.parameters(), trainer.optimiser)
    state: dict[str, Any] = {
        "story": "align",
        "episodes": trainer.episodes,
        "iteration": trainer.iteration,
        "kl_beta": trainer.kl_beta,
        "rollbacks": trainer.rollbacks,
        "micro_batch_size": trainer.micro_batch_size,
        "prompt_position": trainer.order.position,
        "prompts_sha256": _hash_of([*trainer.prompts, *trainer.held_out]),
        "rng": {"update": trainer.update_rng.bit_generator.state},
        "monitor": trainer.monitor.state(),
        "stopped": trainer.stopped,
        "newest": trainer.newest,
        "seconds": trainer.seconds,
    }
    if trainer.pretraining is not None:
        state["rng"]["ptx"] = trainer.pretraining.rng.bit_generator.state
    keep, say = trainer.settings.keep_checkpoints, teller(trainer.report)
    gold = trainer.monitor.newest_gold
    run.save(trainer.episodes, tensors, state, keep=keep, say=say, merit=gold, final=final)


def restore_state(trainer: Trainer, point: Checkpoint) -> None:
    """Put a checkpoint into a trainer of the same settings. ValueError when it is another story's."""
    folder, tensors, state = point
    if state.get("story") != "align":
        raise ValueError(f"{folder} is no checkpoint of an alignment run.")
    if state.get("prompts_sha256") != _hash_of([*trainer.prompts, *trainer.held_out]):
        raise ValueError(
            f"{folder} is of a run with other prompts than these {len(trainer.prompts):,}. Give those that "
            "the run began with, or begin a new run."
        )
    with understood(folder):
        put_back(tensors, trainer.roles.parameters(), trainer.optimiser)
        _put_state(trainer, state)


def _put_state(trainer: Trainer, state: dict[str, Any]) -> None:
    trainer.episodes, trainer.iteration = int(state["episodes"]), int(state["iteration"])
    trainer.kl_beta, trainer.rollbacks = float(state["kl_beta"]), int(state.get("rollbacks", 0))
    trainer.micro_batch_size = state.get("micro_batch_size", trainer.micro_batch_size)
    trainer.order.position = int(state["prompt_position"])
    trainer.update_rng.bit_generator.state = state["rng"]["update"]
    trainer.monitor.restore(state["monitor"])
    trainer.stopped, trainer.seconds = bool(state["stopped"]), float(state["seconds"])
    trainer.newest = {name: math.nan if x is None else float(x) for name, x in state["newest"].items()}
    if trainer.pretraining is not None:
        trainer.pretraining.rng.bit_generator.state = state["rng"]["ptx"]


def roll_back(trainer: Trainer, point: Checkpoint) -> int:
    """Put a trainer back to a checkpoint of its own; what is drawn from there on is a function of the seed,
    the episode and the number of rollbacks. Returns the episode. What fits into memory stays known.
    """
    rollbacks, size = trainer.rollbacks + 1, trainer.micro_batch_size
    restore_state(trainer, point)
    trainer.rollbacks, trainer.micro_batch_size = rollbacks, size
    other = np.random.default_rng([trainer.settings.seed, 9, trainer.episodes, rollbacks])
    trainer.update_rng.bit_generator.state = other.bit_generator.state
    return trainer.episodes


def updates(trainer: Trainer, run: Run) -> Iterator[tuple[dict[str, float], list[dict[str, Any]]]]:
    """`Trainer.iterate`; after a NaN or an infinity, from the newest checkpoint on, so often and no more."""
    back, tell = functools.partial(roll_back, trainer), teller(trainer.report)
    limit = trainer.settings.max_rollbacks
    return rolling_back(trainer.iterate, run, back, tell, taken=trainer.rollbacks, limit=limit)
