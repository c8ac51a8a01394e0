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
from tightrope.language.model.architecture import MISFITS, WINDOW_FIELDS, accepted, parts, relative_gap

if TYPE_CHECKING:
    from transformers import PreTrainedModel

FINAL_NORMS = ("norm", "ln_f", "final_layer_norm")
NARROW = 3  # tokens of a window while the halves are tried
# relative, in bfloat16 and in float32; the two halves are the same operations in the same order
HALVES_TOLERANCE = 0.05, 1e-4
PADDING_TOLERANCE = 0.1, 1e-2  # relative; a layer that reads padding changes the states by their own size


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
            lora.training_mode(model, True)
            lora.require_repeatable(model)
            lora.training_mode(model, False)
        if cut > 0 and any(child is self.parts.layers for child in self.parts.base.children()):
            self._cut_in_two(cut)

    def lower(self, tokens: Tensor, real: Tensor) -> Tensor | None:
        """Hidden states [B, T, d] that enter the upper part; None when the trunk is in one piece."""
        if not self.cut:
            return None
        with torch.no_grad():
            return _run(self._lower, real, input_ids=tokens)

    def hidden(self, tokens: Tensor, real: Tensor, lower: Tensor | None = None) -> Tensor:
        """Hidden states [B, T, d] after the final norm; ``lower`` saves the lower part of a trunk in two."""
        if self._checkpointing and torch.is_grad_enabled():
            lora.training_mode(self.model, True)  # caches are kept only in the other
        try:
            if lower is None or not self.cut:
                return _run(self.parts.base, real, input_ids=tokens)
            return _run(self._upper, real, inputs_embeds=lower)
        finally:
            if self._checkpointing:
                lora.training_mode(self.model, False)

    @torch.no_grad()
    def _cut_in_two(self, cut: int) -> None:
        """Make the two halves and use them where they give the same as the whole, on a padded batch.

        Attention windows are narrowed meanwhile, so that a few tokens show a layer with a wrong window.
        """
        tokens, real = self._few_tokens()
        base, layers = self.parts.base, self.parts.layers
        try:
            with _narrow_windows(base.config):
                lower, upper = _halves(base, layers, cut)
                whole = _run(base, real, input_ids=tokens)
                both = _run(upper, real, inputs_embeds=_run(lower, real, input_ids=tokens))
            self._lower, self._upper = _halves(base, layers, cut)
        except MISFITS:
            return  # the layers of this architecture need more than the output of the layer before
        if relative_gap(both[real], whole[real]) <= HALVES_TOLERANCE[whole.dtype == torch.float32]:
            self.cut = cut

    def _few_tokens(self) -> tuple[Tensor, Tensor]:
        """Two rows [2, 12], one padded on the left, one on the right, and their mask."""
        device = next(self.model.parameters()).device
        tokens = torch.arange(24, device=device).reshape(2, 12) % self.parts.head.out_features
        real = torch.ones(2, 12, dtype=torch.bool, device=device)
        real[0, :2], real[1, 11:] = False, False
        return tokens, real

    @torch.no_grad()
    def require_padding_unread(self) -> None:
        """ValueError for a model whose hidden states depend on the padding of a row: on how much there is, or
        on its ids. Prompts are padded on the left.
        """
        tokens, real = self._few_tokens()
        apart = _run(self.parts.base, real[:1, 2:], input_ids=tokens[:1, 2:])
        beside = _run(self.parts.base, real, input_ids=torch.where(real, tokens, 1))[:1, 2:]
        gap = relative_gap(beside, apart)
        if not gap <= PADDING_TOLERANCE[apart.dtype == torch.float32]:
            raise ValueError(
                f"{type(self.model).__name__} (model type {self.model.config.model_type}) computes other "
                f"hidden states for a text that is padded on the left (relative difference {gap:.1e}): its "
                "attention mask or positions are not respected, so that what is sampled would depend on the "
                "other prompts of a batch. Use it with sft only, or choose another model."
            )


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
    options = accepted(base, attention_mask=mask, position_ids=positions(real), use_cache=False)
    return base(**inputs, **options).last_hidden_state


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
