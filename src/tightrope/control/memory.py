"""The memory that a run takes at least, from its settings: what is too much is refused before it is taken."""

from __future__ import annotations

import math
from itertools import pairwise

from tightrope.control.settings import TrainSettings
from tightrope.control.spaces import ActionLayout, ObservationLayout
from tightrope.training.memory import SHARE, DoesNotFit, available_memory

FLOAT = 4
STEP_BYTES = 48  # of a step beside its observation and action: rewards, values, advantages, flags, twice


def require_fit(
    settings: TrainSettings,
    observations: ObservationLayout | None = None,
    actions: ActionLayout | None = None,
    *,
    own_policy: bool = False,
) -> None:
    """DoesNotFit when rollout and networks need more memory than there is. Without layouts, before an
    environment is made, observation and action count as one number each.
    """
    size = 1 if observations is None else observations.size
    pixels = 0 if observations is None else sum(math.prod(shape) for shape in observations.image_shapes)
    columns = 1 if actions is None else actions.num_columns + actions.num_logits
    steps = settings.num_envs * settings.num_steps
    copies = 2 if settings.normalise_observations else 1
    rollout = steps * (STEP_BYTES + FLOAT * (copies * size + columns) + pixels)
    weights = 0
    if not own_policy:
        half = sum((n + 1) * m for n, m in pairwise([size, *settings.hidden, columns]))
        weights = 4 * FLOAT * (half if settings.shared else 2 * half)  # with gradients and Adam's moments
    available = available_memory("cpu")
    if available is None or rollout + weights <= SHARE * available:
        return
    large = max(rollout, weights)
    advice = "num_envs or num_steps" if large == rollout else "hidden"
    raise DoesNotFit(
        f"A rollout of num_envs {settings.num_envs:,} * num_steps {settings.num_steps:,} steps takes "
        f"{_gigabytes(rollout)}, the networks of hidden {' '.join(map(str, settings.hidden))} with Adam's "
        f"moments {_gigabytes(weights)}; {_gigabytes(available)} of memory are available. Choose a smaller "
        f"{advice}."
    )


def _gigabytes(size: float) -> str:
    return f"{size / 1e9:,.1f} GB"
