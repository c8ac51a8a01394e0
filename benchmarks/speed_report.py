"""Computes and formats the results of the speed benchmark from its raw measurements. Pure functions."""

from __future__ import annotations

import itertools
import math
import re
import statistics
from collections.abc import Sequence
from typing import Any

MATRIX = 64  # the floor's unit of work: single-precision products of MATRIX x MATRIX x MATRIX
PARTS = ("env", "act", "advantages", "update", "rest")


def tightrope_settings(scenario: dict[str, Any]) -> dict[str, Any]:
    """Every setting that could differ between tightrope and its peers; none comes from a preset."""
    names = (
        "num_envs",
        "num_steps",
        "minibatch_size",
        "num_epochs",
        "learning_rate",
        "gamma",
        "gae_lambda",
        "seed",
    )
    return {name: scenario[name] for name in (*names, "entropy_weight")} | {
        "learning_rate_schedule": "constant",
        "entropy_weight_schedule": "constant",
        "clip_schedule": "constant",
        "clip": 0.2,
        "value_clip": None,
        "value_weight": 0.5,
        "target_kl": None,
        "max_grad_norm": 0.5,
        "normalise_advantages": True,
        "normalise_observations": False,
        "normalise_rewards": False,
        "normalise_values": False,
        "hidden": (64, 64),
        "activation": "tanh",
        "shared": False,
        "std": "independent",
        "action_bounds": "clip",
        "evaluate_every": None,
        "checkpoint_every": None,
    }


def flags(settings: dict[str, Any]) -> list[str]:
    """Settings as words of the command line."""
    words: list[str] = []
    for name, value in settings.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, tuple):
            words += [f"--{flag}", *(str(item) for item in value)]
        else:
            words += [f"--{flag}", "none" if value is None else str(value)]
    return words


def rate(short: dict[str, Any], long: dict[str, Any], least_seconds: float = 0.0) -> float:
    """Steps/s by difference: (steps2 - steps1) / (wall2 - wall1) of a short and a long process.

    Both processes pay the same start-up and the same end, so the difference contains only training.
    ValueError if the long run took less than ``least_seconds`` more than the short one: start-up varies by
    tenths of a second, and a small difference would be mostly that.
    """
    steps, wall = long["steps"] - short["steps"], long["wall"] - short["wall"]
    if steps <= 0 or wall <= max(0.0, least_seconds):
        raise ValueError(
            f"the long run took {wall:.3f} s and {steps} steps more than the short; expected more than "
            f"{least_seconds:g} s. Run fewer programs beside the benchmark, or more steps."
        )
    return steps / wall


def ratio(ours: Sequence[float], theirs: Sequence[float]) -> dict[str, float]:
    """Median, smallest and largest of the ratios of paired rates (not the ratio of two medians)."""
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    return {"median": statistics.median(ratios), "low": min(ratios), "high": max(ratios)}


def optimiser_steps(rollouts: int, rows: int, num_epochs: int, minibatch_size: int) -> int:
    """Optimiser steps of ``rollouts`` rollouts of ``rows`` transitions each."""
    return rollouts * num_epochs * math.ceil(rows / minibatch_size)


