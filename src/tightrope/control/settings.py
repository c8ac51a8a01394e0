"""The settings of ``tightrope train``: one frozen dataclass, the update rule's settings in a field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from tightrope.algorithms.settings import A2CSettings, PPOSettings, ReinforceSettings, UpdateSettings
from tightrope.settings.fields import of_update_rule, setting
from tightrope.settings.values import Settings

EVALUATION_SEED = 1_000_003  # far from training's seeds, which start at settings.seed
Algorithm = Literal["ppo", "a2c", "reinforce"]
ALGORITHM_SETTINGS: dict[str, type[UpdateSettings]] = {
    "ppo": PPOSettings,
    "a2c": A2CSettings,
    "reinforce": ReinforceSettings,
}


@dataclass(frozen=True, kw_only=True)
class TrainSettings(Settings):
    """Train a policy on a Gymnasium task."""

    env: str = setting("CartPole-v1", "Gymnasium id of the task.")
    env_kwargs: dict[str, Any] | None = setting(None, "Arguments for the constructor of the task.")
    observation_keys: tuple[str, ...] = setting((), "Of Dict observations, the keys to use; none given: all.")
    algorithm: Algorithm = setting("ppo", "The update rule.", choices=tuple(ALGORITHM_SETTINGS))
    update: UpdateSettings = of_update_rule(ALGORITHM_SETTINGS)

    total_steps: int = setting(100_000, "Agent steps to train for; never exceeded.", at_least=1)
    seed: int = setting(
        0, "Seed of everything random; same seed and settings on one machine: same bits.", at_least=0
    )
    num_envs: int = setting(8, "Copies of the task that run side by side.", at_least=1, at_most=1_000_000)
    num_steps: int = setting(256, "Steps of each copy per rollout.", at_least=1)
    critic_lambda: float | None = setting(
        None,
        "GAE's lambda of the critic's targets; none: gae_lambda.",
        at_least=0,
        at_most=1,
        needs={"baseline": (True,)},
    )

    hidden: tuple[int, ...] = setting(
        (64, 64), "Widths of the hidden layers of actor and critic.", at_least=1, at_most=1_000_000
    )
    activation: str = setting("tanh", "Between the layers.", choices=("tanh", "relu", "elu", "silu"))
    shared: bool = setting(False, "Actor and critic share their hidden layers.")
    std: str = setting(
        "independent",
        "Box actions' deviation: one number a dimension, a function of the state, or gSDE noise.",
        choices=("independent", "state", "gsde"),
    )
    log_std_init: float = setting(
        0.0, "Log of the first deviation of Box actions; above 2 it acts as 2.", at_least=-10, at_most=3
    )
    gsde_steps: int = setting(
        8, "With gSDE: steps for which one exploration matrix is held.", at_least=1, needs={"std": ("gsde",)}
    )
    action_bounds: str = setting(
        "map",
        "How Box actions reach their bounds: [-1, 1] stretched onto them, clipped to them, or by tanh.",
        choices=("map", "clip", "squash"),
        before="clip",
    )
    encoder: str = setting(
        "auto",
        "Convolutions for what looks like an image, for every Box that can be one, or for none.",
        choices=("auto", "cnn", "mlp", "old"),
        before="old",
    )

    normalise_observations: bool = setting(
        False, "Observations to mean 0, deviation 1 by running statistics."
    )
    normalise_rewards: bool = setting(
        False, "Rewards divided by the running deviation of the discounted return."
    )

    vector_backend: str = setting(
        "auto",
        "Who steps the copies: this process, it and workers, workers, the task's vector version, EnvPool.",
        choices=("auto", "serial", "mixed", "workers", "vector", "envpool"),
    )
    num_workers: int | None = setting(
        None,
        "Processes to spread the copies over; with mixed this one is one of them. none: one a core.",
        at_least=1,
        at_most=1024,
        needs={"vector_backend": ("auto", "mixed", "workers")},
    )
    engine: str = setting(
        "auto",
        "Who computes the update: the compiled CPU engine or torch.",
        choices=("auto", "fused", "torch"),
    )
    device: str = setting("cpu", "Torch device of the networks: cpu, cuda, cuda:1, mps.")
    threads: int | None = setting(
        None,
        "CPU threads of torch and BLAS; none: 1. More mostly wait for each other, with images too.",
        at_least=1,
        at_most=1024,
    )
    compile: bool = setting(False, "Torch path: compile the model with torch.compile.")

    reseed_after: int | None = setting(
        0,
        "Steps after which an episode gets a seed of its own; none: only the first does, no exact resume.",
        at_least=0,
        before=None,
    )
    carried: str | None = setting(
        None,
        "What the task keeps from episode to episode, like 1.obs_rms; none: a run looks at its start.",
    )
    repeats: str = setting(
        "untested",
        "Whether episodes repeat from seed and actions; a run tests it and writes it here.",
        choices=("untested", "yes", "no"),
    )
    replay_limit: int = setting(
        20_000,
        "Steps of a copy that a resume repeats at most; a longer episode begins again there.",
        at_least=0,
    )

    on_env_fault: str = setting(
        "raise",
        "When an environment raises, hangs, dies or gives NaN: end the run, or make a new one and continue.",
        choices=("raise", "restart"),
    )
    max_env_restarts: int = setting(
        10,
        "With on_env_fault restart: new environments at most, in all; then the run ends.",
        at_least=1,
        needs={"on_env_fault": ("restart",)},
    )
    env_timeout: float | None = setting(
        60.0,
        "Seconds for a step, a reset, the constructor or close of an environment; none: no limit.",
        above=0,
        at_most=1e9,
    )

    evaluate_every: float | None = setting(
        0.05,
        "Fraction of the run between evaluations; none: no evaluation while training.",
        above=0,
        at_most=1,
    )
    evaluation_episodes: int = setting(
        10,
        "Episodes per evaluation, deterministic, on seeds of their own.",
        at_least=1,
        needs={"evaluate_every": ...},
    )
    evaluation_max_steps: int | None = setting(
        None,
        "Steps after which an evaluation episode is cut; none: by the training episodes.",
        at_least=1,
    )
    checkpoint_every: float | None = setting(
        0.05,
        "Fraction of the run between checkpoints; none: by the clock.",
        above=0,
        at_most=1,
    )
    checkpoint_minutes: float | None = setting(
        10.0, "A checkpoint also this many minutes after the last one; none: off.", above=0
    )
    keep_checkpoints: int | None = setting(
        3, "Checkpoints that are kept, the newest ones; the best policy always is. none: all.", at_least=2
    )
    max_rollbacks: int = setting(
        0,
        "After a NaN or an infinity: go back to the newest checkpoint this often; 0: end the run.",
        at_least=0,
    )
    tensorboard: bool = setting(False, "Also write TensorBoard event files into the run folder.")

    def __post_init__(self) -> None:
        """Check ranges, and the settings that must fit each other."""
        super().__post_init__()
        size, rollout = getattr(self.update, "minibatch_size", None), self.num_envs * self.num_steps
        if size is not None and size > rollout:
            raise ValueError(
                f"minibatch_size is {size}, larger than a rollout of num_envs * num_steps = {self.num_envs} "
                f"* {self.num_steps} = {rollout} steps. Choose minibatch_size <= {rollout} or collect more "
                "steps."
            )

    @classmethod
    def values_from_json(cls, data: object, source: object = "settings.json") -> dict[str, Any]:
        """See Settings. ``squash``, the setting before ``action_bounds``, is translated."""
        if isinstance(data, dict) and isinstance(data.get("squash"), bool):
            kept = {name: value for name, value in data.items() if name != "squash"}
            data = {"encoder": "old", **kept, "action_bounds": "squash" if data["squash"] else "clip"}
        return super().values_from_json(data, source)

    def risks(self) -> list[str]:
        """What is unusual about these settings and why it is risky; training starts all the same."""
        update, found = self.update, []
        if isinstance(update, PPOSettings):
            if update.kl_beta is None and max(update.clip, update.clip_high or 0.0) > 0.3:
                found.append(
                    f"clip {max(update.clip, update.clip_high or 0.0):g} is above 0.3: the clip hardly acts "
                    "and the policy can collapse. Usual: 0.1 to 0.3."
                )
            if update.num_epochs > 15:
                found.append(
                    f"num_epochs {update.num_epochs} is above 15: ratios drift and nearly every step is "
                    "clipped. Usual: 4 to 10, or set target_kl 0.015."
                )
        if not update.normalise_advantages:
            found.append(
                "advantages are not normalised: the learning rate then depends on the scale of the rewards."
            )
        if update.max_grad_norm is None:
            found.append(
                "gradients are not clipped: one bad minibatch can destroy the policy. Usual: max_grad_norm "
                "0.5."
            )
        return found
