"""The KL divergence to the reference: where it acts, what gradient it has there, and how its weight adapts.

RLHF maximises, over responses a_0 a_1 ... of the policy pi, with s_t = prompt and tokens before a_t,

    J = E[ sum_t r_t ] - kl_beta * KL,        KL = E[ sum_t k1_t ] = E[ sum_t D(s_t) ]
    k1_t = log pi(a_t|s_t) - log pi_ref(a_t|s_t),     D(s) = KL( pi(.|s) || pi_ref(.|s) ), exact

all sums over one response, in nats. Changing pi changes the KL in two ways, and a right gradient has both:

    grad KL = E[ sum_t grad D(s_t) ]                                     this state: another choice here
            + E[ sum_t grad log pi(a_t|s_t) * sum_{u > t} D(s_u) ]       later states: other states reached

A cost c_t in the reward enters the policy gradient as grad log pi(a_t|s_t) (c_t + c_{t+1} + ...), a cost in
the loss by its own derivative. That decides what each form is, in expectation:

    form           in the reward of step t   in the loss of step t   this state              later states
    k1-reward      -kl_beta k1_t             -                       right                   right
    exact-split    -kl_beta D(s_{t+1})       kl_beta D(s_t)          right, without noise    right
    k2-loss        -                         kl_beta k2_t            right                   not seen
    exact-loss     -                         kl_beta D(s_t)          right, without noise    not seen

The pure loss forms are blind: pi does not learn to avoid tokens that lead to states in which it will differ
much from the reference. Of the two right ones k1-reward has less noise near the optimum: there
sum_t (r_t - kl_beta k1_t) is the same for every response, and with a good critic the noise of the scores and
that of the KL cancel. Where the policy has moved away without a gain in score, exact-split has less.

Other forms have a wrong gradient and are not offered. In this state: k2 in the reward has E[k2 grad log pi],
of second order near the reference, so that small departures cost almost nothing; k3 in the reward has that of
KL(pi || ref) - KL(ref || pi), which nearly cancel there; the exact KL in the reward has none; k1 in the loss
has an expected gradient of 0; k3 in the loss has that of KL(ref || pi).

Three things keep kl_beta the price of one nat in units of the reward:

- **Scale.** ppo.update takes the mean of the policy loss over the counting steps of the whole minibatch, its
  sum / count; `kl_loss` divides its sum by the same global count. With gamma 1 and lambda 1 (or a perfect
  critic) the expected gradient of the total is then that of J times one common factor, responses / count,
  the reciprocal of the mean length. A mean over responses in one of them would weigh the KL by the length.
- **Advantage normalisation** divides the advantages, and so the scores and a KL in the *reward*, by their
  deviation sigma. k1-reward keeps its relation to the scores (subtracting the mean is a baseline). A KL in
  the *loss* is not divided: its weight silently becomes kl_beta * sigma, and the two halves of exact-split
  no longer belong together. Exact equality needs ``normalise_advantages`` off; to have both, take
  `shared_scale` before the update. The same goes for rewards that are whitened.
- **Epochs.** The actions are those of the old policy. The exact KL in the loss is that of the policy as it is
  now, in every epoch; for k2, weights pi / pi_old (``log_ratio``) correct for it. A KL in the reward is that
  of the sampling policy, and the clip acts on it as on the rest of the advantage.

Sources: Schulman, http://joschu.net/blog/kl-approx.html; Ziegler et al. 2019, arXiv 1909.08593.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tightrope.language.settings import KL_FORMS
from tightrope.maths import divergence, statistics, surrogate
from tightrope.maths.statistics import require_same_shape

LARGEST_CHANGE = 0.2  # Ziegler 2019: the relative error of the KL is clipped to +- this


def kl_rewards(
    form: str,
    kl_beta: float,
    logp: Tensor,
    ref_logp: Tensor,
    exact: Tensor | None,
    mask: Tensor,
    gamma: float = 1.0,
) -> Tensor:
    """What a form adds to the rewards, [B, R]: -kl_beta * KL of the step; 0 where masked, no gradient.

    ``logp``, ``ref_logp`` [B, R]: log-probabilities of the sampled tokens, the sampling policy's and the
    reference's. ``exact`` [B, R]: D(s_t), None where the form does not need it. Pure loss forms give 0.
    With exact-split step t pays for the state it leads to, gamma * D(s_{t+1}), and the last step of a
    response for nothing (where the critic continues a cut response, the KL of that one state is left out).
    ``gamma`` is that of the returns. The counting steps of a row must be contiguous and start at column 0.
    ValueError when shapes differ, ``exact`` is missing, or the KL of a counting step is not finite.
    """
    exact = _checked(form, logp, ref_logp, exact, mask)
    if form.endswith("loss") or kl_beta == 0:
        return torch.zeros_like(logp)
    with torch.no_grad():
        if form == "k1-reward":
            kl = divergence.k1(_log_ratio(logp, ref_logp, mask))
        else:
            following = torch.where(mask, exact, 0.0)[:, 1:]
            kl = gamma * torch.nn.functional.pad(following, (0, 1))
        _require_finite(kl)
        return torch.where(mask, -kl_beta * kl, 0.0)


def kl_loss(
    form: str,
    logp: Tensor,
    ref_logp: Tensor,
    exact: Tensor | None,
    mask: Tensor,
    count: float | Tensor,
    log_ratio: Tensor | None = None,
) -> Tensor | None:
    """The mean KL of a minibatch, a scalar to be multiplied by kl_beta; None for k1-reward: it has no loss.

    sum over the counting steps given here / ``count``, the number of counting steps of the WHOLE minibatch.
    This is the scale of ppo.update's own policy loss: kl_beta weighs it against rewards, and parts add up.
    ``logp`` and ``exact`` are of the policy as it is now, with their graphs. ``log_ratio`` [B, R] =
    log pi / pi_old, no gradient flows through it: k2 is weighted with pi / pi_old, which keeps its expected
    gradient right when the policy has moved since it sampled. None: no weights, which is right only in the
    first step. The exact forms need none. ValueError when shapes differ or ``exact`` is missing.
    """
    steps = _checked(form, logp, ref_logp, exact, mask)
    if form == "k1-reward":
        return None
    if form == "k2-loss":
        steps = divergence.k2(_log_ratio(logp, ref_logp.detach(), mask))
        if log_ratio is not None:
            require_same_shape(log_ratio=log_ratio, mask=mask)
            steps = steps * torch.where(mask, log_ratio.detach(), 0.0).exp()
    return statistics.masked_mean(steps, mask, count)


def shared_scale(advantages: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Standardised advantages [B, R] of a whole rollout, and the scalar 1 / sigma that did it.

    For a KL in the loss together with normalised advantages: switch ``normalise_advantages`` off in
    ppo.update and multiply kl_beta of `kl_loss` by the scalar, so that rewards and KL keep their relation.
    It is 1 where nothing can be scaled: a single step, or equal advantages.
    """
    sigma = statistics.masked_variance(torch.where(mask, advantages, 0.0).double(), mask).sqrt()
    scale = torch.where((mask.sum() > 1) & (sigma > 0), 1 / (sigma + 1e-8), 1.0)
    return statistics.standardise(advantages, mask), scale.to(advantages.dtype)


