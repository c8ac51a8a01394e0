"""The result of a check, as ``tightrope doctor`` prints it."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """One check: its subject, whether it passed, what was seen, and what to do if it failed."""

    what: str
    good: bool
    seen: str
    advice: str = ""
