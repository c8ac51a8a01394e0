"""The copies of one environment spread over this process and worker processes.

With k groups this process steps the first one itself and k - 1 workers step the others, so that no core
waits. Arrays are shared memory; a socket carries only fixed-size wake-ups and, when something breaks, an
error as JSON text.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import multiprocessing
import os
import signal
import socket
import struct
import sys
import time
import traceback
import warnings
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.context import BaseContext
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from tightrope.control import states
from tightrope.control.spaces import (
    ActionLayout,
    Inputs,
    ObservationLayout,
    action_layout,
    observation_layout,
)
from tightrope.control.tasks import check_alike, make_all
from tightrope.control.vector import EnvGroup, EnvironmentFault, Slots, Step

# what to do (r = reset, s = step, g = give states, p = put back states, c = close) and a number: the seed of
# a reset, or the length of the states that follow
COMMAND = struct.Struct("<cq")
LENGTH = struct.Struct("<I")
READY, MASKED, BROKEN = b"k", b"m", b"e"  # replies: fine, fine and there are action masks, JSON follows
PATIENCE = 60.0  # seconds a worker may stay silent
SPIN = 2e-4  # seconds to look for a message before sleeping; to wake a sleeper costs about as much as a step

_yield_core: Callable[[], Any] = getattr(os, "sched_yield", int)  # int() where there is nothing to call
_parent_ends: weakref.WeakSet[socket.socket] = weakref.WeakSet()


def available_cores() -> int:
    """Cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class SharedArray:
    """A numpy array in shared memory that can travel to a worker when it starts."""

    def __init__(self, context: BaseContext, shape: tuple[int, ...], dtype: Any) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)
        self._raw = context.RawArray("b", max(1, math.prod(shape) * self.dtype.itemsize))

    def view(self) -> np.ndarray:
        """The array; every view, in every process, shows the same bytes."""
        return np.frombuffer(self._raw, self.dtype, math.prod(self.shape)).reshape(self.shape)


def _start_context() -> BaseContext:
    """How workers start.

    fork on Linux: the worker takes the user's factory and modules as they are in memory, nothing is pickled
    and the user's script needs no ``if __name__ == "__main__"``. It is safe here because a worker runs
    environments and numpy alone and never touches torch, whose threads do not survive a fork. spawn
    elsewhere.
    """
    return multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


