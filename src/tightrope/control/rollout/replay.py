"""The running episodes, as seeds and actions: recorded after each rollout, saved, and repeated to continue a
run exactly where it was saved.

The log is made from a rollout's arrays after it was collected, never while it is. It holds the actions since
the last seeded reset of each copy and, for every step, a fingerprint of what the environment answered: hashes
of the observation, the reward and the action mask, and both flags. A replay compares them step by step.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from tightrope.control.environments import state as states
from tightrope.control.environments.base import Environments
from tightrope.control.environments.episode import TRAINING, Start
from tightrope.control.spaces.structure import Array, Inputs
from tightrope.runs.growing import GROUP as ACTIONS

PRINTS = 2  # int32 columns of a fingerprint: the observation; reward, mask and flags
# odd: a change of a single 64-bit word is always seen in a sum modulo 2**64
KEYS = np.random.Generator(np.random.PCG64(0x7274)).integers(0, 2**63, 1 << 12, np.uint64) * np.uint64(2)
KEYS += np.uint64(1)
NOTHING = np.zeros(1, np.uint32)
UPPER = int(sys.byteorder == "little")  # place of the upper half of a 64-bit word
REWARD, MASK = np.uint32(0xFFFFFF00), np.uint32(0xFC)  # bits of the second column; the last two are the flags
TELL_AFTER, LONG = 2.0, 10.0  # seconds of a replay: when its length is estimated, and from which it is told
Groups = dict[str, dict[str, torch.Tensor]]  # tensors by group and name


# ------------------------------------------------------------------------------------------ fingerprints


def digests(array: Array, leading: int = 1) -> Array:
    """uint64: a hash of the bytes behind the leading axes of an array, [N] for [N, ...]."""
    rows = np.ascontiguousarray(array).reshape(*array.shape[:leading], -1).view(np.uint8)
    if rows.shape[-1] % 8:
        rows = np.pad(rows, [(0, 0)] * leading + [(0, -rows.shape[-1] % 8)])
    words = rows.view(np.uint64)
    if words.shape[-1] <= len(KEYS):
        return words @ KEYS[: words.shape[-1]]
    found = np.zeros(words.shape[:-1], np.uint64)
    for first in range(0, words.shape[-1], len(KEYS)):  # a large image
        block = words[..., first : first + len(KEYS)]
        found = found * KEYS[-1] + block @ KEYS[: block.shape[-1]]
    return found


def _folded(hashes: Array) -> Array:
    halves = hashes.view(np.uint32)
    return halves[..., ::2] ^ halves[..., 1::2]


def of_observations(inputs: Inputs, leading: int = 1) -> Array:
    """uint32: fingerprints of encoded observations, [N] for N of them."""
    found = None
    for name in sorted(inputs):
        if inputs[name].size:
            here = digests(inputs[name], leading)
            found = here if found is None else found * KEYS[0] + here
    return NOTHING if found is None else _folded(found)


def of_masks(mask: Array | None, leading: int = 1) -> Array:
    """uint32: fingerprints of action masks [N, L]; 0 without any."""
    return NOTHING if mask is None else _folded(digests(mask, leading)) & MASK


def of_steps(rewards: Array, terminated: Array, truncated: Array) -> Array:
    """uint32 [...]: fingerprints of rewards float64 and flags."""
    hashes = np.ascontiguousarray(rewards, np.float64).view(np.uint64) * KEYS[1]
    found = hashes.view(np.uint32)[..., UPPER::2] & REWARD  # the half on which every bit has an effect
    found |= terminated.view(np.uint8) << 1
    found |= truncated.view(np.uint8)
    return found


# --------------------------------------------------------------------------------------------- recording


class Repeatable(NamedTuple):
    """An episode of copy 0 that is over, or runs: its number, the fingerprint of its first observation, the
    parts of its log and what the copy carried.
    """

    episode: int
    first: int
    parts: list[Array]
    carried: object

    @property
    def steps(self) -> int:
        """How long it is."""
        return sum(map(len, self.parts))


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
        carried = None if self.carried is None else self.carried[0]
        parts = parts if more is None else [*parts, more]
        return Repeatable(int(self.origins[0, 0]), int(self.first[0]), parts, carried)

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


# ------------------------------------------------------------------------------------- saving, continuing


class Boundary(NamedTuple):
    """The running episodes between two rollouts. Collecting the next one changes nothing in it."""

    inputs: Inputs  # the observations from which the next actions are chosen, not normalised
    action_mask: Array | None
    returns: Array  # of the running episodes so far
    lengths: Array
    running: Running | None  # None: the environments do not replay
    environments: Any  # the state of a vector environment that gives it, else None


def saved_episodes(at: Boundary) -> tuple[dict[str, Any] | None, dict[str, Array]]:
    """A boundary as JSON, and the logs that grow with it; None where its episodes cannot be continued."""
    found: dict[str, Any] = {"returns": states.encode(at.returns), "lengths": states.encode(at.lengths)}
    if at.running is not None:
        lost = np.array([part is None for part in at.running.parts])
        origins = np.where(lost[:, None] & [False, False, True], -1, at.running.origins)
        found |= {"origins": origins.tolist(), "first": at.running.first.tolist()}
        return {**found, "carried": at.running.carried}, at.running.logs()
    if at.environments is None:
        return None, {}
    seen = {"inputs": at.inputs, "action_mask": at.action_mask, "environments": at.environments}
    return {**found, **{name: states.encode(value) for name, value in seen.items()}}, {}


class Before(NamedTuple):
    """What an update changes before it is complete, as it was."""

    rng: dict[str, Any]
    restarts: int
    boundary: Boundary | None  # None: no episodes are running
    saved: tuple[Any, Groups]

    def episodes(self) -> tuple[Any, Groups]:
        """The running episodes as JSON and tensors."""
        if self.boundary is None:
            return self.saved
        episodes, logs = saved_episodes(self.boundary)
        return episodes, {ACTIONS: {name: torch.from_numpy(x) for name, x in logs.items()}} if logs else {}


def begin(
    collector: Any, saved: tuple[object, Groups], seed: int, steps: int, tell: Callable[[str], None]
) -> list[str]:
    """Continue saved episodes, or begin new ones at an agent step; what is to be told about it. ``tell``: of
    what takes long.
    """
    episodes, logs = saved
    if not (isinstance(episodes, dict) and "returns" in episodes):  # older versions saved something else
        collector.reset(seed, steps)  # as number of the episodes: one that is not used yet
        return []
    arrays = {name: tensor.numpy() for name, tensor in logs.get(ACTIONS, {}).items()}
    differences = collector.resume(seed, episodes, arrays, tell)
    if not differences:
        return []
    shown = "; ".join(differences[:3]) + (" ..." if len(differences) > 3 else "")
    return [
        f"{len(differences)} of {collector.environments.num_envs} copies did not repeat their episode from "
        f"its seed and actions, and begin a new one: {shown}. Training goes on, but not with the bits of "
        "a run without a break."
    ]


# --------------------------------------------------------------------------------------------- repeating


class Replayed(NamedTuple):
    """What a replay ended with: the present observations and masks, what is running, the copies that began
    new episodes, and for people where copies differ.
    """

    inputs: Inputs
    mask: Array | None
    running: Running
    renewed: list[int]
    differences: list[str]


def replay(
    environments: Environments,
    seed: int,
    saved: Running,
    logs: dict[str, Array],
    tell: Callable[[str], None] = lambda text: None,
) -> Replayed:
    """Repeat running episodes, whose logs are ``logs`` and not in ``saved``. A copy that differs, or has no
    log (-1 steps, or it is gone), begins a new one. ``tell``: what is repeated, if it takes long. ValueError
    for a log that does not fit.
    """
    origins, width = saved.origins, environments.action_layout.num_columns
    names = [_name(row, episode) for row, episode in enumerate(origins[:, 0].tolist())]
    missing = (origins[:, 2] > 0) & (not logs)
    lost = missing | (origins[:, 2] < 0)
    lengths = np.where(lost, 0, origins[:, 2])
    longest, copies = int(lengths.max()), len(lengths)
    script = np.zeros((copies, longest, width + PRINTS), np.int32)  # each copy ends with the last step
    for row, length in enumerate(lengths):
        log = script[row, :0] if lost[row] else logs.get(names[row], script[row, :0])
        if log.dtype != script.dtype or log.shape != (length, script.shape[2]):
            raise ValueError(f"the log of copy {row} does not fit its episode")
        script[row, longest - length :] = log
    episodes = np.where(lost, origins[:, 0] + origins[:, 1] + 1, origins[:, 0]).tolist()
    given = [None] * copies if saved.carried is None else saved.carried
    carried = [None if isinstance(x, str) else x for x in given]  # a text: it could not be saved
    waits = longest - lengths
    starts = list(map(Start, episodes, waits.tolist(), carried))
    inputs, mask = environments.reset(seed, TRAINING, starts)
    same = ~lost
    differences = [
        f"copy {row}, episode {origins[row, 0]}: its actions are gone" for row in np.flatnonzero(missing)
    ]
    seen = np.stack([of_observations(inputs) ^ of_masks(mask), np.zeros(copies, np.uint32)], axis=1)
    wanted = np.stack([saved.first, seen[:, 1]], axis=1)
    clock, told = time.monotonic(), False
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
        rest = of_steps(step.rewards, step.terminated, step.truncated) | of_masks(mask)
        seen, wanted = np.column_stack([of_observations(inputs), rest]), script[:, t, width:].view(np.uint32)
        wanted = np.where((t >= waits)[:, None], wanted, seen)
        if not told and (spent := time.monotonic() - clock) > TELL_AFTER:
            told, left = True, spent / (t + 1) * (longest - t - 1)
            if left > LONG:
                tell(
                    f"The running episodes are repeated, {longest:,} steps in {copies} copies: about "
                    f"{left:,.0f} s more. A signal leaves at once, and loses nothing."
                )
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
