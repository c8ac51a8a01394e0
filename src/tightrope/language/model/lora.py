"""Low-rank adapters on one frozen trunk, several side by side, chosen by a context and nothing else.

    y = W x + (alpha / rank) B A x        (Hu et al. 2021, arXiv 2106.09685)

A role is a forward pass with one adapter on, or none. Choosing it changes no requires_grad, so gradients that
an earlier role left in the graph stay where they belong (PEFT's set_adapter freezes the adapters it switches
off, and a backward pass that comes later drops their gradients silently).
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from tightrope.language.model.architecture import accepted, computes_linear, parts

if TYPE_CHECKING:
    from transformers import PreTrainedModel


ROUNDING = 1e-5  # relative; two equal passes, whose sums a GPU may add up in another order


class Switch:
    """Which adapter the forward passes of one model use now; None is the bare trunk. ``folded``: as one
    weight.
    """

    def __init__(self) -> None:
        self.active: str | None = None
        self.folded = False


class Adapted(nn.Module):
    """A linear layer of the trunk with its adapters; the layer itself is ``base``, frozen.

    Some models read a layer's weight instead of calling it (Jamba's dt_proj): ``weight`` is then the one that
    is on, adapter included. Everything else that a layer is asked for is its base's.
    """

    def __init__(self, base: nn.Module, switch: Switch) -> None:
        super().__init__()
        self.base, self._switch = base, switch
        self.read = False  # whether a model has read the weight of an adapter that is on
        self.down, self.up = nn.ParameterDict(), nn.ParameterDict()
        self._scale: dict[str, float] = {}
        self._folded: dict[str, Tensor] = {}

    @property
    def weight(self) -> Tensor:
        """The weight of the adapter that is on, differentiable in it."""
        name = self._switch.active
        if name is None or name not in self.down:
            return self.base.weight  # type: ignore[return-value]
        self.read = True
        return self.merged(name)

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name == "base":
                raise
            return getattr(self.base, name)

    @property
    def transposed(self) -> bool:
        """GPT-2 keeps its weights [in, out]."""
        return not isinstance(self.base, nn.Linear)

    def add(self, name: str, rank: int, alpha: float, generator: torch.Generator) -> None:
        """A new adapter: A uniform as a linear layer's weight, B 0, so that it begins as the bare trunk."""
        weight: Tensor = self.base.weight  # type: ignore[assignment]
        outputs, inputs = weight.shape[::-1] if self.transposed else weight.shape
        bound = 1 / math.sqrt(inputs)
        down = torch.rand(rank, inputs, generator=generator) * 2 * bound - bound
        self.down[name] = nn.Parameter(down.to(weight.device))
        self.up[name] = nn.Parameter(torch.zeros(outputs, rank, device=weight.device))
        self._scale[name] = alpha / rank

    def forward(self, x: Tensor) -> Tensor:
        """The layer, and the adapter that is on."""
        name = self._switch.active
        if name is None or name not in self.down:
            return self.base(x)
        if self._switch.folded:
            if name not in self._folded:
                self._folded[name] = self.merged(name).detach()
            return self._linear(x, self._folded[name])
        if self._narrow(name):
            return self._linear(x, self.merged(name))
        flat = x.reshape(-1, x.shape[-1])
        low, up = flat @ self.down[name].to(x.dtype).T, self.up[name].to(x.dtype).T
        return self.base(flat).addmm_(low, up, alpha=self._scale[name]).view(*x.shape[:-1], -1)

    def _narrow(self, name: str) -> bool:
        """Whether W + BA as one matrix costs less than x A and (x A) B beside x W, forwards and back."""
        rank, inputs = self.down[name].shape
        outputs = self.up[name].shape[0]
        return inputs * outputs <= 3 * rank * (inputs + outputs)

    def _linear(self, x: Tensor, weight: Tensor) -> Tensor:
        bias: Tensor | None = self.base.bias  # type: ignore[assignment]
        return nn.functional.linear(x, weight.T if self.transposed else weight, bias)

    def unfold(self) -> None:
        """Forget folded weights: the adapters may change from here on."""
        self._folded.clear()

    def merged(self, name: str) -> Tensor:
        """The weight with an adapter folded in."""
        weight: Tensor = self.base.weight  # type: ignore[assignment]
        first, second = self.up[name], self.down[name]
        if self.transposed:
            first, second = second.T, first.T
        return torch.addmm(weight.float(), first, second, alpha=self._scale[name]).to(weight.dtype)


