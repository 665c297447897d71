"""Settings: their base type, and descriptions of accepted and of rejected values.

A part declares its own struct: frozen, keyword-only, unknown keys refused, each field with a default where there is
one. `imud.config` fills it from YAML through msgspec, which checks types and `msgspec.Meta` bounds. The docstring below
a field is what docs/configuration.md says of the key; the words are those of errors and of that table.
Where a pattern says nothing to people, `Meta(extra={"words": "an absolute path"})` does.
"""

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from ipaddress import ip_address
from typing import Any, NamedTuple

import msgspec
from msgspec import inspect

SHOWN_CHARACTERS = 60
"""Of a text in an error."""
HOST_CHARACTERS = 253
"""Of a host name (RFC 1035, section 2.3.4)."""
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")
"""A step of msgspec's path to what is wrong."""
UNKNOWN_STEP = "..."
"""The step to a value of a mapping, whose key msgspec does not tell."""


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of one part."""


class NoOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of parts that have none."""


def is_ip_address(text: str) -> bool:
    """Whether a text is an IPv4 or IPv6 address."""
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def is_host(text: str) -> bool:
    """Whether a text is an IP address or a host name (RFC 1123, section 2.1), which has a letter in its last label."""
    labels = text.rstrip(".").split(".")
    is_name = len(text) <= HOST_CHARACTERS and all(map(_LABEL.fullmatch, labels)) and not labels[-1].isdecimal()
    return is_name or is_ip_address(text)


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


class WrongValue(NamedTuple):
    """What is wrong with one of some named values."""

    name: str
    """Name of the value; empty where the values as a whole are wrong."""
    message: str
    """What was expected and what came."""

    def __str__(self) -> str:
        """Format both, for example `rate_hz: expected a number, got "fast"`."""
        return f"{self.name}: {self.message}" if self.name else self.message


def wrong_values(schema: type[msgspec.Struct], given: Mapping[str, Any], what: str = "key") -> list[WrongValue]:
    """List all that is wrong with values for the fields of `schema`. `what` they are, for people: keys, arguments, …

    What `__post_init__` says of values that do not go together is asked only where each by itself is right.
    """
    fields = {field.name: field for field in msgspec.structs.fields(schema)}
    found = []
    if schema.__struct_config__.forbid_unknown_fields:
        article = "an" if what[0] in "aeiou" else "a"
        unknown = [name for name in given if name not in fields]
        found += [WrongValue("", unknown_name(f"{article} {what}", name, list(fields))) for name in unknown]
    for name, field in fields.items():
        if name in given:
            if problem := value_problem(given[name], field.type):
                found.append(WrongValue(name, problem))
        elif field.required:
            found.append(WrongValue("", f"expected the {what} {name} ({expected(field.type)}), got none"))
    return found or disagreements(schema, given)


def disagreements(schema: type[msgspec.Struct], given: Mapping[str, Any]) -> list[WrongValue]:
    """List what `__post_init__` says of values of the right types that do not go together, at most one."""
    try:
        msgspec.convert(given, schema)
    except msgspec.ValidationError as error:
        message = str(error).partition(" - at `$")[0]
        name, colon, rest = message.partition(": ")
        return [WrongValue(name, rest) if colon and name in given else WrongValue("", message)]
    return []


def value_problem(value: object, field_type: Any) -> str:
    """Return what is wrong with a value of a field, empty if it fits: what was expected, and what came."""
    info = inspect.type_info(field_type)
    if isinstance(info, inspect.DictType) and isinstance(info.value_type, inspect.StructType):
        for key, given in value.items() if isinstance(value, Mapping) else ():
            if isinstance(given, Mapping) and (found := wrong_values(info.value_type.cls, given)):
                place = f"{key}.{found[0].name}" if found[0].name else str(key)
                return f"{found[0].message}, at {shown(place)}"
    try:
        msgspec.convert(value, field_type)
    except msgspec.ValidationError as error:
        place = str(error).partition(" - at `$")[2].removesuffix("`")
        return f"expected {expected(field_type)}, got {got(value)}{_inside(value, place)}"
    return ""


def _inside(value: object, place: str) -> str:
    """Describe the part of `value` at the place that msgspec gives, for example `[1]` or `.a[0]`; empty for none."""
    if UNKNOWN_STEP in place:
        return ""
    for key, index in _STEP.findall(place):
        if isinstance(value, Mapping) and key in value:
            value = value[key]
        elif isinstance(value, Sequence) and index and int(index) < len(value):
            value = value[int(index)]
        else:
            return ""
    return f" with {got(value)} at {place.removeprefix('.')}" if place else ""


def unknown_name(what: str, name: str, known: Sequence[str]) -> str:
    """Format the error for a name that is not among `known`, with the nearest one. `what`: for example `a driver`."""
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"expected {what} that imud knows, got {got(name)}; {hint}known: {', '.join(sorted(known)) or 'none'}"


def _words(info: inspect.Type) -> str:
    words = _words_of_several(info)
    match info:
        case inspect.Metadata(type=inner, extra=extra):
            words = (extra or {}).get("words") or _words(inner)
        case inspect.UnionType(types=types):
            words = ", or ".join(_words(one) for one in types)
        case inspect.LiteralType(values=values):
            words = _choice(sorted(values, key=_natural))
        case inspect.EnumType(cls=enum):
            words = _choice([member.value for member in enum])
        case inspect.IntType():
            words = "a whole number" + _range(info)
        case inspect.FloatType():
            words = "a number" + _range(info)
        case inspect.StrType():
            words = "text" + _text_rules(info)
        case inspect.BoolType():
            words = "true or false"
        case inspect.NoneType():
            words = "null"
        case inspect.AnyType():
            words = "any value"
    return words


def _words_of_several(info: inspect.Type) -> str:
    """Describe lists, and mappings with their keys where these are known."""
    match info:
        case inspect.ListType(item_type=item) | inspect.VarTupleType(item_type=item) | inspect.SetType(item_type=item):
            return f"a list{_length(info)}, each of it {_words(item)}"
        case inspect.DictType(key_type=inspect.LiteralType(values=keys), value_type=item):
            return f"keys {', '.join(map(str, sorted(keys, key=_natural)))}, each with {_words(item)}"
        case inspect.DictType(value_type=item):
            return f"keys, each with {_words(item)}"
        case inspect.StructType(fields=fields):
            return f"the keys {', '.join(f'{one.encode_name} ({_words(one.type)})' for one in fields)}"
    return "keys and values"


def _natural(value: object) -> list[tuple[str, float]]:
    """Key that sorts texts with numbers by these, `2 Hz` before `10 Hz`; numbers come before texts, in their order."""
    if not isinstance(value, str):
        return []
    parts = re.split(r"(?<![A-Za-z0-9])([0-9]+(?:\.[0-9]+)?)(?![A-Za-z0-9])", value)
    return [(text, float(number)) for text, number in zip(parts[::2], [*parts[1::2], "0"], strict=True)]


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


def _length(info: inspect.ListType | inspect.VarTupleType | inspect.SetType) -> str:
    low, high = info.min_length or 0, info.max_length
    if high is None:
        return f" of at least {low}" if low else ""
    return f" of {high}" if low == high else f" of {low} to {high}"


def _text_rules(info: inspect.StrType) -> str:
    if info.pattern is not None:
        return f" matching {info.pattern}"
    if info.min_length == 1:
        return " that is not empty"
    return ""
