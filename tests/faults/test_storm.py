"""A quick version of `make storm`: a few kills of one story, by the same script."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks/storm.py"


STORIES = {"pendulum": 5, "workers": 3, "vector": 1, "bipedal": 2, "masks": 1, "language": 1}


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
@pytest.mark.parametrize(("story", "seed"), STORIES.items())
def test_a_small_storm(tmp_path, story, seed):
    if story == "bipedal":
        pytest.importorskip("Box2D")
    words = ["--stories", story, "--kills", "3", "--seed", str(seed), "--out", str(tmp_path / "out.json")]
    ended = subprocess.run([sys.executable, SCRIPT, *words], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = json.loads((tmp_path / "out.json").read_text())["stories"][story]
    assert found["kills"] == 3 and found["all_equal"] and len(found["log"]) == 3 + found["signals"]
    assert {entry["run"] for entry in found["log"]} <= {1, 2, 3}
