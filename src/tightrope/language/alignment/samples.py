"""What the model writes, for people to read: rows of samples.jsonl, and tables of them in the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat, TextIO

from tightrope.language.generation.sample import texts_of
from tightrope.maths import divergence
from tightrope.maths.statistics import masked_mean, masked_sum
from tightrope.runs.records import in_lines, read_lines

if TYPE_CHECKING:
    from rich.console import Console
    from torch import Tensor
    from transformers import PreTrainedTokenizerBase

    from tightrope.algorithms.batch import Batch
    from tightrope.language.data.examples import Prompt
    from tightrope.language.policy.policy_model import Experience
    from tightrope.language.reward.functions import Scores

LONGEST = 300  # characters of a prompt or response in a table
TEXT_WIDTH = 16  # characters of a column of text, at least


def sample_rows(
    tokenizer: PreTrainedTokenizerBase,
    prompts: Sequence[Prompt],
    experience: Experience,
    scores: Scores,
    batch: Batch,
    valid: Tensor,
    step: int,
    stop: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """One row per response of a rollout, in its order, as samples.jsonl holds them.

    ``step``: responses so far. ``prompt`` and ``response`` are text or messages; ``score`` the weighted sum
    and ``scores`` each function's own, None where there is none; ``kl`` to the reference in nats, k1 summed
    over the response; ``advantage`` the mean over its tokens, None where the response is masked (``counts``
    False); ``tokens`` its length, ``ended`` whether it closed itself, with an EOS or a text of ``stop``;
    ``extras`` what reward functions logged. ``batch`` holds only the rows of ``valid`` [B].
    """
    responses = experience.responses
    log_ratio = experience.ref_logp - experience.logp
    texts = texts_of(tokenizer, experience.ids, stop)
    places = {row: place for place, row in enumerate(valid.nonzero()[:, 0].tolist())}
    rows = []
    for index, (prompt, text) in enumerate(zip(prompts, texts, strict=True)):
        mask, place = responses.mask[index], places.get(index)
        advantage = None if place is None else masked_mean(batch.advantages[place], batch.mask[place])
        rows.append(
            {
                "step": step,
                "prompt": _writable(prompt.shown),
                "response": _writable(text),
                "score": _finite(scores.total[index]) if place is not None else None,
                "scores": {name: _finite(part[index]) for name, part in scores.parts.items()},
                "kl": _finite(masked_sum(divergence.k1(log_ratio[index]), mask)),
                "advantage": _finite(advantage),
                "tokens": int(mask.sum()),
                "ended": bool(responses.ended[index]),
                "counts": place is not None,
                "extras": {column: _writable(values[index]) for column, values in scores.extras.items()},
            }
        )
    return rows


def read_samples(path: str | Path) -> list[dict[str, Any]]:
    """The rows of a run folder's samples.jsonl, or of such a file; a line torn by a crash is left out.

    ValueError where there is none: the run recorded no responses.
    """
    path = Path(path)
    file = path / "samples.jsonl" if path.is_dir() else path
    if not file.is_file():
        raise ValueError(f"{file} is not there: {path} is not a run of tightrope align, or has not begun.")
    rows = read_lines(file)
    for number, row in enumerate(rows):
        if not _is_sample(row):
            raise ValueError(f"{file}, row {number}, is not a response as tightrope align records it.")
    return rows


def _is_sample(row: Mapping[str, object]) -> bool:
    """Whether a row has everything that the tables show; the file may come from anywhere."""
    scores = row.get("scores")
    texts = (row.get("prompt"), row.get("response"))
    numbers = [row.get(name) for name in ("score", "kl", "advantage")]
    numbers += scores.values() if isinstance(scores, dict) else [""]
    return (
        all(isinstance(text, str | list) and all(isinstance(m, str | dict) for m in text) for text in texts)
        and all(number is None or isinstance(number, int | float) for number in numbers)
        and isinstance(row.get("step"), int)
        and isinstance(row.get("counts"), bool)
    )


def spread(rows: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """``count`` rows from the highest score to the lowest at even distances; those without a score come last.

    The best alone would hide what happens to the others. ValueError for a count below 1.
    """
    if count < 1:
        raise ValueError(f"count is {count}, expected at least 1.")
    ordered = sorted(rows, key=lambda row: -math.inf if row["score"] is None else row["score"], reverse=True)
    if len(ordered) <= count:
        return ordered
    if count == 1:
        return ordered[:1]
    return [ordered[round(i * (len(ordered) - 1) / (count - 1))] for i in range(count)]


def print_samples(
    rows: Sequence[dict[str, Any]],
    stream: TextIO | None = None,
    *,
    width: int | None = None,
    title: str = "",
    console: Console | None = None,
) -> None:
    """A table of prompt, response, each function's score, their sum where there are several, KL, advantage.

    ``stream``: stdout by default; ``width``: characters, by default the terminal's; ``console``: rich's, in
    their place, where a progress bar owns the terminal. Control characters that a model may write do not
    reach the terminal.
    """
    names = list(dict.fromkeys(name for row in rows for name in row["scores"]))
    heads = [*names, *(["score"] if len(names) > 1 else []), "KL", "advantage"]
    lines = []
    for row in rows:
        scores = [row["scores"].get(name) for name in names] + [row["score"]] * (len(names) > 1)
        advantage = row["advantage"] if row["counts"] else "masked"
        lines.append([row["prompt"], row["response"], *scores, row["kl"], advantage])
    _print_table(["prompt", "response"], heads, lines, stream, width, title, console)


def print_comparison(
    rows: Sequence[dict[str, Any]], stream: TextIO | None = None, *, width: int | None = None, title: str = ""
) -> None:
    """A table of responses before and after training: rows of ``prompt``, ``before`` and ``after``, and of
    the figures that `sample_run` gives, as ``before > after``; below it their means.

    ``stream``, ``width`` and ``title`` as in `print_samples`.
    """
    figures = [head for head in ("score", "kl", "tokens") if any(f"{head}_after" in row for row in rows)]

    def change(name: str, pairs: list[tuple[float | None, float | None]]) -> str:
        means = [[x for x in side if x is not None] for side in zip(*pairs, strict=True)]
        return " > ".join(short_number(sum(side) / len(side) if side else None) for side in means)

    pairs = {
        name: [(row.get(f"{name}_before"), row.get(f"{name}_after")) for row in rows] for name in figures
    }
    lines = [
        [row["prompt"], row["before"], row["after"], *(change(name, [pairs[name][i]]) for name in figures)]
        for i, row in enumerate(rows)
    ]
    _print_table(["prompt", "before", "after"], figures, lines, stream, width, title)
    if figures:
        means = ", ".join(f"{name} {change(name, pairs[name])}" for name in figures)
        print(f"mean of {len(rows)}, before > after: {means}", file=stream)


def one_line(text: str | Sequence[Mapping[str, object]], *, tail: bool = False) -> str:
    """A text or messages in one short line for a table.

    Line ends and other characters that cannot be seen are written as Python writes them. The beginning is
    kept, or with ``tail`` the end.
    """
    if not isinstance(text, str):
        text = "\n".join(f"{message.get('role', '')}: {message.get('content', '')}" for message in text)
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    if len(line) <= LONGEST:
        return line
    return "..." + line[3 - LONGEST :] if tail else line[: LONGEST - 3] + "..."


def short_number(value: float | None) -> str:
    """A number in few characters, ``-`` for none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.3g}"


