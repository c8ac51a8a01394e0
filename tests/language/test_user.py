"""The language story as a user types it: names of models, rewards and data, stop strings, what comes next."""

from __future__ import annotations

import json
import signal
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from language.test_sampling import prompts, uniforms
from language.tiny import WORDS, saved, tiny_llama, tokenizer

from tightrope.cli.main import main
from tightrope.cli.options import training_options
from tightrope.language import align
from tightrope.language.compare import sample_run
from tightrope.language.data.examples import read_rows
from tightrope.language.generation.distribution import Sampling
from tightrope.language.generation.sample import meets_stop, sample, texts_of
from tightrope.language.model import packaged
from tightrope.language.model.packaged import find_model
from tightrope.language.reward.functions import Rewards
from tightrope.language.reward.judge import _entries, _from_hub, make_judge
from tightrope.language.settings import AlignSettings, recorded, weighted

ROWS = [
    {"prompt": p, "completion": "good.", "chosen": "good.", "rejected": "bad"}
    for p in ("ab", "cd", "ef", "gh")
]
FEW = ["--lora-rank", "2", "--minibatch-size", "4"]
SHORT = ["--max-tokens", "32", *FEW]
SAMPLED = ["--total-episodes", "8", "--batch-size", "8", "--max-new-tokens", "6", *FEW]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("model"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A working folder with rows that serve all three stages."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in ROWS))
    return tmp_path


# ------------------------------------------------------------ from stage to stage


def test_each_stage_takes_the_folder_of_the_last_and_names_the_next_command(folder, place, capsys):
    def run(*words: str) -> str:
        assert main([*words]) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    out = run("sft", "--model", folder, "--data", "rows.jsonl", "--run-dir", "runs/sft", *SHORT)
    sft, reward = place / "runs/sft", place / "runs/reward"
    assert f"tightrope reward --model {sft} --data PAIRS.jsonl" in out
    assert f"tightrope align --model {sft} --data PROMPTS.jsonl --reward length" in out
    out = run("reward", "--model", "runs/sft", "--data", "rows.jsonl", "--run-dir", "runs/reward", *SHORT)
    assert f"tightrope align --model runs/sft --data PROMPTS.jsonl --reward {reward}" in out
    words = ["--model", "runs/sft", "--data", "rows.jsonl", "--reward", "runs/reward", "--reward=length=0.5"]
    out = run("align", *words, "--run-dir", "runs/align", *SAMPLED)
    assert f"next         tightrope sample {place / 'runs/align'}" in out
    settings = json.loads((place / "runs/align/settings.json").read_text())
    assert settings["reward"] == ["runs/reward", "length=0.5"] and settings["model"] == "runs/sft"
    row = json.loads((place / "runs/align/samples.jsonl").read_text().splitlines()[0])
    parts = row["scores"]
    assert row["score"] == pytest.approx(parts["reward_model"] + 0.5 * parts["length"])

    found = json.loads(run("sample", "runs/align", "--count", "2", "--json").splitlines()[-1])["samples"]
    for row in found:
        assert row["kl_before"] == 0.0 and np.isfinite(row["kl_after"]) and 1 <= row["tokens_after"] <= 6
        assert all(np.isfinite(row[f"score_{name}"]) for name in ("before", "after"))
    out = run("sample", "runs/align", "--count", "2")
    assert "mean of 2, before > after: score" in out and "kl" in out and "tokens" in out


# ------------------------------------------------------------ names of models


def test_a_model_is_a_folder_a_run_or_an_id_with_or_without_owner(folder, place, monkeypatch):
    asked = []
    monkeypatch.setattr(packaged, "not_on_hub", lambda name: asked.append(name) or "")
    assert find_model(folder) == folder
    for name in ("gpt2", "Qwen/Qwen2.5-0.5B", "meta-llama/Llama-3.2-1B"):  # a dot is no ending of a file
        assert find_model(name) == name
    assert asked == ["gpt2", "Qwen/Qwen2.5-0.5B", "meta-llama/Llama-3.2-1B"]


@pytest.mark.parametrize("given", ["glasslm", "runs/sfd", "a b", "../x/y/z"])
def test_a_wrong_model_is_answered_with_what_was_looked_for(given, place, monkeypatch):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    (place / "runs/sft").mkdir(parents=True)
    with pytest.raises(ValueError) as error:
        find_model(given)
    text = str(error.value)
    for part in (repr(given), "a folder", "(none)", "glassllm", "on the hub"):
        assert part in text
    meant = {"glasslm": "Did you mean glassllm?", "runs/sfd": "Did you mean runs/sft?"}.get(given, "")
    assert meant in text
    assert ("ids are like" in text) == (given in ("a b", "../x/y/z"))


def test_a_run_without_a_model_that_writes_is_named(place):
    def run(name: str, **settings: object) -> str:
        (place / name).mkdir()
        (place / name / "settings.json").write_text(json.dumps(settings))
        return name

    for name, words in (
        (run("new", on_completions=True), "has not written its model yet. Finish it: tightrope resume new"),
        (run("pairs", demonstrations=None), "a run of tightrope reward.* Give it as --reward"),
        (run("pole", env="CartPole-v1"), "a run of tightrope train"),
    ):
        with pytest.raises(ValueError, match=words):
            find_model(name)
    (place / "empty").mkdir()
    with pytest.raises(ValueError, match="neither config.json.* nor settings.json"):
        find_model("empty")


# ------------------------------------------------------------ rewards


def test_a_weight_stands_behind_the_last_sign(place):
    assert weighted("length=0.1") == ("length", 0.1) and weighted("judge.py:good") == ("judge.py:good", 1.0)
    assert weighted("runs/a=b=-2") == ("runs/a=b", -2.0) and weighted("runs/lr=x") == ("runs/lr=x", 1.0)
    (place / "lr=0.1").mkdir()
    assert weighted("lr=0.1") == ("lr=0.1", 1.0)  # the name of a folder
    with pytest.raises(ValueError, match="finite"):
        _entries("length=nan")


def test_rewards_are_given_one_by_one_and_old_files_hold_one_word():
    for words in (["--reward", "length=2", "--reward", "a.py:f"], ["--reward", "length=2", "a.py:f"]):
        assert training_options("align", words)[1]["reward"] == ("length=2", "a.py:f")
    assert AlignSettings.from_json({"reward": "length"}).reward == ("length",)
    assert AlignSettings.from_json({"reward": ""}).reward == ()
    for rewards, kept in (((), ""), (("length",), "length"), (("length", "a.py:f"), ["length", "a.py:f"])):
        settings = AlignSettings(reward=rewards)
        assert (
            settings.to_json()["reward"] == kept and AlignSettings.from_json(settings.to_json()) == settings
        )

    def mine(**_):
        return []

    assert recorded(AlignSettings(), reward=[(mine, 2), "length"]).reward == ("<mine>=2", "length")
    assert recorded(AlignSettings(), reward=mine, data=[1]).reward == ("<mine>",)


def test_a_reward_of_the_hub_is_fetched_and_a_wrong_one_is_answered(place, monkeypatch):
    _from_hub.cache_clear()
    monkeypatch.setattr("tightrope.language.reward.judge.not_on_hub", lambda name: "none")
    with pytest.raises(ValueError, match=r"no reward 'runs/rewrd'.*'?length'?, FILE.py:function.*on the hub"):
        make_judge("runs/rewrd", None, on_trunk=None, timeout=None)
    monkeypatch.setattr("tightrope.language.reward.judge.not_on_hub", lambda name: "")
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda name, allow_patterns: str(place))
    (entry,) = _entries("owner/model=0.5")
    assert (entry.folder, entry.weight) == (place, 0.5)
    _from_hub.cache_clear()