def top_layers(model: PreTrainedModel, count: int | None) -> tuple[int, ...]:
    """Indices of the ``count`` topmost decoder layers (None: all). ValueError: the model has fewer."""
    total = len(parts(model).layers)
    if count is not None and count > total:
        raise ValueError(f"lora_layers is {count}, but the model has {total} layers.")
    return tuple(range(total - (count or total), total))


def add_adapter(
    model: Any, name: str, rank: int, alpha: float, layers: tuple[int, ...] | None = None, seed: int = 0
) -> None:
    """Adapters called ``name`` on every linear layer of these decoder layers (None: all); freezes the trunk.

    The model must not have one of this name. The first adapter of a model puts `Adapted` in the place of its
    linear layers.
    """
    if name in adapter_names(model):
        raise ValueError(f"The model already has an adapter {name!r}; choose another name.")
    switch = getattr(model, "adapter_switch", None)
    if switch is None:
        switch = model.adapter_switch = Switch()
        for parameter in model.parameters():
            parameter.requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    stack = parts(model).layers
    for index in range(len(stack)) if layers is None else layers:
        for owner in list(stack[index].modules()):
            if isinstance(owner, Adapted):
                owner.add(name, rank, alpha, generator)
                continue
            for child, module in list(owner.named_children()):
                if computes_linear(module) and child != "base":
                    adapted = Adapted(module, switch)
                    adapted.add(name, rank, alpha, generator)
                    setattr(owner, child, adapted)


def adapter_names(model: nn.Module) -> set[str]:
    """The adapters that a model has."""
    return {name for module in model.modules() if isinstance(module, Adapted) for name in module.down}


@contextlib.contextmanager
def using(model: PreTrainedModel, name: str | None) -> Iterator[None]:
    """Forward passes inside use this adapter (None: the bare trunk); nothing else changes."""
    switch = getattr(model, "adapter_switch", None)
    if switch is None:
        if name is not None:
            raise ValueError(f"The model has no adapter {name!r}: it has none at all.")
        yield
        return
    before, switch.active = switch.active, name
    try:
        yield
    finally:
        switch.active = before


@contextlib.contextmanager
def folded(model: PreTrainedModel, name: str | None) -> Iterator[None]:
    """`using`, for many passes between two updates: each weight and its adapter are added up once. No
    gradients.
    """
    switch = getattr(model, "adapter_switch", None)
    with using(model, name), torch.no_grad():
        if switch is not None:
            switch.folded = True
        try:
            yield
        finally:
            if switch is not None:
                switch.folded = False
            for module in model.modules() if switch is not None else ():
                if isinstance(module, Adapted):
                    module.unfold()


def checkpoint_activations(model: PreTrainedModel) -> None:
    """Compute activations again in the backward pass, with the adapter that was on in the forward pass, where
    `training_mode` is on. ValueError for an architecture that cannot.
    """
    enable = getattr(model, "activation_checkpointing_enable", None) or model.gradient_checkpointing_enable

    def contexts() -> tuple[Any, Any]:
        switch = getattr(model, "adapter_switch", None)
        return contextlib.nullcontext(), using(model, None if switch is None else switch.active)

    try:
        enable({"use_reentrant": False, "context_fn": contexts})
    except ValueError as error:
        raise ValueError(
            f"{type(model).__name__} cannot compute activations again in the backward pass ({error}). Leave "
            "--gradient-checkpointing out."
        ) from error
    for layer in _checkpointed(model):
        config: Any = getattr(layer, "config", None)
        random = [
            name for name, x in vars(config or object).items() if isinstance(x, float) and "drop" in name
        ]
        if any(getattr(config, name) for name in random):
            layer.config = copy.copy(config)  # a layer of Falcon reads its dropout there
            for name in random:
                setattr(layer.config, name, 0.0)


def training_mode(model: PreTrainedModel, on: bool) -> None:
    """transformers checkpoints activations only in training mode. Only the modules that do so are put into
    it: whatever else reads the mode, such as dropout, layer dropping or the noise of a router, stays as it is
    in evaluation.
    """
    for layer in _checkpointed(model):
        layer.training = on


