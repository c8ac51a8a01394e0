"""Worker processes as the main process sees them, and the channel between the two.

Arrays are shared memory. A socket carries fixed-size commands and replies, and JSON text for seeds, for what
environments carry from episode to episode, and for a fault.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import multiprocessing
import os
import select
import signal
import socket
import struct
import sys
import time
import warnings
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.context import BaseContext
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper
from numpy.typing import DTypeLike

from tightrope.control.environments.faults import RAISED, EnvironmentFault, FaultPolicy
from tightrope.runs.durable import spare_standard_streams

COMMAND = struct.Struct("<cq")  # one of the following, and how many bytes of data follow
RESET, RENEW, STEP, CARRIED, SETTLE, CLOSE = b"r", b"n", b"s", b"g", b"t", b"c"
LENGTH = struct.Struct("<Q")
# replies: done; done, and there are action masks; a fault follows; all environments are closed
READY, MASKED, BROKEN, ENDED = b"k", b"m", b"e", b"x"
TO_START = 60.0  # seconds at least for a worker that is not forked: it imports everything again
SETTLED = b"t"  # follows the reply to SETTLE, and no other
LONGEST_ANSWER = 600.0  # seconds for an answer of `in_process_of_its_own`
LONGEST_END = 1.0  # and for its end after that
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

    def __init__(self, context: BaseContext, shape: tuple[int, ...], dtype: DTypeLike) -> None:
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
        makers: Sequence[Callable[[], object]],
        shared: object,
        first: int,
        number: int,
        name: str,
        spin: float,
        policy: FaultPolicy,
        *more: object,
    ) -> None:
        self.first = first
        self.number = number
        self.name = name
        self._spin = spin
        self._timeout = policy.timeout
        self._owes = False  # an answer to a command
        self._to_build, self._forked = len(makers), context.get_start_method() == "fork"
        spare_standard_streams()
        self._socket, theirs = socket.socketpair()
        self._set_patience(policy.timeout)
        carried = CloudpickleWrapper(list(makers))  # type: ignore[arg-type]
        self._process = context.Process(  # type: ignore[attr-defined]
            target=serve,
            args=(theirs, carried, shared, first, number, name, spin, policy, *more),
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

    def send(self, command: bytes, *arguments: object) -> None:
        """Wake the worker; `wait` finds out if it is gone. ``arguments``: JSON."""
        self._owes |= command != CLOSE
        data = json.dumps(arguments, allow_nan=False).encode() if arguments else b""
        with contextlib.suppress(OSError):
            self._socket.sendall(COMMAND.pack(command, len(data)) + data)

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
            raise self._lost(what, "Give a larger env_timeout if its steps may take that long.") from error
        except OSError as error:
            raise self._lost("has died") from error
        if reply not in (READY, MASKED):
            raise self._lost("has died")
        self._owes = False
        return reply == MASKED

    def settle(self) -> None:
        """Take the replies that a signal kept from being read. EnvironmentFault as `wait`."""
        self.send(SETTLE)
        self.wait()
        while receive_soon(self._socket, 1, self._spin) not in (SETTLED, b""):
            pass

    def wait_until_built(self) -> None:
        """Wait until its environments are made, each within the time limit. EnvironmentFault as `wait`."""
        if self._timeout is not None and not self._forked:
            self._set_patience(max(TO_START, self._timeout))
        for index in range(self.first, self.first + self._to_build):
            try:
                self.wait()
            except EnvironmentFault as fault:
                if not fault.lost:
                    raise
                message = f"{fault} It was making environment {index}."
                raise dataclasses.replace(fault, message=message, index=index) from fault.__cause__
            self._set_patience(self._timeout)
        self.wait()

    def last_words(self, deadline: float) -> EnvironmentFault | None:
        """After CLOSE: what went wrong while its environments were closed, None if nothing did.

        One that still owes an answer is not waited for: it hangs, or has been left in the middle of a step.
        """
        if self._owes:
            return None
        try:
            self._set_patience(None if self._timeout is None else max(0.1, deadline - time.monotonic()))
            reply = receive_soon(self._socket, 1, 0.0)
            return EnvironmentFault(**self._receive_json()) if reply == BROKEN else None
        except (TimeoutError, BlockingIOError):
            self._process.kill()
            return EnvironmentFault(
                f"Closing the environments of worker {self.number} of {self.name} was not back after "
                f"{self._timeout:g} s (env_timeout). Mend close() there.",
                self.first,
                env_id=self.name,
                worker=self.number,
            )
        except (OSError, EnvironmentFault):  # it was gone before
            return None

    def carried(self) -> Any:
        """What follows the reply to CARRIED. EnvironmentFault as `wait`."""
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

    def _lost(
        self, what: str, advice: str = "Try vector_backend serial, which shows the environment's own error."
    ) -> EnvironmentFault:
        self._process.join(1.0)
        return EnvironmentFault(
            f"worker {self.number} of {self.name} (environments from {self.first} on) {what} "
            f"(exit code {self._process.exitcode}). {advice}",
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


def first_look(name: str, make: Callable[[], gym.Env], seconds: float = 1.0) -> None:
    """Make, reset and step an environment in a forked child, for at most ``seconds``.

    EnvironmentFault when it ends the process, which would be this one next. What it raises is left to the
    caller, who will meet it. Without effect where processes are not forked (see `start_context`).
    """
    if sys.platform != "linux":
        return
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DeprecationWarning
        )  # of fork beside threads: the child is short-lived
        child = os.fork()
    if not child:
        _look(make, write)
    os.close(write)
    status, give_up = None, time.monotonic() + seconds
    with open(read, "rb", buffering=0) as answer:
        while status is None and not select.select([answer], [], [], 0.01)[0] and time.monotonic() < give_up:
            ended, found = os.waitpid(child, os.WNOHANG)
            status = found if ended else None
        whole = bool(select.select([answer], [], [], 0)[0]) and bool(answer.read(1))
    late = time.monotonic() >= give_up
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)  # and what it has started
    if status is None:
        status = os.waitpid(child, 0)[1]
    if not whole and not late:
        code = os.waitstatus_to_exitcode(status)
        how = f"with exit code {code}" if code >= 0 else f"by {signal.Signals(-code).name}"
        raise EnvironmentFault(
            f"{name} ended its process {how} while it was made, reset or in its first steps (seen in a child "
            "process). Mend the environment, or make what it calls raise an exception instead.",
            0,
            env_id=name,
        )


def _look(make: Callable[[], gym.Env], write: int) -> NoReturn:
    """In the child: a few random steps; an answer through ``write`` when the environment let this process
    live."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):  # the run itself will print what there is to say
        os.dup2(nowhere, descriptor)
    with contextlib.suppress(BaseException):
        env = make()
        env.reset(seed=0)
        for _ in range(10):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
        env.close()
    os.write(write, b"k")
    os._exit(0)


