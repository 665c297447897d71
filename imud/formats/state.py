"""Tables of the state of an object: the values that a recording stores and restores.

A recording is a foreign file. It contains values only: numbers, booleans, bytes, None, and lists and maps of them. A
table names each attribute that takes part, with its type and its range. The reader changes only these attributes of an
object that imud itself created. A name in a file never selects a class, a function, a module or an attribute.

    object ──StateTable.save──▶ {number of the field: value} ──StateTable.load──▶ the same attributes of a new object

A recording stores the numbers of the fields, not their names. imud never uses a number again: a field with another
meaning gets a new number. A missing field keeps the value of the new object. The reader ignores an unknown number.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from math import inf, isfinite
from typing import Any, Final, NamedTuple, Protocol

import msgspec

from imud.model.errors import ImudError, reason_of

# Maximum size of a state, bytes. The largest real states have 4096 pairs of clocks or 4096 edges, 150 kB each. Python
# needs up to 75 bytes of memory for one byte.
STATE_BYTES_MAX: Final = 1 << 20
_SHOWN_CHARACTERS: Final = 40  # maximum length of an invalid value in a message


class StateError(ImudError):
    """Failure to save or to load a state. Example: a value outside its range."""


class ValueType(Protocol):
    """Type and range of a value."""

    def save(self, value: Any, owner: Any) -> Any:
        """Return the value as MessagePack can store it. `owner` is the object that has it."""
        ...

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the value. `current` is the value of the new object `owner`. Raises StateError."""
        ...


def _expect(condition: bool, expected: str, saved: Any) -> None:
    if not condition:
        raise StateError(f"expected {expected}, got {str(saved)[:_SHOWN_CHARACTERS]!r}")


class _Plain:
    """Base of the types whose values MessagePack stores unchanged."""

    def save(self, value: Any, owner: Any) -> Any:
        """Return the value."""
        return value


class Flag(_Plain):
    """A boolean."""

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return a boolean."""
        _expect(type(saved) is bool, "true or false", saved)
        return saved


@dataclass(frozen=True, slots=True)
class Integer(_Plain):
    """An integer from `low` to `high`."""

    low: int
    high: int

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return an integer in the range."""
        is_valid = type(saved) is int and self.low <= saved <= self.high
        _expect(is_valid, f"an integer from {self.low} to {self.high}", saved)
        return saved


@dataclass(frozen=True, slots=True)
class Real(_Plain):
    """A finite number from `low` to `high`. An integer stays an integer: its sum can be more exact."""

    low: float
    high: float
    least: float = 0.0  # minimum absolute value of a number other than zero, for a divisor

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return a number in the range."""
        is_valid = type(saved) in (int, float) and self.low <= saved <= self.high
        is_valid = is_valid and (not saved or abs(saved) >= self.least)
        _expect(is_valid, f"a number from {self.low:g} to {self.high:g}, zero or at least {self.least:g}", saved)
        return saved


@dataclass(frozen=True, slots=True)
class Extreme:
    """A number as `Real`, or the infinite value of the new object, which means that there is no number yet."""

    low: float
    high: float

    def save(self, value: Any, owner: Any) -> Any:
        """Return the number; None if it is infinite."""
        return value if isfinite(value) else None

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return a number in the range, or the value of the new object."""
        if saved is None and current in (inf, -inf):
            return current
        return Real(self.low, self.high).load(saved, current, owner)


@dataclass(frozen=True, slots=True)
class Data:
    """Bytes, from `bytes_min` to `bytes_max`."""

    bytes_max: int
    bytes_min: int = 0

    def save(self, value: Any, owner: Any) -> Any:
        """Return the bytes."""
        return bytes(value)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return bytes."""
        is_valid = type(saved) is bytes and self.bytes_min <= len(saved) <= self.bytes_max
        _expect(is_valid, f"{self.bytes_min} to {self.bytes_max} bytes", saved)
        return saved


class OneOf:
    """One object of a fixed table: a recording stores its position. Examples: the members of an enumeration."""

    def __init__(self, *objects: object) -> None:
        self._objects = objects

    def save(self, value: Any, owner: Any) -> Any:
        """Return the position of the object. Raises StateError for another object."""
        for index, item in enumerate(self._objects):
            if item is value:
                return index
        raise StateError(f"expected one of {len(self._objects)} objects, got a {type(value).__name__}")

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the object at a position."""
        return self._objects[Integer(0, len(self._objects) - 1).load(saved, current, owner)]