def alarming(completions, **_):
    signal.signal(signal.SIGALRM, lambda *_: None)
    signal.alarm(1)
    signal.alarm(0)
    return [1.0 for _ in completions]


def test_a_function_with_an_alarm_is_answered_with_the_setting_that_lets_it_run():
    with pytest.raises(ValueError, match=r"main thread.*--reward-timeout none"):
        Rewards([alarming], timeout=5.0).score(["a"], ["b"], [[1]])
    before = signal.getsignal(signal.SIGALRM)
    try:
        assert Rewards([alarming], timeout=None).score(["a"], ["b"], [[1]]).total.tolist() == [1.0]
    finally:
        signal.signal(signal.SIGALRM, before)


# ------------------------------------------------------------ data


def test_arrow_data_is_read_with_the_package_datasets(place, monkeypatch):
    """Parquet, a folder of save_to_disk and a hub id, with a stand-in for the package; its bars are off."""
    seen = []
    bars = {"on": True}

    def made(*what, **options):
        seen.append((*what, options, bars["on"]))
        return ROWS

    fake = SimpleNamespace(
        __version__="4.4.0", Dataset=made, load_from_disk=made, load_dataset=made,
        are_progress_bars_disabled=lambda: not bars["on"],
        disable_progress_bars=lambda: bars.update(on=False),
        enable_progress_bars=lambda: bars.update(on=True),
        logging=SimpleNamespace(
            get_verbosity=lambda: 30, set_verbosity=seen.append, set_verbosity_error=lambda: 0
        ),
    )  # fmt: skip
    parquet = SimpleNamespace(read_table=lambda path: f"table of {path}")
    monkeypatch.setitem(sys.modules, "datasets", fake)
    monkeypatch.setitem(sys.modules, "pyarrow", SimpleNamespace(parquet=parquet))
    (place / "x.parquet").write_bytes(b"PAR1")
    assert read_rows("x.parquet") == ROWS
    assert seen == [("table of x.parquet", {}, False), 30] and bars["on"]
    for split in ("train", "test"):
        (place / "saved" / split).mkdir(parents=True)
        (place / "saved" / split / "state.json").write_text('{"_data_files": [{"filename": "data.arrow"}]}')
    (place / "saved/dataset_dict.json").write_text("{}")
    for name, read in (("saved", "train"), ("saved:test", "test"), ("saved/test", "test")):
        seen.clear()
        assert read_rows(name) == ROWS and seen[0][0] == f"saved/{read}"
    with pytest.raises(ValueError, match="splits test, train; name one"):
        read_rows("saved:dev")
    (place / "saved/test/state.json").write_text('{"_data_files": [{"filename": "../../rows.jsonl"}]}')
    with pytest.raises(ValueError, match="expected a file beside it"):
        read_rows("saved/test")
    (place / "none").mkdir()
    with pytest.raises(ValueError, match=r"none is a folder without state\.json"):
        read_rows("none")
    for name, config, split in (
        ("imdb", None, "train"),
        ("o/n:test", None, "test"),
        ("o/n:main:dev", "main", "dev"),
    ):
        seen.clear()
        assert read_rows(name) == ROWS
        assert seen[0][:2] == (name.partition(":")[0], {"name": config, "split": split})

    def fails(*_, **__):
        raise ConnectionError("Couldn't reach 'imdb' on the Hub")

    fake.load_dataset = fails
    with pytest.raises(ValueError, match="'imdb' is neither a file, a folder nor a dataset.*Couldn't reach"):
        read_rows("imdb")
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(ValueError, match="pip install datasets"):
        read_rows("x.parquet")


