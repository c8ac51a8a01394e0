"""Do the properties detect mistakes? Each mutant is the package with one classic mistake seeded."""

import importlib
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
from properties import MODULES, check_all

import tightrope.maths

SOURCE = Path(tightrope.maths.__file__).parent


class Mutant(NamedTuple):
    mistake: str
    file: str
    right: str
    wrong: str


MUTANTS = (
    Mutant("gamma is missing", "returns.py", "rewards + gamma * future", "rewards + future"),
    Mutant("the value is added", "returns.py", "future - values", "future + values"),
    Mutant(
        "the value after a termination is multiplied away, so that NaN survives",
        "returns.py",
        "torch.where(terminated, 0.0, next_values)",
        "next_values * ~terminated",
    ),
    Mutant(
        "a termination bootstraps",
        "returns.py",
        "where(terminated, 0.0, next_values)",
        "where(terminated, next_values, next_values)",
    ),
    Mutant(
        "the mask of TD errors is lost",
        "returns.py",
        "deltas if mask is None else",
        "deltas if mask is not None else",
    ),
    Mutant(
        "the trace is cut at terminations alone",
        "returns.py",
        "torch.where(ended[:, t], 0.0, trace)",
        "torch.where(terminated[:, t], 0.0, trace)",
    ),
    Mutant("the trace is never cut", "returns.py", "torch.where(ended[:, t], 0.0, trace)", "trace"),
    Mutant(
        "the two flags are swapped",
        "returns.py",
        "deltas = _td_errors(rewards, values, next_values, terminated, gamma, mask)",
        "deltas = _td_errors(rewards, values, next_values, ended, gamma, mask)",
    ),
    Mutant("lambda is missing from the trace", "returns.py", "gamma * gae_lambda * torch", "gamma * torch"),
    Mutant(
        "all rows have the lambda of the first",
        "returns.py",
        "gae_lambda.to(rewards)",
        "gae_lambda[0].to(rewards)",
    ),
    Mutant(
        "gamma is missing from the trace", "returns.py", "gamma * gae_lambda * torch", "gae_lambda * torch"
    ),
    Mutant(
        "the trace passes through a masked step",
        "returns.py",
        "trace = torch.where(mask[:, t], trace, 0.0)",
        "pass",
    ),
    Mutant(
        "advantages come out backwards",
        "returns.py",
        "torch.stack(advantages[::-1], dim=1)",
        "torch.stack(advantages, dim=1)",
    ),
    Mutant(
        "a return bootstraps without an end",
        "returns.py",
        "torch.where(ended[:, t], tail[:, t], future)",
        "(future + tail[:, t])",
    ),
    Mutant(
        "the end of the rollout is worth nothing",
        "returns.py",
        "future = tail[:, -1]",
        "future = 0 * tail[:, -1]",
    ),
    Mutant("the sign of the policy loss", "surrogate.py", "return -surrogate", "return surrogate"),
    Mutant(
        "the min is lost",
        "surrogate.py",
        "torch.minimum(ratio * advantages, ratio.clamp(1 - clip, high) * advantages)",
        "ratio.clamp(1 - clip, high) * advantages",
    ),
    Mutant("the min is a max", "surrogate.py", "surrogate = torch.minimum(", "surrogate = torch.maximum("),
    Mutant(
        "the clip is lost", "surrogate.py", "ratio.clamp(1 - clip, high) * advantages", "ratio * advantages"
    ),
    Mutant("the upper clip is ignored", "surrogate.py", "clip if clip_high is None else clip_high", "clip"),
    Mutant(
        "the dual clip bounds good actions",
        "surrogate.py",
        "torch.where(advantages < 0, bounded, surrogate)",
        "torch.where(advantages > 0, bounded, surrogate)",
    ),
    Mutant(
        "a clipped step overflows",
        "surrogate.py",
        "torch.minimum(log_ratio, limit.to(log_ratio.dtype)).exp()",
        "log_ratio.exp()",
    ),
    Mutant("the ratio is upside down", "surrogate.py", "logp - old_logp", "old_logp - logp"),
    Mutant(
        "the log-ratio is masked by a product",
        "surrogate.py",
        "torch.where(mask, logp - old_logp, 0.0)",
        "(logp - old_logp) * mask",
    ),
    Mutant("the KL is a reward", "surrogate.py", "- kl_beta * k3", "+ kl_beta * k3"),
    Mutant(
        "the sign of the policy gradient",
        "surrogate.py",
        "return -logp * advantages",
        "return logp * advantages",
    ),
    Mutant("the lower clip is counted above", "surrogate.py", "ratio < 1 - clip", "ratio < 1 + clip"),
    Mutant("the half is missing", "values.py", "0.5 * error.square()", "error.square()"),
    Mutant(
        "the max is lost",
        "values.py",
        "torch.maximum(squared_error(values, returns, mask), squared_error(clipped, returns, mask))",
        "squared_error(clipped, returns, mask)",
    ),
    Mutant("the max is a min", "values.py", "torch.maximum(", "torch.minimum("),
    Mutant(
        "the clip is around the return",
        "values.py",
        "clipped = old_values + (values - old_values)",
        "clipped = returns + (values - returns)",
    ),
    Mutant(
        "the masked error keeps its gradient", "values.py", "torch.where(mask, error, 0.0)", "error * mask"
    ),
    Mutant(
        "explained variance divides by the wrong one",
        "values.py",
        "kept.var(correction=0), (kept",
        "values[mask].double().var(correction=0), (kept",
    ),
    Mutant("k1 has the other sign", "divergence.py", "return -log_ratio", "return log_ratio"),
    Mutant(
        "k3 has the other sign",
        "divergence.py",
        "log_ratio.expm1() - log_ratio",
        "log_ratio.expm1() + log_ratio",
    ),
    Mutant(
        "k3 is of the other direction",
        "divergence.py",
        "log_ratio.expm1() - log_ratio",
        "(-log_ratio).expm1() + log_ratio",
    ),
    Mutant(
        "entropy has the other sign",
        "divergence.py",
        "return -(logp.exp() * finite_logp)",
        "return (logp.exp() * finite_logp)",
    ),
    Mutant(
        "entropy of a masked choice is NaN",
        "divergence.py",
        "torch.where(logits == -torch.inf, 0.0, logp)",
        "logp",
    ),
    Mutant("entropy is not normalised", "divergence.py", "logp = logits.log_softmax(-1)", "logp = logits"),
    Mutant("a Gaussian of variance std", "divergence.py", "(log_std + 0.5 +", "(0.5 * log_std + 0.5 +"),
    Mutant("half of a bit", "divergence.py", "softplus(finite) - p * finite", "softplus(finite)"),
    Mutant(
        "a masked bit is a fair one",
        "divergence.py",
        "torch.where(certain, 0.0, entropies)",
        "entropies",
    ),
    Mutant("the sum counts masked steps", "statistics.py", "torch.where(mask, x, 0.0).sum()", "x.sum()"),
    Mutant(
        "the sum is masked by a product",
        "statistics.py",
        "torch.where(mask, x, 0.0).sum()",
        "(x * mask).sum()",
    ),
    Mutant("the mean divides by all steps", "statistics.py", "mask.sum().clamp(min=1)", "mask.numel()"),
    Mutant("the global count is ignored", "statistics.py", "if count is None:", "if True:"),
    Mutant(
        "sample variance for population",
        "statistics.py",
        "(masked_variance(wide, mask).sqrt()",
        "(masked_variance(wide, mask, mask.sum() - 1).sqrt()",
    ),
    Mutant(
        "variance for standard deviation",
        "statistics.py",
        "masked_variance(wide, mask).sqrt()",
        "masked_variance(wide, mask)",
    ),
    Mutant("a single step is standardised", "statistics.py", "mask.sum() > 1", "mask.sum() > 0"),
    Mutant("masked steps become -mean / std", "statistics.py", "torch.where(mask, result, 0.0)", "result"),
    Mutant(
        "advantages are standardised in float32",
        "statistics.py",
        "torch.where(mask, x, 0.0).double()",
        "torch.where(mask, x, 0.0)",
    ),
    Mutant(
        "running variance forgets the shift",
        "statistics.py",
        "squares = squares + shift.square() * self.count * added / total",
        "pass",
    ),
    Mutant("running mean counts every batch alike", "statistics.py", "shift * added / total", "shift / 2"),
    Mutant("running variance is the sample's", "statistics.py", "squares / total)", "squares / (total - 1))"),
)


