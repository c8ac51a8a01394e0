"""Tokens are the tokenizer's: whole chats tokenised once, borders where sampling parts them, and no id that
only one of tokenizer and model has.
"""

from __future__ import annotations

import functools
import json

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from language.tiny import saved, tiny_llama, tokenizer

from tightrope.language import align
from tightrope.language.alignment.experience import gather
from tightrope.language.data.examples import preference_pairs, read_prompts, read_rows, sft_examples
from tightrope.language.data.formats import Encoder
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.generation.sample import draw
from tightrope.language.model.load import known_ids, never_drawn, unwritable
from tightrope.language.policy.roles import make_roles
from tightrope.language.selfcheck import check_model
from tightrope.language.settings import AlignSettings, RewardSettings, SFTSettings
from tightrope.language.supervised.preferences import train_reward
from tightrope.language.supervised.sft import train_sft

TEXTS = [
    "The quick brown fox jumps over the lazy dog; a reward, a policy, a critic.",
    "Hi there! The end. The reward model says yes. Blue sky, be nice.",
    "user assistant system model: [INST] hello [/INST] A b  c   d. yes no yesterday.",
] * 20
MARKS = ["<unk>", "<s>", "</s>"]
EOS = 2
TEMPLATES = {
    "chatml": "{% for m in messages %}<|im_start|>{{ m['role'] }}\n{{ m['content'] }}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}",
    "zephyr": "{% for m in messages %}{{ '<|' + m['role'] + '|>\n' + m['content'] + eos_token + '\n' }}"
    "{% endfor %}{% if add_generation_prompt %}<|assistant|>\n{% endif %}",
    "llama2": "{% for m in messages %}{% if m['role'] == 'user' %}"
    "{{ bos_token + '[INST] ' + m['content'] + ' [/INST]' }}"
    "{% elif m['role'] == 'assistant' %}{{ ' ' + m['content'] + ' ' + eos_token }}"
    "{% else %}{{ '<<SYS>>\n' + m['content'] + '\n<</SYS>>\n\n' }}{% endif %}{% endfor %}",
    "llama3": "{{ bos_token }}{% for m in messages %}<|start_header_id|>{{ m['role'] }}<|end_header_id|>\n\n"
    "{{ m['content'] | trim }}<|eot_id|>{% endfor %}"
    "{% if add_generation_prompt %}<|start_header_id|>assistant<|end_header_id|>\n\n{% endif %}",
    "gemma": "{{ bos_token }}{% for m in messages %}"
    "<start_of_turn>{{ 'model' if m['role'] == 'assistant' else m['role'] }}\n"
    "{{ m['content'] | trim }}<end_of_turn>\n{% endfor %}"
    "{% if add_generation_prompt %}<start_of_turn>model\n{% endif %}",
    "mistral": "{{ bos_token }}{% for m in messages %}"
    "{% if m['role'] == 'user' %}[INST] {{ m['content'] }}[/INST]"
    "{% elif m['role'] == 'assistant' %} {{ m['content'] | trim }}{{ eos_token }}"
    "{% else %}{{ m['content'] }}\n{% endif %}{% endfor %}",
}
ADDED = {
    "chatml": ["<|im_end|>", "<|im_start|>"],
    "llama3": ["<|eot_id|>", "<|start_header_id|>", "<|end_header_id|>"],
    "gemma": ["<end_of_turn>", "<start_of_turn>"],
}
KINDS = ["byte level", "metaspace first", "metaspace always", "metaspace never", "prepend", "unigram"]


