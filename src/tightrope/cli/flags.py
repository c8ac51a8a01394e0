"""Command line flags made from settings, one for each field, and suggestions for unknown flags."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import decimal
import json
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from tightrope.errors import TightropeError
from tightrope.settings.fields import kinds, range_text
from tightrope.settings.peer_names import PEER_NAMES

WIDTH = 100


class UsageError(TightropeError, ValueError):
    """The command line is wrong; the message explains how, and suggests what was probably meant."""


class Parser(argparse.ArgumentParser):
    """An argparse parser that raises UsageError instead of printing its usage and ending the process."""

    def __init__(self, prog: str, usage: str, description: str, epilog: str | None = None) -> None:
        super().__init__(
            prog=prog,
            usage=usage,
            description=description,
            epilog=epilog,
            allow_abbrev=False,
            formatter_class=_formatter,
            argument_default=argparse.SUPPRESS,
        )

    def error(self, message: str) -> NoReturn:
        """Raise what argparse found."""
        raise UsageError(message.removeprefix("argument "))

    def flags(self) -> list[str]:
        """Every long option, without its dashes."""
        return [s[2:] for action in self._actions for s in action.option_strings if s.startswith("--")]

    def read(
        self, words: list[str], unknown: Callable[[str, list[str]], str] | None = None
    ) -> dict[str, Any]:
        """The options given, and only those. ``--num_envs`` is read as ``--num-envs``.

        ``unknown(name, flags)`` gives the error text for an unknown flag (default: `unknown_flag`).
        """
        words = [with_dashes(word) for word in words]
        known = self.flags()
        for word in words:
            name = word[2:].partition("=")[0]
            if word.startswith("--") and name not in known:
                raise UsageError((unknown or unknown_flag)(name, known))
        self._refuse_repeated(words)
        return vars(self.parse_args(words))

    def _refuse_repeated(self, words: list[str]) -> None:
        """UsageError for a flag that is given twice, on or off, unless its values are collected in a list."""
        names = {s: action for action in self._actions for s in action.option_strings}
        seen: dict[str, str] = {}
        for flag in (word.partition("=")[0] for word in words if word.startswith("--")):
            action = names[flag]
            if action.dest in seen and not isinstance(action, argparse._AppendAction):
                both = flag if seen[action.dest] == flag else f"{seen[action.dest]} and {flag}"
                raise UsageError(
                    f"{both} was given twice, expected once: only the last would count. Leave one out."
                )
            seen[action.dest] = flag


def _formatter(prog: str) -> argparse.HelpFormatter:
    import shutil

    width = min(WIDTH, shutil.get_terminal_size().columns)
    return argparse.HelpFormatter(prog, max_help_position=28, width=max(40, width))


def with_dashes(word: str) -> str:
    """``--num_envs=8`` as ``--num-envs=8``; words that are no flags stay as they are."""
    if not word.startswith("--"):
        return word
    name, equals, value = word.partition("=")
    return name.replace("_", "-") + equals + value


def nearest(word: str, choices: Iterable[str], cutoff: float = 0.6) -> str | None:
    """The choice most like ``word``, or None when none is."""
    import difflib

    found = difflib.get_close_matches(word, list(choices), n=1, cutoff=cutoff)
    return found[0] if found else None


def unknown_flag(name: str, known: list[str]) -> str:
    """The error text for an unknown flag, with a suggestion."""
    meant = suggestion(name, known)
    return f"There is no flag --{name}." + (
        f" Did you mean --{meant}?" if meant else " --help lists them all."
    )


def suggestion(name: str, known: list[str]) -> str | None:
    """The flag that was probably meant, without its dashes: another library's name, another spelling, or a
    similar one; None when nothing is near.
    """
    negated, name = name.startswith("no-"), name.removeprefix("no-").replace("-", "_").lower()
    british = name.replace("ize", "ise")
    peer = PEER_NAMES.get(name) or PEER_NAMES.get(name.rstrip("_"))
    meant = (british if british.replace("_", "-") in known else peer or "").replace("_", "-")
    if meant and meant.split()[0] in known:
        if negated:  # of a setting with a value, that value is what was not wanted
            return f"no-{meant}" if f"no-{meant}" in known else meant.split()[0]
        return meant
    return nearest(name.replace("_", "-"), known)


def settings_fields(kind: type) -> dict[str, dataclasses.Field[Any]]:
    """The fields of a settings class that are flags, by name."""
    return {f.name: f for f in dataclasses.fields(kind) if f.init and f.name not in ("env", "update")}


def add_fields(
    group: argparse._ArgumentGroup, kind: type, names: Iterable[str], presets: dict[str, str] | None = None
) -> None:
    """One option a field: its help is made from doc, range and default. ``presets``: how a default that
    presets change is written, by name.
    """
    fields = settings_fields(kind)
    for name in names:
        field, (plain, optional, _) = fields[name], kinds(kind)[name]
        flag = "--" + name.replace("_", "-")
        text = help_text(field, optional, (presets or {}).get(name, "{}"))
        if plain is bool:
            group.add_argument(
                flag, action=argparse.BooleanOptionalAction, default=argparse.SUPPRESS, help=text
            )
        elif plain is tuple:
            if kinds(kind)[name].items is int:
                group.add_argument(flag, nargs="*", type=width, metavar="N", help=text)
            else:  # words may also be given one by one, each with its flag
                group.add_argument(flag, nargs="*", action="extend", metavar="WORD", help=text)
        elif plain is dict:
            group.add_argument(flag, nargs="*", type=pair, action=Pairs, metavar="NAME=VALUE", help=text)
        else:
            choices = field.metadata["choices"]
            metavar = {str: "WORD", int: "N", float: "X"}[plain]
            group.add_argument(flag, type=reader(plain, optional, choices), metavar=metavar, help=text)


def help_text(field: dataclasses.Field[Any], optional: bool, written: str = "{}") -> str:
    """``Discount per step. (0 < x <= 1; default 0.99)``; ``written``: how, with {} for the default."""
    default = field.default
    if default is None:
        shown = "none"
    elif isinstance(default, bool):
        shown = "on" if default else "off"
    elif isinstance(default, tuple):
        shown = " ".join(map(str, default)) or "none"
    else:
        shown = f"{default:g}" if isinstance(default, float) else str(default)
    limits = range_text(field.metadata)
    if optional:
        limits = f"{limits}, or none" if limits else "or none"
    text = f"{field.metadata['doc']} ({limits + '; ' if limits else ''}default {written.format(shown)})"
    return text.replace("%", "%%")


def reader(kind: type, optional: bool, choices: tuple[str, ...]) -> Callable[[str], Any]:
    """A function from a word on the command line to a value of ``kind``; ``none`` where that is allowed."""

    def read(word: str) -> Any:
        if optional and word.lower() == "none":
            return None
        if choices and word not in choices:
            near = nearest(word, choices)
            raise argparse.ArgumentTypeError(
                f"{word!r} is not one of: {', '.join(choices)}." + (f" Did you mean {near}?" if near else "")
            )
        try:
            if kind is int:
                return whole_number(word)
            return kind(word)
        except ValueError:
            expected = {int: "a whole number", float: "a number"}[kind] + (" or none" if optional else "")
            raise argparse.ArgumentTypeError(f"{word!r} is not {expected}.") from None

    return read


def width(word: str) -> int:
    """One entry of a list of whole numbers. The error explains that the task comes before the list."""
    try:
        return whole_number(word)
    except ValueError:
        text = f"{word!r} is not a whole number. Give the task before this list: train ENV --hidden 64 64"
        raise argparse.ArgumentTypeError(text) from None


NONE = ("none", None)  # the word none in place of a pair


def pair(word: str) -> tuple[str, Any]:
    """``name=value``; the value as JSON where it is that, as a whole number like 1e6, none, or the word
    itself."""
    name, equals, text = word.partition("=")
    if word.lower() == "none":
        return NONE
    if not equals or not name:
        raise argparse.ArgumentTypeError(
            f"{word!r} is not NAME=VALUE. Give the task before this list: train ENV --env-kwargs size=8"
        )
    known = {"none": None, "true": True, "false": False}
    if text.lower() in known:
        return name, known[text.lower()]
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    if isinstance(value, str) or (isinstance(value, float) and "e" in text.lower()):
        with contextlib.suppress(ValueError, OverflowError):
            return name, whole_number(text)
    return name, value


class Pairs(argparse.Action):
    """Collects pairs in a dict; the word none alone: no dict."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if values == [NONE]:
            setattr(namespace, self.dest, None)
            return
        if len({name for name, _ in values}) < len(values):
            raise argparse.ArgumentError(self, "a name was given twice, expected once. Leave one out.")
        setattr(namespace, self.dest, dict(values))


def whole_number(word: str) -> int:
    """A whole number, also as 100_000 or 1e6. Raises ValueError."""
    try:
        return int(word)
    except ValueError:
        try:
            number = decimal.Decimal(word)  # exact, where a float makes 1e-400 a 0
        except decimal.InvalidOperation:
            raise ValueError(word) from None
        if not number.is_finite() or number.adjusted() > 999 or number != number.to_integral_value():
            raise ValueError(word) from None
        return int(number)
