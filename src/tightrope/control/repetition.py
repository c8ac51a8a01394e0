"""A run asks its task whether episodes repeat, tells it once if they do not, and writes the answer down.

It asks fresh copies in a process of their own, where they disturb neither the run's generators nor its
environments. The first episode alone would not do: what an environment keeps from one episode to the next
shows only in later episodes of a used copy.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np

from tightrope.control.agent import Agent
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import RAISED, FaultPolicy
from tightrope.control.environments.pool import EnvironmentPool
from tightrope.control.environments.processes import in_process_of_its_own
from tightrope.control.environments.state import differing
from tightrope.control.rollout.replay import Repeatable, Running, replay
from tightrope.runs.run import Run
from tightrope.training.events import Listeners

STEPS = 50  # of each short episode that a copy is used for
TESTED_SHARE = 0.005  # of the steps of a run that may be spent on tests after the first two
REMEDY = (
    "An episode must depend on nothing but reset(seed=...) and the actions: draw from self.np_random, never "
    "from np.random, random or the clock (--vector-backend workers --num-workers N, one copy a worker, gives "
    "each copy generators and classes of its own), set every attribute in reset, or name what is kept from "
    "episode to episode (--carried LAYER.ATTRIBUTE, layer 0 is the outermost wrapper), or give it by "
    "get_state and set_state. Training is not affected; but a resumed run begins new episodes where they "
    "differ, and ends with other bits."
)


def carried_attributes(environments: Environments) -> list[str]:
    """Attributes that a reset with a seed leaves as they are, see state.py. ValueError: why nobody knows."""
    maker = environments.makers[-1]

    def search(stack: contextlib.ExitStack) -> list[str]:
        used, fresh = maker(), maker()
        for env in (used, fresh):
            stack.callback(env.close)
        if used is fresh:
            return []
        with contextlib.suppress(*RAISED):  # an action that its mask forbids, say: it is used all the same
            for seed in range(3):
                _play(used, seed)
        used.reset(seed=9)
        fresh.reset(seed=9)
        return differing(used, fresh)

    return in_process_of_its_own(search, environments.policy.timeout)


def _play(env: gym.Env, seed: int) -> None:
    env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(STEPS):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            return


def difference_of(environments: Environments, ended: Repeatable) -> str:
    """Where an episode of copy 0 first differs when a fresh copy repeats it; empty when it does not.
    ValueError: why nobody knows.
    """
    seeding, reading, name = environments.seeding, environments.reading, environments.spec_id
    maker, logs = environments.makers[-1], {f"0.{ended.episode}": np.concatenate(ended.parts)}
    policy = FaultPolicy(timeout=environments.policy.timeout)

    def repeat(stack: contextlib.ExitStack) -> list[str]:
        twin = EnvironmentPool([maker], 1, name, policy=policy, reading=reading)
        stack.callback(twin.close)
        twin.reseed_after, twin.carried_names = seeding.reseed_after, seeding.carried
        origins = np.array([[ended.episode, 0, ended.steps]])
        saved = Running(origins, np.array([ended.first], np.uint32), [], [ended.carried])
        return replay(twin, seeding.run, saved, logs).differences

    return "; ".join(in_process_of_its_own(repeat, None))


class Repetition:
    """The tests of one run: copy 0's first finished episode, its third, ninth and so on, in fresh copies."""

    def __init__(self, agent: Agent, run: Run, listeners: Listeners) -> None:
        self.agent, self.run, self.listeners = agent, run, listeners
        # the number of finished episodes at which the next test is due; 0: never
        self._next = 0 if agent.settings.repeats == "no" else 1
        self._steps = 0  # of all tests

    def begin(self) -> None:
        """Before the first episode: which attributes have to be carried. New copies, at a resume, would tell
        nothing where that was not found: their episodes repeat without what the earlier ones had left.
        """
        environments, settings = self.agent.environments, self.agent.settings
        if not environments.makers:  # a vector version
            self._next = 0
        elif environments.replays and settings.carried is None:
            if self.agent.steps:
                self.listeners.warn(
                    "This run could not look what its task keeps from one episode to the next; its copies "
                    "begin again without it, and whether episodes repeat is not tested."
                )
                self._next = 0
                return
            try:
                found = carried_attributes(environments)
            except ValueError as error:
                self.listeners.info(f"Whether episodes repeat is not tested: {error}")
                self._next = 0
                return
            environments.carried_names = found
            self._write(carried=" ".join(found))

    def after_update(self) -> None:
        """Test the episode that is over, if it is its turn."""
        running = self.agent.collector.boundary().running
        if not self._next or running is None or running.ended is None:
            return
        count = running.ended.episode + 1
        few = self._steps + running.ended.steps <= TESTED_SHARE * self.agent.steps
        if count >= self._next and (few or self._next <= 3):
            self._next = 3 * count
            self._test(running.ended)

    def before_save(self) -> None:
        """Test the running episode, if none was over yet."""
        running = self.agent.collector.boundary().running if self.agent.steps else None
        if self._next == 1 and running is not None and (present := running.of_first_copy()) is not None:
            self._next = 2
            self._test(present)

    def _test(self, episode: Repeatable) -> None:
        environments = self.agent.environments
        self._steps += episode.steps
        try:
            difference = difference_of(environments, episode)
        except ValueError as error:
            self.listeners.info(f"Whether episodes repeat is not tested: {error}")
            self._next = 0
            return
        if difference:
            self.give_up(difference)
        else:
            self._write(repeats="yes")

    def give_up(self, reason: str = "") -> None:
        """Write down that episodes do not repeat; told once with the ``reason``."""
        if reason and self.agent.settings.repeats != "no":
            self.listeners.warn(
                f"The episodes of {self.agent.environments.spec_id} do not repeat from seed and actions in a "
                f"fresh copy: {reason}. {REMEDY}"
            )
        self._next = 0
        self._write(repeats="no")

    def _write(self, **values: Any) -> None:
        """Into the settings of the run, and settings.json."""
        changed = dataclasses.replace(self.agent.settings, **values)
        if changed != self.agent.settings:
            self.agent.settings = changed
            self.run.require_there()
            self.run.update_settings(changed.to_json())
