"""Training data for language models: rows in, tokens and masks out. A mask decides what counts,
never a token id.

Formats are TRL's: ``text``; ``prompt`` and ``completion``; ``messages``; ``prompt``, ``chosen`` and
``rejected``. Padding may be any id: no result depends on it.
"""

from __future__ import annotations

import csv
import json
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tightrope.language.data import formats
from tightrope.language.data.batching import Example
from tightrope.language.data.formats import Encoder, Messages

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

Row = dict[str, Any] | str
# what a user may give as data: a file, the id of a dataset, or rows
Rows = str | Path | Iterable[str | Mapping[str, object] | Sequence[Mapping[str, object]]]
Item = TypeVar("Item")
Notify = Callable[[str], None]
FILES = (".jsonl", ".json", ".csv", ".txt", ".parquet")
CHATS = ("prompt", "completion", "messages", "chosen", "rejected", "tools")  # columns that may hold messages


@dataclass(frozen=True)
class Pair:
    """Two whole texts, of which ``chosen`` was preferred; their first ``prompt_length`` tokens are equal."""

    chosen: tuple[int, ...]
    rejected: tuple[int, ...]
    prompt_length: int


@dataclass(frozen=True)
class Prompt:
    """What is answered: its tokens, what reward functions see of it, and the other columns of its row."""

    tokens: tuple[int, ...]
    shown: str | Messages
    columns: dict[str, Any]


def read_rows(source: Rows, limit: int | None = None) -> list[Row]:
    """The first ``limit`` rows (None: all) of a dataset.

    ``source``: a .jsonl, .json (a list), .csv or .txt file (a string a line), a .parquet file, a folder that
    ``save_to_disk`` wrote (``folder`` or ``folder:split``), the id of a dataset on the hub (``id``,
    ``id:split`` or ``id:config:split``; these three need the package datasets), a table of pandas, polars or
    pyarrow, a list of strings, dicts or message lists, or anything that yields dicts, as datasets.Dataset
    does (without the nulls that tables put into chats). Strings stay strings, and a list of messages is read
    as ``{"prompt": messages}``. ValueError when there is nothing to read, a row is none of these, or a column
    occurs twice in a file's row or header.
    """
    name = str(source) if isinstance(source, str | Path) else "data"
    if isinstance(source, str | Path):
        source = _read_file(Path(source)) if Path(source).is_file() else _read_named(str(source))
    if isinstance(source, Mapping):
        keys = ", ".join(map(str, source))
        raise ValueError(
            f"{name} is a mapping of {keys}; expected rows. Pass one of its parts, or a list of dicts."
        )
    arrow = type(source).__module__.partition(".")[0] == "datasets" or hasattr(source, "columns")
    if hasattr(source, "columns"):
        source = _records(source)
    # a set has no order to repeat, and bytes and numbers have no rows
    if isinstance(source, bytes | bytearray | set | frozenset) or not np.iterable(source):
        raise ValueError(f"{name} is {type(source).__name__}; expected a file, a dataset or a list of rows.")
    rows: list[Row] = []
    for number, row in enumerate(islice(source, limit)):
        if isinstance(row, list) and row and all(isinstance(message, Mapping) for message in row):
            row = {"prompt": row}
        if not isinstance(row, str | Mapping):
            raise ValueError(
                f"{name}[{number}] is {type(row).__name__}; expected a string or a dict of columns, or a "
                'list of messages like {"role": "user", "content": "Hello"}.'
            )
        rows.append(row if isinstance(row, str) else without_nulls(row) if arrow else dict(row))
    if not rows:
        raise ValueError(f"{name} holds no rows.")
    return rows


def _records(table: Any) -> Any:
    """The rows of a table, as dicts: what pandas, polars and pyarrow iterate over are its columns."""
    _each_once([str(name) for name in getattr(table, "column_names", table.columns)], "data")
    for method, given in (("to_pylist", ()), ("to_dicts", ()), ("to_dict", ("records",))):
        if hasattr(table, method):
            return getattr(table, method)(*given)
    raise ValueError(
        f"data is {type(table).__name__}, a table that does not give its rows; expected a list of dicts, one "
        "a row. Make one of it, or a table of pandas, polars or pyarrow."
    )