def pack_json(value: object) -> bytes:
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


def in_process_of_its_own(function: Callable[[contextlib.ExitStack], Any], limit: float | None) -> Any:
    """What a function returns in a process of its own, which then has a second to close what is on the stack.

    ``limit``: seconds for the answer. ValueError: it raised, died or hung there.
    """
    ours, theirs = socket.socketpair()
    ours.settimeout(LONGEST_ANSWER if limit is None else limit)
    process = start_context().Process(  # type: ignore[attr-defined]
        target=_answer,
        args=(CloudpickleWrapper(function), theirs),  # type: ignore[arg-type]
        daemon=True,
        name="tightrope-twin",
    )
    process.start()
    theirs.close()
    try:
        (length,) = LENGTH.unpack(receive_all(ours, LENGTH.size))
        found, error = json.loads(receive_all(ours, length))
        process.join(LONGEST_END)
    except (OSError, EOFError) as gone:
        raise ValueError(f"the process with a second copy was lost ({gone})") from gone
    finally:
        ours.close()
        process.kill()
        process.join()
    if error:
        raise ValueError(error)
    return found


def _answer(function: Any, channel: socket.socket) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    close_inherited()
    with contextlib.suppress(*RAISED), contextlib.ExitStack() as stack:
        try:
            answer = (function.fn(stack), "")
        except RAISED as error:
            answer = (None, f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
        channel.sendall(pack_json(answer))
    os._exit(0)  # whatever threads an environment has left
