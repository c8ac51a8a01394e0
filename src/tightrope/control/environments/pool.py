"""Single environments spread over processes.

With the backend ``workers`` all of them live in k worker processes: when one of them dies or hangs, only its
own environments are lost. With ``mixed`` this process steps the first of k groups and k - 1 workers step the
others, so that no core waits; if the run must survive faults, it is as with ``workers``. With ``serial`` this
process steps all.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import os
import random
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any, final

import gymnasium as gym
import numpy as np

from tightrope.control.environments.base import Environments
from tightrope.control.environments.episode import Seeding, Start, Step
from tightrope.control.environments.faults import (
    RAISED,
    EnvironmentFault,
    FaultPolicy,
    action_text,
    wait_before_restart,
)
from tightrope.control.environments.group import EnvGroup, StepBuffers, check_alike
from tightrope.control.environments.processes import (
    BROKEN,
    CARRIED,
    CLOSE,
    COMMAND,
    ENDED,
    MASKED,
    READY,
    RENEW,
    RESET,
    SETTLE,
    SETTLED,
    SPIN,
    STEP,
    SharedArray,
    WorkerProcess,
    available_cores,
    close_inherited,
    pack_json,
    receive_all,
    receive_soon,
    start_context,
)
from tightrope.control.environments.state import gives_state, nested
from tightrope.control.environments.tasks import close_environment, make_all, time_limit
from tightrope.control.environments.watchdog import Watchdog, limited
from tightrope.control.spaces.actions import action_layout
from tightrope.control.spaces.observations import observation_layout
from tightrope.control.spaces.structure import Inputs, Reading
from tightrope.runs import generators, signals


@final
class EnvironmentPool(Environments):
    """B single environments in ``num_groups`` processes; ``here``: this one is the first of them. Neither
    changes a bit.

    ``makers``: one zero-argument function per environment.
    ``keep_first``: the caller closes environment 0.
    After a fault an environment that raised is restarted where it was; when a process died or hung, all of
    that process are.
    """

    repeatable = True

    def __init__(
        self,
        makers: Sequence[Callable[[], gym.Env]],
        num_groups: int,
        name: str,
        *,
        here: bool = True,
        keep_first: bool = False,
        policy: FaultPolicy = FaultPolicy(),  # noqa: B008 - it cannot be changed
        reading: Reading = Reading(),  # noqa: B008
    ) -> None:
        super().__init__(policy)
        self.name = name
        self.reading = reading
        self.num_envs = len(makers)
        self.makers = makers
        self._keep = 1 if keep_first else 0
        self._count = 0  # steps since the last reset of all
        self._restarts_seen = 0  # of those in the buffers, how many the counter holds
        self._under_way = False  # a reset or a step, until every worker has answered
        self._bounds = [round(k * len(makers) / num_groups) for k in range(num_groups + 1)]
        if not here or (policy.restart and num_groups > 1):  # its death would end the run
            self._bounds.insert(0, 0)
        mine = self._bounds[1]  # so many of the rows are stepped here
        workers_first = (slice(mine, self.num_envs), slice(0, mine))  # they step while this process chooses
        self.row_groups = workers_first if 0 < mine < self.num_envs else (slice(0, self.num_envs),)
        self._limit = functools.partial(limited, timeout=policy.timeout)
        self._entropy = random.getrandbits(31)  # of the workers' global generators; see generators.apart
        self._group: EnvGroup | None = None  # stepped in this process
        self._workers: list[WorkerProcess] = []
        self._watchdog: Watchdog | None = None
        envs: list[gym.Env] = []
        try:
            make_all(makers[: mine or 1], envs, limit=self._limit)
            self._describe(envs)
            self._allocate(shared=mine < self.num_envs)
            if mine:
                buffers = self._buffers.map(lambda array: array[:mine])
                self._group = EnvGroup(
                    envs, buffers, name, makers=makers[:mine], policy=policy, reading=reading
                )
            else:  # it was made for its spaces only
                self._close_all(envs)
                envs = []
            for number in range(1, len(self._bounds) - 1):
                with signals.uninterrupted():  # or nobody would end it
                    self._workers.append(self._start(number))
            for worker in self._workers:
                worker.wait_until_built()
        except BaseException:
            self._stop_workers()
            with contextlib.suppress(EnvironmentFault):
                self._close_all(envs)
            raise
        if policy.timeout is not None and self._group is not None:
            self._watchdog = Watchdog(self._group.call_number, policy.timeout, f"An environment ({name})")

    def _describe(self, envs: list[gym.Env]) -> None:
        spec = envs[0].spec
        self.spec_id = spec.id if spec is not None else type(envs[0].unwrapped).__name__
        self.max_episode_steps = time_limit(envs[0])
        self.keywords = {} if spec is None else dict(spec.kwargs)
        self.observation_layout = observation_layout(
            envs[0].observation_space, self.reading.encoder, self.reading.keys
        )
        self.action_layout = action_layout(envs[0].action_space, self.reading.action_bounds)
        self.gives_own_state, self.layers = gives_state(envs[0]), len(list(nested(envs[0])))
        check_alike(envs, self.observation_layout, self.action_layout, self.name)

    def _allocate(self, *, shared: bool) -> None:
        layouts = (self.observation_layout, self.action_layout)
        self._context = start_context()
        self._shared: StepBuffers | None = None
        if shared:
            zeros = lambda shape, dtype: SharedArray(self._context, shape, dtype)  # noqa: E731
            self._shared = StepBuffers.allocate(self.num_envs, *layouts, zeros)
            self._buffers = self._shared.map(SharedArray.view)
        else:
            self._buffers = StepBuffers.allocate(self.num_envs, *layouts)

    def _start(self, number: int) -> WorkerProcess:
        """Start the process of group ``number``."""
        first, last = self._bounds[number : number + 2]
        spin = SPIN if len(self._bounds) - 1 <= available_cores() else 0.0
        makers, entropy = self.makers[first:last], (self._entropy, number, self.restarts)
        more = (self.name, spin, self.policy, self.reading, entropy)
        return WorkerProcess(self._context, _serve, makers, self._shared, first, number, *more)

    def _reset(self, starts: Sequence[Start] | None) -> tuple[Inputs, np.ndarray | None]:
        if self._watchdog is not None:
            self._watchdog.start()
        self._count = 0
        self._restarts_seen = 0
        self._buffers.restarts.fill(0)
        if self._under_way:  # a signal ended it
            for worker in self._workers:
                worker.settle()
        self._under_way = True
        starts = [Start()] * self.num_envs if starts is None else starts
        for worker, (first, last) in zip(self._workers, itertools.pairwise(self._bounds[1:]), strict=True):
            worker.send(RESET, self.seeding, starts[first:last], 0)
        if self._group is not None:
            self._group.reset(self.seeding, starts[: self._bounds[1]])
        return self._first()

    def _first(self) -> tuple[Inputs, np.ndarray | None]:
        """What the resets that are under way return."""
        self._has_masks = self._await_workers() or (self._group is not None and self._group.has_masks)
        self._under_way = False
        step = self._buffers.step(self._has_masks, self._count)
        return step.inputs, step.action_mask

    def renew(self, row: int, wait: int) -> tuple[Inputs, np.ndarray | None]:
        """See Environments."""
        number = self.worker_of(row)
        if number:
            worker = self._workers[number - 1]
            worker.send(RENEW, row - worker.first, wait)
            self._reply(number - 1)
        elif self._group is not None:
            self._group.renew(row, wait)
        step = self._buffers.step(self._has_masks, self._count)
        return step.inputs, step.action_mask

    def send(self, rows: slice, actions: np.ndarray) -> None:
        """See Environments."""
        self._under_way = True
        self._buffers.actions[rows] = actions
        if rows.stop > self._bounds[1]:
            for worker in self._workers:
                worker.send(STEP)

    def receive(self) -> Step:
        """See Environments."""
        self._count += 1
        if self._group is not None:
            self._group.step()
        self._await_workers()
        self._under_way = False
        return self._buffers.step(self._has_masks, self._count)

    def origins(self) -> np.ndarray:
        """See Environments."""
        return self._buffers.origins_at(self._count)

    def carried(self) -> list[Any] | None:
        """See Environments."""
        if not (self.gives_own_state or self.carried_names):
            return None
        for worker in self._workers:
            worker.send(CARRIED)
        found = [] if self._group is None else list(self._group.carried)
        try:
            for worker in self._workers:
                worker.wait()
                found += worker.carried()
        except EnvironmentFault as fault:
            if not fault.lost:
                raise
            raise self._described(self._workers[fault.worker - 1], fault, "keeping the state of") from fault
        return found

    # ------------------------------------------------------------------------------------------------ faults

    def count_from(self, restarts: int) -> None:
        """See Environments."""
        super().count_from(restarts)
        if self._group is not None:
            self._group.restarts.count = restarts

    def _await_workers(self) -> bool:
        """Wait for every worker's reply; whether one of them has action masks."""
        masked = [self._reply(place) for place in range(len(self._workers))]
        if self.policy.restart:
            self._count_restarts()
        return any(masked)

    def _count_restarts(self) -> None:
        """Count the restarts that the groups made on their own."""
        restarts = int(self._buffers.restarts.sum())
        self._restarts.count += restarts - self._restarts_seen
        self._restarts_seen = restarts
        if self._restarts.count > self.policy.max_restarts:
            raise self._restarts.given_up(EnvironmentFault(f"Environments of {self.name} keep failing."))

    def _reply(self, place: int) -> bool:
        try:
            return self._workers[place].wait()
        except EnvironmentFault as fault:
            fault = self._described(self._workers[place], fault) if fault.lost else fault
            if not (self.policy.restart and fault.lost):
                raise fault from fault.__cause__
            return self._restart(place, fault)

    def _restart(self, place: int, fault: EnvironmentFault) -> bool:
        """Replace a process that is gone and reset its environments; the result is that of `wait`."""
        buffers = self._buffers
        rows = slice(*self._bounds[place + 1 : place + 3])

        def attempt() -> bool:
            self._workers[place].stop()
            buffers.restarts[rows] += 1
            self._restarts_seen += rows.stop - rows.start  # one restart, however many environments
            wait_before_restart(int(buffers.restarts[rows.start]), self.policy)
            fresh = self._workers[place] = self._start(place + 1)
            fresh.wait_until_built()
            origins = buffers.origins[rows]
            starts = [Start(int(episode)) for episode in origins[:, 0] + origins[:, 1] + 1]
            fresh.send(RESET, self.seeding, starts, self._count)
            return fresh.wait()

        def explain(error: BaseException) -> EnvironmentFault:
            if not (isinstance(error, EnvironmentFault) and error.lost):
                raise error
            return self._described(self._workers[place], error)

        masked = self._restarts.until_it_works(fault, attempt, explain)
        if self._count:
            buffers.cut[rows] = True
            buffers.rewards[rows] = 0.0
        buffers.terminated[rows] = False
        buffers.truncated[rows] = False
        return masked

    def _described(
        self, worker: WorkerProcess, fault: EnvironmentFault, doing: str = "stepping"
    ) -> EnvironmentFault:
        """The fault of a process that is gone; it names the environment that was being stepped."""
        row = int(self._buffers.current[worker.first])
        if row < 0:
            return fault
        index = worker.first + row
        seed, action, what = self.seed_of(index), None, "the reset"
        if self._count:
            action = action_text(self.action_layout.to_env_single(self._buffers.actions[index]))
            what = f"step {self._count}, last action {action}"
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
        """See Environments."""
        return self.seeding.seed(row, int(self._buffers.origins[row, 0]))

    def worker_of(self, row: int) -> int:
        """See Environments."""
        return next(k for k, last in enumerate(self._bounds[1:]) if row < last)

    # ----------------------------------------------------------------------------------------------- the end

    def close(self) -> None:
        """See Environments; EnvironmentFault for the first that raises or hangs."""
        if self._watchdog is not None:
            self._watchdog.stop()
        # something else went wrong, or the run was asked to stop and has ten seconds: no time for their ends
        in_order = sys.exc_info()[0] is None
        faults = self._stop_workers(in_order=in_order)
        if self._group is not None:
            envs, self._group.envs = self._group.envs, []
            self._close_all(envs)
        if faults:
            raise faults[0]

    def _close_all(self, envs: Sequence[gym.Env]) -> None:
        """Close all; EnvironmentFault for the first that raised."""
        first: EnvironmentFault | None = None
        for index in range(self._keep, len(envs)):
            try:
                close_environment(envs[index], index, self._limit)
            except EnvironmentFault as fault:
                first = first or fault
        if first is not None:
            raise first

    def _stop_workers(self, *, in_order: bool = False) -> list[EnvironmentFault]:
        """End all workers; ``in_order``: wait for their environments, and return what those did wrong."""
        for worker in self._workers:
            worker.send(CLOSE)
        late = time.monotonic() + (self.policy.timeout or 0.0)  # for all of them, who close at the same time
        found = [worker.last_words(late) for worker in self._workers] if in_order else []
        deadline = time.monotonic() + 2.0  # for all of them
        for worker in self._workers:
            worker.stop(max(0.0, deadline - time.monotonic()))
        self._workers = []
        return [fault for fault in found if fault is not None]


