"""One row of any format to tokens: strings and chats, what of them is learnt, the EOS that closes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

Messages = list[dict[str, Any]]
Pieces = list[tuple[list[int], bool]]  # tokens, and whether they are learnt
Encode = Callable[[str], list[int]]
Spans = list[tuple[int, int]]  # begin and end, of characters or of tokens
# what a text may stand behind, so that it gets the tokens of a continuation; then words of the vocabulary
ANCHORS = ("", "\n", ".", "a", " a")
WORDS_TRIED = 256  # of a vocabulary


class Encoder:
    """A tokenizer, and what it puts before and after a text.

    ``eos`` are the ids that end a response; the first is appended where a text does not end with one.
    ``vocabulary``: how many ids the model knows; None: all of the tokenizer. ``crossed``: the places of rows
    whose reply does not begin at a border of the whole text's tokens.
    """

    def __init__(
        self, tokenizer: PreTrainedTokenizerBase, eos: int | Sequence[int] = (), vocabulary: int | None = None
    ) -> None:
        self.tokenizer, self.vocabulary = tokenizer, vocabulary
        self.eos = (eos,) if isinstance(eos, int) else tuple(eos)
        self.crossed = set[str]()
        # A probe separates the opening (a BOS, or nothing) from a closing EOS, also where both are one id. A
        # tokenizer of digits or of DNA knows no "a".
        self.probe = next((word for word in chain(("a",), self._words()) if self._tokens(word)), "")
        bare, whole = self._tokens(self.probe), list(tokenizer(self.probe)["input_ids"])
        starts = (i for i in range(len(whole)) if bare and whole[i : i + len(bare)] == bare)
        self.opening = whole[: next(starts, 0)]
        self.newline = set(self._tokens("\n"))

    def bare(self, text: str) -> list[int]:
        """The tokens of a text and nothing else. ValueError for a text that the tokenizer cannot write."""
        try:
            return list(self.tokenizer(text, add_special_tokens=False, verbose=False)["input_ids"])
        except Exception as error:  # one without an UNK raises a bare Exception
            raise ValueError(
                f"The tokenizer has no tokens for {text[:80]!r} ({error}). Take out what it does not know, "
                "or give it an UNK token."
            ) from error

    def _tokens(self, text: str) -> list[int]:
        """As `bare`, but none for a text that the tokenizer cannot write."""
        try:
            return self.bare(text)
        except ValueError:
            return []

    def _words(self) -> Iterator[str]:
        """Texts of the first ordinary tokens of the vocabulary."""
        special = set(self.tokenizer.all_special_ids)
        words = (self._decoded([token]) for token in range(len(self.tokenizer)) if token not in special)
        return islice((word for word in words if word.strip()), WORDS_TRIED)

    def text(self, text: str) -> list[int]:
        """The tokens of a text with the tokenizer's opening, which is never put there twice."""
        tokens = self.bare(text)
        return tokens if tokens[: len(self.opening)] == self.opening else [*self.opening, *tokens]

    def opening_of(self, tokens: list[int]) -> list[int]:
        """What of a chat's tokens opens it: the tokenizer's opening, or the BOS, where the template writes it
        there and nowhere else. In some chats the BOS opens every turn.
        """
        bos = self.tokenizer.bos_token_id
        opening = self.opening or ([] if bos is None else [bos])
        begins = bool(opening) and tokens[: len(opening)] == opening
        return opening if begins and tokens.count(opening[0]) == opening.count(opening[0]) else []

    def with_replies(self, text: str, replies: Spans, place: str, encode: Encode) -> tuple[list[int], Spans]:
        """The tokens of a whole text, and where its replies stand in them; ``replies``: spans of characters.

        What stands before a reply should be the tokens of that much of the text alone, as sampling begins
        with them. It is not where a token reaches across the border, or where the end of the prompt is
        written in another way when something follows: there the last reply is tokenised apart, and an earlier
        one is learnt from the first token on that is not the prompt's. Offsets would not show the second,
        lack blanks (``trim_offsets``), and slow tokenizers have none.
        """
        tokens, found = encode(text), Spans()
        for start, end in replies:
            before = encode(text[:start])
            begin = shared(before, tokens)
            if begin < len(before):
                self.crossed.add(place)
                if (start, end) == replies[-1]:
                    encode, begin = self._apart(text, start, before, tokens, place), len(before)
                    tokens = encode(text)
            until = tokens if end == len(text) else encode(text[:end])
            found.append((begin, max(begin, shared(until, tokens))))
        return tokens, found

    def _apart(self, text: str, start: int, before: list[int], whole: list[int], place: str) -> Encode:
        """How to tokenise ``text`` up to any later character with ``before`` as the tokens up to ``start``.

        The rest is tokenised behind a character that leaves its tokens alone: so no blank comes before its
        first word, and half a word stays one. The row must still say what its ``whole`` tokens say.
        """
        ways = (self._decoded, self._written)
        usual = ((said, anchor) for said in ways for anchor in ANCHORS)
        more = ((said, anchor) for anchor in self._words() for said in ways)
        for said, anchor in chain(usual, more):
            head = self._tokens(anchor)
            if anchor and not head:
                continue

            def encode(part: str, anchor: str = anchor, size: int = len(head)) -> list[int]:
                return [*before, *self.bare(anchor + part[start:])[size:]]

            alone = self._tokens(anchor + text[start:])[: len(head)] == head
            if alone and said(encode(text)) == said(whole):
                return encode
        raise ValueError(
            f"{place}: the tokenizer writes the end of the prompt in another way when the reply follows, and "
            "has no tokens for the reply alone. Part them between two words: a blank belongs to the reply."
        )

    def _decoded(self, tokens: list[int]) -> str:
        return str(self.tokenizer.decode(tokens, clean_up_tokenization_spaces=False))

    def _written(self, tokens: list[int]) -> str:
        """Where a tokenizer has no decoder, decoded tokens stand apart."""
        return "".join(self.tokenizer.convert_ids_to_tokens(tokens))

    def reply(self, prompt: str, completion: str, place: str = "this row") -> tuple[list[int], list[int]]:
        """The tokens of a prompt of plain text, and those of its completion."""
        whole, border = prompt + completion, len(prompt)
        tokens, [(start, _)] = self.with_replies(whole, [(border, len(whole))], place, self.text)
        return tokens[:start], tokens[start:]

    def require_known(self, tokens: Sequence[int], place: str) -> None:
        """ValueError for a token that the model has no id for."""
        last = max(tokens, default=-1)
        if self.vocabulary is not None and last >= self.vocabulary:
            raise ValueError(
                f"{place} has the token {self.tokenizer.convert_ids_to_tokens(last)!r}, id {last}, but the "
                f"model has {self.vocabulary} ids. Give it more with "
                "model.resize_token_embeddings(len(tokenizer)), save both, and give that folder."
            )

    def closing(self, tokens: list[int]) -> int | None:
        """How many tokens there are up to the EOS that closes a reply, it included; None without such an EOS.

        Only blanks may follow it: chat templates write a newline there, which is never sampled, and which
        some tokenizers do not know.
        """
        last = max((i for i, token in enumerate(tokens) if token in self.eos), default=None)
        if last is None:
            return None
        tail = [token for token in tokens[last + 1 :] if token not in self.newline]
        if str(self.tokenizer.decode(tail)).strip():
            return None
        return last + 1

    def closed(self, tokens: list[int]) -> list[int]:
        """The tokens up to their closing EOS, which is appended where there is none."""
        end = self.closing(tokens)
        return [*tokens, self.eos[0]] if end is None else tokens[:end]

    def render(self, messages: Messages, place: str, **options: Any) -> str:
        """The text that the chat template makes of messages. ValueError where it cannot."""
        if getattr(self.tokenizer, "chat_template", None) is None:
            raise ValueError(
                f"{place} holds messages, and this tokenizer has no chat template. Give plain strings, or a "
                "model that was made for chats."
            )
        try:
            text = str(self.tokenizer.apply_chat_template(messages, tokenize=False, **options))
        except Exception as error:  # a template is a program of the model's authors and may raise anything
            raise ValueError(f"{place}: the chat template refuses these messages ({error}).") from error
        return encodable(text, f"the chat of {place}")

    def chat(self, messages: Messages, place: str, *, first: int = 0, tools: object = None) -> Pieces:
        """A chat in pieces; assistant turns from message ``first`` on are learnt, up to their EOS. Its tokens
        are those of the whole rendered chat.
        """
        whole = self.render(messages, place, tools=tools)
        learnt = [i for i, message in enumerate(messages) if i >= first and message["role"] == "assistant"]
        turns = [self._turn(messages, index, whole, place, tools) for index in learnt]
        tokens, spans = self.with_replies(whole, turns, place, self.bare)
        pieces, at = Pieces(), 0
        for index, (start, end) in zip(learnt, spans, strict=True):
            turn = tokens[start:end]
            if index == len(messages) - 1:
                turn = self.closed(turn)
            cut = self.closing(turn) or len(turn)
            pieces += [(tokens[at:start], False), (turn[:cut], True), (turn[cut:], False)]
            at = end
        return [*pieces, (tokens[at:], False)]

    def _turn(self, messages: Messages, index: int, whole: str, place: str, tools: object) -> tuple[int, int]:
        """Where an assistant turn begins and ends in the chat's text: its header belongs to the prompt."""
        if index == 0:
            raise ValueError(
                f"{place} begins with an assistant turn, which answers nothing. Put a user's message first."
            )
        before = self.render(messages[:index], place, tools=tools)
        asked = self.render(messages[:index], place, tools=tools, add_generation_prompt=True)
        until = self.render(messages[: index + 1], place, tools=tools)
        if not whole.startswith(before) or not whole.startswith(until):
            raise ValueError(
                f"{place}: the chat template rewrites earlier turns when message {index} is followed by "
                "others. Give one row a reply: the messages before it as prompt, the reply as completion."
            )
        start = shared(whole, asked)
        if start < len(asked):
            # the header opens something that the reply lacks (a thought), and may share letters with it
            other = [*messages[:index], {"role": "assistant", "content": "."}]
            start = min(start, shared(self.render(other, place, tools=tools), asked))
        return start, len(until)

    def prompt(self, messages: Messages, place: str, *, tools: object = None) -> list[int]:
        """A chat up to the assistant's next turn, or up to where a turn that it has begun continues."""
        begun = messages[-1]["role"] == "assistant"
        options = {"continue_final_message": True} if begun else {"add_generation_prompt": True}
        return self.bare(self.render(messages, place, tools=tools, **options))


