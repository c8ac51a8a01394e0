"""Detects over-optimisation: the score that is trained on rises while the true quality falls.

    gold(d) = offset + d (alpha - beta log d),    d = sqrt(KL(policy || reference)), KL summed over a response

is how the gold score follows a policy that PPO drives away from its reference (Gao, Schulman & Hilton 2022,
arXiv 2210.10760; alpha hardly depends on the size of the reward model, beta falls with it). Its top is
at d = exp(alpha / beta - 1) and can be predicted once the curve bends. Near the reference the curve of a real
run is flatter than the law and tells little about the top, so a point has the more weight the larger its d.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

FEWEST_POINTS = 5  # three parameters, and two degrees of freedom to judge them by
SPREAD = 2.0  # the largest d over the smallest but zero: within less the curve looks straight
FARTHEST = 10.0  # times the largest KL seen: a top beyond it is no prediction
DRAWS = 2000
POWER = 2.5  # a residual weighs (d / the largest d) to this power
NEAR = 0.5  # of the predicted KL: d is then 0.71 of the top's, and gold within 5 % of what can be had
TREND_WINDOWS = (8, 16, 32)  # evaluations over which proxy and gold are compared
SIGNIFICANCE = 0.0003  # one-sided, of each of the two slopes: the test is made at every evaluation


@dataclass(frozen=True)
class Fit:
    """gold(d) = offset + d (alpha - beta log d) by weighted least squares.

    ``peak_d`` and ``peak_kl`` = peak_d^2 (nats): the predicted top, inf where the curve does not bend down.
    ``peak_kl_low`` to ``peak_kl_high``: 80 % of the tops that the points allow, inf where more than a tenth
    of them have none. ``decided``: the points determine the top well enough to show it and to act on it.
    ``r2``: share of gold's variance explained, NaN for a constant one. ``reason``: why there is no fit, in
    words (all numbers are NaN then); empty when there is one.
    """

    alpha: float = math.nan
    beta: float = math.nan
    offset: float = math.nan
    peak_d: float = math.nan
    peak_kl: float = math.nan
    peak_kl_low: float = math.nan
    peak_kl_high: float = math.nan
    r2: float = math.nan
    points: int = 0
    decided: bool = False
    reason: str = ""

    def gold(self, kl: float) -> float:
        """The curve at a KL of at least 0 nats; NaN without a fit."""
        d = math.sqrt(kl)
        return self.offset + d * (self.alpha - self.beta * (math.log(d) if d > 0 else 0.0))


def fit(points: Sequence[tuple[float, float]]) -> Fit:
    """Fit Gao's curve to (KL, gold score) pairs; too few or too similar ones give a Fit with the reason.

    KL in nats, per response. An estimate of it may be below 0 and counts as 0. Pairs that are not finite are
    left out. The offset, gold's score at the reference, is fitted like the rest.
    """
    # sorted: sums round by their order, and the order of the points must not decide what is too much alike
    pairs = sorted((max(kl, 0.0), gold) for kl, gold in points if math.isfinite(kl) and math.isfinite(gold))
    kl, gold = np.array(pairs, float).reshape(-1, 2).T
    d = np.sqrt(kl)
    reason = _too_little(d)
    if reason:
        return Fit(points=len(pairs), reason=reason)
    weights = np.maximum((d / d.max()) ** POWER, 1e-3)
    bend = -d * np.log(np.where(d > 0, d, 1.0))
    columns = np.stack([d, bend, np.ones_like(d)], 1) * weights[:, None]
    size = np.linalg.norm(columns, axis=0)
    solution, _, rank, _ = np.linalg.lstsq(columns / size, gold * weights, rcond=1e-8)
    alike = Fit(points=len(pairs), reason="the KLs of the points are too much alike")
    if rank < 3:
        return alike
    alpha, beta, offset = solution / size
    left = gold * weights - columns @ (solution / size)
    squares, spread = float(left @ left), float(np.square(gold - gold.mean()).sum())
    unexplained = float(np.square(left / weights).sum())
    try:
        tops = _possible_tops(columns / size, weights, solution, squares, size)
    except np.linalg.LinAlgError:  # the draws square the condition number that lstsq has just accepted
        return alike
    peak_d, high = float(_top(alpha, beta)), float(tops[-(DRAWS // 10)])
    return Fit(
        alpha=float(alpha),
        beta=float(beta),
        offset=float(offset),
        peak_d=peak_d,
        peak_kl=peak_d**2,
        peak_kl_low=float(tops[DRAWS // 10]),
        peak_kl_high=high,
        r2=1.0 - unexplained / spread if spread > 0 else math.nan,
        points=len(pairs),
        decided=high <= FARTHEST * float(kl.max()),
    )


def _too_little(d: np.ndarray) -> str:
    """Why three parameters cannot be fitted to points at these d [N]; empty when they can."""
    different, apart = len(np.unique(d)), d[d > 0]
    if different < FEWEST_POINTS:
        return f"{different} points at different KLs, at least {FEWEST_POINTS} are needed"
    if apart.max() < SPREAD * apart.min():
        return f"the KLs reach from {apart.min() ** 2:.3g} to {apart.max() ** 2:.3g}, too close to each other"
    return ""


def _top(alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """d of the curve's top, exp(alpha / beta - 1); inf where beta is not above 0 and nothing bends down."""
    bends = beta > 0
    with np.errstate(over="ignore"):
        power = np.where(bends, alpha, np.inf) / np.where(bends, beta, 1.0) - 1.0
    return np.where(power < 300.0, np.exp(np.minimum(power, 300.0)), np.inf)  # e^300: never


