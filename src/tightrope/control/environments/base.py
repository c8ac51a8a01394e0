"""What steps B environments: the interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from tightrope.control.environments.episode import TRAINING, Seeding, Start, Step
from tightrope.control.environments.faults import FaultPolicy, Restarts
from tightrope.control.spaces.actions import ActionLayout
from tightrope.control.spaces.observations import ObservationLayout
from tightrope.control.spaces.structure import Inputs, Reading


class Environments(ABC):
    """B environments of one task. Made by ``make_environments``; close it, or use it in a ``with`` statement.

    After an EnvironmentFault only ``close`` is allowed. ``row_groups``: slices of rows, in the order in which
    to choose their actions: one group is stepped while the actions of the next are chosen.
    """

    backend: str  # "serial" | "mixed" | "workers" | "vector" | "envpool" | "given"
    spec_id: str
    max_episode_steps: int | None
    keywords: dict[str, Any] = {}  # noqa: RUF012 - with which gymnasium.make made them; never changed
    num_workers: int = 1
    reseed_after: int | None = None  # see Seeding
    carried_names: Sequence[str] = ()
    layers: int = 0  # of a single environment: its wrappers and itself
    makers: Sequence[Any] = ()  # of single environments: one function a copy
    reading: Reading
    repeatable: bool = False  # whether seeded episodes, like those of single environments, repeat
    gives_state: bool = False  # a vector environment that can give its state (see state.py)
    num_envs: int
    observation_layout: ObservationLayout
    action_layout: ActionLayout
    row_groups: tuple[slice, ...]

    def __init__(self, policy: FaultPolicy) -> None:
        self.policy = policy
        self.seeding = Seeding(0)
        self._restarts = Restarts(policy)

    @property
    def replays(self) -> bool:
        """Whether episodes are seeded and repeat from seed and actions."""
        return self.repeatable and self.reseed_after is not None

    @property
    def restarts(self) -> int:
        """How often an environment, or a process of them, was restarted after a fault."""
        return self._restarts.count

    def reset(
        self, seed: int, stream: int = TRAINING, starts: Sequence[Start] | None = None
    ) -> tuple[Inputs, np.ndarray | None]:
        """Reset all: the first inputs and action masks.

        ``seed`` of the run and ``stream`` decide the seeds of all episodes (see Seeding); a vector
        environment gets those of copy 0. ``starts``: one a copy; None: each begins with its episode 0.
        """
        self.seeding = Seeding(seed, stream, self.reseed_after, self.carried_names)
        return self._reset(starts)

    @abstractmethod
    def _reset(self, starts: Sequence[Start] | None) -> tuple[Inputs, np.ndarray | None]: ...

    def step(self, actions: np.ndarray) -> Step:
        """Act in every environment; ``actions`` [B, A] float32 as sampled, bounds are handled here."""
        for rows in self.row_groups:
            self.send(rows, actions[rows])
        return self.receive()

    @abstractmethod
    def send(self, rows: slice, actions: np.ndarray) -> None:
        """Hand over the actions of one row group; worker processes begin to step at once."""

    @abstractmethod
    def receive(self) -> Step:
        """Finish the step; the actions of every row group must have been sent, in order."""

    def renew(self, row: int, wait: int) -> tuple[Inputs, np.ndarray | None]:
        """Begin the next episode in one row, which then waits; returns what `reset` returned."""
        raise NotImplementedError

    def origins(self) -> np.ndarray | None:
        """int64 [B, 3]: the episode of each copy's last seeded reset, how many others began since, and the
        steps since. None for vector environments, which are seeded as a whole.
        """
        return None

    def carried(self) -> list[Any] | None:
        """What each copy had carried from earlier episodes at its last seeded reset, encoded, or a text that
        says why it cannot be saved. None where no copy carries anything.
        """
        return None

    def get_state(self) -> Any:
        """The state of a vector environment that gives it, in the middle of episodes."""
        raise NotImplementedError

    def set_state(self, state: Any) -> None:
        """Continue from a state of `get_state`, after a reset."""
        raise NotImplementedError

    def count_from(self, restarts: int) -> None:
        """Start the restart counter at ``restarts``."""
        self._restarts.count = restarts

    def worker_of(self, row: int) -> int:
        """The number of the worker process that steps a row; 0: this process."""
        return 0

    @abstractmethod
    def seed_of(self, row: int) -> int:
        """The seed of a row's last seeded reset."""

    @abstractmethod
    def close(self) -> None:
        """Close every environment that was made here and end the workers; closing twice is fine."""

    def __enter__(self) -> Environments:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