@pytest.fixture
def load(tmp_path: Path) -> Iterator[Callable[[Mutant | None], ModuleType]]:
    """Copies the package, seeds the mistake and imports the copy under its own name."""
    name = "mutated_maths"

    def copy_and_import(mutant: Mutant | None) -> ModuleType:
        folder = tmp_path / name
        shutil.copytree(SOURCE, folder, ignore=shutil.ignore_patterns("__pycache__"))
        if mutant is not None:
            text = (folder / mutant.file).read_text()
            assert text.count(mutant.right) == 1, f"{mutant.right!r} must stand in {mutant.file} exactly once"
            (folder / mutant.file).write_text(text.replace(mutant.right, mutant.wrong))
        importlib.invalidate_caches()
        for module in MODULES:
            importlib.import_module(f"{name}.{module}")
        return sys.modules[name]

    sys.path.insert(0, str(tmp_path))
    yield copy_and_import
    sys.path.remove(str(tmp_path))
    for module in [module for module in sys.modules if module.split(".")[0] == name]:
        del sys.modules[module]


def test_the_current_package_passes(load: Callable[[Mutant | None], ModuleType]) -> None:
    copy = load(None)
    assert copy is not tightrope.maths
    check_all(copy)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.mistake)
def test_every_mutant_is_killed(mutant: Mutant, load: Callable[[Mutant | None], ModuleType]) -> None:
    copy = load(mutant)
    with pytest.raises(AssertionError):
        check_all(copy)
