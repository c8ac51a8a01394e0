"""How a setting is declared: default, help text, range and type.

The command line, the checks and the docs read the declaration. Only this file interprets annotations.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from types import EllipsisType, NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

Schedule = Literal["constant", "linear", "cosine"]
SCHEDULES = get_args(Schedule)
LARGEST_INTEGER = 2**63 - 1  # whole numbers beyond it fit neither torch nor numpy
LARGEST_FLOAT, SMALLEST_FLOAT = 3.4e38, 1.2e-38  # of float32; a positive number below becomes 0


def setting(
    default: object,
    doc: str,
    *,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    above: float = -math.inf,
    choices: tuple[str, ...] = (),
    needs: Mapping[str, tuple[object, ...] | EllipsisType] | None = None,
    before: object = dataclasses.MISSING,
) -> Any:
    """A dataclass field with its help text and its range.

    ``at_least`` and ``at_most`` are inclusive, ``above`` is exclusive, ``choices`` lists the words allowed.
    A default of None means the setting is optional and ``none`` on the command line switches it off.
    ``needs``: the values that other settings, where there are any of these names, must have for this one to
    have an effect; ``...``: any that is not none, off or 0. ``before``: what runs did that do not have the
    setting, where that is not the default.
    """
    metadata = {"doc": doc, "at_least": at_least, "at_most": at_most, "above": above, "choices": choices}
    metadata["needs"] = needs or {}
    if before is not dataclasses.MISSING:
        metadata["before"] = before
    return dataclasses.field(default=default, metadata=metadata)


def fixed(value: object) -> Any:
    """A field of a base class with a fixed value here: written to settings.json, but not an option."""
    return dataclasses.field(default=value, init=False)


def of_update_rule(rules: Mapping[str, type]) -> Any:
    """The field ``update``: the settings of the update rule. ``rules`` holds their class by algorithm, the
    default one first.
    """
    first = next(iter(rules.values()))
    return dataclasses.field(default_factory=first, metadata={"doc": "The update rule's.", "rules": rules})


def range_text(metadata: Mapping[str, Any]) -> str:
    """The range of a field as text: ``0 < x <= 1``, ``a | b``; empty if every value is allowed."""
    if metadata["choices"]:
        return " | ".join(metadata["choices"])
    above, at_least, at_most = (metadata[name] for name in ("above", "at_least", "at_most"))
    low = f"{above:g} < " if above > -math.inf else f"{at_least:g} <= " if at_least > -math.inf else ""
    high = f" <= {at_most:g}" if at_most < math.inf else ""
    return f"{low}x{high}" if low or high else ""


class Kind(NamedTuple):
    """The values a field takes: those of one type, and None where it is optional.

    ``items``: of a tuple, the type of its items. A dict has names and values that JSON can hold.
    """

    type: type
    optional: bool
    items: Any = int

    def __str__(self) -> str:
        """As text, for errors."""
        name = self.type.__name__
        if self.type is dict:
            name = "names and values that JSON can hold, in a dict"
        elif self.type is tuple:
            name = f"{'whole numbers' if self.items is int else 'words'} in a tuple or list"
        return f"{name} or None" if self.optional else name


@functools.cache
def kinds(settings: type) -> dict[str, Kind]:
    """The kind of each field of a settings class, by name, from its annotation."""
    hints = get_type_hints(settings)
    return {field.name: _kind(hints[field.name]) for field in dataclasses.fields(settings)}


def _kind(hint: object) -> Kind:
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    plain = {Literal: str, tuple: tuple, dict: dict}.get(get_origin(options[0]), options[0])
    items = get_args(options[0])[0] if plain is tuple else int
    return Kind(plain, NoneType in options, items)


def typed(name: str, value: object, kind: Kind) -> Any:
    """``value`` as its field holds it: a list as a tuple, a whole number as a float if one is expected.

    One word where several may stand is a tuple of it. Raises ValueError for a value of another kind. The
    settings of an update rule are returned as they are.
    """
    if value is None and kind.optional:
        return None
    if kind.type is tuple and kind.items is str and isinstance(value, str):
        return (value,) if value else ()
    if kind.type is tuple and isinstance(value, list | tuple) and all(type(x) is kind.items for x in value):
        return tuple(typed(name, x, Kind(kind.items, False)) for x in value)
    if kind.type is dict and isinstance(value, dict) and not _plain(value):
        raise ValueError(
            f"{name} is {value!r}; expected {kind}. Give a function that builds the task with them."
        )
    if type(value) is int and abs(value) > LARGEST_INTEGER:
        digits = str(value) if abs(value) < 10**30 else "a number of more than 30 digits"
        raise ValueError(f"{name} is {digits}; expected at most {LARGEST_INTEGER} (64 bits).")
    if kind.type is float and type(value) is int:
        return float(value)
    if type(value) is kind.type or dataclasses.is_dataclass(kind.type):
        return value
    raise ValueError(f"{name} is {value!r} ({type(value).__name__}); expected {kind}.")


def _plain(value: object) -> bool:
    """Whether JSON can hold a value."""
    if isinstance(value, dict):
        return all(type(key) is str and _plain(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(_plain, value))
    finite = type(value) is not float or math.isfinite(value)
    return value is None or (type(value) in (bool, int, float, str) and finite)


def validate(settings: Any) -> None:
    """Raise ValueError naming the first field of a wrong kind or outside its declared range."""
    kind: type = type(settings)
    for field in dataclasses.fields(settings):
        value = typed(field.name, getattr(settings, field.name), kinds(kind)[field.name])
        object.__setattr__(settings, field.name, value)
        _check_range(field, value)


def _check_range(field: dataclasses.Field[Any], value: object) -> None:
    limits = field.metadata
    if isinstance(value, str) and limits["choices"] and value not in limits["choices"]:
        raise ValueError(f"{field.name} is {value!r}; expected one of: {', '.join(limits['choices'])}.")
    for number in value if isinstance(value, tuple) else (value,):
        if type(number) not in (int, float):
            continue
        inside = limits["at_least"] <= number <= limits["at_most"] and number > limits["above"]
        held = type(number) is int or number == 0 or SMALLEST_FLOAT <= abs(number) <= LARGEST_FLOAT
        if not inside or not held:
            expected = range_text(limits) or "a finite number"
            if inside and math.isfinite(number):
                expected = f"a size between {SMALLEST_FLOAT:g} and {LARGEST_FLOAT:g} (float32)"
            raise ValueError(f"{field.name} is {value!r}; expected {expected}. Choose a value in that range.")


def scheduled(value: float | None, schedule: Schedule, progress: float) -> float | None:
    """The value of a schedule at ``progress`` in [0, 1]; linear and cosine fall from the value to 0.

    linear: value * (1 - progress);  cosine: value * (1 + cos(pi * progress)) / 2;  None stays None.
    """
    if value is None or schedule == "constant":
        return value
    factor = 1.0 - progress if schedule == "linear" else 0.5 * (1.0 + math.cos(math.pi * progress))
    return value * factor