# --------------------------------------------------------------------------------------- in a worker process


def _serve(
    channel: socket.socket,
    makers: Any,
    shared: StepBuffers,
    first: int,
    number: int,
    name: str,
    spin: float,
    policy: FaultPolicy,
    reading: Reading,
    entropy: tuple[int, ...],
) -> None:
    """What a worker does: make its environments, then execute commands until CLOSE."""
    # Ctrl-C reaches the whole process group; the main process ends its workers in order
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not the main process's handler, which a fork inherits
    close_inherited()
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    envs: list[gym.Env] = []
    generators.seed(*entropy)
    try:
        make_all(makers.fn, envs, first, made=lambda: channel.sendall(READY))
        buffers = shared.map(SharedArray.view).map(lambda array: array[first : first + len(envs)])
        group = EnvGroup(
            envs, buffers, name, first, makers=makers.fn, policy=policy, worker=number, reading=reading
        )
        envs = group.envs
        _check_buffers(group, buffers)
        channel.sendall(READY)
        while (data := _obey(channel, group, spin)) is not None:
            channel.sendall((MASKED if group.has_masks else READY) + data)
        while envs:
            close_environment(envs.pop(), first + len(envs))
        channel.sendall(ENDED)
    except (ConnectionError, EOFError):
        pass  # the main process is gone
    except RAISED as error:
        if isinstance(error, EnvironmentFault):
            fault = error
        else:
            text = f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
            message = f"making copies of {name} in a worker failed: {text}"
            fault = EnvironmentFault(message, first, env_id=name, worker=number)
        with contextlib.suppress(OSError):
            channel.sendall(BROKEN + pack_json(fault.record()))
    finally:
        for env in envs:
            with contextlib.suppress(EnvironmentFault):
                close_environment(env, first)
        channel.close()