def supervised(row: Mapping[str, object], encoder: Encoder, place: str) -> Pieces:
    """The pieces of a row for supervised fine-tuning."""
    if has(row, "prompt", "completion"):
        prompt, completion = read_content(row, "prompt", place), read_content(row, "completion", place)
        if isinstance(prompt, str) and isinstance(completion, str):
            return answered(encoder, prompt, completion, place)
        asked = as_messages(prompt, "user")
        messages = [*asked, *as_messages(completion, "assistant")]
        return encoder.chat(messages, place, first=len(asked), tools=row.get("tools"))
    if has(row, "messages"):
        messages = as_messages(read_content(row, "messages", place), "user")
        return encoder.chat(messages, place, tools=row.get("tools"))
    if has(row, "text"):
        text = read_content(row, "text", place)
        if isinstance(text, str):
            return [(encoder.closed(encoder.text(text)), True)]
        raise ValueError(f"text of {place} is a list; expected a string. Chats belong into messages.")
    raise missing(row, place, "text, prompt and completion, or messages")


def preference(row: Mapping[str, object], encoder: Encoder, place: str) -> list[Pieces]:
    """The pieces of the chosen and of the rejected text of a row."""
    if not has(row, "chosen", "rejected"):
        raise missing(row, place, "chosen and rejected, and prompt unless both contain it")
    prompt = read_content(row, "prompt", place) if has(row, "prompt") else None
    replies = [read_content(row, column, place) for column in ("chosen", "rejected")]
    texts = [reply for reply in replies if isinstance(reply, str)]
    if len(texts) == 2 and not isinstance(prompt, list):
        if prompt is None:
            return [[(encoder.closed(encoder.text(text)), True)] for text in texts]
        return [answered(encoder, prompt, text, place) for text in texts]
    chosen, rejected = (_whole_chat(prompt, as_messages(reply, "assistant")) for reply in replies)
    first = shared(chosen, rejected)
    return [encoder.chat(chat, place, first=first, tools=row.get("tools")) for chat in (chosen, rejected)]


