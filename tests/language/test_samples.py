"""samples.jsonl records the outcome of every response, and the tables show it safely."""

from __future__ import annotations

import io
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tightrope.algorithms.batch import Batch
from tightrope.language.alignment.samples import (
    LONGEST,
    one_line,
    print_comparison,
    print_samples,
    read_samples,
    sample_rows,
    spread,
)
from tightrope.language.reward.functions import Scores
from tightrope.runs.run import Run

WORDS = ["<pad>", "good", "bad", "film"]
TOKENIZER = SimpleNamespace(decode=lambda ids, skip_special_tokens: " ".join(WORDS[i] for i in ids))


def rollout():
    """Three responses of at most three tokens, the second one masked; padding holds NaN."""
    mask = torch.tensor([[True, True, False], [True, True, True], [True, False, False]])
    tokens = torch.tensor([[1, 3, 0], [2, 2, 3], [3, 0, 0]])
    nan = math.nan
    logp = torch.tensor([[-1.0, -2.0, nan], [-1.0, -1.0, -1.0], [-0.5, nan, nan]])
    ref_logp = torch.tensor([[-1.5, -2.25, nan], [-2.0, -2.0, -2.0], [-0.25, nan, nan]])
    responses = SimpleNamespace(tokens=tokens, mask=mask, ended=torch.tensor([True, False, True]))
    ids = [row[kept].tolist() for row, kept in zip(tokens, mask, strict=True)]
    experience = SimpleNamespace(responses=responses, logp=logp, ref_logp=ref_logp, ids=ids)
    valid = torch.tensor([True, False, True])
    advantages = torch.tensor([[1.0, 3.0, nan], [-2.0, nan, nan]])
    kept = mask[valid]
    batch = Batch(
        {"row": torch.arange(2)}, tokens[valid], logp[valid], kept * 0.0, advantages, kept * 0.0, kept
    )
    parts = {"judge": np.array([0.5, math.nan, -1.0]), "length": np.array([2.0, 3.0, 1.0])}
    total = np.array([2.5, math.nan, 0.0])
    scores = Scores(total, valid.numpy(), parts, {}, {"note": ["a", "b\ud800", "c"]})
    prompts = [SimpleNamespace(shown=text) for text in ("The film", "A \ud800 film", "This")]
    return prompts, experience, scores, batch, valid


def rows():
    prompts, experience, scores, batch, valid = rollout()
    return sample_rows(TOKENIZER, prompts, experience, scores, batch, valid, 24)


def test_a_row_records_the_outcome_of_its_response():
    first, second, third = rows()
    assert first == {
        "step": 24,
        "prompt": "The film",
        "response": "good film",
        "score": 2.5,
        "scores": {"judge": 0.5, "length": 2.0},
        "kl": 0.75,
        "advantage": 2.0,
        "tokens": 2,
        "ended": True,
        "counts": True,
        "extras": {"note": "a"},
    }
    assert (second["score"], second["scores"]["judge"], second["advantage"]) == (None, None, None)
    assert (second["counts"], second["kl"], second["tokens"]) == (False, 3.0, 3)
    assert (third["kl"], third["advantage"]) == (-0.25, -2.0), (
        "rows after a masked one keep their own figures"
    )


def test_what_is_written_is_read_again(tmp_path):
    """Also half a surrogate pair, which UTF-8 cannot hold."""
    with Run.create(tmp_path / "run", {}, "x") as run:
        run.record_samples(rows())
        run.record_samples(rows())
    assert read_samples(tmp_path / "run") == rows() + rows()
    assert read_samples(tmp_path / "run/samples.jsonl")[1]["prompt"] == "A \\ud800 film"
    json.dumps(rows(), allow_nan=False)


def test_a_run_without_samples_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"samples.jsonl is not there: .* is not a run of tightrope align"):
        read_samples(tmp_path)


def scored(*values):
    return [{"score": value} for value in values]


def test_spread_shows_the_best_the_worst_and_what_lies_between():
    found = spread(scored(3, None, 1, 2, 5, 4, 0), 3)
    assert [row["score"] for row in found] == [5, 2, None]
    assert spread(scored(1, 3, 2), 5) == scored(3, 2, 1)
    assert spread(scored(1, 3, 2), 1) == scored(3)
    with pytest.raises(ValueError, match="count is 0"):
        spread([], 0)


def printed(function, table, **options):
    stream = io.StringIO()
    function(table, stream, **options)
    return stream.getvalue()


def test_the_table_shows_every_figure():
    text = printed(print_samples, rows(), width=140, title="after 24 responses")
    for word in ("prompt", "response", "judge", "length", "score", "KL", "advantage", "after 24 responses"):
        assert word in text
    for cell in ("good film", "2.5", "0.75", "-0.25", "masked"):
        assert cell in text
    assert max(len(line) for line in text.splitlines()) <= 140


def test_one_reward_is_shown_once():
    table = [{**row, "scores": {"judge": row["score"]}} for row in rows()]
    assert "score" not in printed(print_samples, table, width=140)


def test_a_response_cannot_write_on_the_terminal():
    row = {**rows()[0], "response": "\x1b[2J[red]gone[/red]\r\x07\u202eend\nnext"}
    text = printed(print_samples, [row], width=200)
    assert not set("\x1b\r\x07\u202e") & set(text)
    assert r"\x1b[2J[red]gone[/red]\r\x07\u202eend\nnext" in text


def test_the_comparison_shows_both_responses():
    table = [{"prompt": "The film", "before": "was long", "after": "was great"}]
    text = printed(print_comparison, table, width=100)
    assert "was long" in text and "was great" in text and "score" not in text


def test_long_texts_keep_the_end_of_a_prompt_and_the_beginning_of_a_response():
    text = "".join(str(i % 10) for i in range(LONGEST)) + "!"
    assert (
        one_line(text).startswith("0123")
        and one_line(text).endswith("...")
        and len(one_line(text)) == LONGEST
    )
    assert one_line(text, tail=True).endswith("!") and len(one_line(text, tail=True)) == LONGEST
    assert one_line(text[:-1]) == text[:-1]


def test_messages_are_shown_with_their_speakers():
    chat = [{"role": "system", "content": "Be kind."}, {"role": "user", "content": "Hi"}]
    assert one_line(chat) == r"system: Be kind.\nuser: Hi"