# ------------------------------------------------------------ stop strings


def test_a_stop_string_ends_a_row_where_its_last_token_completes_it():
    """Every row is the row without stop strings up to there, whatever its neighbours do."""
    model, words = tiny_llama(), tokenizer()
    tokens, real = prompts(rows=40)
    numbers = uniforms(40, 30, seed=1)
    whole = sample(model, tokens, real, Sampling(), numbers, (3,))
    plain = texts_of(words, [row[mask].tolist() for row, mask in zip(whole.tokens, whole.mask, strict=True)])
    common = max("abcdefghijklmnopqrstuvwxyz", key=lambda c: sum(c in text[1:] for text in plain))
    stop = next(text[i - 1 : i + 1] for text in plain for i in range(5, len(text)) if text[i] == common)

    met = meets_stop(words, (stop,))
    got = sample(model, tokens, real, Sampling(), numbers, (3,), stops_at=met)
    assert got.stopped is not None and got.stopped.any() and not got.stopped.all()
    for row in range(40):
        ids = got.tokens[row][got.mask[row]].tolist()
        assert ids == whole.tokens[row][: len(ids)].tolist()
        assert torch.allclose(got.logp[row, : len(ids)], whole.logp[row, : len(ids)], atol=1e-5)
        said = "".join(WORDS[i] if i < len(WORDS) else "" for i in ids if i > 3)
        assert bool(got.stopped[row]) == (stop in said)
        assert bool(got.ended[row]) == (bool(got.stopped[row]) or ids[-1] == 3)
        if got.stopped[row]:
            assert said.endswith(stop) and said.count(stop) == 1
            assert texts_of(words, [ids], (stop,)) == [said[: -len(stop)]]


