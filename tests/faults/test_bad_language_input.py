"""Invalid prompts and rewards: named with exit code 2, or masked and counted; never a wrong number."""

import json
import time

import pytest
from language.tiny import saved

from tightrope.cli.main import main
from tightrope.language import align
from tightrope.runs.run import Run

REWARDS = """
import time
def good(completions, **_): return [1.0] * len(completions)
def raises(completions, answer, **_): raise KeyError("no such answer")
def hangs(completions, **_): time.sleep(30)
def short(completions, **_): return [1.0]
def none(completions, **_): return [None] * len(completions)
def nan(completions, **_): return [float("nan")] * len(completions)
def text(completions, **_): return ["good"] * len(completions)
def wants(completions, solution, **_): return [1.0] * len(completions)
def some(completions, **_): return [[1.0, None, float("nan"), 2.0][i % 4] for i in range(len(completions))]
def slow(completions, seen=[], **_):
    seen.append(1)
    time.sleep(1.3 if len(seen) == 2 else 0)
    return [1.0] * len(completions)
"""
FAST = {"total_episodes": 32, "batch_size": 8, "minibatch_size": 8, "max_new_tokens": 4, "lora_rank": 2}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    saved(folder / "model")
    (folder / "mine.py").write_text(REWARDS)
    return folder


def run(place, tmp_path, rows, reward="good", *more):
    """The exit code of `tightrope align` on these rows."""
    data = tmp_path / "prompts.jsonl"
    data.write_text("".join(json.dumps(row) + "\n" for row in rows))
    words = [
        "align",
        "--model",
        str(place / "model"),
        "--data",
        str(data),
        "--run-dir",
        str(tmp_path / "run"),
    ]
    words += ["--reward", f"{place / 'mine.py'}:{reward}", "--quiet", *more]
    for name, value in FAST.items():
        words += [f"--{name.replace('_', '-')}", str(value)]
    return main(words)


GOOD = [{"prompt": text, "answer": text} for text in ("ab", "cd", "efg")]


@pytest.mark.parametrize(
    ("rows", "reward", "more", "words"),
    [
        ([], "good", [], ["prompts.jsonl", "holds no rows"]),
        ([{"prompt": ""}], "good", [], ["prompt of data[0] is empty", "Take the row out"]),
        ([*GOOD, {"prompt": "  \n"}], "good", [], ["prompt of data[3] is empty"]),
        ([{"question": "ab"}], "good", [], ["data[0] has the columns: question; expected prompt"]),
        ([{"prompt": 3}], "good", [], ["prompt of data[0] is int"]),
        (
            [*GOOD, {"prompt": "ab\ud800"}],
            "good",
            [],
            ["prompt of data[3] holds '\\ud800'", "take the row out"],
        ),
        ([{"prompt": [{"role": "user", "content": "a"}]}], "good", [], ["no chat template"]),
        (GOOD, "good", ["--max-prompt-tokens", "95"], ["95", "context of 96 tokens", "Choose less"]),
        (
            GOOD,
            "good",
            ["--learning-rate", "1e30"],
            ["expected a finite number", "not taken", "learning rate"],
        ),
        (GOOD, "raises", [], ["'raises' raised KeyError", "line 4 of mine.py"]),
        (GOOD, "hangs", ["--reward-timeout", "0.1"], ["last 3 batches", "'hangs' was not back after 0.1 s"]),
        (GOOD, "short", [], ["'short' returned 1 scores, expected a list of 8"]),
        (GOOD, "none", [], ["last 3 batches", "all returned None"]),
        (GOOD, "nan", [], ["last 3 batches", "'nan' returned nan"]),
        (GOOD, "text", [], ["'text' returned the str 'good'", "expected a finite number"]),
        (GOOD, "wants", [], ["'wants' wants 'solution'", "answer"]),
        (GOOD, "absent", [], ["has no function 'absent'"]),
    ],
    ids=lambda value: str(value)[:30] if isinstance(value, str) else "",
)
def test_a_mistake_exits_with_2_and_advice(place, tmp_path, capsys, rows, reward, more, words):
    begin = time.monotonic()
    assert run(place, tmp_path, rows, reward, *more) == 2
    error = capsys.readouterr().err
    assert all(word in error for word in words) and "Traceback" not in error, error
    assert "on_error" not in error  # not an option of the command line
    assert time.monotonic() - begin < 20