def _print_table(
    texts: list[str],
    figures: list[str],
    lines: list[list[Any]],
    stream: TextIO | None,
    width: int | None = None,
    title: str = "",
    console: Console | None = None,
) -> None:
    """Texts and figures side by side; below each other where the texts would be narrower than TEXT_WIDTH."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = console or Console(file=stream, width=width, markup=False, highlight=False)
    heads = [one_line(name) for name in (*texts, *figures)]
    rows = [
        [one_line(line[0], tail=True)]
        + [one_line(x) if isinstance(x, str | list) else short_number(x) for x in line[1:]]
        for line in lines
    ]
    cells = [max(map(len, column)) + 3 for column in zip(heads, *rows, strict=True)][len(texts) :]
    table = Table(title=title or None, title_justify="left", show_lines=True, highlight=False)
    if console.width - sum(cells) < (TEXT_WIDTH + 3) * len(texts):
        table.show_header = False
        table.add_column(overflow="fold")
        for row in rows:
            pairs = [f"{head}: {cell}" for head, cell in zip(heads, row, strict=True)]
            below = in_lines(pairs[len(texts) :], console.width - 4)
            table.add_row(Text("\n".join([*pairs[: len(texts)], below]).rstrip()))
        console.print(table)
        return
    for name in heads[: len(texts)]:
        table.add_column(Text(name), ratio=1, overflow="fold")
    for name in heads[len(texts) :]:
        table.add_column(Text(name), justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))  # Text: brackets in a response are not markup
    console.print(table)


def _finite(value: SupportsFloat | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _writable(value: object) -> object:
    """``value`` with characters that UTF-8 cannot hold (halves of a surrogate pair) written as escapes."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {_writable(key): _writable(item) for key, item in value.items()}
    return [_writable(item) for item in value] if isinstance(value, list | tuple) else value
