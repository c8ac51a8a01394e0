"""Rows to tokens: every format, its learnt tokens, and an error or a count for rows that do not fit."""

from __future__ import annotations

import itertools
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from language.tiny import tokenizer

from tightrope.language.data.batching import (
    PADDING,
    Example,
    attention_of,
    collate,
    pack_rows,
    pad_left,
    pad_right,
    row_of,
)
from tightrope.language.data.examples import preference_pairs, read_prompts, read_rows, sft_examples

EOS = 3
CHATML = (
    "{% for m in messages %}<bos>{{ m['role'] }}.{{ m['content'] }}<eos>\n{% endfor %}"
    "{% if add_generation_prompt %}<bos>assistant.{% endif %}"
)
CHAT = [
    {"role": "system", "content": "be nice"},
    {"role": "user", "content": "hello"},
    {"role": "assistant", "content": "hi you"},
    {"role": "user", "content": "more"},
    {"role": "assistant", "content": "no."},
]


def chatml():
    """Like SmolLM2: PAD is the EOS, and a newline follows the EOS of every turn."""
    made = tokenizer()
    made.chat_template = CHATML
    made.pad_token = "<eos>"
    return made


def opening(template: str):
    """A tokenizer that adds its own tokens around every text."""
    from tokenizers import processors

    made = tokenizer()
    made._tokenizer.post_processor = processors.TemplateProcessing(
        single=template, special_tokens=[("<bos>", 2), ("<eos>", EOS)]
    )
    return made


def examples(rows, made=None, max_tokens=90, **more):
    return sft_examples(rows, made or tokenizer(), eos=EOS, max_tokens=max_tokens, **more)


def learnt(example: Example, made=None) -> str:
    return (made or tokenizer()).decode(
        [t for t, kept in zip(example.tokens, example.learn, strict=True) if kept]
    )


def whole(example: Example, made=None) -> str:
    return (made or tokenizer()).decode(list(example.tokens))


def closed_vocabulary(kind: str):
    """A tokenizer of the letters of DNA, which puts a BOS before every text and has no UNK token."""
    from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    words = {word: i for i, word in enumerate(["<bos>", "<eos>", *"ACGT"])}
    inner = Tokenizer(models.BPE(words, []) if kind == "BPE" else models.WordLevel(words))
    inner.pre_tokenizer = pre_tokenizers.Split(Regex("[\\s\\S]"), "isolated")
    inner.decoder = decoders.Fuse()
    inner.post_processor = processors.TemplateProcessing(
        single="<bos> $A <eos>", special_tokens=[("<bos>", 0), ("<eos>", 1)]
    )
    return PreTrainedTokenizerFast(tokenizer_object=inner, bos_token="<bos>", eos_token="<eos>")


@pytest.mark.parametrize("kind", ["BPE", "WordLevel"])
def test_a_tokenizer_that_knows_few_letters_keeps_its_opening(kind):
    made = closed_vocabulary(kind)
    (prompt,) = read_prompts(["GAT"], made, max_tokens=9)
    assert prompt.tokens == (0, 4, 2, 5)
    (example,) = sft_examples([{"prompt": "GA", "completion": "TC"}], made, eos=1, max_tokens=9)
    assert example.tokens == (0, 4, 2, 5, 3, 1) and sum(example.learn) == 3


def test_a_text_that_a_tokenizer_cannot_write_is_told_in_a_sentence():
    with pytest.raises(ValueError, match="has no tokens for 'GxT' .*give it an UNK token"):
        read_prompts(["GxT"], closed_vocabulary("WordLevel"), max_tokens=9)


# ------------------------------------------------------------------------------------------------- reading


class Table:
    """As pandas, polars and pyarrow: its iteration gives columns, and one method gives rows."""

    def __init__(self, columns: list[str], rows: list[dict], method: str = "") -> None:
        self.columns = columns
        if method:
            setattr(self, method, lambda *words: rows if words == self.words(method) else None)

    @staticmethod
    def words(method: str) -> tuple:
        return ("records",) if method == "to_dict" else ()

    def __iter__(self):
        return iter(self.columns)


