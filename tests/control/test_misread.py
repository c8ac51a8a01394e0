"""What would silently be read as something else is refused or told: values, masks, arguments, other tasks."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import tightrope
from tightrope.cli.main import main
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.evaluate import evaluate_run
from tightrope.control.resolve import resolve
from tightrope.control.spaces.observations import observation_layout
from tightrope.control.train import resume, train

SMALL: dict[str, Any] = {
    "seed": 0, "num_envs": 2, "num_steps": 32, "minibatch_size": 32, "num_epochs": 1, "engine": "torch",
    "vector_backend": "serial",
}  # fmt: skip


class Short(gym.Env):
    """Episodes of five steps; ``seen`` and ``info`` are what every step gives."""

    observation_space: gym.Space = spaces.Box(-1, 1, (1,), np.float32)
    action_space: gym.Space = spaces.Discrete(2)
    seen: Any = np.zeros(1, np.float32)
    info: Any = types.MappingProxyType({})

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.count = 0
        return self.seen, dict(self.info)

    def step(self, action: Any) -> Any:
        self.count += 1
        return self.seen, 1.0, self.count == 5, False, dict(self.info)


def kind(**attributes: Any) -> type[Short]:
    return type("Kind", (Short,), attributes)


BYTES = spaces.Box(0, 255, (40, 40), np.uint8)


@pytest.mark.parametrize(
    ("space", "wrong", "right"),
    [
        (BYTES, np.full((40, 40), 0.5), np.full((40, 40), 200.0)),
        (BYTES, np.full((40, 40), 300), np.full((40, 40), 200)),
        (BYTES, np.full((40, 40), -1), np.full((40, 40), 255, np.int16)),
        (BYTES, np.full((40, 40), np.nan), np.full((40, 40), 3, np.uint8)),
        (spaces.Discrete(3), np.float64(1.7), np.float32(1.0)),
        (spaces.MultiDiscrete([3, 3]), np.array([0.0, 1.2]), np.array([0.0, 2.0])),
        (spaces.MultiBinary(2), np.array([0.4, 1.0]), np.array([0.0, 1.0])),
    ],
)
def test_a_value_that_the_space_cannot_hold_is_refused(space: gym.Space, wrong: Any, right: Any) -> None:
    layout = observation_layout(space)
    layout.encode(right, batched=False)
    for given, batched in ((wrong, False), (np.stack([wrong, wrong]), True)):
        with pytest.raises(ValueError, match="cannot hold"):
            layout.encode(given, batched=batched)
    agent = tightrope.PPO(kind(observation_space=space, seen=right), **SMALL)
    agent.learn(64)
    with pytest.raises(ValueError, match="cannot hold"):
        agent.predict(wrong)
    with pytest.raises(ValueError, match="cannot hold"):
        agent.value(wrong)
    agent.close()
    with pytest.raises(EnvironmentFault, match="cannot hold"):
        tightrope.PPO(kind(observation_space=space, seen=wrong), **SMALL).learn(64)


def test_a_mask_in_the_observation_is_one_in_every_space_of_bits() -> None:
    taken: list[int] = []

    class Masked(Short):
        observation_space = spaces.Dict(
            {"x": Short.observation_space, "action_mask": spaces.MultiDiscrete([2, 2])}
        )
        seen = {"x": np.zeros(1, np.float32), "action_mask": np.array([0, 1])}  # noqa: RUF012

        def step(self, action: Any) -> Any:
            taken.append(int(action))
            return super().step(action)

    tightrope.PPO(Masked, **SMALL).learn(128)
    assert set(taken) == {1}
    no_mask = spaces.Dict({"x": Short.observation_space, "action_mask": spaces.Discrete(5)})
    with pytest.raises(ValueError, match="give it another name"):
        observation_layout(no_mask)


def test_each_construction_gets_arguments_of_its_own() -> None:
    built: list[int] = []

    class Counting(Short):
        def __init__(self, opts: Any = None) -> None:
            opts["a"] += 1
            built.append(opts["a"])

    agent = tightrope.PPO(Counting, env_kwargs={"opts": {"a": 0}}, **SMALL)
    assert set(built) == {1} and len(built) > 2
    assert agent.settings.env_kwargs == {"opts": {"a": 0}}


def test_arguments_of_the_old_task_are_not_given_to_a_factory(tmp_path: Path) -> None:
    agent = tightrope.PPO("Acrobot-v1", env_kwargs={"max_episode_steps": 200}, **SMALL)
    agent.save(tmp_path / "p")
    agent.set_env(lambda: gym.make("Acrobot-v1"))
    assert agent.settings.env_kwargs is None
    loaded = tightrope.load(tmp_path / "p", env=lambda: gym.make("Acrobot-v1"))
    assert loaded.settings.env_kwargs is None
    assert tightrope.load(tmp_path / "p", env_kwargs={}).settings.env_kwargs is None
    assert tightrope.load(tmp_path / "p").settings.env_kwargs == {"max_episode_steps": 200}
    made = tightrope.load(tmp_path / "p", env=gym.make("Acrobot-v1"))
    assert made.settings.env_kwargs is None
    agent = tightrope.PPO(lambda size=1: Short(), env_kwargs={"size": 2}, **SMALL)
    assert agent.set_env(lambda: Short()).settings.env_kwargs is None


def test_an_image_is_not_taken_for_numbers(tmp_path: Path) -> None:
    image, numbers = (
        kind(observation_space=spaces.Box(0, high, (40, 40), np.float32), seen=np.zeros((40, 40), np.float32))
        for high in (1, np.inf)
    )
    agent = tightrope.PPO(image, **SMALL)
    agent.save(tmp_path / "p")
    with pytest.raises(ValueError, match=r"observations Box\(0.0, inf.* made for Box\(0.0, 1.0"):
        agent.set_env(numbers)
    with pytest.raises(ValueError, match=r"numbers\[40, 40\].* Box\(0.0, inf"):
        tightrope.load(tmp_path / "p", env=numbers)
    with pytest.raises(ValueError, match="made for"):
        agent.set_env(kind(observation_space=BYTES, seen=np.zeros((40, 40), np.uint8)))


@pytest.mark.parametrize("space", [spaces.Discrete(2**62), spaces.MultiDiscrete([2**31 - 1] * 2)])
def test_a_space_of_too_many_categories_is_refused(space: gym.Space) -> None:
    with pytest.raises(ValueError, match="inputs, which no memory holds"):
        resolve(kind(observation_space=space))


def test_a_space_that_raises_is_the_environments_fault() -> None:
    def broken(self: Any) -> Any:
        raise RuntimeError("no actions here")

    with pytest.raises(EnvironmentFault, match="raised RuntimeError: no actions here"):
        resolve(kind(action_space=property(broken)))


def test_what_has_an_effect_or_comes_from_a_preset_is_not_told(capsys: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    mixed = {**SMALL, "vector_backend": "mixed", "num_workers": 2}
    tightrope.PPO("CartPole-v1", notify=told.append, **mixed).close()
    tightrope.PPO("MountainCarContinuous-v0", notify=told.append, std="state").close()
    assert not [text for text in told if "no effect" in text]
    tightrope.PPO("MountainCarContinuous-v0", notify=told.append, std="state", gsde_steps=99).close()
    assert [text for text in told if text.startswith("gsde_steps 99 has no effect")]


def test_messages_about_masks_say_what_was_seen() -> None:
    box = kind(action_space=spaces.Box(-1, 1, (1,), np.float32), info={"action_mask": np.ones(2)})
    tightrope.PPO(box, **SMALL).learn(64)  # there is nothing that it could forbid
    for wrong in (kind(info={"action_mask": None}), kind(action_masks=lambda self: None)):
        with pytest.raises(EnvironmentFault, match=r"action_mask.* is None, expected"):
            tightrope.PPO(wrong, **SMALL).learn(64)


class Negated(gym.RewardWrapper):
    def reward(self, reward: Any) -> Any:
        return -reward


def test_an_id_is_not_given_for_a_wrapped_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "neg"
    train(
        resolve("CartPole-v1", "ppo", {**SMALL, "total_steps": 64}),
        run_dir=run,
        env=Negated(gym.make("CartPole-v1")),
    )
    assert main(["evaluate", str(run)]) == 2
    text = capsys.readouterr().err
    assert "--env CartPole-v1" not in text and "load(" in text and "not the whole task" in text
    with pytest.raises(ValueError, match=r"resume\(") as error:
        resume(run)
    assert "--env" not in str(error.value)
    for wrong in ({"episodes": 0}, {"episodes": 1.5}, {"evaluation_max_steps": -3}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            evaluate_run(run, env=Negated(gym.make("CartPole-v1")), **wrong)
