"""A decoder cut in two: the part below the first adapted layer is computed once and shared by every role.

lower(tokens) -> hidden states that enter layer ``cut``        frozen, the same for all roles and epochs
upper(hidden) -> hidden states after the final norm            once a role, with its adapter
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from tightrope.language.data.batching import positions
from tightrope.language.model import lora
from tightrope.language.model.architecture import WINDOW_FIELDS, parts

if TYPE_CHECKING:
    from transformers import PreTrainedModel

FINAL_NORMS = ("norm", "ln_f", "final_layer_norm")
NARROW = 3  # tokens of a window while the halves are tried
HALVES_TOLERANCE = 1e-4  # relative; the two halves are the same operations in the same order


class Trunk:
    """The forward pass of one causal language model without its head, in one piece or in two.

    ``cut`` is the number of layers in the lower part; 0 where the model cannot be cut, or need not be.
    Each layer keeps its own kind of attention.
    """

    def __init__(self, model: PreTrainedModel, cut: int = 0, *, checkpointing: bool = False) -> None:
        self.model, self.parts = model, parts(model)
        self.cut = 0
        self._checkpointing = checkpointing
        if checkpointing:
            lora.checkpoint_activations(model)
        if cut > 0 and any(child is self.parts.layers for child in self.parts.base.children()):
            self._lower, self._upper = _halves(self.parts.base, self.parts.layers, cut)
            self.cut = cut if self._agrees(cut) else 0

    def lower(self, tokens: Tensor, real: Tensor) -> Tensor | None:
        """Hidden states [B, T, d] that enter the upper part; None when the trunk is in one piece."""
        if not self.cut:
            return None
        with torch.no_grad():
            return _run(self._lower, real, input_ids=tokens)

    def hidden(self, tokens: Tensor, real: Tensor, lower: Tensor | None = None) -> Tensor:
        """Hidden states [B, T, d] after the final norm; ``lower`` saves the lower part of a trunk in two."""
        if self._checkpointing and torch.is_grad_enabled():
            self.model.train()  # transformers checkpoints only in this mode, and caches only in the other
        try:
            if lower is None or not self.cut:
                return _run(self.parts.base, real, input_ids=tokens)
            return _run(self._upper, real, inputs_embeds=lower)
        finally:
            if self._checkpointing:
                self.model.eval()

    @torch.no_grad()
    def _agrees(self, cut: int) -> bool:
        """Whether two halves give the same as the whole, on a padded batch of this model.

        Attention windows are narrowed meanwhile, so that a few tokens show a layer with a wrong window.
        """
        device = next(self.model.parameters()).device
        tokens = torch.arange(24, device=device).reshape(2, 12) % self.model.config.vocab_size
        real = torch.ones(2, 12, dtype=torch.bool, device=device)
        real[0, :2], real[1, 11:] = False, False
        base, layers = self.parts.base, self.parts.layers
        try:
            with _narrow_windows(base.config):
                lower, upper = _halves(base, layers, cut)
                whole = _run(base, real, input_ids=tokens)
                both = _run(upper, real, inputs_embeds=_run(lower, real, input_ids=tokens))
        except (TypeError, ValueError, RuntimeError, AttributeError, KeyError, IndexError):
            return False  # the layers of this architecture need more than the output of the layer before
        gap = (whole - both)[real].abs().max() / whole[real].abs().max()
        return bool(gap <= (HALVES_TOLERANCE if whole.dtype == torch.float32 else 0.05))


@dataclass(frozen=True)
class Role:
    """One role's forward pass: a trunk, and the adapter that is on in it (None: the bare trunk)."""

    trunk: Trunk
    adapter: str | None = None

    def hidden(self, tokens: Tensor, real: Tensor, lower: Tensor | None = None) -> Tensor:
        """Hidden states [B, T, d] of this role; ``lower``: those of the shared lower layers, if known."""
        switch = getattr(self.trunk.model, "adapter_switch", None)
        if switch is None:
            return self.trunk.hidden(tokens, real, lower)
        before, switch.active = switch.active, self.adapter
        try:
            return self.trunk.hidden(tokens, real, lower)
        finally:
            switch.active = before


def _run(base: nn.Module, real: Tensor, **inputs: Tensor) -> Tensor:
    mask = None if bool(real.all()) else real.long()
    return base(
        attention_mask=mask, position_ids=positions(real), use_cache=False, **inputs
    ).last_hidden_state


def _halves(base: nn.Module, layers: nn.ModuleList, cut: int) -> tuple[nn.Module, nn.Module]:
    """Two shallow copies of the base, each with some of its layers; they share the weights of the base."""
    lower, upper = _shallow(base), _shallow(base)
    for half, own in ((lower, slice(0, cut)), (upper, slice(cut, len(layers)))):
        name = next(name for name, module in base.named_children() if module is layers)
        half._modules[name] = layers[own]
        config: Any = copy.copy(base.config)
        config.num_hidden_layers = len(layers[own])
        if getattr(config, "layer_types", None):  # a layer's attention is looked up by its place
            config.layer_types = list(config.layer_types[own])
        half.config = config
    for name in FINAL_NORMS:
        if name in lower._modules:
            lower._modules[name] = nn.Identity()
    if "wpe" in upper._modules:  # GPT-2 adds positions to whatever enters its first layer
        upper._modules["wpe"] = _Nothing()
    return lower, upper


@contextlib.contextmanager
def _narrow_windows(config: object) -> Iterator[None]:
    """Inside, layers that look back over a window of tokens look over a narrow one."""
    before = {name: getattr(config, name, None) for name in WINDOW_FIELDS}
    for name, size in before.items():
        if size is not None:
            setattr(config, name, NARROW)
    try:
        yield
    finally:
        for name, size in before.items():
            if size is not None:
                setattr(config, name, size)


def _shallow(module: nn.Module) -> nn.Module:
    twin = copy.copy(module)
    twin._modules = dict(module._modules)
    return twin


class _Nothing(nn.Module):
    """Takes the place of an embedding that is already added."""

    def forward(self, positions: Tensor) -> Tensor:
        return torch.zeros((), device=positions.device)
