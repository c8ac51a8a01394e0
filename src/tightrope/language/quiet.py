"""What libraries print while a run is shown: no progress bars, no deprecations of theirs, no log lines."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator

LIBRARIES = r"(tightrope|transformers|torch|tokenizers|huggingface_hub|peft|safetensors)(\.|$)"


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Inside, transformers and the hub show no progress bars and log errors only; both are put back after.

    Deprecations are for those who write code, so the libraries' are hidden. The filter comes last in the
    list: whatever a caller has asked for, ``-W error`` for one, comes before it. Also a decorator.
    """
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning, module=LIBRARIES, append=True)
            yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
