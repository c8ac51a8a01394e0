"""The arithmetic of the speed benchmark, against numbers computed by hand, and the page that it fills."""

from __future__ import annotations

import ast
import json
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import film_reviews  # noqa: E402
import packages  # noqa: E402
import scaling  # noqa: E402
import speed  # noqa: E402
import speed_peers  # noqa: E402
import speed_report as report  # noqa: E402

SPEC = spec_from_file_location("benchmark_of_language", BENCHMARKS / "language.py")
assert SPEC is not None and SPEC.loader is not None
language = module_from_spec(SPEC)
SPEC.loader.exec_module(language)
sys.path.remove(str(BENCHMARKS))  # tests/language would be hidden by language.py

SMALL = speed.SCENARIOS[0]


def test_rate_is_a_difference():
    """3 s of start-up in both processes change nothing: 10,000 steps in 2 s."""
    assert report.rate({"steps": 1000, "wall": 3.2}, {"steps": 11_000, "wall": 5.2}) == pytest.approx(5000)


@pytest.mark.parametrize("steps, wall", [(2000, 3.1), (1000, 4.0)])
def test_rate_refuses_noise(steps: int, wall: float):
    with pytest.raises(ValueError, match="longer|long run"):
        report.rate({"steps": 1000, "wall": 3.2}, {"steps": steps, "wall": wall})


def test_rate_refuses_a_difference_within_the_noise():
    short, long = {"steps": 1000, "wall": 3.0}, {"steps": 7000, "wall": 3.03}
    assert report.rate(short, long) == pytest.approx(200_000)  # thirty milliseconds of start-up noise
    with pytest.raises(ValueError, match="more than 1 s"):
        report.rate(short, long, least_seconds=1.0)


def test_ratio_is_the_median_over_pairs():
    """A slowdown of both sides in a pair does not change the ratio."""
    found = report.ratio([100.0, 10.0, 90.0], [10.0, 1.0, 5.0])
    assert found == {"median": 10.0, "low": 10.0, "high": 18.0}


def test_flops_of_an_update():
    """4-64-64-2, 64 rows, 256 + 4096 + 128 = 4480 weights: forward and weight gradients 2 * 64 * 4480 each,
    gradients of the inputs of layers two and three 2 * 64 * 4224.
    """
    assert report.update_flops([(4, 64, 64, 2)], 64) == 573_440 + 573_440 + 540_672
    both = report.update_flops([(4, 64, 64, 2), (4, 64, 64, 1)], 64)
    assert both == 1_687_552 + 1_662_976
    assert report.floor_microseconds(both, 112.0) == pytest.approx(29.915, abs=1e-3)


def test_optimiser_steps_round_up():
    assert report.optimiser_steps(rollouts=3, rows=2048, num_epochs=10, minibatch_size=64) == 3 * 10 * 32
    assert report.optimiser_steps(rollouts=1, rows=2049, num_epochs=10, minibatch_size=64) == 10 * 33


@pytest.mark.parametrize("count, phantoms, good", [
    (640, False, True),
    (639, False, False),
    (641, False, False),
    (640, True, True),
    (660, True, True),
    (639, True, False),  # fewer steps than its transitions require
    (1280, True, False),
])  # fmt: skip
def test_work_is_checked(count: int, phantoms: bool, good: bool):
    run = {"contender": "somebody", "steps": 4096, "optimiser_steps": count}
    if good:
        report.check_work(SMALL, run, phantoms=phantoms)
    else:
        with pytest.raises(ValueError, match="somebody took"):
            report.check_work(SMALL, run, phantoms=phantoms)


def test_shares_add_up():
    shares = report.shares({"env": 50.0, "act": 10.0, "advantages": 5.0, "update": 30.0, "rest": 5.0})
    assert shares["env"] == pytest.approx(0.5)
    assert sum(shares.values()) == pytest.approx(1)


def test_flags_are_those_of_the_command_line():
    """The command line of speed.py parses to the intended settings."""
    from tightrope.cli.options import training_options

    wanted = report.tightrope_settings(SMALL) | {"total_steps": 2048}
    _, values, _ = training_options("train", ["CartPole-v1", *report.flags(wanted)])
    assert values["env"] == "CartPole-v1"
    assert {name: values[name] for name in wanted} == wanted