def member_of(kind: type[Enum]) -> OneOf:
    """Return the type of the members of an enumeration. Their order must not change."""
    return OneOf(*kind)


class SameAs:
    """The object that another attribute of the same owner contains, by the name of this attribute in a fixed table."""

    def __init__(self, *names: str) -> None:
        self._names = names

    def save(self, value: Any, owner: Any) -> Any:
        """Return the position of the name."""
        return OneOf(*(getattr(owner, name) for name in self._names)).save(value, owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the object of the owner, which the reader has loaded before."""
        same = getattr(owner, self._names[Integer(0, len(self._names) - 1).load(saved, current, owner)])
        _expect(same is not None, "the position of an object", saved)
        return same


@dataclass(frozen=True, slots=True)
class Maybe:
    """A value, or None."""

    type: ValueType

    def save(self, value: Any, owner: Any) -> Any:
        """Return the value or None."""
        return None if value is None else self.type.save(value, owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the value or None."""
        return None if saved is None else self.type.load(saved, current, owner)


@dataclass(frozen=True, slots=True)
class Present:
    """A value that is None exactly if the value of the new object is None: the constructor decides."""

    type: ValueType

    def save(self, value: Any, owner: Any) -> Any:
        """Return the value or None."""
        return None if value is None else self.type.save(value, owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the value or None."""
        _expect((saved is None) is (current is None), "no value" if current is None else "a value", saved)
        return None if saved is None else self.type.load(saved, current, owner)


@dataclass(frozen=True, slots=True)
class Items:
    """A list or a deque of at most `count_max` values. The reader changes the container of the new object."""

    type: ValueType
    count_max: int

    def save(self, value: Any, owner: Any) -> Any:
        """Return a list."""
        return [self.type.save(item, owner) for item in value]

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the list or the deque of the new object with the values."""
        _expect(type(saved) is list and len(saved) <= self.count_max, f"at most {self.count_max} values", saved)
        items = [self.type.load(item, None, owner) for item in saved]
        if isinstance(current, deque | list):
            current.clear()
            current.extend(items)
            return current
        return items


@dataclass(frozen=True, slots=True)
class Each:
    """A list with the same objects as the list of the new object: the reader loads each object."""

    type: ValueType

    def save(self, value: Any, owner: Any) -> Any:
        """Return a list."""
        return [self.type.save(item, owner) for item in value]

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the list of the new object."""
        _expect(type(saved) is list and len(saved) == len(current), f"{len(current)} values", saved)
        current[:] = [self.type.load(item, new, owner) for item, new in zip(saved, current, strict=True)]
        return current


@dataclass(frozen=True, slots=True)
class Values:
    """A set of at most `count_max` values."""

    type: ValueType
    count_max: int

    def save(self, value: Any, owner: Any) -> Any:
        """Return a sorted list."""
        return [self.type.save(item, owner) for item in sorted(value)]

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return a set."""
        return set(Items(self.type, self.count_max).load(saved, None, owner))


@dataclass(frozen=True, slots=True)
class Map:
    """A dictionary of at most `count_max` pairs. The reader changes the dictionary of the new object."""

    key: ValueType
    type: ValueType
    count_max: int

    def save(self, value: Any, owner: Any) -> Any:
        """Return a list of pairs, in the order of the dictionary."""
        return [[self.key.save(key, owner), self.type.save(item, owner)] for key, item in value.items()]

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the dictionary of the new object with the pairs."""
        pairs = Items(Row(self.key, self.type), self.count_max).load(saved, None, owner)
        current.clear()
        current.update(pairs)
        return current


class Row:
    """A tuple with a type for each member. `make` returns a named tuple or a frozen struct of the members."""

    def __init__(self, *types: ValueType, make: Callable[..., Any] | None = None) -> None:
        self._types = types
        self._make = make

    def save(self, value: Any, owner: Any) -> Any:
        """Return a list."""
        members = value if isinstance(value, tuple) else msgspec.structs.astuple(value)
        return [kind.save(member, owner) for kind, member in zip(self._types, members, strict=True)]

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return the tuple."""
        _expect(type(saved) is list and len(saved) == len(self._types), f"{len(self._types)} values", saved)
        members = [kind.load(member, None, owner) for kind, member in zip(self._types, saved, strict=True)]
        return tuple(members) if self._make is None else self._make(*members)


class Field(NamedTuple):
    """Attribute of a class that a recording stores."""

    number: int  # number in recordings; unique in its table for ever
    name: str  # name of the attribute
    type: ValueType
    since: str = "0.1.0"  # first version of imud with this field


def _accept(_value: Any) -> None:
    """Accept every value."""


class StateTable:
    """Table of the state of the objects of one class. It is also the type of an attribute that contains one object."""

    def __init__(
        self,
        fields: Sequence[Field],
        other: Mapping[str, str] | None = None,
        finish: Callable[[Any], None] = _accept,
    ) -> None:
        """`other` are the attributes that are not state, with the reason. `finish` computes them after `load`, and
        raises StateError if the values contradict each other."""
        self.fields = tuple(fields)
        self.other = dict(other or {})
        self._by_number = {field.number: field for field in fields}
        self._finish = finish

    @property
    def names(self) -> frozenset[str]:
        """Names of all attributes, state or not."""
        return frozenset(field.name for field in self.fields) | self.other.keys()

    def save(self, value: Any, owner: Any = None) -> dict[int, Any]:
        """Return the state of an object. Raises StateError for an attribute that the table does not name."""
        if unnamed := attribute_names(value) - self.names:
            kind = type(value).__name__
            raise StateError(f"the table of the state of {kind} does not name the attribute {min(unnamed)}")
        saved = {}
        for field in self.fields:
            try:
                saved[field.number] = field.type.save(getattr(value, field.name), value)
            except (AttributeError, TypeError, ValueError) as error:
                raise StateError(f"{field.name}: {reason_of(error)}") from None
            except StateError as error:
                raise StateError(f"{field.name}: {error}") from None
        return saved

    def load(self, saved: Any, current: Any, owner: Any = None) -> Any:
        """Set the attributes of the object `current` and return it. Do not use the object after a StateError."""
        _expect(type(saved) is dict and current is not None, "no object, or its fields by number", saved)
        for field in self.fields:
            if field.number in saved:
                try:
                    new = getattr(current, field.name)
                    value = field.type.load(saved[field.number], new, current)
                    if value is not new:
                        setattr(current, field.name, value)
                except StateError as error:
                    raise StateError(f"{field.name}: {error}") from None
        self._finish(current)
        return current


@dataclass(frozen=True, slots=True)
class New:
    """An object that the reader creates with `make`, which receives the owner, and then loads."""

    state: StateTable
    make: Callable[[Any], Any]

    def save(self, value: Any, owner: Any) -> Any:
        """Return the state of the object."""
        return self.state.save(value, owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Return a new object with the state."""
        return self.state.load(saved, self.make(owner), owner)


class CodecState:
    """State of an object with a table of its own, the attribute `STATE` of its class: a codec of any driver."""

    def save(self, value: Any, owner: Any) -> Any:
        """Return the state of the codec. Raises StateError if its class has no table."""
        return self._table(value).save(value, owner)

    def load(self, saved: Any, current: Any, owner: Any) -> Any:
        """Load the codec of the new object."""
        return self._table(current).load(saved, current, owner)

    def _table(self, codec: Any) -> StateTable:
        table = getattr(type(codec), "STATE", None)
        if not isinstance(table, StateTable):
            raise StateError(f"the driver has no table of the state of its codec {type(codec).__name__}")
        return table


def attribute_names(value: object) -> frozenset[str]:
    """Return the names of the attributes of an object, from `__slots__` and `__dict__`."""
    names = set(getattr(value, "__dict__", ()))
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        names.update((slots,) if isinstance(slots, str) else slots)
    return frozenset(names - {"__dict__", "__weakref__"})


def encode_state(revision: int, saved: Mapping[int, Any]) -> bytes:
    """Return a state as bytes. `revision` is the revision of the algorithms that use it. Raises StateError."""
    try:
        data = msgspec.msgpack.encode((revision, saved))
    except (OverflowError, TypeError, ValueError) as error:
        raise StateError(f"cannot write the state: {reason_of(error)}") from None
    if len(data) > STATE_BYTES_MAX:
        raise StateError(f"cannot write the state: expected at most {STATE_BYTES_MAX} bytes, got {len(data)}")
    return data


def decode_state(revision: int, data: bytes) -> dict[int, Any]:
    """Return the fields of a state. Raises StateError for invalid bytes, and for another revision."""
    if len(data) > STATE_BYTES_MAX:
        raise StateError(f"cannot read the state: expected at most {STATE_BYTES_MAX} bytes, got {len(data)}")
    try:
        found, saved = msgspec.msgpack.decode(data, type=tuple[int, dict[int, Any]])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StateError(f"cannot read the state: {reason_of(error)}") from None
    if found != revision:
        raise StateError(f"revision {found} of the clock wrote the recording, this imud has revision {revision}")
    return saved