def _possible_tops(
    scaled: np.ndarray, weights: np.ndarray, solution: np.ndarray, squares: float, size: np.ndarray
) -> np.ndarray:
    """The top's KL for parameters drawn as the fit leaves them in doubt, Student's t around it; [DRAWS],
    ascending. All gold scores are taken to be equally noisy, whatever their weight. The draws are always
    the same ones: a fit is a function of its points.
    """
    total = float(np.sum(weights**2))
    freedom = max(1.0, total**2 / float(np.sum(weights**4)) - 3)  # points, had all the same weight, less 3
    variance = squares / total * (freedom + 3) / freedom
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((DRAWS, 3)) / np.sqrt(rng.chisquare(freedom, (DRAWS, 1)) / freedom)
    own: np.ndarray = np.linalg.cholesky(scaled.T @ (scaled * weights[:, None] ** 2))
    root = np.linalg.inv(scaled.T @ scaled) @ own  # root root^T = A X^T W^4 X A,  A = (X^T W^2 X)^-1
    drawn = (solution + math.sqrt(variance) * noise @ root.T) / size
    return np.sort(_top(drawn[:, 0], drawn[:, 1]) ** 2)


@dataclass(frozen=True)
class Alarm:
    """Something the user should know. ``stop``: the run must end here."""

    kind: Literal["peak near", "peak passed", "over-optimised", "kl budget"]
    text: str
    stop: bool = False