def test_peers_get_the_same_settings():
    """Every number of a scenario that a peer knows reaches its constructor."""
    source = (BENCHMARKS / "speed_peers.py").read_text()
    read = {
        node.slice.value
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant)
    }
    assert set(SMALL) - {"name", "between", "rollouts"} <= read
    assert "tightrope" not in {
        alias.name.split(".")[0]
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    assert set(speed_peers.PACKAGES) == {"stable-baselines3", "sbx", "purejaxrl"}


def test_fit_of_a_line():
    found = scaling.fit([(1, 5.0), (2, 7.0), (4, 11.0)])  # 3 + 2 x
    assert found["intercept"] == pytest.approx(3) and found["slope"] == pytest.approx(2)
    assert found["spread"] == pytest.approx(0, abs=1e-12)
    assert found["exponent"] < 1
    assert scaling.fit([(1, 2.0), (10, 20.0), (100, 200.0)])["exponent"] == pytest.approx(1)


def test_a_block_is_replaced_and_nothing_else():
    page = "before\n<!-- speed -->\nold\n<!-- /speed -->\nafter\n"
    once = report.fill(page, "speed", "new \\1")
    assert once == "before\n<!-- speed -->\n\nnew \\1\n\n<!-- /speed -->\nafter\n"
    assert report.fill(once, "speed", "new \\1") == once
    with pytest.raises(ValueError, match="scaling"):
        report.fill(page, "scaling", "new")


def _pair(ours: float, theirs: float) -> dict[str, dict[str, float]]:
    return {"tightrope": {"rate": ours}, "stable-baselines3": {"rate": theirs}}


def test_the_report_names_every_figure():
    breakdown = dict.fromkeys(report.PARTS, 20.0) | {"minibatch_microseconds": 50.0, "flops": 3_350_528}
    results = {
        "quick": False,
        "date": "2026-01-02", "command": "python benchmarks/speed.py", "sgemm_gflops": 112.0,
        "machine": {"cpu": "a CPU", "cores": 2, "system": "Linux x86_64"},
        "versions": {"torch": "2"}, "peers": {"stable-baselines3": {"stable-baselines3": "2.9.2"}},
        "start_up": {
            "cold_seconds": 20.0, "cold_memory_mb": 500.0, "warm_seconds": 2.5, "warm_memory_mb": 300.0,
        },
        "scenarios": [SMALL | {
            "pairs": [_pair(60_000, 3000)], "rates": {"tightrope": 60_000.0, "stable-baselines3": 3000.0},
            "ratios": {"stable-baselines3": report.ratio([60_000], [3000])},
            "memory_mb": {"tightrope": 300.0, "stable-baselines3": 320.0},
            "breakdown": breakdown | {"backend": "vector"},
        }],
    }  # fmt: skip
    text = report.speed_text(results)
    for figure in ("60,000", "3,000", "20.0 (20.0-20.0)", "60 %", "29.9", "17.5 s", "320"):
        assert figure in text, figure


def test_the_page_holds_the_committed_figures(tmp_path: Path):
    """Rendering again changes nothing: no figure was edited by hand, and none is older than its JSON."""
    for page in (speed.PAGE, speed.README):
        text = page.read_text(encoding="utf-8")
        copy = tmp_path / page.name
        copy.write_text(text, encoding="utf-8")
        speed.render(copy, speed.RESULTS, speed.SCALING)
        assert copy.read_text(encoding="utf-8") == text, "run: python benchmarks/speed.py --render"


BLOCKS = [
    *[(film_reviews, *block) for block in film_reviews.BLOCKS],
    *[(language, *block) for block in language.BLOCKS],
]


@pytest.mark.parametrize("benchmark, page, name, body", BLOCKS, ids=[block[2] for block in BLOCKS])
def test_pages_of_the_language_story_show_the_committed_results(benchmark, page, name, body):
    results = json.loads(benchmark.RESULTS.read_text(encoding="utf-8"))
    text = page.read_text(encoding="utf-8")
    assert report.fill(text, name, body(results)) == text, f"render {benchmark.__name__}.py again"


def test_the_language_benchmark_runs_the_settings_of_the_demo():
    """The timed settings are those that reached the claimed quality."""
    for name in language.MODELS:
        present = language.STAGES[name]["align"]
        timed = language.values_of(name, "one trunk")
        assert timed["lora_layers"] == present["lora_layers"] and timed["lora_rank"] == present["lora_rank"]
        assert timed.get("kl") == present.get("kl") and timed["dtype"] == "float32"
    assert language.values_of("glassllm", "full")["critic"] == "separate"


def test_an_interval_is_students():
    """1, 2, 3: mean 2, deviation 1, t = 4.303 on two degrees of freedom."""
    assert film_reviews.interval([1.0, 2.0, 3.0], 2) == "2.00 ± 2.48"


def test_committed_results_are_whole_runs():
    """A committed file comes from the full benchmark: all scenarios, at least five pairs, and a peer."""
    if not speed.RESULTS.exists():
        pytest.skip("no results are committed yet")
    results = json.loads(speed.RESULTS.read_text(encoding="utf-8"))
    assert [s["name"] for s in results["scenarios"]] == [s["name"] for s in speed.SCENARIOS]
    assert all(len(s["pairs"]) >= 5 for s in results["scenarios"])
    assert "stable-baselines3" in results["peers"] and not results["quick"]


class TwoRewards(gymnasium.Env):
    """Its steps give as many rewards as its class says."""

    observation_space = gymnasium.spaces.Discrete(2)
    action_space = gymnasium.spaces.Discrete(2)
    rewards: Any = 1.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return 0, {}

    def step(self, action: int) -> tuple[int, Any, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self.steps % 2, self.rewards, self.steps == 9, False, {}


@pytest.mark.parametrize("several", [False, True])
def test_a_package_is_tried_in_every_way(several: bool, monkeypatch: pytest.MonkeyPatch):
    """Stand-ins for packages: one that is right, one that must be refused."""
    env = type("Task", (TwoRewards,), {"rewards": np.ones(2)}) if several else TwoRewards
    refused = "one number. Weigh several rewards" if several else ""
    row = packages.Package("gymnasium", "gymnasium", env, {"engine": "torch"}, 256, refused)
    monkeypatch.setattr(packages, "PACKAGES", {"task": row})
    found = packages.examined("task")
    every = ["learn", "predict", "load", "train", "evaluate", "resume", "load of the run"]
    assert found["right"] and found["held"] == ([] if several else every), found
    assert bool(found["error"]) == several
