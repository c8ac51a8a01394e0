"""The base of every settings class: checks, changed values, and settings.json."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from tightrope.settings.fields import kinds, typed, validate
from tightrope.settings.peer_names import PEER_NAMES

ORIGINS = "origins"  # where each value came from, as --dry-run shows it beside the settings; not read


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Frozen values that are checked on creation. A field ``update`` holds those of the update rule, whose
    names are used as if they were fields of this class.
    """

    def __post_init__(self) -> None:
        """Check every field: its kind, its range, and the class of ``update``."""
        validate(self)
        rule = rule_of(type(self), getattr(self, "algorithm", None))
        update = getattr(self, "update", None)
        if rule is not None and not isinstance(update, rule):
            raise ValueError(f"update is {type(update).__name__}; expected {rule.__name__}.")

    def with_values(self, **values: Any) -> Self:
        """The same settings with these changed; names of the update rule's fields are found there."""
        algorithm = values.get("algorithm", getattr(self, "algorithm", None))
        rule, outer = rule_of(type(self), algorithm), names(type(self))
        _require_known(algorithm or type(self).__name__, values, outer | names(rule))
        changed = {name: value for name, value in values.items() if name in outer}
        inner = {name: value for name, value in values.items() if name not in outer}
        if rule is not None:
            present = getattr(self, "update", None)
            update = values.get("update", present if isinstance(present, rule) else rule())
            changed["update"] = dataclasses.replace(update, **inner) if isinstance(update, rule) else update
        return dataclasses.replace(self, **changed)

    def without_effect(self, usual: Sequence[Mapping[str, object]] = ()) -> list[str]:
        """Which settings were changed and do nothing, for lack of the values of others that they need.

        ``usual``: values that nobody chose beside the defaults, those of presets.
        """
        update = getattr(self, "update", None)
        owners = [self, update] if isinstance(update, Settings) else [self]
        flat = {
            field.name: getattr(owner, field.name) for owner in owners for field in dataclasses.fields(owner)
        }
        found = []
        for field in (field for owner in owners for field in dataclasses.fields(owner)):
            value = flat[field.name]
            unchosen = (field.default, *(values[field.name] for values in usual if field.name in values))
            if not field.init or value in unchosen:
                continue
            for other, useful in field.metadata.get("needs", {}).items():
                if other not in flat:  # of another update rule
                    continue
                present = flat[other]
                if bool(present) if useful is ... else present in useful:
                    continue
                wanted = "a value" if useful is ... else " or ".join(map(_shown, useful))
                found.append(
                    f"{field.name} {_shown(value)} has no effect: {other} is {_shown(present)}, and it needs "
                    f"{wanted}."
                )
        return found

    def to_json(self) -> dict[str, Any]:
        """The settings as settings.json holds them: plain JSON types, the update rule's under ``update``."""

        def plain(pairs: list[tuple[str, object]]) -> dict[str, Any]:
            return {name: list(value) if isinstance(value, tuple) else value for name, value in pairs}

        return dataclasses.asdict(self, dict_factory=plain)

    @classmethod
    def from_json(cls, data: object, source: object = "settings.json") -> Self:
        """The settings that `to_json` wrote, in an older version too: a name that is missing has the value
        that says what runs did before it was a setting, most often its default. Raises ValueError.
        """
        values = cls.values_from_json(data, source)
        rule = rule_of(cls, values.get("algorithm"))
        return cls().with_values(**{**_before(cls), **_before(rule), **values})

    @classmethod
    def values_from_json(cls, data: object, source: object = "settings.json") -> dict[str, Any]:
        """The values in a settings.json, flat, as `with_values` takes them.

        Raises ValueError for an unknown name, a value of another type, and a name in both places.
        """
        try:
            return _flat(cls, data)
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from None


def _shown(value: object) -> str:
    """As a flag takes it."""
    if value is None:
        return "none"
    return ("on" if value else "off") if isinstance(value, bool) else str(value)


def names(kind: type | None) -> set[str]:
    """The names of the fields that may be given; none for None."""
    return set() if kind is None else {field.name for field in dataclasses.fields(kind) if field.init}


def _before(kind: type | None) -> dict[str, Any]:
    """What runs did that do not have a setting of this class, by its name, where that is not its default."""
    fields = () if kind is None else dataclasses.fields(kind)
    return {field.name: field.metadata["before"] for field in fields if "before" in field.metadata}


def rule_of(kind: type[Settings], algorithm: object) -> type[Settings] | None:
    """The class of ``update`` for an algorithm (None: the default one); None for settings without it.

    Raises ValueError for an unknown algorithm.
    """
    field = next((field for field in dataclasses.fields(kind) if field.name == "update"), None)
    if field is None:
        return None
    rules: Mapping[str, type[Settings]] = field.metadata["rules"]
    if algorithm is None:
        return next(iter(rules.values()))
    if algorithm not in list(rules):
        raise ValueError(f"algorithm is {algorithm!r}; expected one of: {', '.join(rules)}.")
    return rules[algorithm]


def _flat(kind: type[Settings], data: object) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise ValueError(f"the settings are {type(data).__name__}, expected an object with names and values.")
    outer = {name: value for name, value in data.items() if name != "update" or name not in names(kind)}
    outer.pop(ORIGINS, None)
    values = _read(kind, outer)
    rule = rule_of(kind, values.get("algorithm"))
    if rule is None:
        return values
    inner = data.get("update", {})
    if not isinstance(inner, dict):
        raise ValueError(f"update is {inner!r}; expected an object with the settings of the update rule.")
    return values | _read(rule, inner)


def _read(kind: type, values: Mapping[str, object]) -> dict[str, Any]:
    """Values of one class by name, each of the kind of its field; those of fixed fields are left out."""
    given = names(kind)
    _require_known(kind.__name__, values, kinds(kind))
    return {name: typed(name, value, kinds(kind)[name]) for name, value in values.items() if name in given}


def _require_known(owner: str, values: Collection[str], known: Collection[str]) -> None:
    """ValueError for a name that is not a setting, with the setting that was probably meant."""
    for name in values:
        if name not in known:
            near = [PEER_NAMES.get(name, ""), *difflib.get_close_matches(name, known, n=1)]
            hint = next(
                (f" Did you mean {meant!r}?" for meant in near if meant.partition(" ")[0] in known), ""
            )
            raise ValueError(f"{owner} has no setting named {name!r}.{hint}")
