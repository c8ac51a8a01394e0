"""A language small enough to list every response, and a policy with a row of logits per prefix.

Token 0 is EOS: a response ends with it, or after `length` tokens. Everything is float64.
"""

from itertools import product

import torch
from torch import Tensor, nn

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.maths import divergence, returns

EOS = 0


class Language:
    """All responses over `words` tokens: `tokens`, `mask` [N, length]; `states` numbers the prefixes."""

    def __init__(self, words: int, length: int) -> None:
        self.words, self.length = words, length
        rows = [row for row in product(range(words), repeat=length) if self._is_canonical(row)]
        self.tokens = torch.tensor(rows)
        self.mask = self.mask_of(self.tokens)
        self.prefixes = sum(words**t for t in range(length))

    @staticmethod
    def _is_canonical(row: tuple[int, ...]) -> bool:
        """Of the rows that differ only after their EOS, the one with only EOS there."""
        return EOS not in row or not any(row[row.index(EOS) :])

    @staticmethod
    def mask_of(tokens: Tensor) -> Tensor:
        """True up to and with the first EOS, [B, T]."""
        before = (tokens == EOS).int().cumsum(1) - (tokens == EOS).int()
        return before == 0

    def states(self, tokens: Tensor) -> Tensor:
        """The number of the prefix before each token, [B, T]: the children of n are words * n + 1 + a."""
        numbers = [torch.zeros_like(tokens[:, 0])]
        for t in range(self.length - 1):
            numbers.append(self.words * numbers[-1] + 1 + tokens[:, t])
        return torch.stack(numbers, dim=1)


class Tabular(nn.Module):
    """Logits [prefixes, words] and values [prefixes], both parameters."""

    def __init__(self, language: Language, seed: int, scale: float = 1.0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        shape = (language.prefixes, language.words)
        logits = scale * torch.randn(shape, generator=generator, dtype=torch.float64)
        self.language = language
        self.logits = nn.Parameter(logits)
        self.values = nn.Parameter(torch.randn(shape[0], generator=generator, dtype=torch.float64))

    def logp(self, tokens: Tensor) -> Tensor:
        """Log-probabilities of the tokens, [B, T]."""
        rows = self.logits[self.language.states(tokens)].log_softmax(-1)
        return rows.gather(-1, tokens[..., None])[..., 0]

    def exact(self, tokens: Tensor, reference: "Tabular") -> Tensor:
        """KL(self || reference) of every visited state, [B, T]."""
        states = self.language.states(tokens)
        logp, other = (logits[states].log_softmax(-1) for logits in (self.logits, reference.logits))
        return (logp.exp() * (logp - other)).sum(-1)

    def forward(self, batch: Batch) -> Evaluation:
        """What ppo.update asks of a model."""
        states = self.language.states(batch.actions)
        entropy = divergence.categorical_entropy(self.logits[states])
        return Evaluation(self.logp(batch.actions), entropy, self.values[states])

    def probabilities(self) -> Tensor:
        """p(response) of every response of the language, [N]; differentiable, and they sum to 1."""
        return torch.where(self.language.mask, self.logp(self.language.tokens), 0.0).sum(1).exp()

    @torch.no_grad()
    def sample(self, rows: int, generator: torch.Generator) -> Tensor:
        """Responses [rows, T]; EOS is followed by EOS."""
        tokens = torch.zeros(rows, self.language.length, dtype=torch.int64)
        for t in range(self.language.length):
            probabilities = self.logits[self.language.states(tokens)[:, t]].softmax(-1)
            drawn = torch.multinomial(probabilities, 1, generator=generator)[:, 0]
            tokens[:, t] = torch.where(self.language.mask_of(tokens)[:, t], drawn, EOS)
        return tokens


def objective(policy: Tabular, reference: Tabular, scores: Tensor, kl_beta: float) -> Tensor:
    """E[score] - kl_beta KL(policy || reference) over whole responses, by the definition of both; scalar."""
    p = policy.probabilities()
    return (p * scores).sum() - kl_beta * (p * (p / reference.probabilities().detach()).log()).sum()


def advantages_of(
    rewards: Tensor, values: Tensor, mask: Tensor, gae_lambda: float = 1.0, gamma: float = 1.0
) -> tuple[Tensor, Tensor]:
    """GAE and the critic's targets of responses that end with their last counting step, [B, T] each."""
    ended = mask & ~torch.cat([mask[:, 1:], torch.zeros_like(mask[:, :1])], dim=1)
    following = torch.cat([values[:, 1:], torch.zeros_like(values[:, :1])], dim=1)
    advantages = returns.gae(rewards, values, following, ended, ended, gamma, gae_lambda, mask)
    return advantages, advantages + values


def with_scores(rewards: Tensor, scores: Tensor, mask: Tensor) -> Tensor:
    """The score of each response [B] added to the reward of its last counting step."""
    last = mask.sum(1) - 1
    return rewards.index_put((torch.arange(len(rewards)), last), scores, accumulate=True)


def gradient_of(scalar: Tensor, policy: Tabular) -> Tensor:
    """d scalar / d logits, [prefixes, words]."""
    (gradient,) = torch.autograd.grad(scalar, policy.logits)
    return gradient
