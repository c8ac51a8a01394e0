"""Memory runs out while responses are sampled or scored: what is tried next, and the advice."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

from tightrope.algorithms.memory import OutOfMemory, free, is_out_of_memory
from tightrope.language.policy.roles import Roles

F = TypeVar("F", bound=Callable[..., Any])


def advising_on_memory(function: F) -> F:
    """``function(roles, ...)``, which where memory runs out does without ``keep``; without it an OutOfMemory
    says which setting to lower.
    """

    @functools.wraps(function)
    def advising(roles: Roles, *args: Any, **how: Any) -> Any:
        try:
            return function(roles, *args, **how)
        except (RuntimeError, MemoryError) as error:
            if isinstance(error, OutOfMemory) or not is_out_of_memory(error):
                raise
            if not how.get("keep"):
                raise _advice(roles, error) from error
        # outside the except clause, which keeps the failed pass's tensors alive
        free()
        found = advising(roles, *args, **{**how, "keep": False})
        found.short_of_memory = True
        return found

    return cast(F, advising)


def _advice(roles: Roles, error: BaseException) -> OutOfMemory:
    reason = (str(error).splitlines() or [""])[0][:200]
    return OutOfMemory(
        f"Memory is not enough to sample {roles.settings.batch_size} responses at once ({reason}). Choose a "
        "smaller --batch-size, --max-new-tokens or --max-prompt-tokens; --micro-batch-size makes the pass "
        "over the finished responses smaller."
    )
