"""Whether an episode reached its goal: ``info["is_success"]`` of its last step, where a task gives it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tightrope.control.environments.faults import ApiBreak

SUCCESS_KEY = "is_success"


def success_of(info: dict[str, Any]) -> float:
    """The number in the info of an episode's last step, 1 for True; NaN: it says nothing. ApiBreak for what
    is no number.
    """
    value = info.get(SUCCESS_KEY)
    if value is None:
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ApiBreak(f"info[{SUCCESS_KEY!r}] is {value!r}, expected True or False") from None


def vector_success(infos: dict[str, Any], ended: np.ndarray) -> np.ndarray | None:
    """float64 [B]: `success_of` for the rows that ``ended`` in this step, NaN elsewhere; None: none tells.

    Where the row is reset in the same step, its last info is in ``final_info``.
    """
    finals = infos.get("final_info", infos)
    if isinstance(finals, dict) and SUCCESS_KEY not in finals:
        return None
    found = np.full(len(ended), np.nan)
    for row in np.flatnonzero(ended):
        if not isinstance(finals, dict):  # an array with an info a row
            info = finals[row] or {}
        else:
            info = (
                {SUCCESS_KEY: finals[SUCCESS_KEY][row]} if finals.get(f"_{SUCCESS_KEY}", ended)[row] else {}
            )
        found[row] = success_of(info)
    return found