def test_responses_without_a_score_are_masked_counted_and_reported_once(place, tmp_path, capsys):
    assert run(place, tmp_path, GOOD, "some") == 0
    error = capsys.readouterr().err
    assert error.count("expected a finite number or None") == 1 and error.count("all returned None") == 1
    rows = Run.open(tmp_path / "run").read_metrics()
    assert [row["objective/masked_samples"] for row in rows] == [4.0] * 4
    assert {row["objective/scores"] for row in rows} == {1.5} == {row["scores/some"] for row in rows}


def test_a_late_batch_is_left_out_and_the_run_continues(place, tmp_path, capsys):
    assert run(place, tmp_path, GOOD, "slow", "--reward-timeout", "1") == 0
    assert "was not back after 1 s" in capsys.readouterr().err
    rows = Run.open(tmp_path / "run").read_metrics()
    assert [row["objective/masked_samples"] for row in rows] == [0.0, 8.0, 0.0, 0.0]
    assert [row["objective/scores"] for row in rows] == [1.0, None, 1.0, 1.0]


def test_prompts_over_their_length_lose_their_beginning_and_are_counted(place, tmp_path, capsys):
    long = [{"prompt": "x" * 200 + "ab"}, *GOOD]
    assert run(place, tmp_path, long, "good", "--max-prompt-tokens", "8") == 0
    assert "1 of 4 prompts have more than 8 tokens and lost their beginning" in capsys.readouterr().err
    lines = (tmp_path / "run" / "samples.jsonl").read_text().splitlines()
    assert "xxxxxxab" in {json.loads(line)["prompt"] for line in lines}


class Rows:
    """The interface of datasets.Dataset: not a list or mapping; yields dicts and has column names."""

    def __init__(self, rows):
        self.rows, self.column_names = rows, list(rows[0])

    def __len__(self):
        return len(self.rows)

    def __getitem__(self, place):
        return self.rows[place] if isinstance(place, int) else [row[place] for row in self.rows]

    def __iter__(self):
        return iter(self.rows)


def test_a_dataset_object_serves_every_stage_and_a_dictionary_of_them_is_named(place, tmp_path):
    from tightrope.language.settings import RewardSettings, SFTSettings
    from tightrope.language.supervised.preferences import train_reward
    from tightrope.language.supervised.sft import train_sft

    model = str(place / "model")
    usual = {"model": model, "max_tokens": 16, "lora_rank": 2, "threads": 1}
    texts = Rows([{"text": f"ab {c}"} for c in "cdefgh"])
    pairs = Rows([{"prompt": "ab", "chosen": c, "rejected": "x"} for c in "cdefgh"])
    assert train_sft(SFTSettings(**usual), data=texts, run_dir=tmp_path / "sft")["rows"] == 5
    assert train_reward(RewardSettings(**usual), data=pairs, run_dir=tmp_path / "reward")["pairs"] == 5
    seen = set()

    def reward(completions, answer):
        seen.update(answer)
        return [0.0] * len(completions)

    align(model=model, prompts=Rows(GOOD), reward=reward, run_dir=tmp_path / "align", **FAST)
    assert seen == {"ab", "cd", "efg"}
    both = {"train": texts, "test": texts}
    for stage in (
        lambda: train_sft(SFTSettings(**usual), data=both, run_dir=tmp_path / "a"),
        lambda: train_reward(RewardSettings(**usual), data=both, run_dir=tmp_path / "b"),
        lambda: align(model=model, prompts=both, reward=reward, run_dir=tmp_path / "c", **FAST),
    ):
        with pytest.raises(ValueError, match="mapping of train, test; expected rows. Pass one of its parts"):
            stage()
