"""Running episodes as seeds and actions: they are repeated to continue a run exactly where it was saved.

The log is made from a rollout's arrays after it was collected, never while it is. It holds the actions since
the last seeded reset of each copy and, for every step, a fingerprint of what the environment answered: hashes
of the observation, the reward and the action mask, and both flags. A replay compares them step by step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tightrope.control.environments.base import Environments
from tightrope.control.environments.episode import TRAINING, Start
from tightrope.control.spaces.structure import Array, Inputs

PRINTS = 2  # int32 columns of a fingerprint: the observation; reward, mask and flags
# odd: a change of a single 64-bit word is always seen in a sum modulo 2**64
KEYS = np.random.Generator(np.random.PCG64(0x7274)).integers(0, 2**63, 1 << 12, np.uint64) * np.uint64(2)
KEYS += np.uint64(1)
NO_MASK = np.zeros(1, np.uint32)
REWARD, MASK = np.uint32(0xFFFFFF00), np.uint32(0xFC)  # bits of the second column; the last two are the flags


def digests(array: Array) -> Array:
    """uint64 [N]: a hash of the bytes of each row of an array [N, ...]."""
    rows = np.ascontiguousarray(array).reshape(len(array), -1).view(np.uint8)
    if rows.shape[1] % 8:
        rows = np.pad(rows, ((0, 0), (0, -rows.shape[1] % 8)))
    words, found = rows.view(np.uint64), np.zeros(len(rows), np.uint64)
    for first in range(0, words.shape[1], len(KEYS)):  # one block, but for large images
        block = words[:, first : first + len(KEYS)]
        found = found * KEYS[-1] + np.einsum("ij,j->i", block, KEYS[: block.shape[1]])
    return found


def _folded(hashes: Array) -> Array:
    return (hashes ^ (hashes >> np.uint64(32))).astype(np.uint32)


def of_observations(inputs: Inputs) -> Array:
    """uint32 [N]: fingerprints of N encoded observations."""
    found = np.uint64(0)
    for name in sorted(inputs):
        if inputs[name].size:
            found = found * KEYS[0] + digests(inputs[name])
    return _folded(np.asarray(found))


def of_masks(mask: Array | None) -> Array:
    """uint32 [N]: fingerprints of action masks [N, L]; one 0 without any."""
    return NO_MASK if mask is None else _folded(digests(mask)) & MASK


def of_steps(rewards: Array, terminated: Array, truncated: Array, masks: Array) -> Array:
    """uint32 [...]: fingerprints of rewards float64, flags and those of the masks."""
    found = np.ascontiguousarray(rewards, np.float64).view(np.uint64) * KEYS[1]
    found >>= np.uint64(32)  # the upper half, on which every bit has an effect
    found &= np.uint64(REWARD)
    found |= terminated.view(np.uint8) << 1 | truncated.view(np.uint8)
    return (found if masks is NO_MASK else found | masks).astype(np.uint32)


class Repeatable(NamedTuple):
    """An episode of copy 0 that is over, or runs: its number, the fingerprint of its first observation, its
    log and what the copy carried.
    """

    episode: int
    first: int
    log: Array
    carried: object


class Running(NamedTuple):
    """The running episodes of B copies at the end of a rollout.

    ``origins``: see Environments.  ``first`` uint32 [B]: the fingerprint of each first observation.
    ``parts``: arrays int32 [n, A + PRINTS] of each copy, its actions (float32) and fingerprints; None for a
    copy that begins again at a resume.  ``carried``: see Environments.  ``ended``: the episode of copy 0 that
    ran at the end of the rollout before, once it is over; None where it is not, or has no log.
    """

    origins: Array
    first: Array
    parts: list[list[Array] | None]
    carried: list[object] | None
    ended: Repeatable | None = None

    def of_first_copy(self, more: Array | None = None) -> Repeatable | None:
        """The running episode of copy 0, with ``more`` of its log; None without a log."""
        parts = self.parts[0]
        if parts is None or not (parts or more is not None):
            return None
        log = np.concatenate(parts if more is None else [*parts, more])
        carried = None if self.carried is None else self.carried[0]
        return Repeatable(int(self.origins[0, 0]), int(self.first[0]), log, carried)

    def logs(self) -> dict[str, Array]:
        """The whole log of every copy that has one, named after copy and episode."""
        found = zip(self.origins.tolist(), self.parts, strict=True)
        return {
            _name(row, origin[0]): np.concatenate(parts) for row, (origin, parts) in enumerate(found) if parts
        }


def _name(row: int, episode: int) -> str:
    return f"{row}.{episode}"


def begun(environments: Environments, inputs: Inputs, mask: Array | None) -> Running | None:
    """After a reset of all; None for environments that do not replay."""
    origins = environments.origins() if environments.replays else None
    if origins is None:
        return None
    first = of_observations(inputs) ^ of_masks(mask)
    return Running(origins, first, [[] for _ in range(len(origins))], environments.carried())


class Stepped(NamedTuple):
    """T steps of B copies, as a rollout holds them: observations and masks before each step, and the last."""

    observations: Inputs  # [B, T, ...]
    last: Inputs  # [B, ...]
    masks: Array | None  # bool [B, T, L]
    last_mask: Array | None
    rewards: Array  # [B, T], as all that follow
    terminated: Array
    truncated: Array
    actions: Array  # float32 [B, T, A], as sampled


def continued(
    running: Running, environments: Environments, stepped: Stepped, limit: int, over: int
) -> Running:
    """After T steps: what came before each copy's last seeded reset is forgotten, and a log of more than
    ``limit`` steps is dropped. ``over``: steps after which copy 0 had its first seeded reset, 0 without any.
    """
    origins, shape = environments.origins(), stepped.rewards.shape
    assert origins is not None
    num_steps, lengths = shape[1], origins[:, 2]
    before = of_observations({k: x.reshape(-1, *x.shape[2:]) for k, x in stepped.observations.items()})
    seen = np.column_stack([before.reshape(shape), of_observations(stepped.last)])
    masks, present = NO_MASK, seen
    if stepped.masks is not None:
        flat = stepped.masks.reshape(-1, stepped.masks.shape[2])
        masks = np.column_stack([of_masks(flat).reshape(shape), of_masks(stepped.last_mask)])
        masks, present = masks[:, 1:], seen ^ masks
    width = stepped.actions.shape[2]
    rows = np.empty((*shape, width + PRINTS), np.int32)
    rows[:, :, :width] = stepped.actions.view(np.int32)
    rows[:, :, width] = seen[:, 1:].view(np.int32)
    rest = of_steps(stepped.rewards, stepped.terminated, stepped.truncated, masks)
    rows[:, :, width + 1] = rest.view(np.int32)
    begins = np.maximum(num_steps - lengths, 0)
    first = running.first
    if begins.any():
        first = np.where(begins > 0, present[np.arange(shape[0]), begins], first)
    parts: list[list[Array] | None] = []
    for row, (old, length, begin) in enumerate(zip(running.parts, lengths, begins, strict=True)):
        earlier = [] if length < num_steps else old
        if earlier is None or length > limit:
            parts.append(None)
        else:
            parts.append([*earlier, rows[row, begin:].copy()] if begin < num_steps else [])
    ended = running.of_first_copy(rows[0, :over]) if over else None
    return Running(origins, first, parts, environments.carried(), ended)


class Replayed(NamedTuple):
    """What a replay ended with: the present observations and masks, what is running, the copies that began
    new episodes, and for people where copies differ.
    """

    inputs: Inputs
    mask: Array | None
    running: Running
    renewed: list[int]
    differences: list[str]


def replay(environments: Environments, seed: int, saved: Running, logs: dict[str, Array]) -> Replayed:
    """Repeat running episodes, whose logs are ``logs`` and not in ``saved``. A copy that differs, or has no
    log (-1 steps), begins a new one. ValueError for a log that does not fit.
    """
    origins, width = saved.origins, environments.action_layout.num_columns
    lost, lengths = origins[:, 2] < 0, np.maximum(origins[:, 2], 0)
    longest, copies = int(lengths.max()), len(lengths)
    script = np.zeros((copies, longest, width + PRINTS), np.int32)  # each copy ends with the last step
    for row, length in enumerate(lengths):
        log = logs.get(_name(row, origins[row, 0]), script[row, :0])
        if log.dtype != script.dtype or log.shape != (length, script.shape[2]):
            raise ValueError(f"the log of copy {row} does not fit its episode")
        script[row, longest - length :] = log
    episodes = np.where(lost, origins[:, 0] + origins[:, 1] + 1, origins[:, 0]).tolist()
    carried = [None] * copies if saved.carried is None else saved.carried
    waits = longest - lengths
    starts = list(map(Start, episodes, waits.tolist(), carried))
    inputs, mask = environments.reset(seed, TRAINING, starts)
    same, differences = ~lost, list[str]()
    seen = np.stack([of_observations(inputs) ^ of_masks(mask), np.zeros(copies, np.uint32)], axis=1)
    wanted = np.stack([saved.first, seen[:, 1]], axis=1)
    for t in range(longest + 1):
        for row in np.flatnonzero(same & (seen != wanted).any(axis=1)).tolist():
            same[row] = False
            place = f"step {t - waits[row]:,} of {lengths[row]:,}" if t else "its reset"
            what = _what(seen[row] ^ wanted[row])
            differences.append(f"copy {row}, episode {episodes[row]}, {place}: {what}")
            inputs, mask = environments.renew(row, longest - t)
        if t == longest:
            break
        step = environments.step(script[:, t, :width].view(np.float32))
        inputs, mask = step.inputs, step.action_mask
        rest = of_steps(step.rewards, step.terminated, step.truncated, of_masks(mask))
        seen, wanted = np.column_stack([of_observations(inputs), rest]), script[:, t, width:].view(np.uint32)
        wanted = np.where((t >= waits)[:, None], wanted, seen)
    running = begun(environments, inputs, mask)
    assert running is not None
    parts: list[list[Array] | None] = [
        [script[row, waits[row] :]] if same[row] and lengths[row] else [] for row in range(copies)
    ]
    running = running._replace(first=np.where(same, saved.first, running.first), parts=parts)
    return Replayed(inputs, mask, running, np.flatnonzero(~same).tolist(), differences)


def _what(differs: Array) -> str:
    """Which parts of two fingerprints [PRINTS] differ, from their exclusive or."""
    observation, rest = differs.tolist()
    parts = {
        "observation": observation, "reward": rest & int(REWARD), "action mask": rest & int(MASK),
        "end of the episode": rest & 3,
    }  # fmt: skip
    return "another " + " and ".join(name for name, found in parts.items() if found)
