"""The compiled CPU engine: torch's parameters and Adam in flat memory, and calls of compiled code."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable

import numpy as np
import torch

from tightrope.algorithms import ppo
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.descent import check_first_ratios
from tightrope.algorithms.nonfinite import NonFiniteError, explain
from tightrope.algorithms.settings import PPOSettings, UpdateSettings
from tightrope.control.engine.base import Acted, Steps
from tightrope.control.engine.compiled import cache, infer, plan, threads
from tightrope.control.engine.compiled import update as kernels
from tightrope.control.policy.normalise import EDGE, ObservationNormaliser
from tightrope.control.policy.policy import Policy
from tightrope.control.spaces.structure import Array, Inputs

cache.mark_complete()  # importing infer and update has compiled or loaded every entry

CHECK_LIMIT = 1e-4  # largest difference of a parameter after one minibatch
CHECK_CLIP = 1e-3  # smallest clip in that comparison: within rounding, either side of a clip is right
_NOTHING = np.zeros(0)
_NO_MASK = np.zeros((0, 1), bool)

# For the comparison with ppo.py: an Adam whose step is nearly the gradient itself. With its usual tiny
# epsilon a gradient of pure rounding error would move a parameter by a whole learning rate.
SMOOTH = {"lr": 1.0, "eps": 1.0}


class CompiledEngine:
    """See Engine: the compiled execution of ``ppo.update`` for one policy and its torch.optim.Adam.

    Both remain torch objects: every parameter, and every moment of Adam, is a view of flat memory that the
    engine works on. ``num_threads`` 2: actor and critic on a core each, unless they share a trunk; the bits
    are those of 1. ``notify`` gets a line about the comparison with ppo.py.
    """

    name = "fused"
    device = torch.device("cpu")

    def __init__(
        self,
        policy: Policy,
        optimiser: torch.optim.Optimizer,
        num_threads: int,
        notify: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.policy, self.optimiser, self.notify = policy, optimiser, notify
        self._plan = plan.make_plan(policy)
        self._flat, self._grad = plan.aligned_zeros(self._plan.size), plan.aligned_zeros(self._plan.size)
        self._moment, self._square = plan.aligned_zeros(self._plan.size), plan.aligned_zeros(self._plan.size)
        self._steps = np.zeros(len(self._plan.parameters), np.float32)
        self._homes = [x.ctypes.data for x in (self._flat, self._moment, self._square, self._steps)]
        self._work = [plan.aligned_zeros(self._plan.work_size)]
        self._helper = threads.Helper()
        self._choice = threads.ThreadChoice(both=num_threads > 1 and policy.trunk is None)
        self._compared = False  # with ppo.py, on the first minibatch of the first update
        self.attach()

    def attach(self) -> None:
        """Make parameters and Adam's state views of the flat memory, with the numbers they hold now."""
        if self._attached():
            return
        known = {id(p) for group in self.optimiser.param_groups for p in group["params"]}
        with torch.no_grad():
            for i, (parameter, at) in enumerate(self._plan.parameters):
                if id(parameter) not in known:
                    raise ValueError(
                        "The optimiser does not hold all parameters of the policy; build it from that policy."
                    )
                parameter.data = self._view(self._flat, parameter.data, at)
                state = self.optimiser.state[parameter]
                for name, memory in (("exp_avg", self._moment), ("exp_avg_sq", self._square)):
                    state[name] = self._view(memory, state.get(name, torch.zeros_like(parameter)), at)
                state["step"] = self._view(self._steps, torch.as_tensor(state.get("step", 0.0)), i)

    def _attached(self) -> bool:
        state = self.optimiser.state
        for i, (parameter, at) in enumerate(self._plan.parameters):
            mine = state.get(parameter, {})
            tensors = (parameter, mine.get("exp_avg"), mine.get("exp_avg_sq"), mine.get("step"))
            homes = [first + 4 * offset for first, offset in zip(self._homes, (at, at, at, i), strict=True)]
            if any(t is None or t.data_ptr() != home for t, home in zip(tensors, homes, strict=True)):
                return False
        return True

    @staticmethod
    def _view(memory: Array, tensor: torch.Tensor, at: int) -> torch.Tensor:
        part = torch.from_numpy(memory[at : at + max(1, tensor.numel())]).view(tensor.shape)
        if part.data_ptr() != tensor.data_ptr():
            part.copy_(tensor)
        return part

    def close(self) -> None:
        """End the critic's thread; a later update starts it again."""
        self._helper.stop()

    # --- rollout

    def begin_rollout(self, num_envs: int, rng: np.random.Generator) -> None:
        """Attach to parameters whose memory was replaced since the last update."""
        self.attach()

    def act(
        self,
        inputs: Inputs,
        normaliser: ObservationNormaliser | None,
        action_mask: Array | None,
        noise: Array,
        rows: slice,
        out: Acted,
    ) -> None:
        """See Engine. The arrays of ``out`` may be strided columns of a rollout."""
        p, masks = self._plan, _NO_MASK
        if action_mask is not None:
            masks = action_mask[rows]
            out.inputs["action_mask"][:] = masks
        mean, inverse_std, hard = _NOTHING, _NOTHING, False
        if normaliser is not None:
            mean, inverse_std, hard = normaliser.mean, normaliser.inverse_std, normaliser.old
        infer.act_batch(
            p.places, p.layers, p.components, self._flat, self._work[0], inputs["flat"][rows], mean,
            inverse_std, EDGE, hard, masks, noise[rows], out.actions, out.logp, out.inputs["flat"],
        )  # fmt: skip

    def values(self, inputs: Inputs) -> Array:
        """See Engine."""
        flat = _float(inputs["flat"])
        out = np.empty(len(flat), np.float32)
        infer.value_batch(self._plan.places, self._plan.layers, self._flat, self._work[0], flat, out)
        return out

    def gae(self, steps: Steps, gamma: float, gae_lambda: float) -> Array:
        """See Engine. ValueError when the shapes differ: compiled code does not look."""
        numbers = [np.ascontiguousarray(x, np.float64) for x in steps[:3]]
        flags = [np.ascontiguousarray(x, bool) for x in steps[3:]]
        out = np.empty(numbers[0].shape)
        if any(x.shape != out.shape for x in (*numbers, *flags)):
            raise ValueError(
                f"All arrays of gae must have one shape; got {[x.shape for x in (*numbers, *flags)]}."
            )
        infer.gae_batch(*numbers, *flags, gamma, gae_lambda, out)
        return out

    # --- learning

    def update(
        self,
        batch: Batch,
        settings: UpdateSettings,
        rng: np.random.Generator,
        *,
        refresh: Callable[[Batch], Batch] | None = None,
        log_ratio_limit: float | None = None,
    ) -> dict[str, float]:
        """``ppo.update``: same permutations, metrics and errors; parameters equal within 1e-5.

        ``refresh`` is not needed: `plan.unsupported` refuses recompute_advantages.
        """
        assert isinstance(settings, PPOSettings)
        batch.require_steps()
        self.attach()
        if log_ratio_limit is not None and not self._compared:
            self._check(batch, settings)
            self._compared = True
        rows, columns = _rows(batch), _columns(batch)
        run = _Run(self, columns, self._options(settings, log_ratio_limit))
        began, together = time.perf_counter(), self._choice.choose()
        status = run.epochs(rows, rng, settings.num_epochs, together)
        self._choice.record(together, time.perf_counter() - began, int(run.ledgers[0, kernels.NORM_COUNT]))
        self._steps += np.float32(run.ledgers[0, kernels.STEPS])
        if status == kernels.NOT_FINITE:
            raise NonFiniteError(self._explain(run, batch, settings))
        if status == kernels.MISMATCH:
            check_first_ratios(torch.tensor(run.ledgers[0, kernels.FIRST]), log_ratio_limit)
        return run.metrics()

    def _explain(self, run: _Run, batch: Batch, settings: PPOSettings) -> str:
        """The message of the minibatch that was refused, as ppo.update gives it."""
        k, (actor, critic), size = kernels, run.ledgers[:2], settings.minibatch_size
        start = int(actor[k.AT])
        where = f"in minibatch {start // size + 1} of epoch {run.epoch + 1}"
        rows = torch.from_numpy(run.order[start : start + size])
        minibatch = batch.map(lambda x: x.flatten(0, 1).unsqueeze(1)).select(rows)
        sums = torch.tensor([actor[k.KL_NOW], actor[k.POLICY] + critic[k.VALUES]], dtype=torch.float64)
        for parameter, at in self._plan.parameters:
            part = torch.from_numpy(self._grad[at : at + parameter.numel()])
            parameter.grad = part.view(parameter.shape)
        message = explain(self.policy, self.optimiser, batch, minibatch, where, sums)
        self.optimiser.zero_grad()  # torch shall not see the flat memory of the gradients
        return message

    def _options(self, settings: PPOSettings, limit: float | None) -> Array:
        """Numbers for the compiled code; learning rates, betas and epsilon are those of the optimiser."""
        k, options = kernels, np.zeros(kernels.OPTIONS)
        groups = {id(p): group for group in self.optimiser.param_groups for p in group["params"]}
        for half, (begin, end) in enumerate(self._plan.halves):
            mine = [groups[id(p)] for p, at in self._plan.parameters if begin <= at < end]
            if any(group["lr"] != mine[0]["lr"] for group in mine):
                raise ValueError(
                    "The compiled engine needs one learning rate for the actor and one for the critic."
                )
            options[k.RATE + half] = float(mine[0]["lr"])
            options[k.ACTOR_FROM + 2 * half], options[k.ACTOR_TO + 2 * half] = begin, end
        first = self.optimiser.param_groups[0]
        (options[k.BETA_1], options[k.BETA_2]), options[k.EPSILON] = first["betas"], first["eps"]
        options[k.CLIP_LOW] = settings.clip
        options[k.CLIP_HIGH] = settings.clip if settings.clip_high is None else settings.clip_high
        options[k.VALUE_CLIP] = settings.value_clip or 0.0
        options[k.VALUE_WEIGHT], options[k.ENTROPY_WEIGHT] = settings.value_weight, settings.entropy_weight
        options[k.TARGET_KL] = np.inf if settings.target_kl is None else settings.target_kl
        options[k.MAX_NORM] = np.inf if settings.max_grad_norm is None else settings.max_grad_norm
        options[k.NORMALISE], options[k.MINIBATCH] = settings.normalise_advantages, settings.minibatch_size
        options[k.RATIO_LIMIT] = np.inf if limit is None else limit
        options[k.STEPS_BEFORE] = self._steps[0]
        return options

    def _check(self, batch: Batch, settings: PPOSettings) -> None:
        """Compare one minibatch with ppo.py. RuntimeError when a parameter differs by over CHECK_LIMIT."""
        difference = self.check_first_minibatch(batch, settings)
        if not difference <= CHECK_LIMIT:
            raise RuntimeError(
                f"After one minibatch the compiled engine differs from ppo.py by {difference:.2g} in a "
                f"parameter (limit {CHECK_LIMIT:g}). Train with --engine torch, and please report this with "
                "your settings.json."
            )
        self.notify(
            f"engine check: one minibatch by ppo.py and compiled, largest difference {difference:.1e}"
        )

    def check_first_minibatch(self, batch: Batch, settings: PPOSettings) -> float:
        """Largest difference between a parameter after one step of ppo.update and after one of this engine.

        Both work on copies, on the first ``minibatch_size`` rows of the batch; nothing of this engine
        changes.
        """
        steps = batch.as_steps().select(slice(0, settings.minibatch_size))
        clips = {name: getattr(settings, name) for name in ("clip", "clip_high", "value_clip")}
        clips = {name: max(clip, CHECK_CLIP) for name, clip in clips.items() if clip is not None}
        once = settings.unchecked(num_epochs=1, target_kl=None, **clips)
        pairs = [copy.deepcopy((self.policy, self.optimiser)) for _ in range(2)]
        for _, optimiser in pairs:
            for group in optimiser.param_groups:
                group.update(SMOOTH)
        (expected, first), (found, second) = pairs
        ppo.update(expected, first, steps, once, np.random.default_rng(0))
        CompiledEngine(found, second, 1).update(steps, once, np.random.default_rng(0))
        parameters = zip(expected.parameters(), found.parameters(), strict=True)
        return max(float((a.detach() - b.detach()).abs().max()) for a, b in parameters)


