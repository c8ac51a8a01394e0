"""Worker processes that step some copies of an environment each.

Arrays are shared memory; a socket carries only fixed-size wake-ups and, when something breaks, an error as
JSON text.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
import os
import signal
import socket
import struct
import sys
import threading
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

from tightrope.control.environments import state as states
from tightrope.control.environments.faults import RAISED, EnvironmentFault, FaultPolicy
from tightrope.control.environments.group import EnvGroup
from tightrope.control.environments.step import Slots
from tightrope.control.environments.tasks import make_all

# what to do (r = reset, s = step, g = give states, p = put back states, c = close) and a number: the seed of
# a reset, or the length of the states that follow
COMMAND = struct.Struct("<cq")
LENGTH = struct.Struct("<I")
READY, MASKED, BROKEN = b"k", b"m", b"e"  # replies: fine, fine and there are action masks, JSON follows
TO_BUILD = 60.0  # seconds at least to make the copies, which may import much; then env_timeout is the limit
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


def start_context() -> BaseContext:
    """How workers start.

    fork on Linux: the worker takes the user's factory and modules as they are in memory, nothing is pickled
    and the user's script needs no ``if __name__ == "__main__"``. It is safe here because a worker runs
    environments and numpy alone and never touches torch, whose threads do not survive a fork. spawn
    elsewhere.
    """
    return multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


class Worker:
    """This process's end of one worker."""

    def __init__(
        self,
        context: BaseContext,
        makers: Sequence[Callable[[], gym.Env]],
        slots: Slots | None,
        first: int,
        number: int,
        name: str,
        spin: float,
        policy: FaultPolicy,
    ) -> None:
        self.first, self.number, self.name, self._spin = first, number, name, spin
        self._socket, theirs = socket.socketpair()
        self._timeout, self._built = policy.timeout, False
        self._be_patient(None if policy.timeout is None else max(TO_BUILD, policy.timeout))
        carried = CloudpickleWrapper(list(makers))  # type: ignore[arg-type]
        arguments = (theirs, carried, slots, first, number, name, spin, policy)
        self._process = context.Process(  # type: ignore[attr-defined]
            target=_work, args=arguments, daemon=True, name=f"tightrope-worker-{first}"
        )
        _parent_ends.add(self._socket)
        with (
            warnings.catch_warnings()
        ):  # Python 3.12 warns of fork beside threads; start_context says why it is safe
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork", category=DeprecationWarning)
            self._process.start()
        theirs.close()

    def tell(self, command: bytes, seed: int = 0, data: bytes = b"") -> None:
        """Wake the worker; that it is gone shows when it is waited for."""
        with contextlib.suppress(OSError):
            self._socket.sendall(COMMAND.pack(command, seed) + data)

    def wait(self) -> bool:
        """Until the worker has finished; True when its copies give action masks. EnvironmentFault: its
        error.
        """
        try:
            reply = _receive_soon(self._socket, 1, self._spin)
            if reply == BROKEN:
                (length,) = LENGTH.unpack(self._receive(LENGTH.size))
                raise EnvironmentFault(**json.loads(self._receive(length).decode()))
        except (TimeoutError, BlockingIOError) as error:
            self._process.kill()
            what = f"has not answered for {self._patience:g} s (env_timeout); is the environment stuck?"
            raise self._lost(what) from error
        except OSError as error:
            raise self._lost("has died") from error
        if reply not in (READY, MASKED):
            raise self._lost("has died")
        if not self._built:
            self._built = True
            self._be_patient(self._timeout)
        return reply == MASKED

    def data(self) -> Any:
        """What follows the reply of a worker that was asked for its states. EnvironmentFault as `wait`."""
        try:
            (length,) = states.LENGTH.unpack(self._receive(states.LENGTH.size))
            return json.loads(self._receive(length))
        except OSError as error:
            self._process.kill()
            raise self._lost("has died amid its answer") from error

    def _be_patient(self, seconds: float | None) -> None:
        """Let a blocking ``recv`` give up after ``seconds``: the kernel's own timeout, one system call less
        than Python's.
        """
        self._patience = seconds or 0.0
        if hasattr(socket, "MSG_DONTWAIT"):
            whole, part = divmod(seconds or 0.0, 1.0)  # 0: never
            wait = struct.pack("ll", int(whole), int(part * 1e6))
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, wait)
        else:
            self._socket.settimeout(seconds)

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
            f"worker {self.number} of {self.name} (environments from {self.first} on) {what} "
            f"(exit code {self._process.exitcode}). Try vector_backend serial, which shows the environment's "
            "own error.",
            self.first,
            env_id=self.name,
            worker=self.number,
            lost=True,
        )

    def ask_to_stop(self) -> None:
        """The first half of stopping, so that several workers close side by side."""
        with contextlib.suppress(OSError):
            self._socket.sendall(COMMAND.pack(b"c", 0))

    def stop(self, patience: float = 2.0) -> None:
        """Wait so many seconds for the worker to end, and end it when it does not."""
        self._process.join(patience)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._socket.close()
        self._process.close()


def _receive_soon(channel: socket.socket, length: int, spin: float) -> bytes:
    """``recv`` of a whole message that is likely to come within ``spin`` seconds."""
    if spin and hasattr(socket, "MSG_DONTWAIT"):
        give_up = time.perf_counter() + spin
        while time.perf_counter() < give_up:
            with contextlib.suppress(BlockingIOError):
                return channel.recv(length, socket.MSG_DONTWAIT)
            _yield_core()  # to whoever has work: without it a busy machine is slowed down twofold
    return channel.recv(length, socket.MSG_WAITALL)


def _work(
    channel: socket.socket,
    makers: Any,
    shared: Slots,
    first: int,
    number: int,
    name: str,
    spin: float,
    policy: FaultPolicy,
) -> None:
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
    threading.Thread(target=_outlive_nobody, args=(os.getppid(),), daemon=True).start()
    envs: list[gym.Env] = []
    try:
        make_all(makers.fn, envs)
        slots = shared.map(SharedArray.view).map(lambda array: array[first : first + len(envs)])
        group = EnvGroup(envs, slots, name, first, makers=makers.fn, policy=policy, worker=number)
        envs = group.envs
        check_slots(group, slots)
        channel.sendall(READY)
        while (more := _obey(channel, group, spin)) is not None:
            channel.sendall((MASKED if group.has_masks else READY) + more)
    except (ConnectionError, EOFError):
        pass  # the parent is gone
    except RAISED as error:
        text = f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
        failed = EnvironmentFault(
            f"making copies of {name} in a worker failed: {text}", first, env_id=name, worker=number
        )
        fault = error if isinstance(error, EnvironmentFault) else failed
        data = json.dumps(fault.record()).encode()
        with contextlib.suppress(OSError):
            channel.sendall(BROKEN + LENGTH.pack(len(data)) + data)
    finally:
        for env in envs:
            with contextlib.suppress(Exception):
                env.close()
        channel.close()


def _outlive_nobody(parent: int) -> None:
    """End this process soon after its parent, even while an environment hangs."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


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