class Monitor:
    """Watches a run: its KL, its score and, where there is a gold judge, the gold score.

    ``kl_budget``: nats per response at which the run stops, None for no limit. Each kind of alarm is given
    once in a run, but for the budget, which stops it whenever it is exceeded.
    """

    def __init__(self, kl_budget: float | None = None) -> None:
        if kl_budget is not None and not kl_budget > 0:
            raise ValueError(f"kl_budget is {kl_budget}, expected nats above 0, or None for no limit.")
        self.kl_budget = kl_budget
        self.fit = fit([])
        self._points: list[tuple[float, float, float]] = []
        self._given: list[str] = []

    def add(self, kl: float, proxy: float, gold: float | None = None) -> list[Alarm]:
        """One update: KL to the reference (sum over a response, mean over responses), mean score that is
        trained on, mean gold score. A gold score or proxy that is None or NaN (nothing was scored) is
        left out of the fit. ValueError for a KL that is not finite: then no budget holds.
        """
        if not math.isfinite(kl):
            raise ValueError(f"The KL to the reference is {kl}: the policy's weights are no longer usable.")
        alarms = []
        if self.kl_budget is not None and kl >= self.kl_budget:
            text = (
                f"KL to the reference {kl:.3g} nats has reached the budget of {self.kl_budget:g}: stopping."
            )
            alarms.append(Alarm("kl budget", text, stop=True))
        if gold is not None and math.isfinite(gold):
            self._points.append((kl, proxy, gold))
            self.fit = fit([(kl, gold) for kl, _, gold in self._points])
            alarms += [
                a for a in (self._peak(kl), self._opposed()) if a is not None and a.kind not in self._given
            ]
            self._given += [alarm.kind for alarm in alarms if not alarm.stop]
        return alarms

    @property
    def newest_gold(self) -> float | None:
        """The gold score of the newest evaluation that gave one."""
        return self._points[-1][2] if self._points else None

    def state(self) -> dict[str, Any]:
        """What `restore` needs, as JSON can hold it."""
        points = [[kl, proxy if math.isfinite(proxy) else None, gold] for kl, proxy, gold in self._points]
        return {"points": points, "given": list(self._given)}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; the budget of this monitor stays."""
        self._points = [
            (kl, math.nan if proxy is None else proxy, gold) for kl, proxy, gold in state["points"]
        ]
        self._given = list(state["given"])
        self.fit = fit([(kl, gold) for kl, _, gold in self._points])

    def _peak(self, kl: float) -> Alarm | None:
        """Near: above NEAR of the predicted KL; passed: beyond nine tenths of the tops that are possible."""
        found = self.fit
        if not found.decided or kl < NEAR * found.peak_kl:
            return None
        where = (
            f"at a KL of {found.peak_kl:.3g} nats (80 % interval {found.peak_kl_low:.3g} to "
            f"{found.peak_kl_high:.3g}, from {found.points} evaluations); the policy is at {kl:.3g}."
        )
        if kl < found.peak_kl_high:
            return Alarm("peak near", f"The gold score is predicted to be highest {where} Stop soon.")
        text = f"The gold score has most likely been highest {where} Keep an earlier checkpoint, or hold the "
        return Alarm("peak passed", text + "policy nearer to the reference with a larger kl_beta.")

    def _opposed(self) -> Alarm | None:
        """Proxy up and gold down over the last evaluations, both beyond chance."""
        scored = [(proxy, gold) for _, proxy, gold in self._points if math.isfinite(proxy)]
        for window in TREND_WINDOWS:
            proxy, gold = np.array(scored[-window:]).reshape(-1, 2).T
            if len(proxy) < window or max(trend_p_value(proxy), trend_p_value(-gold)) >= SIGNIFICANCE:
                continue
            text = (
                f"Over {window} evaluations the score rose from {proxy[0]:.3g} to {proxy[-1]:.3g} while the "
                f"gold score fell from {gold[0]:.3g} to {gold[-1]:.3g}: the policy exploits the reward. "
                "Stop, keep an earlier checkpoint, or choose a larger kl_beta."
            )
            return Alarm("over-optimised", text)
        return None


def trend_p_value(values: np.ndarray) -> float:
    """The chance that values [N >= 3] without a trend have a slope at least as steep upwards: Student's t
    test of the least-squares line over their order, one-sided.
    """
    from scipy.special import stdtr

    order = np.arange(len(values)) - (len(values) - 1) / 2
    centred = values - values.mean()
    slope = float(order @ centred) / float(order @ order)
    left = float(np.square(centred - slope * order).sum())
    if left <= 1e-24 * float(np.square(centred).sum()) or not centred.any():
        return 0.0 if slope > 0 else 1.0
    t = slope / math.sqrt(left / (len(values) - 2) / float(order @ order))
    return float(stdtr(len(values) - 2, -t))