@pytest.mark.parametrize("method", ["to_dict", "to_dicts", "to_pylist"])
def test_the_rows_of_a_table_are_read_and_not_its_columns(method):
    rows = [{"prompt": "ab", "completion": "cd"}, {"prompt": "e", "completion": "f"}]
    assert read_rows(Table(["prompt", "completion"], rows, method)) == rows
    assert read_rows(Table(["prompt", "completion"], rows, method), limit=1) == rows[:1]
    with pytest.raises(ValueError, match="data names 'prompt' twice"):
        read_rows(Table(["prompt", "prompt"], rows, method))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            Table(["prompt"], []),
            "data is Table, a table that does not give its rows; expected a list of dicts",
        ),
        ({"ab", "cd"}, "data is set; expected a file"),
        (frozenset({"ab"}), "data is frozenset; expected a file"),
        (b"ab", "data is bytes; expected a file"),
        ([b"ab"], r"data\[0\] is bytes; expected a string"),
        (np.array(5), "data is ndarray; expected a file"),
        (np.array([1, 2]), r"data\[0\] is int64; expected a string"),
        (np.array([["ab", "cd"]]), r"data\[0\] is ndarray; expected a string"),
    ],
)
def test_what_has_no_rows_in_an_order_is_refused(source, message):
    with pytest.raises(ValueError, match=message):
        read_rows(source)


def test_every_kind_of_file_gives_the_same_rows(tmp_path):
    rows = [{"prompt": "a,b", "completion": 'say "c"'}, {"prompt": "d\u2028e", "completion": "f"}]
    (tmp_path / "x.jsonl").write_text("".join(json.dumps(row) + "\n\n" for row in rows))
    (tmp_path / "x.json").write_text(json.dumps(rows))
    (tmp_path / "x.csv").write_text(
        '\ufeffprompt,completion\n"a,b","say ""c"""\nd\u2028e,f\n', encoding="utf-8"
    )
    for kind in ("jsonl", "json", "csv"):
        assert read_rows(tmp_path / f"x.{kind}") == rows
        assert read_rows(str(tmp_path / f"x.{kind}"), limit=1) == rows[:1]
    (tmp_path / "x.txt").write_text("one\n\n  two \r\n")
    assert read_rows(tmp_path / "x.txt") == ["one", "  two "]


def test_lists_and_other_iterables_of_rows():
    class Dataset:  # like datasets.Dataset: it yields dicts, and is not a list
        def __iter__(self):
            return iter([{"text": "a"}, {"text": "b"}])

    assert read_rows(Dataset()) == [{"text": "a"}, {"text": "b"}]
    assert read_rows(["a", {"text": "b"}]) == ["a", {"text": "b"}]
    chats = [[{"role": "user", "content": "hi"}], [{"role": "user", "content": "ho"}]]
    assert read_rows(chats) == [{"prompt": chat} for chat in chats]
    endless = ({"text": str(i)} for i in itertools.count())
    assert len(read_rows(endless, limit=3)) == 3
    row = {"text": "a"}
    read_rows([row])[0]["text"] = "changed"
    assert row == {"text": "a"}


