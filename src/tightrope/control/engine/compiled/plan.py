"""Which policies the engine supports, and how it lays one out in flat buffers described by tables.

The kernels know depths, widths and action spaces only from these tables. Nothing here needs numba.
"""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from tightrope.algorithms.settings import PPOSettings, UpdateSettings

BLOCK_ROWS = 128  # rows worked on at once: sums are made block by block, so this number is part of the bits
ALIGNMENT = 16  # float32 numbers in a cache line

# columns of the table of layers, and the activations
INPUTS, OUTPUTS, WEIGHT, BIAS, ACTIVATION, VALUE, DELTA, SLOPE, FEED = range(9)
NONE, TANH, RELU, ELU, SILU = range(5)
ACTIVATION_CODES = {nn.Tanh: TANH, nn.ReLU: RELU, nn.ELU: ELU, nn.SiLU: SILU}

# columns of the table of components (of the action), and the kinds of a component
KIND, PARAMETER, COUNT, COLUMN, MASK, DEVIATION, ENTROPY_ROW = range(7)
CATEGORICAL, BERNOULLI, GAUSSIAN = range(3)
COMPONENT_KINDS = {"categorical": CATEGORICAL, "bernoulli": BERNOULLI, "gaussian": GAUSSIAN}

# entries of ``places``: offsets into the intermediate matrices, sizes of these, ranges of layers
LOGITS, DELTAS, LOGS, ACTIONS, PENALTY, ENTROPIES, VECTORS = range(7)
FEATURES, COLUMNS, MASK_WIDTH, PARAMETERS, LOG_STD, DEVIATIONS = range(7, 13)
ACTOR_FIRST, ACTOR_LAST, CRITIC_FIRST, CRITIC_LAST, TRUNK_LAST = range(13, 18)
PLACES = 18

# vectors of one number a row: offsets from places[VECTORS]
LOGP, TOTAL_ENTROPY, OLD_LOGP, ADVANTAGE, COEFFICIENT, TOP = range(0, 6 * BLOCK_ROWS, BLOCK_ROWS)
SUM, CHOSEN, RETURN, OLD_VALUE, RATIO = range(6 * BLOCK_ROWS, 11 * BLOCK_ROWS, BLOCK_ROWS)
NUM_VECTORS = 11


def unsupported(policy: Any, settings: UpdateSettings, device: Any, algorithm: str) -> str | None:
    """What the engine does not cover, in words that follow "does not cover"; None when it covers
    everything."""
    if algorithm != "ppo" or not isinstance(settings, PPOSettings):
        return f"the algorithm {algorithm}"
    if torch.device(device).type != "cpu":
        return f"the device {device}"
    for name in ("dual_clip", "kl_beta"):
        if getattr(settings, name) is not None:
            return name
    if settings.recompute_advantages:
        return "recompute_advantages"
    return _uncovered_policy(policy) or _missing_package()


def _uncovered_policy(policy: Any) -> str | None:
    if getattr(policy, "own", None) is not None or getattr(policy, "actor", None) is None:
        return "own modules"
    if len(getattr(policy, "encoders", ())) or policy.observation_layout.images:
        return "image observations"
    if getattr(policy, "gsde", False):
        return "gSDE"
    if getattr(policy, "std", "independent") == "state":
        return "a deviation that depends on the state"
    if getattr(policy, "half_range", None) is not None:
        return "action_bounds squash"
    for name in ("trunk", "actor", "critic"):
        reason = _uncovered_network(getattr(policy, name), ends_linear=name != "trunk")
        if reason is not None:
            return f"{reason} in the {name}"
    networks = [part for part in (policy.trunk, policy.actor, policy.critic) if part is not None]
    known = sum(len(list(part.parameters())) for part in networks)
    if known + (policy.log_std is not None) != len(list(policy.parameters())):
        return "parameters beside trunk, actor, critic and log_std"
    if not all(p.requires_grad and p.dtype == torch.float32 for p in policy.parameters()):
        return "frozen parameters or numbers other than float32"
    return None


def _uncovered_network(network: nn.Module | None, *, ends_linear: bool) -> str | None:
    if network is None:
        return None
    if not isinstance(network, nn.Sequential) or not len(network) or not isinstance(network[0], nn.Linear):
        return "a network that is no sequence of layers"
    linear = False
    for module in network:
        if isinstance(module, nn.Linear):
            if module.bias is None:
                return "layers without bias"
            linear = True
        elif isinstance(module, tuple(ACTIVATION_CODES)) and linear:
            if isinstance(module, nn.ELU) and module.alpha != 1:
                return "ELU with another alpha than 1"
            linear = False
        else:
            return f"{type(module).__name__} layers"
    return None if linear == ends_linear else "a network that ends in the wrong kind of layer"