def marked():
    """The tokenizer with a special token that is no EOS, with the id of the letter e."""
    from tokenizers import Tokenizer
    from transformers import AddedToken, PreTrainedTokenizerFast

    told = json.loads(tokenizer()._tokenizer.to_str())
    told["model"]["vocab"]["<|im_end|>"] = told["model"]["vocab"].pop("e")
    made = PreTrainedTokenizerFast(
        tokenizer_object=Tokenizer.from_str(json.dumps(told)), eos_token="<eos>", unk_token="<unk>"
    )
    made.add_tokens([AddedToken("<|im_end|>", special=True, normalized=False)])
    assert made.convert_tokens_to_ids("<|im_end|>") == WORDS.index("e")
    return made


def test_a_special_token_that_is_no_eos_may_be_a_stop(tmp_path):
    words, end = marked(), WORDS.index("e")
    row = [WORDS.index("a"), end, WORDS.index("b")]
    assert meets_stop(words, ("<|im_end|>", "x"))([row[:1], row[:2]]) == [False, True]
    assert texts_of(words, [row, row[:1]], ("<|im_end|>", "x")) == ["a", "a"]
    assert texts_of(words, [row], ("x",)) == ["ab"]
    folder = saved(tmp_path / "model")
    words.save_pretrained(folder)
    values = {
        "total_episodes": 32,
        "batch_size": 32,
        "minibatch_size": 32,
        "max_new_tokens": 12,
        "lora_rank": 2,
    }
    given = {"model": folder, "prompts": ["ab", "cd"], "reward": "length", **values}
    run = align(**given, run_dir=tmp_path / "run", stop=("<|im_end|>",), seed=1)
    assert run.metrics[0]["objective/stop_fraction"] > 0
    with pytest.raises(ValueError, match="holds the special token '<|im_end|>' and other text"):
        align(**given, run_dir=tmp_path / "other", stop=("<|im_end|>\n",))
    assert not (tmp_path / "other").exists()


def letter(token):
    return WORDS[token] if token < len(WORDS) else "-"  # the model has a few more ids


def test_what_functions_score_ends_before_the_stop_and_what_is_trained_holds_it(folder, place):
    shown = []

    def reward(completions, completion_ids, **_):
        shown.extend(zip(completions, completion_ids, strict=True))
        return [float(len(c)) for c in completions]

    values = {
        "total_episodes": 64,
        "batch_size": 32,
        "minibatch_size": 32,
        "max_new_tokens": 12,
        "lora_rank": 2,
    }
    run = align(
        model=folder,
        prompts=["ab", "cd"],
        reward=reward,
        run_dir="run",
        stop=("e", "o", "a"),
        seed=1,
        **values,
    )
    rows = [json.loads(line) for line in (place / "run/samples.jsonl").read_text().splitlines()]
    assert not any(set("eoa") & set(text) for text, _ in shown)
    ended = [words for _, words in shown if letter(words[-1]) in "eoa"]
    first = run.metrics[0]
    assert len(ended) >= 8 and len(rows) == 64
    assert first["objective/stop_fraction"] == sum(letter(w[-1]) in "eoa" for _, w in shown[:32]) / 32
    fractions = [first[f"objective/{name}_fraction"] for name in ("eos", "stop", "truncated")]
    assert sum(fractions) == pytest.approx(1.0)
    assert [row["response"] for row in rows] == [text for text, _ in shown]
    assert [row["tokens"] for row in rows] == [len(words) for _, words in shown]
    assert all(not set("eoa") & set(row["after"]) for row in sample_run("run", ["ab"]))


def test_a_shell_writes_a_line_end_as_two_characters():
    assert training_options("align", ["--stop", r"\n\n", "--stop", "###"])[1]["stop"] == ("\n\n", "###")
    assert training_options("align", ["--stop", r"a\\n"])[1]["stop"] == (r"a\n",)
    with pytest.raises(ValueError, match="empty"):
        AlignSettings(stop=("",))


def test_tensorboard_shows_what_the_run_records(folder, place):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    values = {
        "total_episodes": 32,
        "batch_size": 16,
        "minibatch_size": 16,
        "max_new_tokens": 4,
        "lora_rank": 2,
    }
    run = align(model=folder, prompts=["ab"], reward="length", run_dir="run", tensorboard=True, **values)
    found = EventAccumulator(str(place / "run/tensorboard"))
    found.Reload()
    for name in ("objective/kl", "objective/scores", "train/approx_kl", "time/fps"):
        shown = [(event.step, event.value) for event in found.Scalars(name)]
        assert shown == [(row["step"], pytest.approx(row[name], abs=1e-6, rel=1e-6)) for row in run.metrics]
