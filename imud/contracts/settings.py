"""Settings: their base type, and descriptions of accepted and of rejected values.

A part declares its own struct: frozen, keyword-only, unknown keys refused, each field with a default where there is
one. `imud.config` fills it from YAML through msgspec, which checks types and `msgspec.Meta` bounds. The docstring below
a field is what docs/configuration.md says of the key; the words are those of errors and of that table.
"""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import msgspec
from msgspec import inspect

SHOWN_CHARACTERS = 60
"""Of a text in an error."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of one part."""


class NoSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of parts that have none."""


def expected(field_type: Any) -> str:
    """Describe the values of `field_type`, for example `a whole number from 50 to 4000000, or "auto"`."""
    return _words(inspect.type_info(field_type))


def got(value: object) -> str:
    """Format `value` as it stands in a file, with its kind where that is not obvious."""
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return "keys and values"
    if isinstance(value, str):
        return shown(value[:SHOWN_CHARACTERS])
    if isinstance(value, Sequence):
        return "a list"
    return str(value).lower() if isinstance(value, bool) else str(value)


def shown(value: object) -> str:
    """Format `value` for a configuration file, in one line of plain ASCII or printable text."""
    text = msgspec.json.encode(value).decode()
    return "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text)


def unknown_name(what: str, name: str, known: Sequence[str]) -> str:
    """Format the error for a name that is not among `known`, with the nearest one. `what`: for example `a driver`."""
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"expected {what} that imud knows, got {got(name)}; {hint}known: {', '.join(sorted(known)) or 'none'}"


def _words(info: inspect.Type) -> str:
    words = "keys and values"
    match info:
        case inspect.Metadata(type=inner):
            words = _words(inner)
        case inspect.UnionType(types=types):
            words = ", or ".join(_words(one) for one in types)
        case inspect.LiteralType(values=values):
            words = _choice(values)
        case inspect.EnumType(cls=enum):
            words = _choice([member.value for member in enum])
        case inspect.IntType():
            words = "a whole number" + _range(info)
        case inspect.FloatType():
            words = "a number" + _range(info)
        case inspect.StrType():
            words = "text" + _text_rules(info)
        case inspect.ListType(item_type=item) | inspect.VarTupleType(item_type=item) | inspect.SetType(item_type=item):
            words = f"a list, each of it {_words(item)}"
        case inspect.DictType(value_type=item):
            words = f"keys, each with {_words(item)}"
        case inspect.BoolType():
            words = "true or false"
        case inspect.NoneType():
            words = "null"
    return words


def _choice(values: Sequence[object]) -> str:
    words = [shown(value) for value in values]
    return words[0] if len(words) == 1 else f"one of {', '.join(words)}"


def _range(info: inspect.IntType | inspect.FloatType) -> str:
    low, high = _bound(info.ge), _bound(info.le)
    words = [f" from {low}" if low else "", f" to {high}" if high else ""]
    words += [f" above {_bound(info.gt)}" if info.gt is not None else ""]
    words += [f" below {_bound(info.lt)}" if info.lt is not None else ""]
    return "".join(words)


def _bound(value: float | None) -> str:
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _text_rules(info: inspect.StrType) -> str:
    if info.pattern is not None:
        return f" matching {info.pattern}"
    if info.min_length == 1:
        return " that is not empty"
    return ""