def test_a_dataset_is_read_by_its_id(monkeypatch):
    asked = []

    def load_dataset(path, name, split):
        asked.append((path, split))
        return [{"text": "a"}]

    new = {"load_dataset": load_dataset, "logging": SimpleNamespace(get_verbosity=lambda: 30)}
    new["logging"].set_verbosity = new["logging"].set_verbosity_error = lambda *level: None
    for word in ("are_progress_bars_disabled", "disable_progress_bars", "enable_progress_bars"):
        new[word] = lambda: True
    monkeypatch.setitem(sys.modules, "datasets", SimpleNamespace(__version__="4.0.0", **new))
    assert read_rows("owner/name") == read_rows("owner/name:test") == [{"text": "a"}]
    assert asked == [("owner/name", "train"), ("owner/name", "test")]
    old = SimpleNamespace(__version__="3.6.0", load_dataset=load_dataset)  # it may run a dataset's script
    monkeypatch.setitem(sys.modules, "datasets", old)
    with pytest.raises(ValueError, match=r"is 3\.6\.0, which may run a script.*pip install 'datasets>=4'"):
        read_rows("owner/name")
    assert len(asked) == 2
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(ValueError, match=r"no text file 'owner/name'.*pip install datasets"):
        read_rows("owner/name")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.jsonl", '{"text": "a"}\n{"text": \n', r"x\.jsonl line 2 is not JSON"),
        ("x.jsonl", '["a", 3]\n', r"\[0\] is list; expected a string or a dict"),
        ("x.json", '{"text": ["a"]}', "holds dict; expected a list"),
        ("x.json", "[1", "not readable as json"),
        ("x.jsonl", '{"text": "a"}\n{"text": "b", "text": "c"}\n', r"x\.jsonl line 2 names 'text' twice"),
        ("x.json", '[{"prompt": "a", "prompt": "b"}]', r"x\.json names 'prompt' twice; .* Rename one"),
        ("x.csv", "a,b,a\n1,2,3\n", r"x\.csv line 1 names 'a' twice"),
        ("x.csv", "a,b\n1\n", "line 2 has more or fewer fields"),
        ("x.csv", "a,b\n1,2,3\n", "line 2 has more or fewer fields"),
        ("x.txt", "\n \n", "holds no rows"),
        ("x.xlsx", "PK", r"ends with '\.xlsx'; expected one of \.jsonl"),
    ],
)
def test_a_bad_file_is_named_with_its_place(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_rows(tmp_path / name)
    assert "x." in str(caught.value)


def test_other_bad_sources(tmp_path):
    (tmp_path / "x.txt").write_bytes(b"caf\xe9")
    for source, message in [
        (tmp_path / "x.txt", "not UTF-8"),
        (tmp_path / "absent.jsonl", "no file"),
        (tmp_path, "a folder without"),
        ({"train": [], "test": []}, "mapping of train, test"),
        (3, "is int; expected a file"),
        ([{"text": "a"}, 5], r"data\[1\] is int"),
        ([], "holds no rows"),
    ]:
        with pytest.raises(ValueError, match=message):
            read_rows(source)


# ------------------------------------------------------------------------------------- supervised examples


def test_text_is_learnt_from_its_second_token_to_its_eos():
    for row in ("abc", {"text": "abc"}, {"text": "abc<eos>"}, {"text": "abc", "prompt": None}):
        (example,) = examples([row])
        assert whole(example) == "abc<eos>"
        assert learnt(example) == "bc<eos>"


@pytest.mark.parametrize("make", [lambda: tokenizer(chat=True), chatml])
def test_only_completions_are_learnt_with_their_eos(make):
    made = make()
    messages = {"prompt": CHAT[:2], "completion": CHAT[2:3]}
    mixed = {"prompt": CHAT[:2], "completion": "hi you"}
    for row in ({"prompt": "ask. ", "completion": "hi you"}, messages, mixed):
        (example,) = examples([row], made)
        assert learnt(example, made) == "hi you<eos>"
        assert example.tokens[-1] == EOS and example.learn[-1]  # nothing after it, not even a newline


def test_every_assistant_turn_is_learnt_and_nothing_else():
    made = chatml()
    (example,) = examples([{"messages": CHAT}], made)
    assert learnt(example, made) == "hi you<eos>no.<eos>"
    assert whole(example, made) + "\n" == made.apply_chat_template(CHAT, tokenize=False)
    (example,) = examples([{"messages": CHAT}], made, on_completions=False)
    assert learnt(example, made) + "\n" == made.apply_chat_template(CHAT, tokenize=False)[len("<bos>") :]
    (example,) = examples([{"prompt": CHAT[:4], "completion": CHAT[4:]}], made)
    assert learnt(example, made) == "no.<eos>"  # earlier assistant turns belong to the prompt


def test_a_template_without_eos_gets_one_at_the_end():
    made = tokenizer()
    made.chat_template = (
        "{% for m in messages %}{{ m['role'][0] }}.{{ m['content'] }}\n{% endfor %}"
        "{% if add_generation_prompt %}a.{% endif %}"
    )
    (example,) = examples([{"messages": CHAT}], made)
    assert learnt(example, made) == "hi you\nno.\n<eos>"


@pytest.mark.parametrize(
    "row",
    [{"text": "abc"}, {"prompt": "ask", "completion": "abc"}, {"messages": CHAT}],
    ids=["text", "completion", "messages"],
)
def test_the_padding_token_is_never_asked(row):
    """Separate PAD, PAD equal to EOS, no PAD: the same tokens, and the EOS is learnt."""
    found = []
    for pad in ("<pad>", "<eos>", None):
        made = tokenizer(chat=True)
        made.pad_token = pad
        found += examples([row], made)
    assert found[0] == found[1] == found[2]
    assert found[0].tokens[-1] == EOS and found[0].learn[-1]


@pytest.mark.parametrize("template", ["$A", "<bos> $A", "<bos> $A <eos>"])
def test_what_is_sampled_is_what_is_trained(template):
    """A prompt has the same tokens in an example as in generation."""
    made = opening(template)
    made.chat_template = CHATML
    for ask, reply in (("ask. ", "reply"), (CHAT[:2], CHAT[2:3])):
        (prompt,) = read_prompts([{"prompt": ask}], made, max_tokens=90)
        (example,) = examples([{"prompt": ask, "completion": reply}], made)
        assert example.tokens[: len(prompt.tokens)] == prompt.tokens
        assert not any(example.learn[: len(prompt.tokens)]) and all(example.learn[len(prompt.tokens) :])
        assert prompt.tokens[-1] != EOS  # an EOS that some tokenizers add would end the prompt
        assert example.tokens.count(EOS) == 1 + 2 * (not isinstance(ask, str))


@pytest.mark.parametrize("template", ["<bos> $A", "<bos> $A <eos>"])
def test_an_opening_is_written_once(template):
    made = opening(template)
    for text in ("abc", "<bos>abc"):
        (example,) = examples([text], made)
        assert whole(example, made) == "<bos>abc<eos>"
        assert learnt(example, made) == "abc<eos>"
    (prompt,) = read_prompts(["<bos>abc"], made, max_tokens=9)
    assert made.decode(list(prompt.tokens)) == "<bos>abc"


def test_a_completion_of_white_space_is_one():
    (example,) = examples([{"prompt": "ask.", "completion": "\n"}])
    assert sum(example.learn) == 2  # it and the EOS


def test_no_token_reaches_across_from_prompt_to_completion():
    from tokenizers import Tokenizer, models
    from transformers import PreTrainedTokenizerFast

    words = {"<eos>": 0, "a": 1, "b": 2, "ab": 3}
    inner = Tokenizer(models.BPE(words, [("a", "b")]))
    made = PreTrainedTokenizerFast(tokenizer_object=inner, eos_token="<eos>")
    assert made("aab")["input_ids"] == [1, 3]
    with pytest.warns(UserWarning, match=r"1 of 2 rows have a prompt whose end .* in another way when"):
        example, _ = sft_examples(
            [{"prompt": "aa", "completion": "bab"}, {"prompt": "a", "completion": "a"}],
            made, eos=0, max_tokens=9,
        )  # fmt: skip
    assert example == Example((1, 1, 2, 3, 0), (False, False, True, True, True))


def test_several_eos_ids_close_a_reply_and_the_first_is_written():
    end = tokenizer()("!")["input_ids"][0]
    rows = [{"prompt": "a", "completion": "b!"}, {"prompt": "a", "completion": "b"}]
    first, second = sft_examples(rows, tokenizer(), eos=(EOS, end), max_tokens=9)
    assert whole(first) == "ab!"
    assert whole(second) == "ab<eos>"


def test_tools_reach_the_template():
    made = tokenizer()
    made.chat_template = "{{ tools | length }}" + CHATML
    row = {"messages": CHAT[1:3], "tools": [{"type": "function", "function": {"name": "f"}}]}
    plain, given = tokenizer(), []
    made.apply_chat_template = lambda messages, **options: (
        given.append(options["tools"]) or "".join(m["content"] + "." for m in messages)
    )
    assert examples([row], made) and given and all(tools == row["tools"] for tools in given)
    assert plain.chat_template is None


def test_long_rows_are_cut_and_counted():
    rows = [{"prompt": "abc", "completion": "defg"}, {"prompt": "abcdef", "completion": "g"}, {"text": "ab"}]
    with pytest.warns(
        UserWarning, match=r"2 of 3 rows have more than max_tokens 5 .* 1 of 3 rows have nothing"
    ):
        first, last = examples(rows, max_tokens=5)
    assert (
        whole(first) == "abcde" and learnt(first) == "de"
    )  # cut: no EOS is learnt, because the text did not end
    assert whole(last) == "ab<eos>"
    heard = []
    examples(rows, max_tokens=5, notify=heard.append)
    assert len(heard) == 1
    with pytest.raises(ValueError, match=r"None of the 1 rows is left: .* max_tokens 3 .*nothing to learn"):
        examples(rows[1:2], max_tokens=3)
    examples(rows, max_tokens=90)  # nothing is cut: a warning would be an error here


BAD_CHAT = [{"role": "user", "content": "a"}, {"role": "assistant", "content": ""}]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"text": "  "}, r"text of data\[1\] is empty"),
        ({"prompt": "", "completion": "a"}, r"prompt of data\[1\] is empty"),
        ({"prompt": " ", "completion": "a"}, r"prompt of data\[1\] is empty"),
        ({"prompt": "a", "completion": ""}, r"completion of data\[1\] is empty"),
        ({"messages": []}, r"messages of data\[1\] is empty"),
        ({"messages": BAD_CHAT}, r"data\[1\] has an empty assistant message"),
        ({"messages": [{"from": "a"}]}, r"holds \{'from': 'a'\}; expected messages like"),
        ({"text": 3}, r"text of data\[1\] is int; expected a string"),
        ({"text": CHAT}, r"text of data\[1\] is a list; expected a string"),
        ({"review": "a", "label": 1}, r"data\[1\] has the columns: review, label; expected text, prompt and"),
        ({"prompt": "a", "completion": None}, r"has the columns: prompt; expected"),
        ({"messages": CHAT[2:]}, r"data\[1\] begins with an assistant turn"),
        ({"text": "ab\ud800"}, r"text of data\[1\] holds '\\ud800' at character 2: half .* take the row out"),
        (
            {"messages": [{"role": "user", "content": "\udc80"}, CHAT[2]]},
            r"chat of data\[1\] holds '\\udc80'",
        ),
    ],
)
def test_a_bad_row_is_named(row, message):
    with pytest.raises(ValueError, match=message):
        examples(["fine", row], tokenizer(chat=True))