def without_nulls(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of Arrow without the nulls inside its chats: Arrow gives all objects of a column the keys of all
    others, such as the arguments of other tools.
    """
    return {name: _without_nulls(value) if name in CHATS else value for name, value in row.items()}


def _without_nulls(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nulls(part) for key, part in value.items() if part is not None}
    return [_without_nulls(part) for part in value] if isinstance(value, list) else value


def _read_file(path: Path) -> Any:
    kind = path.suffix.lower()
    if kind not in FILES:
        raise ValueError(f"{path} ends with {kind!r}; expected one of {', '.join(FILES)}. Convert it.")
    if kind == ".parquet":
        return _with_datasets(str(path), lambda datasets: datasets.Dataset(_parquet(path)))
    try:
        with open(path, encoding="utf-8-sig", newline="" if kind == ".csv" else None) as file:
            if kind == ".csv":
                return _table(file, path)
            if kind == ".json":
                value = json.load(file, object_pairs_hook=partial(_unique, str(path)))
                if not isinstance(value, list):
                    raise ValueError(f"{path} holds {type(value).__name__}; expected a list of objects.")
                return value
            lines = file.read().split("\n")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text ({error}). Convert it.") from error
    except (json.JSONDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not readable as {kind[1:]} ({error}).") from error
    except RecursionError as error:
        raise ValueError(f"{path} is not readable as {kind[1:]}: it is nested too deeply.") from error
    filled = [(number, line) for number, line in enumerate(lines, start=1) if line.strip()]
    if kind == ".txt":
        return [line for _, line in filled]
    return [_object(line, f"{path} line {number}") for number, line in filled]


def _object(line: str, place: str) -> Any:
    try:
        return json.loads(line, object_pairs_hook=partial(_unique, place))
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(
            f"{place} is not JSON ({error}). Each line of a .jsonl file is one object."
        ) from error


def _unique(place: str, pairs: Sequence[tuple[str, object]]) -> dict[str, object]:
    """An object of its pairs. ValueError for a duplicate key: one of its values would be lost."""
    _each_once([key for key, _ in pairs], place)
    return dict(pairs)


def _each_once(names: Sequence[str], place: str) -> None:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(
            f"{place} names {twice!r} twice; expected every column once. Rename one, or take it out."
        )


def _table(file: Iterable[str], path: Path) -> list[Any]:
    reader, rows = csv.DictReader(file, strict=True), []
    _each_once(list(reader.fieldnames or []), f"{path} line {reader.line_num}")
    for row in reader:
        if None in row or None in row.values():
            raise ValueError(f"{path} line {reader.line_num} has more or fewer fields than its header.")
        rows.append(row)
    return rows


def _parquet(path: Path) -> Any:
    from pyarrow import parquet  # datasets brings it

    return parquet.read_table(path)


def _read_named(name: str) -> Any:
    """A folder that ``save_to_disk`` wrote, or a dataset of the hub by its id; its split ``train`` unless
    another is named behind a colon.
    """
    source, *more = name.split(":")
    config, split = more if len(more) == 2 else (None, more[0] if more else "train")
    path = Path(source).expanduser()
    if path.is_dir():
        return _read_folder(path, split if more else None)
    if Path(source).suffix.lower() in FILES or path.exists() or not source or len(more) > 2:
        raise ValueError(f"There is no file {name!r}. Give one ending with {', '.join(FILES)}.")
    return _with_datasets(name, lambda datasets: datasets.load_dataset(source, name=config, split=split))


def _read_folder(path: Path, split: str | None) -> Any:
    """A dataset that ``save_to_disk`` wrote, or a split of several. ValueError for any other folder."""
    whole = (path / "state.json").is_file()
    if not whole and not (path / "dataset_dict.json").is_file():
        raise ValueError(
            f"{path} is a folder without state.json or dataset_dict.json; expected one that save_to_disk of "
            f"the package datasets wrote, or a file: {', '.join(FILES)}."
        )
    if not whole:
        splits = sorted(entry.parent.name for entry in path.glob("*/state.json"))
        chosen = split or ("train" if "train" in splits or len(splits) != 1 else splits[0])
        if chosen not in splits:
            raise ValueError(f"{path} holds the splits {', '.join(splits)}; name one: {path}:SPLIT.")
        path = path / chosen
    for file in json.loads((path / "state.json").read_text(encoding="utf-8")).get("_data_files") or []:
        if Path(file["filename"]).name != file["filename"]:
            raise ValueError(f"{path / 'state.json'} names {file['filename']!r}; expected a file beside it.")
    return _with_datasets(str(path), lambda datasets: datasets.load_from_disk(str(path)))


def _with_datasets(name: str, read: Callable[[Any], Any]) -> Any:
    """What ``read`` makes with the package datasets, whose progress bars and log lines are not shown.
    ValueError where the package is missing or old, and for what it cannot read, with its reason.
    """
    try:
        import datasets
    except ImportError as error:
        raise ValueError(
            f"There is no text file {name!r}, and reading .parquet, a folder of save_to_disk or a dataset by "
            "its id needs another package. Install it with: pip install datasets. Or give a file: "
            f"{', '.join(FILES[:4])}."
        ) from error
    if int(datasets.__version__.partition(".")[0]) < 4:
        raise ValueError(
            f"The package datasets is {datasets.__version__}, which may run a script from the data's "
            "folder; expected 4 or newer, which runs none. Update it: pip install 'datasets>=4'."
        )
    bars, level = not datasets.are_progress_bars_disabled(), datasets.logging.get_verbosity()
    datasets.disable_progress_bars()
    datasets.logging.set_verbosity_error()
    try:
        return read(datasets)
    except Exception as error:  # the package and its clients raise many kinds
        reason = (str(error).strip().splitlines() or [""])[0]
        there = (
            "cannot be read" if Path(name).exists() else "is neither a file, a folder nor a dataset to read"
        )
        raise ValueError(f"{name!r} {there}: {type(error).__name__}: {reason}") from error
    finally:
        datasets.logging.set_verbosity(level)
        if bars:
            datasets.enable_progress_bars()


def sft_examples(
    rows: Sequence[Row],
    tokenizer: PreTrainedTokenizerBase,
    *,
    eos: int | Sequence[int],
    max_tokens: int,
    on_completions: bool = True,
    vocabulary: int | None = None,
    notify: Notify = warnings.warn,
) -> list[Example]:
    """Examples for supervised fine-tuning.

    ``{"text"}`` or a plain string: every token is learnt.  ``{"prompt", "completion"}``, strings or lists of
    messages, and ``{"messages"}``: only completions and assistant turns, or everything with
    ``on_completions`` off. The EOS that closes a text or a reply is learnt, with any PAD; where none
    is written, the first of ``eos`` is appended. Rows over ``max_tokens`` are cut at the end, rows with
    nothing left to learn are left out, and ``notify`` receives how many; also how many have a prompt that
    had to be tokenised apart from its reply. ``vocabulary``: how many ids the model knows. ValueError names
    the row that is empty, lacks its columns, or has a token that the model does not know.
    """
    encoder, cut = Encoder(tokenizer, eos, vocabulary), 0
    examples: list[Example] = []
    for number, row in enumerate(rows):
        columns = {"text": row} if isinstance(row, str) else row
        pieces = formats.supervised(columns, encoder, f"data[{number}]")
        tokens, learn = formats.joined(pieces, everything=not on_completions)
        encoder.require_known(tokens, f"data[{number}]")
        cut += len(tokens) > max_tokens
        example = Example(tuple(tokens[:max_tokens]), tuple(learn[:max_tokens]))
        if any(example.learn):
            examples.append(example)
    _report(notify, len(rows), len(examples), cut, max_tokens, "nothing to learn")
    _report_borders(notify, len(rows), encoder)
    return examples


def preference_pairs(
    rows: Sequence[Row],
    tokenizer: PreTrainedTokenizerBase,
    *,
    eos: int | Sequence[int],
    max_tokens: int,
    vocabulary: int | None = None,
    notify: Notify = warnings.warn,
) -> list[Pair]:
    """Pairs for a reward model: ``{"prompt", "chosen", "rejected"}``, or ``{"chosen", "rejected"}`` that both
    contain their prompt; strings or lists of messages.

    Each text ends with its EOS, as a sampled response does. Texts over ``max_tokens`` are cut at the end,
    pairs whose texts are equal (then, or from the start) are left out, and ``notify`` receives how many; also
    how many have a prompt that had to be tokenised apart from its reply. ``vocabulary`` and ValueError as in
    `sft_examples`.
    """
    encoder, cut = Encoder(tokenizer, eos, vocabulary), 0
    pairs: list[Pair] = []
    for number, row in enumerate(rows):
        columns = {"text": row} if isinstance(row, str) else row
        both = formats.preference(columns, encoder, f"data[{number}]")
        chosen, rejected = (tuple(formats.joined(pieces)[0]) for pieces in both)
        encoder.require_known((*chosen, *rejected), f"data[{number}]")
        cut += max(len(chosen), len(rejected)) > max_tokens
        chosen, rejected = chosen[:max_tokens], rejected[:max_tokens]
        if chosen != rejected:
            (head, learnt), common = both[0][0], formats.shared(chosen, rejected)
            pairs.append(Pair(chosen, rejected, common if learnt else min(len(head), common)))
    _report(notify, len(rows), len(pairs), cut, max_tokens, "two equal texts")
    _report_borders(notify, len(rows), encoder)
    return pairs


def read_prompts(
    rows: Sequence[Row],
    tokenizer: PreTrainedTokenizerBase,
    *,
    max_tokens: int,
    vocabulary: int | None = None,
    notify: Notify = warnings.warn,
) -> list[Prompt]:
    """Prompts to respond to: plain strings, or ``{"prompt"}`` as a string or a list of messages.

    Messages end with the assistant's header, so that the response is its turn. Every other column goes to the
    reward functions. Prompts over ``max_tokens`` lose their beginning (the tokenizer's opening stays, and
    ``shown`` is what is left of a string; a chat is shown whole), and ``notify`` receives how many.
    ``vocabulary``: how many ids the model knows. ValueError names a row that is empty, has no prompt, or has
    a token that the model does not know.
    """
    encoder, cut, chats, blank = Encoder(tokenizer, vocabulary=vocabulary), 0, 0, 0
    prompts: list[Prompt] = []
    for number, row in enumerate(rows):
        columns, place = {"prompt": row} if isinstance(row, str) else row, f"data[{number}]"
        if not formats.has(columns, "prompt"):
            raise formats.missing(columns, place, "prompt")
        shown = formats.read_content(columns, "prompt", place)
        if isinstance(shown, str):
            tokens, opening = encoder.text(shown), encoder.opening[: max_tokens - 1]
            if shown[-1].isspace():
                blank += encoder.text(shown + encoder.probe)[: len(tokens)] != tokens
        else:
            tokens = encoder.prompt(shown, place, tools=columns.get("tools"))
            opening = encoder.opening_of(tokens)[: max_tokens - 1]
        encoder.require_known(tokens, f"prompt of {place}")
        if not tokens:
            raise ValueError(f"prompt of {place} has no tokens. Take the row out, or fill it in.")
        if len(tokens) > max_tokens:
            cut, chats = cut + 1, chats + (not isinstance(shown, str))
            tail = tokens[len(opening) - max_tokens :]
            tokens = [*opening, *tail]
            shown = str(tokenizer.decode(tail)) if isinstance(shown, str) else shown
        others = {name: value for name, value in columns.items() if name != "prompt"}
        prompts.append(Prompt(tuple(tokens), shown, others))
    if cut:
        whole = f", though {chats} of them are chats, which reward functions are shown whole" if chats else ""
        long = f"{cut} of {len(rows)} prompts have more than {max_tokens} tokens"
        notify(f"{long} and lost their beginning{whole}. Raise max_prompt_tokens to keep them whole.")
    if blank:
        notify(
            f"{blank} of {len(rows)} prompts end with a blank that this tokenizer writes together with the "
            "word that follows: the model has hardly ever continued such a text. Take the blank out."
        )
    return prompts


def _report(notify: Notify, rows: int, kept: int, cut: int, max_tokens: int, why: str) -> None:
    """Report how many rows were cut or left out. ValueError when none is left."""
    if not kept:
        raise ValueError(
            f"None of the {rows} rows is left: after the cut at max_tokens {max_tokens} each has {why}. "
            "Raise max_tokens, or give other data."
        )
    parts = []
    if cut:
        parts.append(f"{cut} of {rows} rows have more than max_tokens {max_tokens} tokens and were cut")
    if kept < rows:
        parts.append(f"{rows - kept} of {rows} rows have {why} and were left out")
    if parts:
        notify("; ".join(parts) + "." + (" Raise max_tokens to keep them whole." if cut else ""))


def _report_borders(notify: Notify, rows: int, encoder: Encoder) -> None:
    """Report in how many rows a reply does not begin at a border of the whole text's tokens."""
    if encoder.crossed:
        notify(
            f"{len(encoder.crossed)} of {rows} rows have a prompt whose end this tokenizer writes in another "
            "way when the reply follows. Their last reply was tokenised apart, so that the prompt has the "
            "tokens that sampling begins with. Where a prompt ends with a blank, let the reply begin with it."
        )


def hold_out_prompts(prompts: list[Prompt], count: int) -> tuple[list[Prompt], list[Prompt]]:
    """Prompts to train on, and ``count`` (a quarter at most) that are held out together with their
    duplicates.

    ValueError when there are too few different ones.
    """
    distinct = list({prompt.tokens: prompt for prompt in prompts}.values())
    held = distinct[len(distinct) - min(count, len(distinct) // 4) :]
    if not held:
        raise ValueError(
            f"There are {len(distinct)} different prompts; a gold score on held-out ones needs at least 4. "
            "Give more, or no gold."
        )
    kept = {prompt.tokens for prompt in held}
    return [prompt for prompt in prompts if prompt.tokens not in kept], held


def hold_out(
    items: Sequence[Item], share: float, seed: int, group: Callable[[Item], Hashable] | None = None
) -> tuple[list[Item], list[Item]]:
    """Items to train on and items held out, about ``share`` of them, drawn by the seed; in their order.

    Items of one ``group`` stay together, unless a group is larger than the share; equal items always do,
    where not all are equal. At least one item is held out where there are two or more and the share is above
    0.
    """
    left = max(1, round(share * len(items))) if share > 0 and len(items) > 1 else 0
    keys: list[Hashable] = list(items) if len(set(items)) > 1 else list(range(len(items)))
    if group is not None:
        groups: list[Hashable] = [group(item) for item in items]
        keys = groups if max(Counter(groups).values(), default=0) <= left else keys
    sizes = Counter(keys)
    names = list(sizes)
    held: set[Hashable] = set()
    for index in np.random.default_rng([seed, 1]).permutation(len(names)):
        if left <= 0:
            break
        held.add(names[index])
        left -= sizes[names[index]]
    parts: tuple[list[Item], list[Item]] = ([], [])
    for item, key in zip(items, keys, strict=True):
        parts[key in held].append(item)
    return parts