class _Run:
    """One update under way."""

    def __init__(self, engine: CompiledEngine, columns: list[Array], options: Array) -> None:
        self.engine, self.columns, self.options = engine, columns, options
        self.control = np.zeros(threads.CONTROL_SIZE, np.int64)
        self.exchange, self.ledgers = np.zeros(4 * kernels.LEDGER), np.zeros((4, kernels.LEDGER))
        self.ledgers[0, [kernels.RATIO_MIN, kernels.RATIO_MAX]] = np.inf, -np.inf
        self.epoch, self.order = 0, np.zeros(0, np.int64)
        self.rows_before = 0.0  # that the epochs before the present one have seen

    def _call(self, role: int, begin: int, epoch: int, epochs: int) -> int:
        e, p = self.engine, self.engine._plan
        work = e._work[1 if role == kernels.CRITIC else 0]
        return kernels.run_epochs(
            role, begin, epoch, epochs, p.places, p.layers, p.components,
            e._flat, e._grad, e._moment, e._square, work,
            *self.columns, self.order, self.options, self.control, self.exchange, self.ledgers,
        )  # fmt: skip

    def epochs(self, rows: Array | int, rng: np.random.Generator, num_epochs: int, together: bool) -> int:
        """Run all epochs; returns why it stopped. A permutation is drawn only when its epoch begins.

        ``together``: run the critic's half on the second thread if it can be started.
        """
        count = rows if isinstance(rows, int) else len(rows)
        self.order = np.empty(count, np.int64)
        job: Callable[[], object] = lambda: self._call(kernels.CRITIC, 0, 0, num_epochs)  # noqa: E731
        role = kernels.ACTOR if together and self._helped(job) else kernels.BOTH
        status = kernels.RUNNING
        try:
            for self.epoch in range(num_epochs):
                self.ledgers[0, kernels.KL] = 0.0
                self.rows_before = float(self.ledgers[0, kernels.ROWS_SEEN])
                permutation = rng.permutation(count)
                self.order[:] = permutation if isinstance(rows, int) else rows[permutation]
                status = self._call(role, 0, self.epoch, self.epoch + 1)
                if status == kernels.ALONE:  # restore the ledgers, and do both halves on this thread
                    role = kernels.BOTH
                    self.ledgers[:2] = self.ledgers[2:]
                    status = self._call(role, int(self.ledgers[0, kernels.AT]), self.epoch, self.epoch + 1)
                if status != kernels.RUNNING:
                    break
        except BaseException:
            self.control[threads.LEFT] = 1
            self.engine._helper.wait()  # who undoes the update writes to the same weights
            raise
        finally:
            self.control[threads.LEFT] = 1
        return status

    def _helped(self, job: Callable[[], object]) -> bool:
        engine = self.engine
        if len(engine._work) < 2:
            engine._work.append(plan.aligned_zeros(engine._plan.work_size))
        return engine._helper.start(job, self.control)

    def metrics(self) -> dict[str, float]:
        """Means over all rows of all minibatches, of approx_kl over those of the last epoch."""
        k, (actor, critic) = kernels, self.ledgers[:2]
        rows = actor[k.ROWS_SEEN]
        means = {
            "policy_gradient_loss": actor[k.POLICY] / rows,
            "value_loss": critic[k.VALUES] / critic[k.ROWS_SEEN],
            "entropy": actor[k.ENTROPY_SUM] / rows,
            "approx_kl": actor[k.KL] / (rows - self.rows_before),
            "clip_fraction": (actor[k.HIGH] + actor[k.LOW]) / rows,
            "clip_fraction_high": actor[k.HIGH] / rows,
            "clip_fraction_low": actor[k.LOW] / rows,
            "grad_norm": actor[k.NORMS] / actor[k.NORM_COUNT],
            "ratio_min": actor[k.RATIO_MIN],
            "ratio_max": actor[k.RATIO_MAX],
            "log_ratio_first": actor[k.FIRST],
            "minibatches": actor[k.STEPS],
        }
        return {f"train/{name}": float(value) for name, value in means.items()}


def _float(array: Array) -> Array:
    return np.ascontiguousarray(array, np.float32)


def _rows(batch: Batch) -> Array | int:
    """The steps that count, of the flattened batch; a number when all do."""
    mask = batch.mask.reshape(-1).numpy()
    return len(mask) if mask.all() else np.flatnonzero(mask)


def _columns(batch: Batch) -> list[Array]:
    """The batch's tensors as flat arrays, views wherever they can be."""
    steps = batch.mask.numel()

    def flat(tensor: torch.Tensor, width: bool) -> Array:
        array = tensor.detach().reshape(steps, -1) if width else tensor.detach().reshape(steps)
        return _float(array.numpy())

    mask = batch.inputs.get("action_mask")
    masks = _NO_MASK if mask is None else np.ascontiguousarray(mask.reshape(steps, -1).numpy(), bool)
    numbers = (batch.old_logp, batch.old_values, batch.advantages, batch.returns)
    return [
        flat(batch.inputs["flat"], True),
        masks,
        flat(batch.actions, True),
        *(flat(x, False) for x in numbers),
    ]