def test_templates_that_cannot_serve_are_named():
    with pytest.raises(
        ValueError, match=r"data\[0\] holds messages, and this tokenizer has no chat template"
    ):
        examples([{"messages": CHAT}])
    made = tokenizer()
    made.chat_template = "{{ raise_exception('roles must alternate') }}"
    with pytest.raises(ValueError, match=r"data\[0\]: the chat template refuses .*roles must alternate"):
        examples([{"messages": CHAT}], made)
    made.chat_template = (  # earlier replies are shortened, as in templates of thinking models
        "{% for m in messages %}{{ m['content'] if loop.last else m['content'][:2] }}<eos>{% endfor %}"
    )
    with pytest.raises(ValueError, match=r"rewrites earlier turns .* prompt, the reply as completion"):
        examples([{"messages": CHAT}], made)


def test_a_header_that_the_reply_does_not_keep_stays_outside():
    """Thinking models open a thought in the generation prompt that a plain reply does not have."""
    made = tokenizer()
    made.chat_template = (
        "{% for m in messages %}{{ m['role'][0] }}.{{ m['content'] }}<eos>{% endfor %}"
        "{% if add_generation_prompt %}a.think{% endif %}"
    )
    (example,) = examples([{"prompt": "ask", "completion": CHAT[2:3]}], made)
    assert whole(example, made) == "u.ask<eos>a.hi you<eos>" and learnt(example, made) == "hi you<eos>"