def _checkpointed(model: nn.Module) -> list[Any]:
    """The modules whose activations are checkpointed: decoder layers, or else whole stacks of them."""
    found = [module for module in model.modules() if getattr(module, "gradient_checkpointing", False)]
    return [module for module in found if not hasattr(module, "config_class")] or found


@torch.no_grad()
def require_repeatable(model: PreTrainedModel) -> None:
    """ValueError unless two forward passes in the present mode are equal: nothing draws random numbers."""
    if not repeats(model):
        raise ValueError(
            f"Two forward passes of {type(model).__name__} (model type {model.config.model_type}) over the "
            "same tokens differ: a module draws random numbers (dropout of a kind that is not known here). "
            "Set it to 0 in config.json, or leave --gradient-checkpointing out."
        )


@torch.no_grad()
def repeats(model: PreTrainedModel) -> bool:
    """Whether two forward passes over a few tokens are equal up to the rounding of parallel sums."""
    base, _, head = parts(model)
    tokens = torch.arange(8, device=head.weight.device)[None] % head.out_features
    inputs = accepted(base, input_ids=tokens, use_cache=False)
    one, two = (base(**inputs).last_hidden_state.float() for _ in range(2))
    return bool((one - two).abs().max() <= ROUNDING * one.abs().max())


@torch.no_grad()
def read_only(model: PreTrainedModel, name: str) -> list[str]:
    """The paths of the adapted layers whose weight the model reads in a forward pass and never calls."""
    base, _, head = parts(model)
    adapted = {path: m for path, m in model.named_modules() if isinstance(m, Adapted) and name in m.down}
    called: set[nn.Module] = set()
    handles = [m.register_forward_hook(lambda module, *_: called.add(module)) for m in adapted.values()]
    for module in adapted.values():
        module.read = False
    try:
        with using(model, name):
            tokens = torch.arange(8, device=head.weight.device)[None] % head.out_features
            base(**accepted(base, input_ids=tokens, use_cache=False))
    finally:
        for handle in handles:
            handle.remove()
    return [path for path, module in adapted.items() if module.read and module not in called]


def adapter_parameters(model: nn.Module, name: str) -> list[nn.Parameter]:
    """The weights of one adapter, in the order of the layers."""
    found = [m for m in model.modules() if isinstance(m, Adapted) and name in m.down]
    return [parameter for module in found for parameter in (module.down[name], module.up[name])]


def adapter_state(model: nn.Module, name: str) -> dict[str, Tensor]:
    """The weights of one adapter under PEFT's names, without the adapter's own."""
    state = {}
    for path, module in model.named_modules():
        if isinstance(module, Adapted) and name in module.down:
            state[f"base_model.model.{path}.lora_A.weight"] = module.down[name].detach()
            state[f"base_model.model.{path}.lora_B.weight"] = module.up[name].detach()
    return state


def load_adapter_state(model: nn.Module, name: str, state: dict[str, Tensor]) -> None:
    """Copy weights as `adapter_state` names them into an adapter. ValueError when they do not fit it."""
    mine = adapter_state(model, name)
    wrong = sorted(set(mine) ^ (set(state) & {k for k in state if ".lora_" in k}))
    wrong += [k for k in mine if k in state and mine[k].shape != state[k].shape]
    if wrong:
        raise ValueError(
            f"The adapter does not fit this model: {wrong[0]} and {len(wrong) - 1} others differ. Was it "
            "trained on another model, rank or number of layers?"
        )
    with torch.no_grad():
        for key, tensor in mine.items():
            tensor.copy_(state[key])


def merged_state(model: nn.Module, name: str | None) -> dict[str, Tensor]:
    """The model's plain state dict, the names it had before adapters, with one adapter folded in."""
    state: dict[str, Tensor] = {}
    folded: dict[str, Tensor] = {}
    for path, module in model.named_modules():
        if isinstance(module, Adapted) and name is not None and name in module.down:
            folded[f"{path}.weight"] = module.merged(name)
    for key, tensor in model.state_dict().items():
        if ".down." in key or ".up." in key:
            continue
        plain = key.replace(".base.", ".")
        state[plain] = folded.get(plain, tensor).detach()
    return state
