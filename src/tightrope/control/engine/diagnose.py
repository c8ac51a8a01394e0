"""What to say when a step was refused: the first number that is not finite, and where it lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

ADVICE = "That step was not taken and the weights are as before it."
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
            return f"The weight {name}{index} is {parameter[tuple(index)].item()} {where}; expected a finite number. {ADVICE}"
    found = None
    for name, column in zip(NAMES, columns, strict=True):
        if len(column) == 0 or column.dtype == bool:
            continue
        bad = ~np.isfinite(column[rows].reshape(len(rows), -1))
        if bad.any() and (found is None or int(np.argmax(bad.any(1))) < found[0]):
            first = int(np.argmax(bad.any(1)))
            found = first, name, column[rows[first]].reshape(-1)[int(np.argmax(bad[first]))]
    if found is None:
        found = _outputs(engine, columns, rows)
    if found is None:
        return (
            f"The gradient holds a NaN or an infinity {where}, all of its data and weights being finite: it overflowed. "
            f"{ADVICE} Look for extreme rewards or observations, or a learning rate that is too high."
        )
    row = int(rows[found[0]])
    place = f"row {row} (environment {row // steps}, step {row % steps})"
    return f"The {found[1]} is {found[2]} {where}, {place}; expected a finite number. {ADVICE} Look for its source there."


def _outputs(engine: Any, columns: list[np.ndarray], rows: np.ndarray) -> tuple[int, str, float] | None:
    """The first row whose logit or value is not finite."""
    policy, flat = engine.policy, torch.from_numpy(columns[0][rows])
    with torch.no_grad():
        features = flat if policy.trunk is None else policy.trunk(flat)
        outputs = {"logit": policy.actor(features).numpy(), "value": policy.critic(features).numpy()}
    for name, numbers in outputs.items():
        bad = ~np.isfinite(numbers)
        if bad.any():
            first = int(np.argmax(bad.any(1)))
            return first, name, float(numbers[first][int(np.argmax(bad[first]))])
    return None


def mismatch(worst: float, limit: float | None) -> str:
    """The first ratios are not 1."""
    return (
        f"Before any update the log-probabilities differ by {worst:.3g} from those that sampled (limit {limit:g}). "
        "Sampling and training disagree. Likely causes: a normaliser that moved between rollout and update, another "
        "action mask in training, or weights changed after sampling."
    )