# --------------------------------------------------------------------------------------- preference pairs


def pairs(rows, made=None, max_tokens=90, **more):
    return preference_pairs(rows, made or tokenizer(), eos=EOS, max_tokens=max_tokens, **more)


@pytest.mark.parametrize(
    ("row", "prompt", "chosen", "rejected"),
    [
        ({"prompt": "ask ", "chosen": "yes", "rejected": "no"}, "ask ", "yes<eos>", "no<eos>"),
        ({"prompt": "ask ", "chosen": "yes", "rejected": "yet"}, "ask ", "yes<eos>", "yet<eos>"),
        ({"chosen": "ask yes", "rejected": "ask no"}, "ask ", "yes<eos>", "no<eos>"),
        ({"prompt": CHAT[:2], "chosen": CHAT[2:3], "rejected": CHAT[4:]}, None, "hi you<eos>", "no.<eos>"),
        ({"chosen": CHAT[:3], "rejected": [*CHAT[:2], CHAT[4]]}, None, "hi you<eos>", "no.<eos>"),
        (
            {"prompt": "x", "chosen": CHAT[:3], "rejected": [*CHAT[:2], CHAT[4]]},
            None,
            "hi you<eos>",
            "no.<eos>",
        ),
        ({"prompt": CHAT[:2], "chosen": "hi you", "rejected": "no."}, None, "hi you<eos>", "no.<eos>"),
    ],
)
def test_pairs_share_their_prompt_and_end_with_eos(row, prompt, chosen, rejected):
    made = chatml()
    (pair,) = pairs([row], made)
    if prompt is None:
        prompt = made.apply_chat_template(CHAT[:2], tokenize=False, add_generation_prompt=True)
    n = pair.prompt_length
    assert pair.chosen[:n] == pair.rejected[:n]
    assert made.decode(list(pair.chosen[:n])) == prompt
    assert made.decode(list(pair.chosen[n:])) == chosen
    assert made.decode(list(pair.rejected[n:])) == rejected


