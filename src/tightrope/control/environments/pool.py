"""The copies of one environment spread over this process and worker processes.

With k groups this process steps the first one itself and k - 1 workers step the others, so that no core
waits. Where a fault is to be survived it steps none, and k workers step them all: what dies in a worker takes
nothing else along.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from tightrope.control.environments import state as states
from tightrope.control.environments.faults import (
    EnvironmentFault,
    FaultPolicy,
    action_text,
    given_up,
    pause,
    renewed_seed,
)
from tightrope.control.environments.group import EnvGroup
from tightrope.control.environments.processes import SPIN, SharedArray, Worker, available_cores, start_context
from tightrope.control.environments.step import Slots, Step
from tightrope.control.environments.tasks import check_alike, make_all
from tightrope.control.environments.watchdog import Watchdog
from tightrope.control.spaces import (
    ActionLayout,
    Inputs,
    ObservationLayout,
    action_layout,
    observation_layout,
)


class EnvCopies:
    """B copies of an environment in ``num_groups`` processes, this one included; the bits are the same for
    any number.

    ``makers`` holds one zero-argument function per copy; copy i is seeded with seed + i. ``keep_first``
    leaves closing copy 0 to the caller. ``policy`` says what a fault leads to: a copy that raised is made
    anew where it was; when a process died or hung, all copies of that process are.
    """

    def __init__(
        self,
        makers: Sequence[Callable[[], gym.Env]],
        num_groups: int,
        name: str,
        *,
        keep_first: bool = False,
        policy: FaultPolicy = FaultPolicy(),  # noqa: B008 - it cannot be changed
    ) -> None:
        self.name, self.policy, self.restarts = name, policy, 0
        self._keep = 1 if keep_first else 0
        self._makers = makers
        self._bounds = [round(k * len(makers) / num_groups) for k in range(num_groups + 1)]
        if policy.restart and num_groups > 1:  # nothing that dies may take the run along
            self._bounds.insert(0, 0)
        self._spin = SPIN if num_groups <= available_cores() else 0.0
        self._workers: list[Worker] = []
        self._watchdog: Watchdog | None = None
        self._seed, self._count, self._renewals = 0, 0, 0
        own = self._bounds[1]
        envs: list[gym.Env] = []
        try:
            make_all(makers[: own or 1], envs)
            self.spec = envs[0].spec
            self.spec_id = self.spec.id if self.spec is not None else type(envs[0].unwrapped).__name__
            self.observation_layout: ObservationLayout = observation_layout(envs[0].observation_space)
            self.action_layout: ActionLayout = action_layout(envs[0].action_space)
            check_alike(envs, self.observation_layout, self.action_layout, name)
            self.gives_state = states.gives_state(envs[0])
            self._context = start_context()
            self._allocate(len(makers), num_groups > 1)
            slots = self._slots.map(lambda array: array[:own])
            self._own = EnvGroup(envs, slots, name, makers=makers[:own], policy=policy) if own else None
            if not own:  # it was made for its spaces alone
                for env in envs[self._keep :]:
                    env.close()
                envs = []
            for number in range(1, len(self._bounds) - 1):
                self._workers.append(self._worker(number))
            for worker in self._workers:
                worker.wait()
        except BaseException:
            self._stop_workers()
            for env in envs[self._keep :]:
                env.close()
            raise
        if policy.timeout is not None and self._own is not None:
            self._watchdog = Watchdog(self._own.busy, policy.timeout, f"An environment ({name})")

    def _allocate(self, rows: int, shared: bool) -> None:
        layouts = (self.observation_layout, self.action_layout)
        self._shared = (
            Slots.allocate(rows, *layouts, lambda s, d: SharedArray(self._context, s, d))
            if (shared)
            else None
        )
        self._slots = (
            Slots.allocate(rows, *layouts) if self._shared is None else self._shared.map(SharedArray.view)
        )

    def _worker(self, number: int) -> Worker:
        """Start the process of group ``number``."""
        first, last = self._bounds[number : number + 2]
        makers = self._makers[first:last]
        return Worker(self._context, makers, self._shared, first, number, self.name, self._spin, self.policy)

    def reset(self, seed: int) -> tuple[Inputs, np.ndarray | None]:
        """Reset every copy, seeded; the first inputs and action masks."""
        if self._watchdog is not None:
            self._watchdog.start()
        self._seed, self._count, self._renewals = seed, 0, 0
        self._slots.renewals.fill(0)
        for worker in self._workers:
            worker.tell(b"r", seed)
        if self._own is not None:
            self._own.reset(seed)
        self._has_masks = self._await_workers() or (self._own is not None and self._own.has_masks)
        step = self._slots.step(self._has_masks)
        return step.inputs, step.action_mask

    @property
    def waves(self) -> tuple[slice, ...]:
        """Rows in the order in which to choose their actions: the workers' first, so that they step while the
        actions of this process's own copies are chosen.
        """
        total, own = len(self._slots.actions), self._bounds[1]
        return (slice(own, total), slice(0, own)) if 0 < own < total else (slice(0, total),)

    def begin(self, rows: slice, actions: np.ndarray) -> None:
        """Take the actions of one wave; the workers start at once."""
        self._slots.actions[rows] = actions
        if rows.stop > self._bounds[1]:
            for worker in self._workers:
                worker.tell(b"s")

    def finish(self) -> Step:
        """Step this process's own copies and wait for the workers', all waves having begun."""
        self._count += 1
        if self._own is not None:
            self._own.step()
        self._await_workers()
        return self._slots.step(self._has_masks)

    def get_state(self) -> dict[str, Any]:
        """The packed states of all copies, and what the seeds of those made anew are made of."""
        found = self._keeping(lambda: states.of_copies(self._own, self._workers))
        return {"seed": self._seed, "renewals": self._slots.renewals.tolist(), "states": found}

    def set_state(self, found: dict[str, Any]) -> tuple[Inputs, np.ndarray | None]:
        """Reset, and go on from what `get_state` gave; returns what the reset did."""
        fresh = self.reset(found["seed"])
        self._slots.renewals[:] = found["renewals"]
        self._renewals = sum(found["renewals"])
        self._keeping(lambda: states.into_copies(found["states"], self._own, self._workers))
        return fresh

    def _keeping(self, states_go: Callable[[], Any]) -> Any:
        """A fault while states come or go ends the run: a copy made anew would be in another one."""
        try:
            return states_go()
        except EnvironmentFault as fault:
            if not fault.lost:
                raise
            lost = self._workers[fault.worker - 1]
            raise self._described(lost, fault, "keeping the state of") from fault

    # ------------------------------------------------------------------------------------------------ faults

    def count_from(self, restarts: int) -> None:
        """So many restarts are behind the run already."""
        self.restarts = restarts
        if self._own is not None:
            self._own.renewed = restarts

    def _await_workers(self) -> bool:
        """Wait for every worker's reply; whether one of them has action masks."""
        masked = [self._reply(place) for place in range(len(self._workers))]
        if self.policy.restart:
            self._count_restarts()
        return any(masked)

    def _reply(self, place: int) -> bool:
        worker = self._workers[place]
        try:
            return worker.wait()
        except EnvironmentFault as fault:
            fault = self._described(worker, fault) if fault.lost else fault
            if not (self.policy.restart and fault.lost):
                raise fault from fault.__cause__
            return self._renew(place, fault)

    def _renew(self, place: int, fault: EnvironmentFault) -> bool:
        """Another process in the place of one that is gone, with all its copies made anew; as `wait`."""
        slots, restarts = self._slots, 0
        rows = slice(*self._bounds[place + 1 : place + 3])
        while True:
            if self.restarts + restarts >= self.policy.max_restarts:
                raise given_up(fault, self.restarts + restarts)
            restarts += 1
            self._workers[place].stop()
            slots.renewals[rows] += 1
            time.sleep(pause(int(slots.renewals[rows.start]), self.policy.timeout))
            fresh = self._workers[place] = self._worker(place + 1)
            try:
                fresh.wait()
                fresh.tell(b"r", self._seed)
                masked = fresh.wait()
                break
            except EnvironmentFault as again:
                if not again.lost:
                    raise
                fault = self._described(fresh, again)
        if self._count:
            slots.cut[rows], slots.rewards[rows] = True, 0.0
        slots.terminated[rows] = slots.truncated[rows] = False
        self._renewals += restarts * (rows.stop - rows.start - 1)  # one restart, however many copies
        return masked

    def _described(
        self, worker: Worker, fault: EnvironmentFault, doing: str = "stepping"
    ) -> EnvironmentFault:
        """The fault of a process that is gone, with what is known of the copy it was stepping."""
        row = int(self._slots.under_way[worker.first])
        if row < 0:
            return fault
        index = worker.first + row
        seed = self.seed_of(index)
        actions = self.action_layout.rows(self._slots.actions)
        action = action_text(next(itertools.islice(actions, index, None))) if self._count else None
        what = f"step {self._count}, last action {action}" if self._count else "the reset"
        return EnvironmentFault(
            f"{fault} It was {doing} environment {index}: {what}, seed {seed}.",
            index,
            self._count,
            env_id=self.name,
            worker=worker.number,
            seed=seed,
            action=action,
            lost=True,
        )

    def seed_of(self, row: int) -> int:
        """The seed of a row's last seeded reset."""
        often = int(self._slots.renewals[row])
        return renewed_seed(self._seed, often, row) if often else self._seed + row

    def worker_of(self, row: int) -> int:
        """The number of the process that steps a row; 0: this one."""
        return next(k for k, last in enumerate(self._bounds[1:]) if row < last)

    def _count_restarts(self) -> None:
        renewals = int(self._slots.renewals.sum())
        self.restarts += renewals - self._renewals
        self._renewals = renewals
        if self.restarts > self.policy.max_restarts:
            raise given_up(EnvironmentFault(f"Environments of {self.name} keep failing."), self.restarts)

    # ----------------------------------------------------------------------------------------------- the end

    def close(self) -> None:
        """Close every copy and end the workers; closing twice is fine."""
        if self._watchdog is not None:
            self._watchdog.stop()
        self._stop_workers()
        if self._own is not None:
            for env in self._own.envs[self._keep :]:
                env.close()
            self._own.envs = []

    def _stop_workers(self) -> None:
        for worker in self._workers:
            worker.ask_to_stop()
        until = time.monotonic() + 2.0  # for all of them: a run that is asked to stop has ten seconds
        for worker in self._workers:
            worker.stop(max(0.0, until - time.monotonic()))
        self._workers = []