def answered(encoder: Encoder, prompt: str, completion: str, place: str) -> Pieces:
    """A prompt, not learnt, and a completion, learnt with its EOS."""
    before, reply = encoder.reply(prompt, completion, place)
    return [(before, False), (encoder.closed(reply), True)]


def _whole_chat(prompt: str | Messages | None, reply: Messages) -> Messages:
    """Prompt and reply; a reply that begins with the prompt's messages, or with a user, brings it along."""
    if prompt is None or (isinstance(prompt, str) and reply[0]["role"] != "assistant"):
        return reply
    asked = as_messages(prompt, "user")
    return reply if reply[: len(asked)] == asked else [*asked, *reply]


def joined(pieces: Pieces, *, everything: bool = False) -> tuple[list[int], list[bool]]:
    """Tokens and what of them is learnt; the first is no target, and what follows the last is left out."""
    tokens = [token for piece, _ in pieces for token in piece]
    learn = [learnt or everything for piece, learnt in pieces for _ in piece]
    learn[:1] = [False] * len(learn[:1])
    end = max((i + 1 for i, learnt in enumerate(learn) if learnt), default=0)
    return tokens[:end], learn[:end]


def shared(first: Sequence[object], second: Sequence[object]) -> int:
    """The number of leading items that two sequences have in common."""
    pairs = enumerate(zip(first, second, strict=False))
    return next((i for i, (a, b) in pairs if a != b), min(len(first), len(second)))