class EnvCopies:
    """B copies of an environment in ``num_groups`` processes, this one included; the bits are the same for
    any number.

    ``makers`` holds one zero-argument function per copy; copy i is seeded with seed + i. ``keep_first``
    leaves closing copy 0 to the caller.
    """

    def __init__(
        self, makers: Sequence[Callable[[], gym.Env]], num_groups: int, name: str, *, keep_first: bool = False
    ) -> None:
        self.name = name
        self._keep = 1 if keep_first else 0
        bounds = [round(k * len(makers) / num_groups) for k in range(num_groups + 1)]
        self._workers: list[Worker] = []
        envs: list[gym.Env] = []
        try:
            make_all(makers[: bounds[1]], envs)
            self.spec = envs[0].spec
            self.spec_id = self.spec.id if self.spec is not None else type(envs[0].unwrapped).__name__
            self.observation_layout: ObservationLayout = observation_layout(envs[0].observation_space)
            self.action_layout: ActionLayout = action_layout(envs[0].action_space)
            check_alike(envs, self.observation_layout, self.action_layout, name)
            context = _start_context()
            spin = SPIN if num_groups <= available_cores() else 0.0
            shared: Slots | None = None
            if num_groups > 1:
                shared = Slots.allocate(
                    len(makers),
                    self.observation_layout,
                    self.action_layout,
                    lambda s, d: SharedArray(context, s, d),
                )
                self._slots = shared.map(SharedArray.view)
            else:
                self._slots = Slots.allocate(len(makers), self.observation_layout, self.action_layout)
            self._own = EnvGroup(envs, self._slots.map(lambda array: array[: bounds[1]]), name)
            for first, last in itertools.pairwise(bounds[1:]):
                self._workers.append(Worker(context, makers[first:last], shared, first, name, spin))
            for worker in self._workers:
                worker.wait()
        except BaseException:
            self._stop_workers()
            for env in envs[self._keep :]:
                env.close()
            raise

    def reset(self, seed: int) -> tuple[Inputs, np.ndarray | None]:
        """Reset every copy, seeded; the first inputs and action masks."""
        for worker in self._workers:
            worker.tell(b"r", seed)
        self._own.reset(seed)
        masked = [worker.wait() for worker in self._workers]  # every reply must be read
        self._has_masks = any(masked) or self._own.has_masks
        step = self._slots.step(self._has_masks)
        return step.inputs, step.action_mask

    @property
    def waves(self) -> tuple[slice, ...]:
        """Rows in the order in which to choose their actions: the workers' first, so that they step while the
        actions of this process's own copies are chosen.
        """
        total, own = len(self._slots.actions), len(self._own.envs)
        return (slice(own, total), slice(0, own)) if self._workers else (slice(0, total),)

    def begin(self, rows: slice, actions: np.ndarray) -> None:
        """Take the actions of one wave; the workers start at once."""
        self._slots.actions[rows] = actions
        if rows.start:
            for worker in self._workers:
                worker.tell(b"s")

    def finish(self) -> Step:
        """Step this process's own copies and wait for the workers', all waves having begun."""
        self._own.step()
        for worker in self._workers:
            worker.wait()
        return self._slots.step(self._has_masks)

    def close(self) -> None:
        """Close every copy and end the workers; closing twice is fine."""
        self._stop_workers()
        for env in self._own.envs[self._keep :]:
            env.close()
        self._own.envs = []

    def _stop_workers(self) -> None:
        for worker in self._workers:
            worker.ask_to_stop()
        for worker in self._workers:
            worker.stop()
        self._workers = []


class Worker:
    """This process's end of one worker."""

    def __init__(
        self,
        context: BaseContext,
        makers: Sequence[Callable[[], gym.Env]],
        slots: Slots | None,
        first: int,
        name: str,
        spin: float,
    ) -> None:
        self.first, self.name, self._spin = first, name, spin
        self._socket, theirs = socket.socketpair()
        _set_patience(self._socket)
        carried = CloudpickleWrapper(list(makers))  # type: ignore[arg-type]
        arguments = (theirs, carried, slots, first, name, spin)
        self._process = context.Process(  # type: ignore[attr-defined]
            target=_work, args=arguments, daemon=True, name=f"tightrope-worker-{first}"
        )
        _parent_ends.add(self._socket)
        with (
            warnings.catch_warnings()
        ):  # Python 3.12 warns of fork beside threads; _start_context says why it is safe
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork", category=DeprecationWarning)
            self._process.start()
        theirs.close()

    def tell(self, command: bytes, seed: int = 0) -> None:
        """Wake the worker."""
        try:
            self._socket.sendall(COMMAND.pack(command, seed))
        except OSError as error:
            raise self._lost("has died") from error

    def wait(self) -> bool:
        """Until the worker has finished; True when its copies give action masks. EnvironmentFault: its
        error.
        """
        try:
            reply = _receive_soon(self._socket, 1, self._spin)
            if reply == BROKEN:
                (length,) = LENGTH.unpack(self._receive(LENGTH.size))
                fault = json.loads(self._receive(length).decode())
                raise EnvironmentFault(str(fault["message"]), int(fault["index"]), int(fault["step"]))
        except (TimeoutError, BlockingIOError) as error:
            self._process.kill()
            raise self._lost(f"has not answered for {PATIENCE:g} s; is the environment stuck?") from error
        except OSError as error:
            raise self._lost("has died") from error
        if reply not in (READY, MASKED):
            raise self._lost("has died")
        return reply == MASKED

    def _receive(self, length: int) -> bytes:
        data = b""
        while len(data) < length:
            part = self._socket.recv(length - len(data))
            if not part:
                raise self._lost("has died")
            data += part
        return data

    def _lost(self, what: str) -> EnvironmentFault:
        self._process.join(1.0)
        return EnvironmentFault(
            f"the worker process of {self.name} (environments from {self.first} on) {what} "
            f"(exit code {self._process.exitcode}). Try backend serial, which shows the environment's own "
            "error.",
            self.first,
        )

    def ask_to_stop(self) -> None:
        """The first half of stopping, so that several workers close side by side."""
        with contextlib.suppress(OSError):
            self._socket.sendall(COMMAND.pack(b"c", 0))

    def stop(self) -> None:
        """Wait for the worker to end, and end it when it does not."""
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._socket.close()
        self._process.close()