def adapted(kl_beta: float, kl: float, episodes: int, *, target: float, horizon: float) -> float:
    """kl_beta after ``episodes`` more responses whose mean KL was ``kl`` nats.

    kl_beta *= 1 + clip(kl / target - 1, -0.2, 0.2) * episodes / horizon. The KL of a response is the *sum*
    over its tokens: a mean over tokens is far below any target, and kl_beta would only ever fall.
    ``horizon``, above 0.2 episodes: responses over which kl_beta may change by a fifth. ValueError when the
    KL is not finite. Source: Ziegler et al. 2019, section 2.2 (there target 6, horizon 10000).
    """
    if not math.isfinite(kl):
        raise ValueError(f"the KL is {kl!r}; kl_beta cannot adapt to it.")
    error = min(max(kl / target - 1, -LARGEST_CHANGE), LARGEST_CHANGE)
    return kl_beta * (1 + error * episodes / horizon)


def _checked(form: str, logp: Tensor, ref_logp: Tensor, exact: Tensor | None, mask: Tensor) -> Tensor:
    """The exact KL, zeros where the form does not need it; ValueError for arguments that do not fit."""
    if form not in KL_FORMS:
        raise ValueError(f"kl is {form!r}; expected one of {', '.join(KL_FORMS)}.")
    require_same_shape(logp=logp, ref_logp=ref_logp, exact=exact, mask=mask)
    if not form.startswith("exact"):
        return torch.zeros_like(logp)
    if exact is None:
        raise ValueError(f"kl {form!r} needs the exact KL of every state [B, R]; exact is None.")
    return exact


def _log_ratio(logp: Tensor, ref_logp: Tensor, mask: Tensor) -> Tensor:
    """log ref / pi per step, 0 where masked: divergences have the sampler, here the policy, on the left."""
    return surrogate.log_ratio(ref_logp, logp, mask)


def _require_finite(kl: Tensor) -> None:
    bad = (~torch.isfinite(kl)).nonzero()
    if len(bad):
        row, step = bad[0].tolist()
        raise ValueError(
            f"The KL to the reference is {float(kl[row, step])} at response {row}, step {step}. The policy "
            "chose a token to which the reference gives probability 0 (another top-k, another vocabulary?), "
            "or a model's weights are not finite."
        )
