"""Options: their base type, and descriptions of accepted and rejected values.

A part declares a struct: frozen, keyword-only, without unknown keys, with defaults where possible. `imud.config` fills
it from YAML with msgspec, which checks types and `msgspec.Meta` bounds. docs/configuration.md contains the docstring
below each field. Error messages and that page describe types in the same words. `Meta(extra={"words": "an absolute
path"})` replaces a pattern that a user cannot read.
"""

import re
from collections.abc import Mapping, Sequence
from ipaddress import ip_address
from typing import Any, NamedTuple

import msgspec
from msgspec import inspect

SHOWN_CHARACTERS = 60  # maximum number of characters of a text in an error message
HOST_CHARACTERS = 253  # maximum length of a host name (RFC 1035, section 2.3.4)
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")  # one step in msgspec's path to an invalid value
UNKNOWN_STEP = "..."  # step to a value of a mapping; msgspec does not report its key


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of one part."""


class NoOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a part without options."""


def is_ip_address(text: str) -> bool:
    """Return whether a text is an IPv4 or IPv6 address."""
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def is_host(text: str) -> bool:
    """Return whether a text is an IP address or a host name."""
    labels = text.rstrip(".").split(".")
    # RFC 1123, section 2.1: the last label contains a letter
    is_name = len(text) <= HOST_CHARACTERS and all(map(_LABEL.fullmatch, labels)) and not labels[-1].isdecimal()
    return is_name or is_ip_address(text)


def expected(field_type: Any) -> str:
    """Return a description of the values of `field_type`, for example `a number from 0 to 60, or "auto"`."""
    return _words(inspect.type_info(field_type))


def got(value: object) -> str:
    """Return `value` as in a YAML file; for mappings, lists and null, return a description."""
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
    """Return `value` as one line of YAML with printable characters only."""
    text = msgspec.json.encode(value).decode()
    return text if text.isprintable() else "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text)


def json_or_text(text: str) -> Any:
    """Return the value of JSON; another text unchanged."""
    try:
        # numbers, true, false, null, lists, objects and quoted strings
        return msgspec.json.decode(text)
    except msgspec.DecodeError:
        return text


class WrongValue(NamedTuple):
    """One invalid value of several named values."""

    name: str  # name of the value; empty if the combination of values is invalid
    message: str  # expected and received value

    def __str__(self) -> str:
        """Return both as text, for example `rate_hz: expected a number, got "fast"`."""
        return f"{self.name}: {self.message}" if self.name else self.message


def wrong_values(schema: type[msgspec.Struct], given: Mapping[str, Any], what: str = "key") -> list[WrongValue]:
    """Return all errors of values for the fields of `schema`. `what` names a value in messages: key, argument."""
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
    # __post_init__ checks the combination only if each value is valid
    return found or disagreements(schema, given)


def disagreements(schema: type[msgspec.Struct], given: Mapping[str, Any]) -> list[WrongValue]:
    """Return the error of `__post_init__` for a combination of values with correct types; at most one."""
    try:
        msgspec.convert(given, schema)
    except msgspec.ValidationError as error:
        message = str(error).partition(" - at `$")[0]
        name, colon, rest = message.partition(": ")
        return [WrongValue(name, rest) if colon and name in given else WrongValue("", message)]
    return []


def value_problem(value: object, field_type: Any) -> str:
    """Return the error of a value with the expected and the received value; empty if the value is valid."""
    info = inspect.type_info(field_type)
    if isinstance(info, inspect.DictType) and isinstance(info.value_type, inspect.StructType):
        for key, given in value.items() if isinstance(value, Mapping) else ():
            if isinstance(given, Mapping) and (found := wrong_values(info.value_type.cls, given)):
                place = f"{key}.{found[0].name}" if found[0].name else str(key)
                return f"{found[0].message}, at {shown(place)}"
    if isinstance(info, inspect.UnionType) and isinstance(value, Mapping):
        schemas = [one.cls for one in info.types if isinstance(one, inspect.StructType)]
        if schemas and (found := wrong_values(schemas[0], value)):
            return str(found[0])
    try:
        msgspec.convert(value, field_type)
    except msgspec.ValidationError as error:
        place = str(error).partition(" - at `$")[2].removesuffix("`")
        return f"expected {expected(field_type)}, got {got(value)}{_inside(value, place)}"
    return ""


def _inside(value: object, place: str) -> str:
    """Return a description of the part of `value` at msgspec's path, for example `[1]` or `.a[0]`."""
    if UNKNOWN_STEP in place:
        return ""
    for key, index in _STEP.findall(place):
        if isinstance(value, Mapping) and key in value:
            value = value[key]
        elif isinstance(value, Sequence) and index:
            value = value[int(index)]
        else:
            return ""
    return f" with {got(value)} at {place.removeprefix('.')}" if place else ""


def unknown_name(what: str, name: str, known: Sequence[str]) -> str:
    """Return the error for a name that is not in `known`, with the most similar name. `what`: `a driver`, …."""
    from difflib import get_close_matches  # only an error needs it: 0.2 MB

    near = get_close_matches(name, known, cutoff=0.5)
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
    match info:
        case inspect.ListType(item_type=item) | inspect.VarTupleType(item_type=item) | inspect.SetType(item_type=item):
            return f"a list{_length(info)}, each item {_words(item)}"
        case inspect.DictType(key_type=inspect.LiteralType(values=keys), value_type=item):
            return f"keys {', '.join(map(str, sorted(keys, key=_natural)))}, each with {_words(item)}"
        case inspect.DictType(value_type=item):
            return f"keys, each with {_words(item)}"
        case inspect.StructType(fields=fields):
            return f"the keys {', '.join(f'{one.encode_name} ({_words(one.type)})' for one in fields)}"
    return "keys and values"


def _natural(value: object) -> list[tuple[str, float]]:
    """Return a sort key for texts with numbers: `2 Hz` before `10 Hz`, numbers before texts."""
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