def _missing_package() -> str | None:
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return "NUMBA_DISABLE_JIT"
    for name in ("numba", "scipy"):
        if importlib.util.find_spec(name) is None:
            return f"an installation without {name}"
    return None


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


@dataclass(frozen=True)
class Plan:
    """Where everything lies; offsets count float32 numbers.

    ``parameters``: each parameter and its offset in the flat buffer of ``size``; ``halves``: [begin, end) of
    what the actor's thread steps (trunk, actor, log_std) and the critic's. ``work_size``: of the buffer of
    intermediate matrices. ``places`` [PLACES], ``layers`` [L, 9] and ``components`` [C, 7] are int64 tables,
    whose entries and columns are named at the top of this file.
    """

    parameters: list[tuple[nn.Parameter, int]]
    halves: tuple[tuple[int, int], tuple[int, int]]
    size: int
    work_size: int
    places: np.ndarray
    layers: np.ndarray
    components: np.ndarray


def make_plan(policy: Any) -> Plan:
    """The plan of a policy that the engine supports."""
    parameters: list[tuple[nn.Parameter, int]] = []
    table: list[list[int]] = []
    cursor = 0
    work = _aligned(policy.observation_layout.size * BLOCK_ROWS)

    def place(parameter: Any) -> int:
        nonlocal cursor
        at, cursor = cursor, cursor + _aligned(parameter.numel())
        parameters.append((parameter, at))
        return at

    def reserve(rows: int) -> int:
        nonlocal work
        at, work = work, work + _aligned(rows * BLOCK_ROWS)
        return at

    def add(modules: nn.Sequential, feed: int) -> tuple[int, int]:
        first = len(table)
        for module in modules:
            if not isinstance(module, nn.Linear):
                table[-1][ACTIVATION] = ACTIVATION_CODES[type(module)]
                if isinstance(module, nn.SiLU):
                    table[-1][SLOPE] = reserve(table[-1][OUTPUTS])
                continue
            inputs, outputs = module.in_features, module.out_features
            weight, bias = place(module.weight), place(module.bias)
            value, delta = reserve(outputs), reserve(outputs)
            table.append([inputs, outputs, weight, bias, NONE, value, delta, -1, feed])
            feed = len(table) - 1
        return first, len(table)

    _, trunk = add(policy.trunk, -1) if policy.trunk is not None else (0, 0)
    actor = add(policy.actor, trunk - 1)
    log_std = place(policy.log_std) if policy.log_std is not None else 0
    middle = cursor
    critic = add(policy.critic, trunk - 1)

    layout = policy.layout
    components = np.zeros((len(layout.components), 7), np.int64)
    for i, c in enumerate(layout.components):
        components[i] = [COMPONENT_KINDS[c.kind], c.parameter, c.count, c.column, c.mask, c.deviation, i]
    places = np.zeros(PLACES, np.int64)
    places[LOGITS], places[DELTAS] = table[actor[1] - 1][VALUE], table[actor[1] - 1][DELTA]
    places[LOGS] = reserve(layout.num_parameters)
    places[ACTIONS] = reserve(layout.num_columns)
    places[PENALTY] = reserve(max(1, layout.num_logits))
    places[ENTROPIES] = reserve(len(components))
    places[VECTORS] = reserve(NUM_VECTORS)
    places[FEATURES], places[COLUMNS] = table[0][INPUTS], layout.num_columns
    places[MASK_WIDTH], places[PARAMETERS] = layout.num_logits, layout.num_parameters
    places[LOG_STD], places[DEVIATIONS] = log_std, layout.gaussian.sum()
    places[ACTOR_FIRST:] = [*actor, *critic, trunk]
    halves = ((0, middle), (middle, cursor))
    return Plan(parameters, halves, cursor, work, places, np.array(table, np.int64), components)


def aligned_zeros(size: int) -> np.ndarray:
    """float32 zeros that begin at a cache line."""
    memory = np.zeros(size + ALIGNMENT, np.float32)
    skip = -memory.ctypes.data % (4 * ALIGNMENT) // 4
    return memory[skip : skip + size]
