"""The settings of the language story: one frozen dataclass per command, imported without torch."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

from tightrope.algorithms.settings import PPOSettings
from tightrope.runs.records import retyped
from tightrope.settings.fields import SCHEDULES, Schedule, fixed, of_update_rule, setting
from tightrope.settings.values import Settings

KL_FORMS = ("k1-reward", "exact-split", "k2-loss", "exact-loss")  # their equations: alignment/kl.py

Tune = Literal["lora", "full"]


@dataclass(frozen=True, kw_only=True)
class ModelSettings(Settings):
    """Which model, which of its weights are trained, where, and how often they are saved."""

    model: str = setting("glassllm", "Folder or hub id of the model, or a packaged one: glassllm, smollm2.")
    tune: Tune = setting(
        "lora", "Train low-rank adapters on a frozen trunk, or every weight.", choices=("lora", "full")
    )
    lora_rank: int = setting(16, "Rank of the adapters.", at_least=1, needs={"tune": ("lora",)})
    lora_alpha: float = setting(
        32.0, "Adapters are scaled by lora_alpha / lora_rank.", above=0, needs={"tune": ("lora",)}
    )
    lora_layers: int | None = setting(
        None,
        "Adapt this many of the top layers; the layers below are computed once. none: every layer.",
        at_least=1,
        needs={"tune": ("lora",)},
    )
    seed: int = setting(0, "Seed of everything random.", at_least=0)
    device: str = setting("cpu", "Torch device: cpu, cuda, cuda:1, mps.")
    dtype: str = setting("float32", "Precision of the trunk.", choices=("float32", "bfloat16"))
    threads: int | None = setting(None, "CPU threads of torch; none: every core.", at_least=1, at_most=1024)
    gradient_checkpointing: bool = setting(
        False, "Compute activations again in the backward pass: less memory, a third more time."
    )
    checkpoint_every: float | None = setting(
        0.25, "Fraction of the run between checkpoints; none: by the clock.", above=0, at_most=1
    )
    checkpoint_minutes: float | None = setting(
        10.0, "A checkpoint also this many minutes after the last one; none: off.", above=0
    )
    keep_checkpoints: int | None = setting(
        3,
        "Checkpoints that are kept: the newest, and the best by held-out figures. none: all.",
        at_least=2,
    )
    max_rollbacks: int = setting(
        0,
        "After a NaN or an infinity: go back to the newest checkpoint this often; 0: end the run.",
        at_least=0,
    )
    tensorboard: bool = setting(False, "Also write TensorBoard event files into the run folder.")


@dataclass(frozen=True, kw_only=True)
class SupervisedSettings(ModelSettings):
    """What supervised fine-tuning and reward modelling share."""

    data: str = setting(
        "",
        "The training examples: a .jsonl, .json, .csv, .txt or .parquet file, a folder of save_to_disk, or a "
        "dataset's id.",
    )
    validation: str | None = setting(None, "Held-out examples; none: a share of the data is held out.")
    held_out: float = setting(0.05, "Share of the data that is held out.", at_least=0, at_most=0.5)
    max_examples: int | None = setting(None, "Use this many examples at most; none: all.", at_least=1)
    max_tokens: int = setting(128, "Longer examples are cut to this many tokens.", at_least=2)
    num_epochs: int = setting(1, "Passes over the data.", at_least=1)
    minibatch_size: int = setting(16, "Examples per optimiser step.", at_least=1)
    micro_batch_size: int | None = setting(
        None, "Examples per forward pass; the gradient stays the same. none: the minibatch.", at_least=1
    )
    learning_rate: float = setting(1e-4, "Adam's step size.", above=0)
    learning_rate_schedule: Schedule = setting(
        "linear", "How the learning rate falls over the run.", choices=SCHEDULES
    )
    max_grad_norm: float | None = setting(1.0, "Limit on the norm of the gradient; none: no limit.", above=0)


@dataclass(frozen=True, kw_only=True)
class SFTSettings(SupervisedSettings):
    """Supervised fine-tuning on text, prompt and completion, or chats."""

    on_completions: bool = setting(True, "Learn completions and assistant turns only, not prompts.")
    pack: bool = setting(False, "Put several examples into one row; none sees another.")


@dataclass(frozen=True, kw_only=True)
class RewardSettings(SupervisedSettings):
    """A reward model from preferences (Bradley-Terry)."""

    demonstrations: str | None = setting(
        None, "Texts on which scores get mean 0 and deviation 1; none: the chosen responses."
    )


@dataclass(frozen=True, kw_only=True)
class RLHFSettings(PPOSettings):
    """PPO on responses: the defaults that language wants."""

    gamma: float = setting(1.0, "Discount per token; 1 in language.", above=0, at_most=1)
    num_epochs: int = setting(4, "Passes over each batch of responses.", at_least=1)
    minibatch_size: int = setting(64, "Responses per optimiser step.", at_least=1)
    learning_rate: float = setting(3e-4, "Adam's step size (1e-5 is usual with --tune full).", above=0)
    max_grad_norm: float | None = setting(1.0, "One joint limit on the norm of all gradients.", above=0)
    value_weight: float = setting(0.1, "Weight of the value loss in the total loss.", at_least=0)
    micro_batch_size: int | None = setting(
        None, "Responses per forward pass; splits a minibatch to save memory, the gradient is the same.",
        at_least=1,
    )  # fmt: skip
    # The KL-penalised surrogate is for control only. In align, kl_beta weighs the KL to the reference.
    kl_beta: float | None = fixed(None)
    kl_adapt: float | None = fixed(None)
    recompute_advantages: bool = fixed(False)


@dataclass(frozen=True, kw_only=True)
class AlignSettings(ModelSettings):
    """PPO on a causal language model against any reward."""

    BUILT_IN_REWARDS: ClassVar = ("length",)  # words for reward and gold that name no file

    data: str = setting(
        "",
        "The prompts: a .jsonl, .json, .csv, .txt or .parquet file, a folder of save_to_disk, or a dataset's "
        "id.",
    )
    reward: tuple[str, ...] = setting(
        (),
        "length, FILE.py:function, or the folder or hub id of a reward model; with =X, that times X. Several "
        "are added up.",
    )
    gold: str | None = setting(
        None, "A second judge of the same kinds, asked on held-out prompts; never trained on. none: no judge."
    )
    update: RLHFSettings = of_update_rule({"ppo": RLHFSettings})
    total_episodes: int = setting(4096, "Responses to train on; never exceeded.", at_least=1)
    batch_size: int = setting(64, "Responses per iteration.", at_least=1)
    samples_per_prompt: int = setting(1, "Responses to each prompt; they share its KV cache.", at_least=1)
    max_new_tokens: int = setting(24, "Tokens of a response at most.", at_least=1)
    max_prompt_tokens: int = setting(64, "Longer prompts lose their beginning.", at_least=1)
    temperature: float = setting(1.0, "Of sampling and training alike.", above=0)
    top_k: int = setting(0, "Sample among the k likeliest tokens, in training too; 0: all.", at_least=0)

    kl_beta: float = setting(0.05, "Weight of the KL to the reference; 0.02 to 0.2 is usual.", at_least=0)
    kl: str = setting(
        "k1-reward",
        "Where the KL acts: in the reward (k1), exact and split, or only in the loss.",
        choices=KL_FORMS,
    )
    allow_biased_kl: bool = fixed(False)  # in settings.json of older runs
    kl_goal: float | None = setting(
        None, "Adapt kl_beta towards this KL per response, in nats (Ziegler: 6); none: fixed.", above=0
    )
    kl_horizon: float = setting(
        10_000.0, "Responses over which kl_beta adapts.", above=0, needs={"kl_goal": ...}
    )
    kl_budget: float | None = setting(None, "Stop at this KL per response, in nats; none: continue.", above=0)

    critic: str = setting(
        "head",
        "A head on the policy, an adapter of its own, a model of its own, or none: the other samples' mean.",
        choices=("head", "adapter", "separate", "none"),
    )
    critic_from_reward: bool = setting(False, "Begin the critic with the reward model's weights.")
    critic_warmup: int = setting(0, "Iterations in which the critic alone learns.", at_least=0)
    critic_lambda: float | None = setting(
        None, "GAE's lambda of the critic's targets (VC-PPO: 1); none: gae_lambda.", at_least=0, at_most=1
    )
    lambda_alpha: float | None = setting(
        None, "Lambda = max(0, 1 - 1 / (this * length)) per response (VAPO: 0.05); none: off.", above=0
    )

    reward_scale: float = setting(1.0, "Scores are multiplied by this.", above=0)
    reward_clip: float | None = setting(None, "Scores are kept within +- this; none: off.", above=0)
    whiten_rewards: bool = setting(False, "Divide rewards by their deviation; the mean stays.")
    missing_eos_penalty: float | None = setting(
        None, "Subtracted from the score of a response cut at max_new_tokens; none: off.", at_least=0
    )
    ignore_eos: bool = setting(False, "EOS is never chosen: a response has max_new_tokens, or a stop text.")
    stop: tuple[str, ...] = setting(
        (), "Texts that end a response as EOS does; trained on, but cut from the text that is scored."
    )
    truncation: str = setting(
        "terminal",
        "A response cut at max_new_tokens ends there, or goes on in the critic's eyes.",
        choices=("terminal", "bootstrap"),
    )
    ptx_weight: float = setting(0.0, "Weight of the pretraining loss (InstructGPT: 27.8).", at_least=0)
    ptx_data: str | None = setting(None, "Texts of the pretraining loss.", needs={"ptx_weight": ...})
    ptx_per_response: int = setting(
        1, "Pretraining texts per response (InstructGPT: 8).", at_least=1, needs={"ptx_weight": ...}
    )
    reward_timeout: float | None = setting(
        60.0, "Seconds a reward function may take; its samples are left out then. none: no limit.", above=0
    )
    evaluate_every: float | None = setting(
        0.05,
        "Fraction of the run between gold scores on held-out prompts.",
        above=0,
        at_most=1,
        needs={"gold": ...},
    )
    held_out_prompts: int = setting(
        64,
        "Prompts kept for the gold score, a quarter of all at most; more of them, less noise.",
        at_least=1,
        needs={"gold": ...},
    )

    def __post_init__(self) -> None:
        """Check ranges, and the settings that must fit each other."""
        if self.critic is None:  # as in Python: no critic
            object.__setattr__(self, "critic", "none")
        super().__post_init__()
        if self.batch_size % self.samples_per_prompt:
            raise ValueError(
                f"batch_size {self.batch_size} is not a multiple of samples_per_prompt "
                f"{self.samples_per_prompt}. Choose one that is."
            )
        if self.kl_goal is not None and not (self.kl_beta > 0 and self.kl_horizon > 0.2 * self.batch_size):
            raise ValueError(
                f"kl_goal adapts kl_beta, which is {self.kl_beta:g}, over kl_horizon {self.kl_horizon:g} "
                "responses; expected kl_beta above 0 and a horizon above a fifth of batch_size "
                f"{self.batch_size}."
            )
        if self.total_episodes < self.samples_per_prompt:
            raise ValueError(
                f"total_episodes {self.total_episodes} is less than samples_per_prompt "
                f"{self.samples_per_prompt}: not one prompt could be answered. Give more."
            )
        if self.tune == "full" and self.dtype != "float32":
            raise ValueError(
                f"tune full with dtype {self.dtype}: steps of 1e-5 are lost on {self.dtype} weights. Use "
                "dtype float32, or tune lora, whose adapters are float32 on any trunk."
            )
        idle = {"critic_warmup": 0, "critic_lambda": None, "lambda_alpha": None, "truncation": "terminal"}
        acting = [name for name, usual in idle.items() if getattr(self, name) != usual]
        if self.critic == "none" and acting:
            raise ValueError(f"{', '.join(acting)} needs a critic, and critic is none. Leave it out.")
        if self.critic == "none" and self.samples_per_prompt < 2:
            raise ValueError(
                "critic none compares the responses to one prompt; samples_per_prompt is 1. Give "
                "--samples-per-prompt 4, or a critic."
            )
        if self.critic == "adapter" and self.tune == "full":
            raise ValueError(
                "critic adapter needs the frozen trunk of --tune lora. With --tune full use head or separate."
            )
        if "" in self.stop:
            raise ValueError("stop holds an empty text, which every response ends with. Take it out.")
        if self.ptx_weight and self.ptx_data is None:
            raise ValueError("ptx_weight needs texts: give ptx_data, or ptx_weight 0.")

    def to_json(self) -> dict[str, Any]:
        """As of any settings; one reward is a word, as in runs of before there could be several."""
        found = super().to_json()
        if len(self.reward) < 2:
            found["reward"] = "".join(self.reward)
        return found

    @property
    def exact_in_loss(self) -> bool:
        """Whether the exact KL of every state is part of the loss."""
        return self.kl in ("exact-split", "exact-loss")

    @property
    def logp_alone(self) -> bool:
        """Whether training needs only log p from the head, and the head itself is not trained."""
        return self.tune == "lora" and not self.exact_in_loss and not self.update.entropy_weight

    @property
    def one_pass(self) -> bool:
        """Whether an epoch is one forward pass over all responses."""
        return self.update.minibatch_size >= self.batch_size and self.update.micro_batch_size is None

    def risks(self) -> list[str]:
        """What is unusual about these settings and why it is risky; training starts anyway."""
        found = []
        if self.kl_beta == 0 and self.kl_budget is None:
            found.append(
                "kl_beta is 0 and there is no kl_budget: nothing holds the policy near the reference, and "
                "it will learn to exploit the reward's mistakes. Usual: 0.02 to 0.2."
            )
        if self.tune == "full" and self.update.learning_rate > 5e-5:
            found.append(
                f"learning_rate {self.update.learning_rate:g} is high for every weight of a language model. "
                "Usual with tune full: 1e-6 to 1e-5 (tiny models stand more)."
            )
        return found


AnySettings = TypeVar("AnySettings", bound=ModelSettings)


def recorded(settings: AnySettings, **given: object) -> AnySettings:
    """The settings that settings.json keeps of what was given in Python: paths are stored as text. Of an
    object only its name is, in angle brackets, so that nobody takes it for a file, a folder or a reward.
    None keeps the setting.
    """
    names: dict[str, Any] = {name: _word(value) for name, value in given.items() if value is not None}
    reward = given.get("reward")
    if isinstance(reward, list | tuple):
        every = reward if isinstance(reward, list) else [reward]
        names["reward"] = [
            f"{_word(one[0])}={one[1]}" if isinstance(one, tuple) and len(one) == 2 else _word(one)
            for one in every
        ]
    return settings.with_values(**names)


def _word(value: object) -> str:
    if isinstance(value, str | Path):
        return str(value)
    return f"<{getattr(value, '__name__', type(value).__name__).strip('<>')}>"


def weighted(word: str) -> tuple[str, float]:
    """A reward as it is typed, without its weight, and the weight: ``length=0.1``. What does not end with =
    and a number, and what is the name of a file or folder as it stands, has the weight 1.
    """
    name, _, number = word.rpartition("=")
    if name and not Path(word).exists():
        with contextlib.suppress(ValueError):
            return name, float(number)
    return word, 1.0


def typed_again(flag: str, words: Iterable[str]) -> str:
    """Judges as flags to type again, each with its weight: FILE.py:function in place of an object, a folder
    that is gone, and what a user should not copy.
    """
    typed = []
    for word in words:
        name, weight = weighted(word)
        again = retyped(name, "FOLDER" if may_stand_in_a_file(word) else "FILE.py:function")
        typed.append(f"{flag} {again}" + (f"={weight}" if weight != 1 else ""))
    return " ".join(typed)


def may_stand_in_a_file(word: str) -> bool:
    """Whether a file may name this reward: a built-in one, or a folder, but never code."""
    name = weighted(word)[0]
    return name in AlignSettings.BUILT_IN_REWARDS or Path(name).is_dir()


class Recipe(NamedTuple):
    """Settings that somebody published, and where."""

    values: dict[str, Any]
    source: str


RECIPES: dict[str, Recipe] = {
    "ziegler2019": Recipe(
        {
            "normalise_values": False,
            "kl_beta": 0.15, "kl_goal": 6.0, "kl_horizon": 10_000.0, "temperature": 0.7, "num_epochs": 4,
            "value_clip": 0.2, "value_weight": 0.1, "whiten_rewards": True, "critic": "head",
            "max_new_tokens": 24, "tune": "full",
            "ignore_eos": True, "learning_rate": 1e-5, "batch_size": 512, "minibatch_size": 512,
        },
        "Ziegler et al. 2019, arXiv 1909.08593; lm-human-preferences, launch.py; without the cut at the "
        "first full stop, which is the reward's to make",
    ),
    "instructgpt": Recipe(
        {
            "normalise_values": False,
            "kl_beta": 0.02, "temperature": 1.0, "num_epochs": 1, "batch_size": 512, "minibatch_size": 64,
            "critic": "separate", "critic_from_reward": True, "tune": "full", "learning_rate": 8e-6,
            "critic_learning_rate": 9e-6, "learning_rate_schedule": "constant", "ptx_weight": 27.8,
            "ptx_per_response": 8,
        },
        "Ouyang et al. 2022, arXiv 2203.02155, appendix C; without the warm-up of the learning rate and the "
        "moving average of the weights; needs --ptx-data",
    ),
    "nplus": Recipe(
        {
            "normalise_values": False,
            "kl_beta": 0.05, "temperature": 0.7, "num_epochs": 4, "batch_size": 512, "minibatch_size": 512,
            "value_clip": 0.2, "value_weight": 0.1, "critic": "separate", "critic_from_reward": True,
            "tune": "full", "learning_rate": 3e-6, "missing_eos_penalty": 1.0, "max_new_tokens": 53,
        },
        "Huang et al. 2024, arXiv 2403.17031",
    ),
    "ppo-max": Recipe(
        {
            "normalise_values": False,
            "kl_beta": 0.05, "batch_size": 128, "minibatch_size": 32, "num_epochs": 1, "value_clip": 0.2,
            "critic": "separate", "critic_from_reward": True, "tune": "full", "learning_rate": 5e-7,
            "critic_learning_rate": 1.65e-6, "reward_clip": 10.0, "critic_warmup": 10,
        },
        "Zheng et al. 2023, Secrets of RLHF I, arXiv 2307.04964; without its normalisation of rewards by "
        "running moments, its pretraining loss and its warm-up of the learning rate",
    ),
    "vapo": Recipe(
        {
            "normalise_values": False,
            "kl_beta": 0.0, "clip": 0.2, "clip_high": 0.28, "critic_lambda": 1.0, "lambda_alpha": 0.05,
            "critic": "separate", "critic_from_reward": True, "critic_warmup": 50, "tune": "full",
            "learning_rate": 1e-6, "critic_learning_rate": 2e-6, "samples_per_prompt": 16,
            "batch_size": 8192, "minibatch_size": 512, "num_epochs": 1,
        },
        "Yue et al. 2025, VAPO, arXiv 2504.05118; without its language-modelling loss on correct responses",
    ),
}  # fmt: skip
