"""No warning or progress bar of a library reaches the terminal, and all switches are restored afterwards."""

import os
import subprocess
import sys
import warnings

import pytest
from language.tiny import saved, tiny_llama

from tightrope.language.model.load import quiet_libraries

PROGRAM = """
from tightrope.language import align, sample_run
from tightrope.language.alignment.align import resume_align
from tightrope.language.model.packaged import find_model
from tightrope.language.settings import RewardSettings, SFTSettings
from tightrope.language.supervised.preferences import resume_reward, train_reward
from tightrope.language.supervised.sft import resume_sft, train_sft

def reward(prompts, completions, **columns):
    return [float(len(c)) for c in completions]

small = dict(total_episodes=8, batch_size=8, minibatch_size=8, max_new_tokens=4, max_prompt_tokens=8)
run = align(model={model!r}, prompts=["ab", "ba"], reward=reward, seed=1, run_dir="run", **small)
assert len(sample_run(run.path)) == 2
resume_align(run.path, prompts=["ab", "ba"], reward=reward)

assert find_model("glassllm").startswith("cache")  # unpacked here

few = dict(model={model!r}, num_epochs=1, minibatch_size=2, max_tokens=16, lora_rank=2)
texts = [{{"prompt": "ab", "completion": "cd"}}] * 4
train_sft(SFTSettings(**few), data=texts, run_dir="sft")
resume_sft("sft", data=texts)
pairs = [{{"prompt": "ab", "chosen": "cd", "rejected": "e"}}] * 4
train_reward(RewardSettings(**few), data=pairs, run_dir="reward")
resume_reward("reward", data=pairs)
"""


def test_the_three_stages_in_python_print_nothing_of_their_libraries(tmp_path):
    """A user's program, under Python's default filters."""
    program = PROGRAM.format(model=saved(tmp_path / "model", tiny_llama()))
    command = [sys.executable, "-c", program]
    fresh = {**os.environ, "XDG_CACHE_HOME": "cache"}
    ended = subprocess.run(command, cwd=tmp_path, env=fresh, capture_output=True, text=True, timeout=300)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


def from_library(module: str, category: type[Warning] = FutureWarning) -> None:
    warnings.warn_explicit("`old` is deprecated", category, "file.py", 1, module=module, registry={})


@pytest.mark.parametrize(
    "module", ["transformers.models.llama", "torch", "tightrope.language.generation.sample"]
)
def test_deprecations_of_libraries_are_hidden_unless_somebody_asked(module):
    with warnings.catch_warnings(record=True) as seen:
        warnings.resetwarnings()
        with quiet_libraries():
            from_library(module)
        assert seen == []
        warnings.simplefilter("error")
        with quiet_libraries(), pytest.raises(FutureWarning):
            from_library(module)


@pytest.mark.parametrize(
    "module, category", [("my_reward", FutureWarning), ("torchvision", FutureWarning), ("torch", UserWarning)]
)
def test_warnings_of_a_users_own_code_and_of_other_kinds_are_shown(module, category):
    with warnings.catch_warnings(record=True) as seen:
        warnings.resetwarnings()
        with quiet_libraries():
            from_library(module, category)
    assert [str(x.message) for x in seen] == ["`old` is deprecated"]


@pytest.mark.parametrize("off", [True, False])
def test_the_bars_of_the_hub_are_as_they_were(off):
    """transformers switches them together with its own; a user may have disabled only the hub's."""
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    before = are_progress_bars_disabled()
    (disable_progress_bars if off else enable_progress_bars)()
    try:
        with quiet_libraries():
            assert are_progress_bars_disabled()
        assert are_progress_bars_disabled() == off
    finally:
        (disable_progress_bars if before else enable_progress_bars)()


def test_the_hubs_own_switch_brings_no_warning():
    program = "from tightrope.language.model.load import quiet_libraries\nwith quiet_libraries():\n    pass\n"
    environment = {**os.environ, "HF_HUB_DISABLE_PROGRESS_BARS": "0"}
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize("bars", [True, False])
def test_what_was_set_before_is_put_back_after_an_error_too(bars):
    from transformers.utils import logging

    before = logging.get_verbosity(), logging.is_progress_bar_enabled(), list(warnings.filters)
    (logging.enable_progress_bar if bars else logging.disable_progress_bar)()
    try:
        with pytest.raises(KeyError), quiet_libraries():
            assert not logging.is_progress_bar_enabled()
            assert logging.get_verbosity() == logging.ERROR
            raise KeyError
        assert logging.is_progress_bar_enabled() == bars
        assert (logging.get_verbosity(), list(warnings.filters)) == before[::2]
    finally:
        (logging.enable_progress_bar if before[1] else logging.disable_progress_bar)()