def check_work(scenario: dict[str, Any], run: dict[str, Any], *, phantoms: bool) -> None:
    """ValueError unless a run took the optimiser steps that its transitions require.

    If every row of a rollout is a transition, the number must be exact. ``phantoms``: a NEXT_STEP vector
    environment spends a row on each reset. tightrope does not count such rows as steps, fills its budget with
    more (and possibly shorter) rollouts, and so takes a few per cent *more* optimiser steps for the same
    transitions, never fewer.
    """
    rollout = scenario["num_envs"] * scenario["num_steps"]
    epochs, size = scenario["num_epochs"], scenario["minibatch_size"]
    fewest, seen = math.ceil(run["steps"] * epochs / size), run["optimiser_steps"]
    exact = optimiser_steps(run["steps"] // rollout, rollout, epochs, size)
    if not (fewest <= seen <= 1.25 * fewest + epochs if phantoms else seen == exact):
        raise ValueError(
            f"{run['contender']} took {seen} optimiser steps for {run['steps']} steps of {scenario['name']}; "
            f"expected {f'about {fewest}' if phantoms else exact}. Its settings are not the scenario's."
        )


def update_flops(networks: Sequence[Sequence[int]], rows: int) -> int:
    """Floating-point operations of the matrix products of one minibatch update.

    ``networks``: layer sizes, e.g. (4, 64, 64, 2). A product [m, k] x [k, n] counts 2 m k n. Each layer has
    one forward, one for the gradient of its weight and, except for the first layer, one for that of its
    input.
    """
    total = 0
    for sizes in networks:
        layers = [a * b for a, b in itertools.pairwise(sizes)]
        total += 2 * rows * (3 * sum(layers) - layers[0])
    return total


def floor_microseconds(flops: float, gflops: float) -> float:
    """The time of these operations on one core at the measured rate of the products, in microseconds."""
    return flops / (gflops * 1e3)


def shares(breakdown: dict[str, Any]) -> dict[str, float]:
    """The parts of a breakdown as fractions of their sum."""
    total = sum(breakdown[part] for part in PARTS)
    return {part: breakdown[part] / total for part in PARTS}


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table that also reads well in a terminal: columns aligned, the first to the left."""
    lines = [list(head), *(list(row) for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]

    def text(line: Sequence[str]) -> str:
        cells = [
            c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True))
        ]
        return "| " + " | ".join(cells) + " |"

    rule = ["-" * widths[0], *("-" * (w - 1) + ":" for w in widths[1:])]
    return "\n".join([text(lines[0]), "| " + " | ".join(rule) + " |", *(text(line) for line in lines[1:])])


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:,.0f}"


def _ratio_text(found: dict[str, float] | None) -> str:
    if found is None:
        return "-"
    return f"{found['median']:.1f} ({found['low']:.1f}-{found['high']:.1f})"


def _settings_text(s: dict[str, Any]) -> str:
    return f"{s['num_envs']} x {s['num_steps']}, {s['minibatch_size']}, {s['num_epochs']}"


def speed_table(results: dict[str, Any]) -> str:
    """Median steps/s of all contenders; our ratio to each peer: median over the pairs (smallest-largest)."""
    peers = list(results["peers"])
    head = ["scenario", "environment", "envs x steps, minibatch, epochs", "tightrope", *peers]
    rows = []
    for s in results["scenarios"]:
        row = [s["name"], s["env"], _settings_text(s), _number(s["rates"]["tightrope"])]
        row += [_number(s["rates"].get(peer)) for peer in peers]
        rows.append([*row, *(_ratio_text(s["ratios"].get(p)) for p in peers)])
    return table([*head, *(f"ratio to {peer}" for peer in peers)], rows)


def short_text(results: dict[str, Any]) -> str:
    """Steps/s of all contenders and our ratio to each, for the README."""
    peers = list(results["peers"])
    head = ["task", "envs x steps, minibatch, epochs", "tightrope", *(f"{p} (ratio)" for p in peers)]
    rows = []
    for s in results["scenarios"]:
        beside = {p: f"{_number(s['rates'][p])} ({found['median']:.1f})" for p, found in s["ratios"].items()}
        cells = [beside.get(peer, "-") for peer in peers]
        rows.append([s["env"], _settings_text(s), f"**{_number(s['rates']['tightrope'])}**", *cells])
    machine = results["machine"]
    where = f"{machine['cpu']}, {machine['cores']} cores, {results['date']}"
    return f"{table(head, rows)}\n\nSteps/s, medians; {where}."


def breakdown_table(results: dict[str, Any]) -> str:
    """Our time per step of all environments, by part, and a minibatch update beside its floor."""
    head = [
        "scenario",
        "environments",
        *(f"{part} us" for part in PARTS),
        "us a minibatch",
        "floor us",
        "of the floor",
    ]
    rows = []
    for s in results["scenarios"]:
        b = s["breakdown"]
        parts = [f"{b[part]:.1f} ({100 * share:.0f} %)" for part, share in shares(b).items()]
        floor = floor_microseconds(b["flops"], results["sgemm_gflops"])
        minibatch = b["minibatch_microseconds"]
        rows.append(
            [
                s["name"],
                b["backend"],
                *parts,
                f"{minibatch:.1f}",
                f"{floor:.1f}",
                f"{100 * floor / minibatch:.0f} %",
            ]
        )
    return table(head, rows)


def memory_table(results: dict[str, Any]) -> str:
    """Peak memory of each contender in MB, warm cache."""
    names = ["tightrope", *results["peers"]]
    rows = [[s["name"], *(_number(s["memory_mb"].get(name)) for name in names)] for s in results["scenarios"]]
    return table(["scenario", *(f"{name} MB" for name in names)], rows)


def speed_text(results: dict[str, Any]) -> str:
    """The results as a Markdown text: the terminal's output and the page's block."""
    machine, start = results["machine"], results["start_up"]
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    peers = "; ".join(
        f"{peer} ({', '.join(f'{name} {version}' for name, version in found.items())})"
        for peer, found in results["peers"].items()
    )
    pairs = min((len(s["pairs"]) for s in results["scenarios"]), default=0)
    trial = ["**A trial (--quick): differences this short are mostly noise. Not a measurement.**", ""]
    return "\n".join(
        [
            *(trial if results["quick"] else []),
            f"Measured {results['date']} on {machine['cpu']}, {machine['cores']} cores, {machine['system']}:",
            f"`{results['command']}`, {pairs} pairs a scenario.",
            f"tightrope with {versions}. Peers: {peers or 'none found'}.",
            "",
            "Steps/s of the whole training loop, medians; ratios are medians over pairs (smallest-largest):",
            "",
            speed_table(results),
            "",
            "Where our time goes, in microseconds per step of all environments of a scenario, and one",
            "minibatch update beside its floor (the matrix products alone, on one core, at the",
            f"{results['sgemm_gflops']:.0f} GFLOP/s measured for {MATRIX} x {MATRIX} x {MATRIX};",
            "actor and critic may use a core each, so that 100 % is no limit):",
            "",
            breakdown_table(results),
            "",
            "Peak memory of whole processes, workers included:",
            "",
            memory_table(results),
            "",
            f"A short run with an empty cache takes {start['cold_seconds']:.1f} s from start to end, at most",
            f"{start['cold_memory_mb']:,.0f} MB; the same run once cached {start['warm_seconds']:.1f} s,",
            f"{start['warm_memory_mb']:,.0f} MB. Compilation is the difference,",
            f"{start['cold_seconds'] - start['warm_seconds']:.1f} s, once per version and machine.",
        ]
    )


def scaling_text(results: dict[str, Any]) -> str:
    """The scaling results as a Markdown text."""
    rows = [
        [
            name,
            " ".join(f"{x:g}" for x, _ in series["points"]),
            f"{series['spread']:.2f}",
            f"{series['exponent']:.2f}",
        ]
        for name, series in results["series"].items()
    ]
    lines = [f"Measured {results['date']} with `{results['command']}`.", ""]
    lines.append(table(["cost against", "measured at", "fit: 1 - R^2", "exponent"], rows))
    for name, series in results["series"].items():
        a, b = series["intercept"], series["slope"]
        points = ", ".join(f"{x:g}: {y:.4g}" for x, y in series["points"])
        lines += ["", f"- {name} ({series['unit']}): {points}; fit {a:.3g} + {b:.3g} x"]
    return "\n".join(lines)


def fill(page: str, name: str, body: str) -> str:
    """The page with the block ``<!-- name -->`` to ``<!-- /name -->`` replaced; ValueError if missing."""
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    if len(pattern.findall(page)) != 1:
        raise ValueError(
            f"the page has no single block <!-- {name} --> ... <!-- /{name} -->; put one where it belongs."
        )
    return pattern.sub(lambda match: f"{match[1]}\n{body}\n\n{match[2]}", page)