def has(row: Mapping[str, object], *columns: str) -> bool:
    """Whether a row has all of these columns; one that holds None does not count."""
    return all(row.get(column) is not None for column in columns)


def missing(row: Mapping[str, object], place: str, expected: str) -> ValueError:
    """The error for a row without its columns."""
    seen = ", ".join(str(name) for name in row if row[name] is not None) or "none"
    return ValueError(f"{place} has the columns: {seen}; expected {expected}. Rename them in the data.")


def as_messages(value: str | Messages, role: str) -> Messages:
    """Messages as they are, a string as the one message of ``role``."""
    return [{"role": role, "content": value}] if isinstance(value, str) else value


def read_content(row: Mapping[str, object], column: str, place: str) -> str | Messages:
    """A string of encodable text that is not blank, or a list of messages. ValueError names the row and what
    is wrong.
    """
    value = row[column]
    if not isinstance(value, str | list):
        kind = type(value).__name__
        raise ValueError(f"{column} of {place} is {kind}; expected a string or a list of messages.")
    if not value or (column != "completion" and isinstance(value, str) and not value.strip()):
        raise ValueError(f"{column} of {place} is empty. Take the row out, or fill it in.")
    if isinstance(value, str):
        return encodable(value, f"{column} of {place}")
    for message in value:
        if not isinstance(message, dict) or not isinstance(message.get("role"), str):
            raise ValueError(
                f"{column} of {place} holds {message!r}; expected messages like "
                '{"role": "user", "content": "Hello"}.'
            )
        text, role = message.get("content"), message["role"]
        blank = not text or (isinstance(text, str) and not text.strip())
        if blank and role != "system" and not message.get("tool_calls"):
            raise ValueError(
                f"{column} of {place} has an empty {role} message. Take the row out, or fill it in."
            )
    return value


def encodable(text: str, place: str) -> str:
    """The text, where it is one: ValueError for half of a surrogate pair, which no tokenizer reads."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise ValueError(
            f"{place} holds {text[error.start]!r} at character {error.start}: half of a surrogate pair, "
            "which is no text. It was cut or decoded wrongly: take the row out, or the character, with "
            'text.encode("utf-8", "ignore").decode().'
        ) from error
    return text
