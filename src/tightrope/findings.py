"""What a check found, as ``tightrope doctor`` prints it."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """One thing that was looked at: what, whether it is as it should be, what was seen, what to do if not."""

    what: str
    good: bool
    seen: str
    advice: str = ""