def _end_with(parent: int) -> None:
    """End this process soon after its parent, even while an environment hangs."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _obey(channel: socket.socket, group: EnvGroup, spin: float) -> bytes | None:
    """Wait for a command and execute it; what to send behind the reply, None when it is time to stop."""
    message = receive_soon(channel, COMMAND.size, spin)
    if len(message) < COMMAND.size:
        return None  # the main process is gone
    command, length = COMMAND.unpack(message)
    arguments = json.loads(receive_all(channel, length)) if length else []
    if command == RESET:
        seeding, starts, count = arguments
        group.reset(Seeding(*seeding), [Start(*start) for start in starts], count)
    elif command == RENEW:
        group.renew(*arguments)
    elif command == STEP:
        group.step()
    elif command == CARRIED:
        return pack_json(group.carried)
    elif command == SETTLE:
        return SETTLED
    return None if command == CLOSE else b""


def _check_buffers(group: EnvGroup, buffers: StepBuffers) -> None:
    """ValueError when a worker's environments do not fit the arrays that the first environment laid out."""
    expected = {name: array.shape[1:] for name, array in buffers.inputs.items()}
    found = {name: array.shape[1:] for name, array in group.observation_layout.allocate(0).items()}
    layout = group.action_layout
    widths = (buffers.actions.shape[1], buffers.masks.shape[1])
    if found != expected or (layout.num_columns, layout.num_logits) != widths:
        raise ValueError(
            f"the copies differ: {group.envs[0].observation_space}, {layout.space}; expected {expected}."
        )
