"""Where everything lies: one flat buffer for the parameters, one for the intermediate matrices, and tables
for both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import nn

from tightrope.control.engine.compiled import dense as d
from tightrope.control.engine.compiled import heads as h

ALIGNMENT = 16  # float32 numbers in a cache line
ACTIVATIONS = {nn.Tanh: d.TANH, nn.ReLU: d.RELU, nn.ELU: d.ELU, nn.SiLU: d.SILU}
KINDS = {"categorical": h.CATEGORICAL, "bernoulli": h.BERNOULLI, "gaussian": h.GAUSSIAN}


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


@dataclass(frozen=True)
class Plan:
    """Offsets of parameters (in the order of the flat buffer) and the tables that the compiled functions
    read.

    ``halves``: [begin, end) of what the actor steps (trunk, actor, log_std) and of the critic.
    """

    parameters: list[tuple[nn.Parameter, int]]
    halves: tuple[tuple[int, int], tuple[int, int]]
    size: int
    work_size: int
    places: np.ndarray
    layers: np.ndarray
    heads: np.ndarray


def make_plan(policy: Any) -> Plan:
    """The plan of a policy that ``unsupported`` has nothing against."""
    parameters: list[tuple[nn.Parameter, int]] = []
    table: list[list[int]] = []
    cursor = 0
    work = _aligned(policy.observation_layout.size * d.BLOCK)

    def place(parameter: Any) -> int:
        nonlocal cursor
        at, cursor = cursor, cursor + _aligned(parameter.numel())
        parameters.append((parameter, at))
        return at

    def reserve(rows: int) -> int:
        nonlocal work
        at, work = work, work + _aligned(rows * d.BLOCK)
        return at

    def add(modules: nn.Sequential, feed: int) -> tuple[int, int]:
        first = len(table)
        for module in modules:
            if not isinstance(module, nn.Linear):
                table[-1][d.ACTIVATION] = ACTIVATIONS[type(module)]
                if isinstance(module, nn.SiLU):
                    table[-1][d.SLOPE] = reserve(table[-1][d.OUTPUTS])
                continue
            inputs, outputs = module.in_features, module.out_features
            line = [
                inputs,
                outputs,
                place(module.weight),
                place(module.bias),
                d.NONE,
                reserve(outputs),
                reserve(outputs),
            ]
            table.append([*line, -1, feed])
            feed = len(table) - 1
        return first, len(table)

    _, trunk = add(policy.trunk, -1) if policy.trunk is not None else (0, 0)
    actor = add(policy.actor, trunk - 1)
    log_std = place(policy.log_std) if policy.log_std is not None else 0
    middle = cursor
    critic = add(policy.critic, trunk - 1)

    layout = policy.layout
    heads = np.zeros((len(layout.components), 7), np.int64)
    deviation = 0
    for i, c in enumerate(layout.components):
        heads[i] = [KINDS[c.kind], c.parameter, c.count, c.column, c.mask, deviation, i]
        deviation += c.count if c.kind == "gaussian" else 0
    places = np.zeros(h.PLACES, np.int64)
    places[h.LOGITS], places[h.DELTAS] = table[actor[1] - 1][d.VALUE], table[actor[1] - 1][d.DELTA]
    widths = (layout.num_parameters, layout.num_columns, max(1, layout.num_logits), len(heads), h.VECTORS)
    places[h.LOGS : h.ROWS + 1] = [reserve(width) for width in widths]
    places[h.FEATURES : h.PARAMETERS + 1] = [table[0][d.INPUTS], widths[1], layout.num_logits, widths[0]]
    places[h.LOG_STD], places[h.SAVED] = log_std, deviation
    places[h.ACTOR_FIRST :] = [*actor, *critic, trunk]
    halves = ((0, middle), (middle, cursor))
    return Plan(parameters, halves, cursor, work, places, np.array(table, np.int64), heads)


def aligned_zeros(size: int) -> np.ndarray:
    """float32 zeros that begin at a cache line."""
    memory = np.zeros(size + ALIGNMENT, np.float32)
    skip = -memory.ctypes.data % (4 * ALIGNMENT) // 4
    return memory[skip : skip + size]
