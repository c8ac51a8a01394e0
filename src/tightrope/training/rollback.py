"""Going back to the newest checkpoint after a NaN or an infinity, so often and no more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

from tightrope.runs.history import Checkpoint
from tightrope.runs.run import Run

T = TypeVar("T")


def rolling_back(
    updates: Callable[[], Iterator[T]],
    run: Run,
    go_back: Callable[[Checkpoint], int],
    tell: Callable[[str], None],
    *,
    limit: int,
    taken: int = 0,
) -> Iterator[T]:
    """What ``updates()`` yields; after a FloatingPointError it begins again at the run's newest checkpoint,
    with what was recorded behind it forgotten.

    ``go_back`` restores a checkpoint and gives its step; it must see to it that other random numbers are
    drawn from there, or the same would happen again. ``tell`` gets a line each time. The error itself is
    raised after ``limit`` times, of which ``taken`` are behind the run, and where there is no checkpoint.
    """
    while True:
        try:
            yield from updates()
            return
        except FloatingPointError as error:
            if taken >= limit:
                raise
            reason = str(error).splitlines()[0]
            try:
                point = run.resume_point(tell)
                run.rewind(point)
                step = go_back(point)
            except ValueError as missing:
                raise type(error)(f"{error} There is no checkpoint to go back to: {missing}") from error
        taken += 1
        tell(
            f"warning: {reason} Going back to the checkpoint of step {step}, {taken} of {limit} times at "
            "most (max_rollbacks), with other random numbers from there."
        )