def test_uninformative_pairs_are_counted():
    rows = [
        {"prompt": "ask", "chosen": "yes", "rejected": "yes"},
        {"prompt": "ask", "chosen": "yes a", "rejected": "yes b"},
        {"prompt": "ask", "chosen": "yes", "rejected": "no"},
    ]
    with pytest.warns(UserWarning, match=r"1 of 3 rows .* cut; 2 of 3 rows have two equal texts"):
        (kept,) = pairs(rows, max_tokens=7)
    assert kept.prompt_length == 3
    with pytest.raises(ValueError, match=r"data\[0\] has the columns: text; expected chosen and rejected"):
        pairs(["abc"])
    with pytest.raises(ValueError, match=r"rejected of data\[0\] is empty"):
        pairs([{"chosen": "a", "rejected": ""}])


# ------------------------------------------------------------------------------------------------- prompts


def test_prompts_keep_what_is_shown_and_the_other_columns():
    made = chatml()
    rows = ["plain", {"prompt": "text", "answer": 3, "tags": ["a"]}, {"prompt": CHAT[:2], "answer": None}]
    plain, text, chat = read_prompts(rows, made, max_tokens=90)
    assert (plain.shown, plain.columns) == ("plain", {})
    assert (text.shown, text.columns) == ("text", {"answer": 3, "tags": ["a"]})
    assert (chat.shown, chat.columns) == (CHAT[:2], {"answer": None})
    assert made.decode(list(chat.tokens)).endswith("hello<eos>\n<bos>assistant.")
    begun = [*CHAT[:2], {"role": "assistant", "content": "hi y"}]
    (prompt,) = read_prompts([{"prompt": begun}], made, max_tokens=90)
    assert made.decode(list(prompt.tokens)).endswith("<bos>assistant.hi y")


def test_long_prompts_lose_their_beginning():
    made = opening("<bos> $A")
    with pytest.warns(UserWarning, match="1 of 2 prompts have more than 4 tokens and lost their beginning"):
        long, short = read_prompts(["abcdef", "abc"], made, max_tokens=4)
    assert made.decode(list(long.tokens)) == "<bos>def" and long.shown == "def"
    assert made.decode(list(short.tokens)) == "<bos>abc" and short.shown == "abc"


def test_a_long_chat_loses_its_beginning_with_a_message():
    made, heard = chatml(), []
    rows = [{"prompt": CHAT[:2]}, "abcdefghijklmno"]
    chat, _ = read_prompts(rows, made, max_tokens=12, notify=heard.append)
    assert made.decode(list(chat.tokens)) == "\n<bos>assistant." and chat.shown == CHAT[:2]
    assert heard == [
        "2 of 2 prompts have more than 12 tokens and lost their beginning, though 1 of them are chats, which "
        "reward functions are shown whole. Raise max_prompt_tokens to keep them whole."
    ]


