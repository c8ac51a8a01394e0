"""The process of the command: ``tightrope`` and ``python -m tightrope``."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal
import sys
from typing import NoReturn

SECONDS_TO_END = 5.0  # for what user code has left running


def run() -> None:
    """Run the command line and end the process with its exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # which would print a traceback while modules are imported
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(128 + number))
    with contextlib.suppress(OSError, ValueError, AttributeError):  # no stream, or one without a file
        faulthandler.enable()  # a crash in native code of an environment says where
    _tell_of_exits()
    from tightrope.cli.main import main

    code = 1
    try:
        code = main()
    finally:
        _leave_behind(code)
    sys.exit(code)


def _tell_of_exits() -> None:
    """``os._exit`` in an environment or a reward function would end the process without a word, and with the
    code 0 for half a run.
    """
    ends, process = os._exit, os.getpid()

    def end(status: int) -> NoReturn:
        caller = str(sys._getframe(1).f_globals.get("__name__"))
        if os.getpid() == process and caller.partition(".")[0] not in ("tightrope", "__main__"):
            print(
                f"tightrope: os._exit({status}) was called in {caller}: the process ends and the run is not "
                "finished. A run folder can be resumed; --vector-backend workers keeps environments out of "
                "this process.",
                file=sys.stderr,
                flush=True,
            )
            status = status or 1
        ends(status)

    os._exit = end


def _leave_behind(code: int) -> None:
    """Python waits at its end for threads that are no daemons, and for child processes. Those that an
    environment has left must not keep the process alive: they are named and left behind.
    """
    import threading
    import time

    def end() -> None:
        time.sleep(SECONDS_TO_END)
        left = [thread.name for thread in threading.enumerate() if not thread.daemon]
        left = [name for name in left if name != threading.main_thread().name]
        what = f"the threads {', '.join(left)}" if left else "child processes"
        print(
            f"tightrope: the process ends without waiting for {what}, left running by an environment or a "
            "library.",
            file=sys.stderr,
            flush=True,
        )
        os._exit(code)

    threading.Thread(target=end, daemon=True).start()


if __name__ == "__main__":
    run()