def _set_patience(channel: socket.socket) -> None:
    """Let a blocking ``recv`` give up after PATIENCE: the kernel's own timeout, one system call less than
    Python's.
    """
    if hasattr(socket, "MSG_DONTWAIT"):
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", int(PATIENCE), 0))
    else:
        channel.settimeout(PATIENCE)


def _receive_soon(channel: socket.socket, length: int, spin: float) -> bytes:
    """``recv`` of a whole message that is likely to come within ``spin`` seconds."""
    if spin and hasattr(socket, "MSG_DONTWAIT"):
        give_up = time.perf_counter() + spin
        while time.perf_counter() < give_up:
            with contextlib.suppress(BlockingIOError):
                return channel.recv(length, socket.MSG_DONTWAIT)
            _yield_core()  # to whoever has work: without it a busy machine is slowed down twofold
    return channel.recv(length, socket.MSG_WAITALL)


def _work(channel: socket.socket, makers: Any, shared: Slots, first: int, name: str, spin: float) -> None:
    """The life of a worker: make the copies, then reset and step them as told until told to stop or left
    alone.
    """
    # Ctrl-C reaches the whole process group; the parent ends its workers in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not the parent's answer, which a fork brings along
    for inherited in list(
        _parent_ends
    ):  # else this process would keep other workers from seeing their parent die
        inherited.close()
    envs: list[gym.Env] = []
    try:
        make_all(makers.fn, envs)
        slots = shared.map(SharedArray.view).map(lambda array: array[first : first + len(envs)])
        group = EnvGroup(envs, slots, name, first)
        check_slots(group, slots)
        channel.sendall(READY)
        while (more := _obey(channel, group, spin)) is not None:
            channel.sendall((MASKED if group.has_masks else READY) + more)
    except (ConnectionError, EOFError):
        pass  # the parent is gone
    except Exception as error:
        fault = error if isinstance(error, EnvironmentFault) else None
        text = str(fault) if fault else f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
        message = text if fault else f"making copies of {name} in a worker failed: {text}"
        index, step = (fault.index, fault.step) if fault else (first, -1)
        data = json.dumps({"message": message, "index": index, "step": step}).encode()
        with contextlib.suppress(OSError):
            channel.sendall(BROKEN + LENGTH.pack(len(data)) + data)
    finally:
        for env in envs:
            with contextlib.suppress(Exception):
                env.close()
        channel.close()


def _obey(channel: socket.socket, group: EnvGroup, spin: float) -> bytes | None:
    """Wait for one command and carry it out; what to send behind the reply, None when it is time to stop."""
    message = _receive_soon(channel, COMMAND.size, spin)
    command, number = COMMAND.unpack(message) if len(message) == COMMAND.size else (b"c", 0)
    if command == b"r":
        group.reset(number)
    elif command == b"s":
        group.step()
    elif command == b"p":
        states.taken(channel, group, number)
    elif command == b"g":
        return states.told(group)
    return None if command == b"c" else b""


def check_slots(group: EnvGroup, slots: Slots) -> None:
    """ValueError when a worker's copies do not fit the arrays that the first group's spaces laid out."""
    theirs = {name: array.shape[1:] for name, array in slots.inputs.items()}
    ours = {name: array.shape[1:] for name, array in group.observation_layout.allocate(0).items()}
    layout = group.action_layout
    if theirs != ours or (layout.num_columns, layout.num_logits) != (
        slots.actions.shape[1],
        slots.masks.shape[1],
    ):
        raise ValueError(
            f"the copies differ: {group.envs[0].observation_space}, {layout.space}; expected {theirs}."
        )
