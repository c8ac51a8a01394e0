"""Points of a run at which something is due, told from two steps alone: nothing to keep or to restore."""

from __future__ import annotations


def crosses(before: float, after: float, total: float, fraction: float | None) -> bool:
    """Whether ``fraction * total``, ``2 fraction * total``, ... has a member in (before, after].

    Several at once count as one; ``fraction`` None: there are no points. The total itself is one where the
    fraction divides it. Steps that miss a point by a rounding error of their share have reached it.
    """
    if fraction is None:
        return False
    first, last = (int(step / total / fraction + 1e-9) for step in (before, after))
    return last > first
