"""The events that training loops send are those that panel.py documents, and a warning is said in one way."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from contracts.source_tree import sources
from language.tiny import saved, tiny_llama

from tightrope.cli import panel
from tightrope.cli.language_display import ALIGN, Display
from tightrope.control.settings import TrainSettings
from tightrope.control.train import train
from tightrope.language.alignment.align import align
from tightrope.language.settings import RewardSettings, SFTSettings
from tightrope.language.supervised.preferences import train_reward
from tightrope.language.supervised.sft import train_sft
from tightrope.training import report

Events = list[tuple[str, dict[str, Any]]]


def documented() -> dict[str, set[str]]:
    """Event -> keys, as the list at the top of panel.py has them; "finish" has those of summary.json."""
    items = re.findall(r"^- ``(\w+)``(.*?)(?=^- |^$)", panel.__doc__ or "", re.MULTILINE | re.DOTALL)
    return {event: set(re.findall(r"``([\w/]+)``", rest)) for event, rest in items}


def control(folder: Path, sent: Any) -> None:
    settings = TrainSettings(env="CartPole-v1", num_envs=2, total_steps=256, engine="torch")
    settings = settings.with_values(num_steps=64, clip=0.9, evaluation_episodes=1)  # the clip is a risk
    train(settings, run_dir=folder, report=sent)


def language(folder: Path, sent: Any) -> None:
    align(
        model=saved(folder.parent / "model", tiny_llama()), prompts=["ab", "cde"], reward=vowels,
        total_episodes=16, batch_size=8, minibatch_size=8, max_new_tokens=4, lora_rank=2, run_dir=folder,
        kl="k3-reward", allow_biased_kl=True, checkpoint_every=0.5, report=sent,
    )  # fmt: skip


def sft(folder: Path, sent: Any) -> None:
    settings = SFTSettings(model=saved(folder.parent / "model", tiny_llama()), num_epochs=1, max_tokens=3)
    train_sft(settings, data=[{"prompt": "ab", "completion": "cd"}] * 4, run_dir=folder, report=sent)


def reward(folder: Path, sent: Any) -> None:
    settings = RewardSettings(model=saved(folder.parent / "model", tiny_llama()), num_epochs=1, max_tokens=3)
    rows = [{"prompt": "ab", "chosen": "cd", "rejected": "e"}] * 4
    train_reward(settings, data=rows, run_dir=folder, report=sent)


def vowels(completions: list[str], **_: Any) -> list[float]:
    return [sum(c in "aeiou" for c in text) / 4 for text in completions]


OWN = {control: {"evaluation"}, language: {"samples"}, sft: set(), reward: set()}


@pytest.mark.parametrize("run", OWN)
def test_what_is_sent_is_what_is_documented(run: Any, tmp_path: Path) -> None:
    events: Events = []
    run(tmp_path / "run", lambda event, data: events.append((event, data)))
    known = documented()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    known["finish"] = set(summary)
    assert {event for event, _ in events} == {"line", "start", "update", "finish"} | OWN[run]
    for event, data in events:
        assert set(data) == known[event], event
    assert set(documented()) == {"line", "start", "update", "finish", "evaluation", "samples"}
    warnings = [data["text"] for event, data in events if event == "line" and data["warning"]]
    assert warnings and not any(text.startswith("warning") for text in warnings)


def test_only_one_place_sends_lines() -> None:
    senders = [path.name for path in sources() if re.search(r'report\(\s*"line"', path.read_text())]
    assert senders == ["report.py"]


@pytest.mark.parametrize("quiet", [False, True])
def test_both_displays_tell_a_warning_by_its_key(quiet: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """The text of a fact may begin with any word; that of a warning need not."""
    import sys

    displays = panel.choose(sys.stdout, quiet=quiet, live=False), Display(ALIGN, "x", sys.stdout, quiet=quiet)
    for display in displays:
        report.warn(display, "clip is high")
        report.say(display, "warning: is the first word of a fact")
        report.teller(display)("warning: of a run\x1b")
        out, err = capsys.readouterr()
        assert err == "warning: clip is high\nwarning: of a run\\x1b\n"
        assert out == ("" if quiet else "warning: is the first word of a fact\n")
