"""What to say when a step was refused: the first number that is not finite, and where it lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

EXPECTED = "expected a finite number. That step was not taken and the weights are as before it."
NAMES = ("observation", "action mask", "action", "old_logp", "old value", "advantage", "return")


def describe(
    engine: Any, columns: list[np.ndarray], rows: np.ndarray, epoch: int, number: int, steps: int
) -> str:
    """One message for a minibatch of these rows of the flattened [B, T] batch (``steps`` = T)."""
    where = f"in minibatch {number + 1} of epoch {epoch + 1}"
    for name, parameter in engine.policy.named_parameters():
        bad = ~torch.isfinite(parameter.detach())
        if bool(bad.any()):
            index = bad.nonzero()[0].tolist()
            number_there = parameter.detach()[tuple(index)].item()
            return f"The weight {name}{index} is {number_there} {where}; {EXPECTED}"
    found = _data(columns, rows) or _outputs(engine, columns, rows)
    if found is None:
        return (
            f"The gradient overflowed {where}: it holds a NaN or an infinity though all data and weights are "
            "finite. That step was not taken and the weights are as before it. Look for extreme rewards or "
            "observations, or a learning rate that is too high."
        )
    row = int(rows[found[0]])
    place = f"row {row} (environment {row // steps}, step {row % steps})"
    return f"The {found[1]} is {found[2]} {where}, {place}; {EXPECTED} Look for its source there."


def _data(columns: list[np.ndarray], rows: np.ndarray) -> tuple[int, str, float] | None:
    """The first row that holds a bad number, which column it is in, and the number."""
    found: tuple[int, str, float] | None = None
    for name, column in zip(NAMES, columns, strict=True):
        if len(column) == 0 or column.dtype == bool:
            continue
        here = _first(column[rows].reshape(len(rows), -1), name)
        if here is not None and (found is None or here[0] < found[0]):
            found = here
    return found


def _outputs(engine: Any, columns: list[np.ndarray], rows: np.ndarray) -> tuple[int, str, float] | None:
    """The first row whose logit or value is not finite."""
    policy, flat = engine.policy, torch.from_numpy(columns[0][rows])
    with torch.no_grad():
        features = flat if policy.trunk is None else policy.trunk(flat)
        logits, values = policy.actor(features).numpy(), policy.critic(features).numpy()
    return _first(logits, "logit") or _first(values, "value")


def _first(matrix: np.ndarray, name: str) -> tuple[int, str, float] | None:
    bad = ~np.isfinite(matrix)
    if not bad.any():
        return None
    row = int(np.argmax(bad.any(1)))
    return row, name, float(matrix[row][int(np.argmax(bad[row]))])


def mismatch(worst: float, limit: float | None) -> str:
    """The first ratios are not 1."""
    return (
        f"Before any update the log-probabilities differ by {worst:.3g} from those that sampled (limit "
        f"{limit:g}). Sampling and training disagree. Likely causes: a normaliser that moved between rollout "
        "and update, another action mask in training, or weights changed after sampling."
    )
