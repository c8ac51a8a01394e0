"""Worker processes as the main process sees them, and the channel between the two.

Arrays are shared memory. A socket carries fixed-size commands and replies, and JSON text for the states of
environments and for a fault.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
import os
import socket
import struct
import sys
import time
import warnings
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from tightrope.control.environments.faults import EnvironmentFault, FaultPolicy
from tightrope.control.spaces.structure import Reading

COMMAND = struct.Struct("<cq")  # one of the following, and a number: a seed, or how many bytes of data follow
RESET, STEP, GET_STATE, SET_STATE, SETTLE, CLOSE = b"r", b"s", b"g", b"p", b"t", b"c"
LENGTH = struct.Struct("<Q")
READY, MASKED, BROKEN = b"k", b"m", b"e"  # replies: done; done, and there are action masks; a fault follows
SETTLED = b"t"  # follows the reply to SETTLE, and no other
TO_BUILD = 60.0  # seconds at least to make the environments, which may import much
SPIN = 2e-4  # seconds to poll for a message before sleeping; waking up costs about as much as a step

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
    environments and numpy only and never touches torch, whose threads do not survive a fork. spawn
    elsewhere.
    """
    return multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


class WorkerProcess:
    """The main process's end of one worker process, which runs ``serve`` (see pool.py)."""

    def __init__(
        self,
        context: BaseContext,
        serve: Callable[..., None],
        makers: Sequence[Callable[[], Any]],
        shared: Any,
        first: int,
        number: int,
        name: str,
        spin: float,
        policy: FaultPolicy,
        reading: Reading,
    ) -> None:
        self.first = first
        self.number = number
        self.name = name
        self._spin = spin
        self._timeout = policy.timeout
        self._built = False
        self._socket, theirs = socket.socketpair()
        self._set_patience(None if policy.timeout is None else max(TO_BUILD, policy.timeout))
        carried = CloudpickleWrapper(list(makers))  # type: ignore[arg-type]
        self._process = context.Process(  # type: ignore[attr-defined]
            target=serve,
            args=(theirs, carried, shared, first, number, name, spin, policy, reading),
            daemon=True,
            name=f"tightrope-worker-{first}",
        )
        _parent_ends.add(self._socket)
        with warnings.catch_warnings():
            # Python 3.12 warns of fork beside threads; start_context explains why it is safe here
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork", category=DeprecationWarning)
            try:
                self._process.start()
            except Exception as error:  # what a factory holds may raise anything when it is pickled
                theirs.close()
                self._socket.close()
                if isinstance(error, OSError):
                    raise
                raise ValueError(
                    f"The factory of {name} cannot be sent to a worker process ({error}). Make the "
                    "environment from what a module defines, without locks, files or connections around it, "
                    "or use vector_backend serial."
                ) from error
        theirs.close()

    def send(self, command: bytes, number: int = 0, data: bytes = b"") -> None:
        """Wake the worker; `wait` finds out if it is gone."""
        with contextlib.suppress(OSError):
            self._socket.sendall(COMMAND.pack(command, number) + data)

    def wait(self) -> bool:
        """Wait for the reply; True when the environments give action masks.

        EnvironmentFault: the worker's, or the worker is gone.
        """
        try:
            reply = receive_soon(self._socket, 1, self._spin)
            if reply == BROKEN:
                raise EnvironmentFault(**self._receive_json())
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
            self._set_patience(self._timeout)
        return reply == MASKED

    def settle(self) -> None:
        """Take the replies that a signal kept from being read. EnvironmentFault as `wait`."""
        self.send(SETTLE)
        self.wait()
        while receive_soon(self._socket, 1, self._spin) not in (SETTLED, b""):
            pass

    def states(self) -> Any:
        """The packed states that follow the reply to GET_STATE. EnvironmentFault as `wait`."""
        try:
            return self._receive_json()
        except OSError as error:
            self._process.kill()
            raise self._lost("died while it answered") from error

    def _set_patience(self, seconds: float | None) -> None:
        """Let a blocking ``recv`` give up after ``seconds``; the kernel's timeout saves a system call."""
        self._patience = seconds or 0.0
        if hasattr(socket, "MSG_DONTWAIT"):
            whole, part = divmod(seconds or 0.0, 1.0)  # 0: never
            wait = struct.pack("ll", int(whole), int(part * 1e6))
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, wait)
        else:
            self._socket.settimeout(seconds)

    def _receive_json(self) -> Any:
        try:
            (length,) = LENGTH.unpack(receive_all(self._socket, LENGTH.size))
            return json.loads(receive_all(self._socket, length))
        except EOFError as error:
            raise self._lost("has died") from error

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

    def stop(self, patience: float = 2.0) -> None:
        """Wait for the worker to end, and kill it after ``patience`` seconds."""
        self._process.join(patience)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._socket.close()
        self._process.close()


def pack_json(value: Any) -> bytes:
    """A value as JSON text behind its length, as `WorkerProcess` reads it."""
    data = json.dumps(value, allow_nan=False).encode()
    return LENGTH.pack(len(data)) + data


def receive_all(channel: socket.socket, length: int) -> bytes:
    """Exactly ``length`` bytes. EOFError: the other end is gone."""
    data = b""
    while len(data) < length:
        part = channel.recv(length - len(data))
        if not part:
            raise EOFError("the other process is gone")
        data += part
    return data


def receive_soon(channel: socket.socket, length: int, spin: float) -> bytes:
    """A whole message that is likely to come within ``spin`` seconds; empty when the other end is gone."""
    if spin and hasattr(socket, "MSG_DONTWAIT"):
        give_up = time.perf_counter() + spin
        while time.perf_counter() < give_up:
            with contextlib.suppress(BlockingIOError):
                return channel.recv(length, socket.MSG_DONTWAIT)
            _yield_core()  # without it a busy machine runs at half its speed
    return channel.recv(length, socket.MSG_WAITALL)


def close_inherited() -> None:
    """In a forked worker: close the main process's ends, which would hide the main process's death."""
    for inherited in list(_parent_ends):
        inherited.close()
