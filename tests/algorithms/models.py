"""A small categorical actor-critic and batches for it, for tests of the update rules."""

import numpy as np
import torch
from torch import nn

from tightrope.algorithms.batch import Batch, Evaluation


class TinyModel(nn.Module):
    """Linear softmax policy over 3 actions and a linear critic on 4 inputs."""

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.actor, self.critic = nn.Linear(4, 3).to(dtype), nn.Linear(4, 1).to(dtype)
        for parameter in self.parameters():
            nn.init.normal_(parameter, std=0.3, generator=generator)
        self.calls = 0

    def forward(self, batch: Batch) -> Evaluation:
        self.calls += 1
        x = batch.inputs["flat"]
        logp = torch.log_softmax(self.actor(x), -1)
        chosen = logp.gather(-1, batch.actions.long())[..., 0]
        return Evaluation(chosen, -(logp.exp() * logp).sum(-1), self.critic(x)[..., 0])


def make_batch(
    model: TinyModel, rows: int = 24, columns: int = 1, seed: int = 0, masked: float = 0.0
) -> Batch:
    """Random steps whose old_logp and old_values are the model's own."""
    rng = np.random.default_rng(seed)
    dtype = model.actor.weight.dtype
    shape = (rows, columns)

    def tensor(x: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(x)).to(dtype)

    mask = torch.from_numpy(rng.random(shape) >= masked)
    mask[0] = True
    inputs = {"flat": tensor(rng.standard_normal((*shape, 4)))}
    actions = torch.from_numpy(rng.integers(0, 3, (*shape, 1)).astype(np.float32))
    empty = torch.zeros(shape, dtype=dtype)
    batch = Batch(
        inputs,
        actions,
        empty,
        empty,
        tensor(rng.standard_normal(shape)),
        tensor(rng.standard_normal(shape)),
        mask,
    )
    with torch.no_grad():
        now = model(batch)
    model.calls = 0
    return Batch(inputs, actions, now.logp, now.values, batch.advantages, batch.returns, mask)
