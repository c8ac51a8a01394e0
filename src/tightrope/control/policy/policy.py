"""Actors and critics: networks that turn encoded observations into action distributions and values."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor, nn

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.control.policy.distributions import Distribution, bounded
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.actions import ActionLayout
from tightrope.control.spaces.observations import ObservationLayout, channels_last
from tightrope.control.spaces.structure import Inputs

InputTensors = dict[str, Tensor]
ACTIVATION_LAYERS: dict[str, type[nn.Module]] = {
    "tanh": nn.Tanh,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "silu": nn.SiLU,
}


def mlp(
    sizes: list[int], activation: str, last_gain: float | None, generator: torch.Generator
) -> nn.Sequential:
    """Linear layers with the activation between them; orthogonal weights of gain sqrt 2, biases 0.

    ``last_gain``: gain of the last layer, which then has no activation after it; None: all layers are hidden
    ones.
    """
    layers: list[nn.Module] = []
    for i, (n_in, n_out) in enumerate(pairwise(sizes)):
        final = last_gain is not None and i == len(sizes) - 2
        layers.append(_orthogonal(nn.Linear(n_in, n_out), last_gain if final else math.sqrt(2.0), generator))
        if not final:
            layers.append(ACTIVATION_LAYERS[activation]())
    return nn.Sequential(*layers)


# a module of the user, or a function of (observation space, action space) that returns one
OwnPolicy = nn.Module | Callable[..., nn.Module]


def _orthogonal(layer: Any, gain: float | None, generator: torch.Generator) -> Any:
    nn.init.orthogonal_(layer.weight, gain=1.0 if gain is None else gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


class ImageEncoder(nn.Module):
    """Images [N, *shape] to features [N, 512]: convolutions as in Mnih et al. 2015, smaller for small ones.

    Channels may come first or last (the shorter of the two axes) or be missing. Each number is first moved
    from its bounds to [0, 1]: (x - low) / (high - low), bytes of 0..255 divided by 255 (``old``: always).
    """

    low: Tensor | None
    width: Tensor

    def __init__(self, space: Box, generator: torch.Generator, old: bool = False) -> None:
        super().__init__()
        shape = space.shape
        self.rank = len(shape)
        self.channels_last = channels_last(shape)
        low, high = space.low.astype(np.float32), space.high.astype(np.float32)
        bounds = [np.zeros(()), np.full((), 255.0)] if old else [low, np.where(high > low, high - low, 1.0)]
        for name, values in zip(("low", "width"), bounds, strict=True):  # not saved: they are the space's
            one = values.flat[0]  # where all elements have the same bounds, one number broadcasts faster
            buffer = torch.as_tensor(one if (values == one).all() else values, dtype=torch.float32)
            self.register_buffer(name, buffer if buffer.any() else None, persistent=False)
        channels, *sides = {
            True: (shape[-1], *shape[:-1]),
            False: shape if self.rank == 3 else (1, *shape),
        }[self.channels_last]
        plan = [(32, 8, 4), (64, 4, 2), (64, 3, 1)] if min(sides) >= 36 else [(16, 3, 1), (32, 3, 2)]
        layers: list[nn.Module] = []
        for width, kernel, stride in plan:
            layers += [
                _orthogonal(nn.Conv2d(channels, width, kernel, stride), math.sqrt(2.0), generator),
                nn.ReLU(),
            ]
            channels, sides = width, [(side - kernel) // stride + 1 for side in sides]
        linear = _orthogonal(nn.Linear(channels * math.prod(sides), 512), math.sqrt(2.0), generator)
        self.layers = nn.Sequential(*layers, nn.Flatten(), linear, nn.ReLU())

    def forward(self, images: Tensor) -> Tensor:
        """[N, *shape] to [N, 512]."""
        x = (images.float() if self.low is None else images.float() - self.low) / self.width
        x = x[:, None] if self.rank == 2 else x.permute(0, 3, 1, 2) if self.channels_last else x
        return self.layers(x)


class Policy(nn.Module):
    """An actor and a critic over encoded observations; ``own`` (a user's module) takes the place of both.

    ``trunk`` is shared by both when settings.shared; ``encoders`` turn images into features, shared always.
    ``own(observations) -> (parameters [N, P], values [N])`` receives observations as the space has them,
    batched, in float32 (Discrete leaves one-hot).
    """

    def __init__(
        self,
        observations: ObservationLayout,
        actions: ActionLayout,
        settings: TrainSettings,
        own: OwnPolicy | None = None,
    ) -> None:
        super().__init__()
        self.observation_layout, self.layout, self.std = observations, actions, settings.std
        generator = torch.Generator().manual_seed(settings.seed)
        dimensions = int(actions.gaussian.sum())
        self.own = _own_module(own, observations, actions)
        boxes = [leaf.space for leaf in observations.images if isinstance(leaf.space, Box)]
        self.encoders = nn.ModuleList(ImageEncoder(x, generator, settings.encoder == "old") for x in boxes)
        size = observations.size + 512 * len(observations.images)
        outputs = actions.num_parameters + (dimensions if settings.std == "state" else 0)
        hidden, activation = list(settings.hidden), settings.activation
        self.trunk: nn.Sequential | None = None
        self.actor: nn.Sequential | None = None
        self.critic: nn.Sequential | None = None
        if self.own is None:
            if settings.shared and hidden:
                self.trunk = mlp([size, *hidden], activation, None, generator)
                size, hidden = hidden[-1], []
            self.actor = mlp([size, *hidden, outputs], activation, 0.01, generator)
            self.critic = mlp([size, *hidden, 1], activation, 1.0, generator)
        else:
            self.encoders = nn.ModuleList()
        self.log_std_init = settings.log_std_init
        self.log_std: nn.Parameter | None = None
        if dimensions and settings.std == "independent":
            self.log_std = nn.Parameter(torch.full((dimensions,), settings.log_std_init))
        elif dimensions and settings.std == "gsde":
            features = hidden[-1] if hidden else size
            self.log_std = nn.Parameter(torch.full((features, dimensions), settings.log_std_init))
        self.gsde = bool(dimensions) and settings.std == "gsde"
        self.half_range: Tensor | None
        self.register_buffer(
            "half_range",
            _half_range(actions) if settings.action_bounds == "squash" else None,
            persistent=False,
        )
        self.exploration: Tensor | None = None

    @property
    def device(self) -> torch.device:
        """Where the parameters lie."""
        return next(self.parameters()).device

    def _tensors(self, arrays: Inputs) -> InputTensors:
        """Encoded observations as tensors where the parameters lie."""
        device = self.device
        return {name: torch.from_numpy(np.ascontiguousarray(x)).to(device) for name, x in arrays.items()}

    @property
    def last_critic_layer(self) -> nn.Linear | None:
        """The layer that gives the critic's output; None for a user's own module."""
        return None if self.critic is None else self.critic[-1]  # type: ignore[return-value]

    def critic_parameters(self) -> list[nn.Parameter]:
        """The parameters that only the critic uses; empty for a user's own module."""
        return list(self.critic.parameters()) if self.critic is not None else []

    def forward(self, batch: Batch) -> Evaluation:
        """Log-probability, entropy and value of every step of a batch, each [B, T]."""
        shape = batch.mask.shape
        inputs = {name: x.reshape(shape[0] * shape[1], *x.shape[2:]) for name, x in batch.inputs.items()}
        distribution, values = self.evaluate(inputs)
        logp = distribution.logp(batch.actions.reshape(shape[0] * shape[1], -1))
        return Evaluation(logp.view(shape), distribution.entropy().view(shape), values.view(shape))

    def evaluate(self, inputs: InputTensors) -> tuple[Distribution, Tensor]:
        """Distribution and the critic's outputs [N] for encoded observations [N, ...]."""
        if self.own is not None:
            parameters, values = self._own_outputs(inputs)
            return self._distribution(parameters, None, inputs), values
        assert self.actor is not None and self.critic is not None
        features = self.features(inputs)
        latent = self.actor[:-1](features)
        parameters = self.actor[-1](latent)
        return self._distribution(parameters, latent, inputs), self.critic(features)[:, 0]

    @torch.no_grad()
    def values(self, arrays: Inputs) -> Tensor:
        """Only the critic's outputs [N] for encoded observations [N, ...]: values in its scale
        (`ReturnScale`).
        """
        inputs = self._tensors(arrays)
        if self.own is not None:
            return self._own_outputs(inputs)[1]
        assert self.critic is not None
        return self.critic(self.features(inputs))[:, 0]

    def features(self, inputs: InputTensors) -> Tensor:
        """What actor and critic both start from: flat inputs and image features, through the trunk."""
        parts = [inputs["flat"]] if self.observation_layout.size else []
        parts += [encoder(inputs[f"image{i}"]) for i, encoder in enumerate(self.encoders)]
        x = torch.cat(parts, dim=1) if len(parts) > 1 else parts[0]
        return self.trunk(x) if self.trunk is not None else x

    @torch.no_grad()
    def act(self, arrays: Inputs, noise: np.ndarray, rows: slice = slice(None)) -> tuple[Tensor, Tensor]:
        """Sampled actions [N, A] and their log-probabilities [N], from encoded observations and noise [N, A].

        With gSDE the held exploration of these rows makes the noise of Gaussian columns.
        """
        distribution, latent = self._actor(self._tensors(arrays))
        random = torch.from_numpy(noise).to(self.device)
        if self.gsde and self.exploration is not None:
            assert latent is not None and self.log_std is not None and distribution.log_std is not None
            held = torch.einsum("nf,nfd->nd", latent, self.exploration[rows] * bounded(self.log_std).exp())
            random = random.clone()
            random[:, self.layout.gaussian] = held * (-distribution.log_std).exp()
        return distribution.sample(random)

    def sample(self, arrays: Inputs, noise: np.ndarray, rng: np.random.Generator) -> Tensor:
        """Sampled actions [N, A] outside a rollout: fresh exploration, and the held one is left as it is."""
        held = self.exploration
        self.hold_exploration(len(noise), rng)
        try:
            return self.act(arrays, noise)[0]
        finally:
            self.exploration = held

    @torch.no_grad()
    def mode(self, arrays: Inputs) -> Tensor:
        """The most likely actions [N, A]."""
        return self._actor(self._tensors(arrays))[0].mode()

    def hold_exploration(self, num_envs: int, rng: np.random.Generator) -> None:
        """Draw the gSDE matrices [num_envs, features, d] that are held for the next ``gsde_steps`` steps."""
        if self.gsde:
            assert self.log_std is not None
            draws = rng.standard_normal((num_envs, *self.log_std.shape), dtype=np.float32)
            self.exploration = torch.from_numpy(draws).to(self.device)

    def _actor(self, inputs: InputTensors) -> tuple[Distribution, Tensor | None]:
        if self.own is not None:
            return self._distribution(self._own_outputs(inputs)[0], None, inputs), None
        assert self.actor is not None
        latent = self.actor[:-1](self.features(inputs))
        return self._distribution(self.actor[-1](latent), latent, inputs), latent

    def _distribution(self, parameters: Tensor, latent: Tensor | None, inputs: InputTensors) -> Distribution:
        log_std: Tensor | None = self.log_std
        if self.std == "state" and parameters.shape[1] > self.layout.num_parameters:
            log_std = parameters[:, self.layout.num_parameters :] + self.log_std_init
            parameters = parameters[:, : self.layout.num_parameters]
        elif self.gsde:
            # the matrix is Gaussian, so the action given the state is too: var = sum_f (phi_f std_f)^2,
            # exactly
            assert latent is not None and self.log_std is not None
            variance = latent.detach().square() @ (2.0 * bounded(self.log_std)).exp()
            log_std = 0.5 * torch.log(variance + 1e-6)
        return Distribution(
            self.layout.components, parameters, log_std, inputs.get("action_mask"), self.half_range
        )

    def _own_outputs(self, inputs: InputTensors) -> tuple[Tensor, Tensor]:
        assert self.own is not None
        result = self.own(self.observation_layout.unflatten(inputs))
        n = next(iter(inputs.values())).shape[0]
        expected = self.layout.num_parameters
        if self.std == "state":
            expected += int(self.layout.gaussian.sum())
        good = isinstance(result, tuple) and len(result) == 2 and all(isinstance(x, Tensor) for x in result)
        if not good or result[0].shape != (n, expected) or result[1].numel() != n:
            seen = (
                [tuple(x.shape) for x in result if isinstance(x, Tensor)]
                if isinstance(result, tuple)
                else result
            )
            raise ValueError(
                f"Your policy returned {seen}; expected a pair (action parameters of shape ({n}, "
                f"{expected}), values of shape ({n},)) for {n} observations of a task with actions "
                f"{self.layout.space}."
            )
        return result[0], result[1].reshape(n)


def _own_module(
    own: OwnPolicy | None,
    observations: ObservationLayout,
    actions: ActionLayout,
) -> nn.Module | None:
    if own is None or isinstance(own, nn.Module):
        return own
    module = own(observations.space, actions.space) if callable(own) else own
    if not isinstance(module, nn.Module):
        raise ValueError(
            f"policy is {type(module).__name__}; expected a torch.nn.Module, or a function of "
            "(observation_space, action_space) that returns one."
        )
    return module


def _half_range(actions: ActionLayout) -> Tensor | None:
    """Half the width of the bounds of every Gaussian dimension [d]; 1 for a constant one, whose density would
    be infinite.
    """
    boxes = [leaf for leaf in actions.leaves if isinstance(leaf.space, Box)]
    widths = [np.where(leaf.high > leaf.low, (leaf.high - leaf.low) / 2.0, 1.0) for leaf in boxes]
    return torch.as_tensor(np.concatenate(widths), dtype=torch.float32) if widths else None