@functools.cache
def trained(kind: str):
    """A tokenizer of tokenizers, trained on a few lines: how it marks the beginning of a word."""
    from tokenizers import Tokenizer, decoders, models, normalizers, pre_tokenizers, processors, trainers

    codes = [f"<0x{i:02X}>" for i in range(256)]
    spoken = [decoders.Replace("▁", " "), decoders.ByteFallback(), decoders.Fuse(), decoders.Strip(" ", 1, 0)]
    made = Tokenizer(models.BPE(byte_fallback=True, unk_token="<unk>", fuse_unk=True))
    made.decoder = decoders.Sequence(spoken)
    train = trainers.BpeTrainer(vocab_size=500, special_tokens=[*MARKS, *codes], show_progress=False)
    if kind == "byte level":
        made = Tokenizer(models.BPE())
        made.pre_tokenizer, made.decoder = (
            pre_tokenizers.ByteLevel(add_prefix_space=False),
            decoders.ByteLevel(),
        )
        made.post_processor = processors.ByteLevel(trim_offsets=True)
        letters = pre_tokenizers.ByteLevel.alphabet()
        train = trainers.BpeTrainer(
            vocab_size=400, special_tokens=MARKS, initial_alphabet=letters, show_progress=False
        )
    elif kind == "unigram":
        made = Tokenizer(models.Unigram())
        made.pre_tokenizer, made.decoder = pre_tokenizers.Metaspace(), decoders.Metaspace()
        train = trainers.UnigramTrainer(
            vocab_size=150, special_tokens=MARKS, unk_token="<unk>", show_progress=False
        )
    else:
        scheme = kind.removeprefix("metaspace ") if kind != "prepend" else "always"
        made.pre_tokenizer = pre_tokenizers.Metaspace(prepend_scheme=scheme)
    made.train_from_iterator(TEXTS, train)
    if kind == "prepend":  # as Llama 2: no word has a blank inside
        made.normalizer = normalizers.Sequence([normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")])
        made.pre_tokenizer = None
    return made.to_str()


@functools.cache
def chatting(kind: str, template: str | None = None, marked: bool = True):
    """The tokenizer of a kind with a chat template, whose marks are tokens (``marked``) or text."""
    from tokenizers import Tokenizer
    from transformers import PreTrainedTokenizerFast

    made = PreTrainedTokenizerFast(
        tokenizer_object=Tokenizer.from_str(trained(kind)),
        bos_token="<s>",
        eos_token="</s>",
        unk_token="<unk>",
    )
    if template is not None:
        made.chat_template = TEMPLATES[template]
        if marked:
            made.add_tokens(ADDED.get(template, []), special_tokens=True)
    return made


def ending(made, template: str, marked: bool) -> int:
    """What ends a turn."""
    own = ADDED.get(template) if marked else None
    return made.convert_tokens_to_ids(own[0]) if own else EOS


def blank(made, tokens: list[int]) -> bool:
    """Whether these are blanks, as every template may write them behind the last turn."""
    return not made.decode([t for t in tokens if t not in made("\n")["input_ids"]]).strip()


def check(made, eos: int, chat: list[dict], prompts: int) -> bool:
    """Whether this chat is told to have no border before a reply. Else it has the template's tokens; always
    it begins with the prompt of alignment, of ``prompts`` messages.
    """
    heard: list[str] = []
    (example,) = sft_examples([{"messages": chat}], made, eos=eos, max_tokens=9999, notify=heard.append)
    theirs, own = made.apply_chat_template(chat, return_dict=False), list(example.tokens)
    if eos not in theirs:
        assert own.pop() == eos  # it is appended where the template writes none
    (asked,) = read_prompts([{"prompt": chat[:prompts]}], made, max_tokens=9999)
    begin = len(asked.tokens)
    assert tuple(own[:begin]) == asked.tokens
    assert all(example.learn[begin:]) and not example.learn[begin - 1]
    assert heard or (theirs[: len(own)] == own and blank(made, theirs[len(own) :]))
    said, wanted = made.decode(own), made.decode(theirs)
    assert wanted.startswith(said) and blank(made, made(wanted.removeprefix(said))["input_ids"])
    return bool(heard)


CHATS = [
    [{"role": "user", "content": "Hi"}, {"role": "assistant", "content": "The end."}],
    [
        {"role": "system", "content": "be nice"},
        {"role": "user", "content": "Hi there"},
        {"role": "assistant", "content": "The quick brown fox\n\nyes  no"},
        {"role": "user", "content": "more? "},
        {"role": "assistant", "content": "Blue sky é日本"},
    ],
]


@pytest.mark.parametrize("template", TEMPLATES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_chat_has_the_tokens_of_its_template(kind, template):
    for marked in (True, False) if template in ADDED else (True,):
        made = chatting(kind, template, marked)
        for chat in CHATS:
            crossing = check(made, ending(made, template, marked), chat, len(chat) - 1)
            assert not crossing


WORDS = st.sampled_from([*" \n.'", "  ", "The", "the end", "reward", "é", "日", "yes", "<", "[", "_", "▁"])
CONTENT = st.lists(WORDS, min_size=1, max_size=6).map("".join).filter(str.strip)


@given(kind=st.sampled_from(KINDS), template=st.sampled_from(list(TEMPLATES)), marked=st.booleans(),
       contents=st.lists(CONTENT, min_size=2, max_size=6).filter(lambda x: len(x) % 2 == 0))  # fmt: skip
@settings(max_examples=300)
def test_every_chat_begins_with_the_prompt_that_is_sampled_from(kind, template, marked, contents):
    made = chatting(kind, template, marked)
    chat = [{"role": ("user", "assistant")[i % 2], "content": content} for i, content in enumerate(contents)]
    check(made, ending(made, template, marked), chat, len(chat) - 1)


@pytest.mark.parametrize("kind", KINDS)
@given(prompt=CONTENT, completion=CONTENT)
@settings(max_examples=60)
def test_a_prompt_and_its_completion_say_what_they_say_together(kind, prompt, completion):
    made, row = chatting(kind), {"prompt": prompt, "completion": completion}
    heard: list[str] = []
    (example,) = sft_examples([row], made, eos=EOS, max_tokens=9999, notify=heard.append)
    (asked,) = read_prompts([prompt], made, max_tokens=9999, notify=heard.append)
    begin, whole = len(asked.tokens), made(prompt + completion)["input_ids"]
    assert example.tokens[:begin] == asked.tokens
    assert example.learn == (False,) * begin + (True,) * (len(example.tokens) - begin)
    assert made.decode(list(example.tokens[:-1])) == made.decode(whole)
    assert heard or list(example.tokens[:-1]) == whole


def test_the_first_word_of_a_reply_has_no_blank_that_nobody_wrote():
    """A tokenizer with a word mark before every string: the Zephyr template's reply begins with The."""
    made = chatting("metaspace always", "zephyr")
    (example,) = sft_examples([{"messages": CHATS[0]}], made, eos=EOS, max_tokens=99)
    learnt = [t for t, kept in zip(example.tokens, example.learn, strict=True) if kept]
    assert made.convert_ids_to_tokens(learnt)[0][0] == "T"
    rows = [{"prompt": CHATS[0][:1], "chosen": "The end.", "rejected": "Blue."}]
    (pair,) = preference_pairs(rows, made, eos=EOS, max_tokens=99)
    assert pair.chosen == example.tokens
    assert made.convert_ids_to_tokens(pair.rejected[pair.prompt_length])[0] == "B"


@pytest.mark.parametrize(
    ("prompt", "completion"),
    [
        ("Hi: a\nA: ", "yes"),
        ("The rew", "ard model"),
        ("The", " reward"),
        ("a\n\n", "The"),
        ("Hi ", " there"),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_no_blank_comes_between_a_prompt_and_its_completion(kind, prompt, completion):
    made, heard = chatting(kind), []
    before, reply = Encoder(made, EOS).reply(prompt, completion)
    assert before == made(prompt)["input_ids"]
    assert made.decode([*before, *reply]) == made.decode(made(prompt + completion)["input_ids"])
    row = {"prompt": prompt, "completion": completion}
    rows = [row, {"prompt": "The", "completion": " end"}]
    sft_examples(rows, made, eos=EOS, max_tokens=99, notify=heard.append)
    crossing = [*before, *reply] != made(prompt + completion)["input_ids"]
    assert len(heard) == crossing and all("1 of 2 rows have a prompt whose end" in text for text in heard)


def test_a_prompt_that_ends_with_a_blank_is_told():
    made = chatting("metaspace always")
    with pytest.warns(UserWarning, match="1 of 3 prompts end with a blank .* Take the blank out"):
        read_prompts(["Q: a\nA: ", "Q: a\nA:", "Q: a\n"], made, max_tokens=99)


def test_an_earlier_reply_is_learnt_and_the_last_begins_as_it_is_sampled():
    """A template whose header ends with a blank, which the tokenizer writes together with the next word."""
    made, heard = chatting("metaspace always", "zephyr", True), []
    made = type(made)(tokenizer_object=made._tokenizer, bos_token="<s>", eos_token="</s>", unk_token="<unk>")
    made.chat_template = (
        "{% for m in messages %}{{ m['role'] }}: {{ m['content'] }}{{ eos_token }}{% endfor %}"
        "{% if add_generation_prompt %}assistant: {% endif %}"
    )
    chat = [*CHATS[0], {"role": "user", "content": "more"}, {"role": "assistant", "content": "The reward"}]
    (example,) = sft_examples([{"messages": chat}], made, eos=EOS, max_tokens=99, notify=heard.append)
    learnt = [t for t, kept in zip(example.tokens, example.learn, strict=True) if kept]
    first = learnt[: learnt.index(EOS) + 1]
    assert made.convert_ids_to_tokens(first)[0].startswith("▁T")  # as the template's history has it
    assert made.convert_ids_to_tokens(learnt[len(first)]).startswith("T")
    (prompt,) = read_prompts([{"prompt": chat[:3]}], made, max_tokens=99)
    assert example.tokens[: len(prompt.tokens)] == prompt.tokens
    assert made.decode(list(example.tokens)) == made.decode(made.apply_chat_template(chat, return_dict=False))
    assert len(heard) == 1 and heard[0].startswith("1 of 1 rows have a prompt whose end")


def test_a_header_that_shares_letters_with_the_reply_stays_outside():
    made = tokenizer()
    made.chat_template = (
        "{% for m in messages %}{{ m['role'][0] }}.{{ m['content'] }}<eos>{% endfor %}"
        "{% if add_generation_prompt %}a.think{% endif %}"
    )
    reply = [{"role": "assistant", "content": "this"}]
    (example,) = sft_examples([{"prompt": "ask", "completion": reply}], made, eos=3, max_tokens=99)
    learnt = [t for t, kept in zip(example.tokens, example.learn, strict=True) if kept]
    assert made.decode(learnt) == "this<eos>"


def slow_tokenizer():
    """A tokenizer in Python, without offsets, that marks the beginning of every string it is given."""
    from transformers import PreTrainedTokenizer

    class Slow(PreTrainedTokenizer):
        def __init__(self, **more):
            words = [
                "<s>",
                "</s>",
                "<unk>",
                "▁The",
                "The",
                "▁end",
                "▁yes",
                "yes",
                "▁",
                *map(chr, range(33, 127)),
            ]
            self.words = {word: i for i, word in enumerate([*words, "\n"])}
            super().__init__(bos_token="<s>", eos_token="</s>", unk_token="<unk>", **more)

        @property
        def vocab_size(self):
            return len(self.words)

        def get_vocab(self):
            return {**self.words, **self.added_tokens_encoder}

        def _tokenize(self, text, **more):
            text, found = "▁" + text.replace(" ", "▁"), []
            while text:
                word = max((w for w in self.words if text.startswith(w)), key=len, default=text[0])
                text, _ = text[len(word) :], found.append(word)
            return found

        def _convert_token_to_id(self, token):
            return self.words.get(token, 2)

        def _convert_id_to_token(self, index):
            return list(self.words)[index]

        def convert_tokens_to_string(self, tokens):
            return "".join(tokens).replace("▁", " ").removeprefix(" ")

    return Slow()


def test_a_tokenizer_without_offsets_gives_its_own_tokens():
    made = slow_tokenizer()
    assert not made.is_fast
    made.chat_template = TEMPLATES["zephyr"]
    assert not check(made, 1, CHATS[0], 1)
    for prompt, completion in (("Q: ", "yes"), ("Th", "e end"), ("The", " end")):
        before, reply = Encoder(made, 1).reply(prompt, completion)
        assert made.decode([*before, *reply]) == prompt + completion
        assert before == Encoder(made, 1).text(prompt)


# -------------------------------------------------------------------------------- ids that only one side has


def test_an_id_outside_the_tokenizer_is_never_sampled_and_in_no_support():
    model, made = tiny_llama(), tokenizer()
    strangers = unwritable(model, made)
    assert strangers == tuple(range(60, 64))
    with torch.no_grad():
        model.lm_head.weight[60:] *= 40  # they would be drawn nearly always
    head, hidden = model.get_output_embeddings(), torch.randn(500, 32)
    numbers = torch.rand(500, dtype=torch.float64)
    for k, size in ((0, 0), (5, 5), (99, 60)):
        sampling = Sampling(1.0, k, never_drawn(model, made, (3,), ignore_eos=False))
        tokens, logp, support = draw(hidden, head, sampling, numbers)
        assert not torch.isin(tokens, torch.tensor(strangers)).any()
        if k:
            assert support.shape == (500, size) and not torch.isin(support, torch.tensor(strangers)).any()
        found = token_statistics(hidden, head, tokens, sampling, support=support)
        torch.testing.assert_close(found.logp, logp)
    assert torch.isin(draw(hidden, head, Sampling(), numbers)[0], torch.tensor(strangers)).any()


def test_a_hole_in_the_tokenizers_ids_and_a_head_wider_than_the_embedding_count_too():
    model, made = tiny_llama(), tokenizer()
    made.get_vocab = lambda: {f"w{i}": i for i in range(70) if i != 17}
    assert unwritable(model, made) == (17,)
    model.lm_head = torch.nn.Linear(32, 66, bias=False)
    assert unwritable(model, made) == (17, 64, 65)
    assert never_drawn(model, made, (3, 99), ignore_eos=True) == (3, 17, 64, 65)
    with pytest.raises(ValueError, match=r"ends responses with 17, 99, which its tokenizer does not have"):
        never_drawn(model, made, (17, 99), ignore_eos=False)


@pytest.mark.parametrize("top_k", [0, 7, 64])
def test_sampling_update_and_exact_kl_are_of_the_tokenizers_ids(tmp_path, top_k):
    """The logits of ids without a token are huge: whoever counts them has another probability."""
    model = tiny_llama()
    model.lm_head.weight = torch.nn.Parameter(model.lm_head.weight.clone())
    model.config.tie_word_embeddings = False
    with torch.no_grad():
        model.lm_head.weight[60:] *= 3
    chosen = AlignSettings(
        model=saved(tmp_path, model), lora_rank=2, batch_size=6, samples_per_prompt=2, max_new_tokens=8,
        max_prompt_tokens=8, top_k=top_k, temperature=0.8,
    )  # fmt: skip
    roles = make_roles(chosen, notify=lambda text: None)
    assert any("4 of the model's ids are never sampled" in line for line in roles.lines())
    for name, weight in roles.model.named_parameters():
        if "policy" in name:
            torch.nn.init.normal_(weight, std=0.1)
    prompts = read_prompts(["abc", "d", "ef"], roles.tokenizer, max_tokens=8)
    found = gather(roles, prompts, 0, 0, 2)
    mask = found.responses.mask
    assert found.responses.tokens[mask].max() < 60
    assert (found.responses.logp - found.logp)[mask].abs().max() < 1e-4
    with torch.no_grad():
        logs = []
        for role in (roles.policy, roles.reference):
            hidden = role.hidden(found.tokens, found.real)[:, -mask.shape[1] - 1 : -1]
            logs.append(roles.trunk.parts.head(hidden).div(0.8)[..., :60])
    if top_k == 7:
        assert found.responses.support.shape[-1] == 7
        logs = [x.gather(2, found.responses.support) for x in logs]
    p, q = (x.log_softmax(2) for x in logs)
    torch.testing.assert_close(found.exact[mask], (p.exp() * (p - q)).sum(2)[mask], rtol=1e-3, atol=1e-5)
    assert found.exact[mask].max() > 1e-3


def added(folder, model=None, template=False):
    """A model with a tokenizer that has a token more than it."""
    path = saved(folder, model)
    made = tokenizer()
    made.add_tokens([f"<{i}>" for i in range(4)] + ["<tool>"])
    if template:
        made.chat_template = "{% for m in messages %}<tool>{{ m['content'] }}{% endfor %}"
    made.save_pretrained(path)
    return path


REFUSED = r"data\[0\] has the token '<tool>', id 64, but the model has 64 ids.*resize_token_embeddings"


def test_a_text_with_a_token_beyond_the_embedding_is_refused_before_a_run_begins(tmp_path):
    path, run = added(tmp_path / "model"), tmp_path / "run"
    rows = [{"prompt": "a", "completion": "<tool>b"}]
    pairs = [{"prompt": "a", "chosen": "<tool>b", "rejected": "c"}]
    with pytest.raises(ValueError, match=REFUSED):
        train_sft(SFTSettings(model=path, max_tokens=20), data=rows, run_dir=run)
    with pytest.raises(ValueError, match=REFUSED):
        train_reward(RewardSettings(model=path, max_tokens=20), data=pairs, run_dir=run)
    with pytest.raises(ValueError, match="prompt of " + REFUSED):
        align(model=path, prompts=["<tool>b"], reward="length", run_dir=run)
    assert not run.exists()


def test_tokens_beyond_the_embedding_that_no_text_has_are_named(tmp_path):
    """As in Gemma 3 1B, whose tokenizer has a token for images."""
    path, heard = added(tmp_path / "model"), []
    rows = [{"prompt": "a", "completion": "b"}] * 4
    settings = SFTSettings(model=path, max_tokens=20, num_epochs=1)
    train_sft(settings, data=rows, run_dir=tmp_path / "run", listeners=[heard.append])
    texts = [getattr(event, "text", "") for event in heard]
    assert any("tokens beyond the 64 ids of the model: '<tool>'." in text for text in texts)
    make_roles(AlignSettings(model=path), notify=heard.append)
    assert any("'<tool>'" in text for text in heard if isinstance(text, str))
    finding = check_model(path)[1]
    assert finding.good and "64 ids, 0 of which" in finding.seen and "'<tool>'" in finding.seen
    finding = check_model(added(tmp_path / "chat", template=True))[1]
    assert not finding.good and "resize_token_embeddings" in finding.advice


def test_a_reward_model_must_read_what_the_policy_writes(tmp_path):
    policy = tiny_llama()
    policy.resize_token_embeddings(65)
    ours, theirs = added(tmp_path / "ours", policy), added(tmp_path / "theirs")
    train_reward(
        RewardSettings(model=theirs, max_tokens=20, num_epochs=1, tune="full"),
        data=[{"prompt": "a", "chosen": "b", "rejected": "c"}] * 4, run_dir=tmp_path / "reward",
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"reads 64 ids, the policy also writes '<tool>', id 64"):
        align(model=ours, prompts=["a"], reward=tmp_path / "reward" / "model", run_dir=tmp_path / "run")


# --------------------------------------------------------------------------------------------------- Arrow


def test_nulls_of_arrow_are_not_in_the_data():
    """Rows of one Arrow table have the keys of all: other tools' arguments, other messages' calls."""
    call = {"type": "function", "function": {"name": "light", "arguments": {"room": "x", "level": None}}}
    messages = [
        {"role": "user", "content": "on", "tool_calls": None},
        {"role": "assistant", "content": None, "tool_calls": [call]},
    ]
    tools = [{"function": {"name": "light", "parameters": {"room": {"type": "string"}, "level": None}}}]
    row = {"messages": messages, "tools": tools, "answer": None, "facts": {"level": None}}
    rows = type("Dataset", (list,), {"__module__": "datasets.arrow_dataset"})([row])
    (found,) = read_rows(rows)
    assert "null" not in json.dumps([found["messages"], found["tools"]])
    assert found["messages"][1]["tool_calls"][0]["function"]["arguments"] == {"room": "x"}
    assert found["answer"] is None and found["facts"] == {"level": None}  # a reward function's own
    assert read_rows([row]) == [row]  # what somebody wrote by hand is data


def test_known_ids_are_those_of_the_embedding():
    assert known_ids(tiny_llama()) == 64
