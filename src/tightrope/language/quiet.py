"""Keeps libraries quiet while a run is shown: no progress bars, deprecations or log lines of theirs."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator

NOISY_LIBRARIES = r"(tightrope|transformers|torch|tokenizers|huggingface_hub|peft|safetensors)(\.|$)"


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """Inside, transformers and the hub show no progress bars and log errors only; both are put back after.

    Deprecations are for those who write code, so the libraries' are hidden. The filter is the last
    in the list: what a caller has asked for, such as ``-W error``, comes before it. Also a decorator.
    """
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars
    from transformers.utils import logging

    level, bars, hub_bars_off = (
        logging.get_verbosity(), logging.is_progress_bar_enabled(), are_progress_bars_disabled()
    )  # fmt: skip
    logging.set_verbosity_error()
    with _no_warning_of_the_hub():
        logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning, module=NOISY_LIBRARIES, append=True)
            yield
    finally:
        logging.set_verbosity(level)
        if bars:
            with _no_warning_of_the_hub():
                logging.enable_progress_bar()  # switches the hub's bars on too
                if hub_bars_off:
                    disable_progress_bars()


@contextlib.contextmanager
def _no_warning_of_the_hub() -> Iterator[None]:
    """The hub warns when HF_HUB_DISABLE_PROGRESS_BARS decides and a call cannot."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Cannot (en|dis)able progress bars", category=UserWarning)
        yield
