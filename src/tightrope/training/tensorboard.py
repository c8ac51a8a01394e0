"""A listener that writes the metrics of every update as TensorBoard files, in the folder of the run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from tightrope.training.events import Evaluated, Event, Finished, Started, Updated


class TensorBoard:
    """Raises ValueError if the package is missing."""

    def __init__(self) -> None:
        self._make: Any = require_tensorboard(True)
        self._writer: Any = None
        self._written: set[str] = set()  # names that an evaluation of this update brought

    def __call__(self, event: Event) -> None:
        """Write the scalars of an update or an evaluation; those that are not finite are left out."""
        if isinstance(event, Started):
            # what was written after the checkpoint that the run continues from is hidden
            purge = event.step + 1 if event.step else None
            self._writer = self._make(str(Path(event.run_dir) / "tensorboard"), purge_step=purge)
        elif isinstance(event, Updated | Evaluated):
            for name, value in event.metrics.items():
                if name not in self._written and value is not None and math.isfinite(value):
                    self._writer.add_scalar(name, float(value), event.step)
            self._written = set(event.metrics) if isinstance(event, Evaluated) else set()
            self._writer.flush()
        elif isinstance(event, Finished):
            self._writer.close()


def require_tensorboard(wanted: bool) -> Any:
    """TensorBoard's writer class if it is wanted, else None. ValueError if the package is missing."""
    if not wanted:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError(
            "TensorBoard files are requested, but the package tensorboard is not installed. "
            "Install it with: pip install 'tightrope[tensorboard]', or leave --tensorboard out."
        ) from error
    return SummaryWriter
