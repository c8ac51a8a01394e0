"""When memory runs out, the micro-batches are halved and the step is the same, or the advice is clear."""

import dataclasses

import numpy as np
import pytest
import torch
from test_bad_numbers import RULES, Line, line_batch

from tightrope.algorithms.descent import OutOfMemory, is_out_of_memory
from tightrope.algorithms.optimise import make_optimiser

ERRORS = [
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:114] DefaultCPUAllocator: can't allocate memory"),
    RuntimeError("not enough memory: you tried to allocate 123 bytes"),
    MemoryError(),
]


def step(rule, fits, error=ERRORS[0], micro_batch_size=None, late=False, noise=False, look=None, **more):
    """The parameters and metrics of one update in which passes over more than ``fits`` rows fail."""
    module, settings = RULES[rule]
    settings = dataclasses.replace(settings, micro_batch_size=micro_batch_size)
    model, batch = Line().double(), line_batch().map(lambda x: x.double() if x.is_floating_point() else x)
    optimiser = make_optimiser(model.parameters(), [], settings)
    passes = []

    def asked(part):
        now = model(part)
        if noise:  # drawn row by row, so that a split draws the same
            now = dataclasses.replace(now, entropy=now.entropy + torch.rand(now.entropy.shape))
        if look is not None:
            look.append(part.inputs["drawn"])
        passes.append(len(part))
        if len(part) > fits and (not late or passes.count(len(part)) > 1):
            raise error
        return now

    metrics = module.update(asked, optimiser, batch, settings, np.random.default_rng(0), **more)
    return model.slope.detach(), metrics, passes


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_the_step_is_the_same_in_halves(rule, error):
    whole, plain, _ = step(rule, fits=100)
    halved, metrics, passes = step(rule, fits=2, error=error)
    torch.testing.assert_close(halved, whole, rtol=0, atol=1e-6)
    assert passes == [6, 3, 2, 2, 2]
    assert metrics["train/micro_batch_size"] == 2 and metrics["train/memory_halvings"] == 2
    assert "train/memory_halvings" not in plain
    for name, value in plain.items():  # the sums too, none counted twice
        assert metrics[name] == pytest.approx(value, rel=1e-6, abs=1e-7), name


def test_what_a_failed_pass_added_before_it_failed_is_taken_back():
    """The second part of two fails, after the first has added its gradient and its sums."""
    whole, plain, _ = step("ppo", fits=100)
    halved, metrics, passes = step("ppo", fits=2, micro_batch_size=3, late=True)
    assert passes == [3, 3, 2, 2, 2]
    torch.testing.assert_close(halved, whole, rtol=0, atol=1e-6)
    assert metrics["train/value_loss"] == pytest.approx(plain["train/value_loss"])


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("late", [False, True])
def test_a_pass_that_is_repeated_draws_the_same_random_numbers(rule, late):
    """A custom policy may draw random numbers; torch's restart where the failed pass started."""
    ends = []
    for fits in (100, 2):
        torch.manual_seed(7)
        ends.append((step(rule, fits, micro_batch_size=3, late=late, noise=True), torch.rand(3)))
    (whole, plain, _), (halved, metrics, passes) = (end[0] for end in ends)
    assert passes == ([3, 3, 2, 2, 2] if late else [3, 2, 2, 2])
    assert step(rule, 100)[1]["train/entropy"] != plain["train/entropy"]
    assert metrics["train/entropy"] == pytest.approx(plain["train/entropy"], rel=1e-6)
    torch.testing.assert_close(halved, whole, rtol=0, atol=1e-6)
    assert torch.equal(ends[0][1], ends[1][1])  # and so do those after the update


@pytest.mark.parametrize("rule", RULES)
def test_what_is_drawn_for_a_minibatch_is_drawn_once(rule):
    """Inputs added by `draw` stay with their rows, in every part and repetition."""
    drawn = []

    def draw(batch):
        drawn.append(torch.arange(len(batch)) + 100)
        return dataclasses.replace(batch, inputs={**batch.inputs, "drawn": drawn[-1]})

    step(rule, fits=2, draw=draw, look=(seen := []))
    assert len(drawn) == 1 and torch.equal(torch.cat(seen[-3:]), drawn[0])


def test_a_single_row_that_does_not_fit_ends_with_advice():
    with pytest.raises(OutOfMemory, match="single row.*CUDA out of memory.*--gradient-checkpointing"):
        step("ppo", fits=0)


def test_supervised_steps_are_halved_likewise():
    from tightrope.algorithms.descent import CheckedSteps
    from tightrope.language.settings import SFTSettings
    from tightrope.language.supervised.fit import Objective, take_step

    results = []
    for fits in (9, 2):
        weight, sizes = torch.nn.Parameter(torch.ones(2)), []

        def loss(items, weight=weight, sizes=sizes, fits=fits):
            sizes.append(len(items))
            if len(items) > fits:
                raise ERRORS[0]
            total = sum((weight * torch.tensor([1.0, x])).sum().tanh() for x in items)
            return total, {"figure": torch.tensor(float(len(items)))}

        objective = Objective("sft", "sft", [], loss, lambda item: 1, lambda item: int(item), dict)
        optimiser = torch.optim.SGD([weight], lr=1.0)
        guard, items = CheckedSteps(torch.device("cpu")), [1.0, 2.0, 3.0, 4.0, 5.0]
        metrics = take_step(objective, items, optimiser, guard, SFTSettings())
        assert metrics["sft/figure"] == 1.0
        results.append(weight.detach())
    assert sizes == [5, 3, 2, 2, 1]
    torch.testing.assert_close(*results, rtol=0, atol=1e-6)


def test_other_errors_are_no_matter_of_memory():
    assert not is_out_of_memory(RuntimeError("shapes do not match"))
    with pytest.raises(RuntimeError, match="shapes"):
        step("ppo", fits=2, error=RuntimeError("shapes do not match"))