@pytest.mark.parametrize("template", ["$A", "<bos> $A"])
def test_a_long_chat_keeps_the_opening_that_its_template_writes(template):
    made = opening(template)
    made.chat_template = "<bos>" + CHATML.replace("<bos>", "")
    (chat,) = read_prompts([{"prompt": CHAT[:2]}], made, max_tokens=12, notify=str)
    assert made.decode(list(chat.tokens)) == "<bos>\nassistant."


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("", r"prompt of data\[1\] is empty"),
        ({"prompt": None, "text": "a"}, r"has the columns: text; expected prompt"),
        ({"prompt": []}, r"prompt of data\[1\] is empty"),
        ({"prompt": 5}, r"prompt of data\[1\] is int"),
        ("\ud800", r"prompt of data\[1\] holds '\\ud800' at character 0"),
    ],
)
def test_a_bad_prompt_is_named(row, message):
    with pytest.raises(ValueError, match=message):
        read_prompts(["fine", row], tokenizer(chat=True), max_tokens=9)


# ------------------------------------------------------------------------------------- padding and packing


@pytest.mark.parametrize("filler", [0, 7, EOS])
def test_only_the_mask_defines_padding(filler):
    rows = [[5], [6, 7, 8], []]
    tokens, real = pad_left(rows, filler)
    assert tokens.dtype == torch.int64 and real.dtype == torch.bool
    assert tokens.tolist() == [[filler, filler, 5], [6, 7, 8], [filler] * 3]
    assert real.tolist() == [[False, False, True], [True] * 3, [False] * 3]
    tokens, real = pad_right(rows, filler)
    assert tokens.tolist() == [[5, filler, filler], [6, 7, 8], [filler] * 3]
    assert real.tolist() == [[True, False, False], [True] * 3, [False] * 3]


def random_examples(count: int, longest: int, seed: int = 0) -> list[Example]:
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.randint(2, longest + 1, (count,), generator=generator).tolist()
    tokens = [torch.randint(4, 60, (n,), generator=generator).tolist() for n in sizes]
    return [Example(tuple(row), (False, *[True] * (len(row) - 1))) for row in tokens]


def test_packing_keeps_every_example_once_and_wastes_little():
    given = random_examples(200, 30)
    rows = pack_rows(given, 32)
    assert all(len(row) <= 32 for row in rows)
    found = []
    for row in rows:
        count = int(row.segments.max()) + 1
        for segment in range(count):
            inside = row.segments[0] == segment
            assert row.positions[0][inside].tolist() == list(range(int(inside.sum())))
            found.append(Example(tuple(row.tokens[0][inside].tolist()), tuple(row.learn[0][inside].tolist())))
    key = lambda example: (example.tokens, example.learn)  # noqa: E731
    assert sorted(found, key=key) == sorted(given, key=key)
    total = sum(len(example.tokens) for example in given)
    assert len(rows) <= 1.1 * total / 32 + 1
    again = pack_rows(given, 32)
    assert all(torch.equal(a.tokens, b.tokens) for a, b in zip(rows, again, strict=True))
    with pytest.raises(ValueError, match=r"examples\[0\] has 3 tokens; rows have 2"):
        pack_rows([Example((1, 2, 3), (False, True, True))], 2)


def test_rows_are_put_together_with_padding_that_is_no_text():
    rows = [row_of(random_examples(2, 5, seed)) for seed in range(3)]
    batch = collate(rows, filler=9)
    for i, row in enumerate(rows):
        n = len(row)
        assert torch.equal(batch.tokens[i, :n], row.tokens[0])
        assert (batch.tokens[i, n:] == 9).all() and (batch.segments[i, n:] == PADDING).all()
        assert not batch.learn[i, n:].any() and batch.learn.dtype == torch.bool


def test_attention_stays_in_its_text_and_looks_back():
    segments = torch.tensor([[0, 0, 1, 1, 1, PADDING], [0, 0, 0, 0, PADDING, PADDING]])
    allowed = attention_of(segments)
    assert allowed.shape == (2, 1, 6, 6)
    for row, i, j in itertools.product(range(2), range(6), range(6)):
        assert bool(allowed[row, 0, i, j]) == (j <= i and bool(segments[row, i] == segments[row, j]))
    assert allowed.any(-1).all()  # a softmax over nothing would be NaN
