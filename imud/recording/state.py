"""Saved state of a device's codec, clock and path, so that a recording can start in the middle of a run.

A state contains the objects below a root: class, attributes, containers, and references to objects written before. A
recording is a foreign file. The reader therefore imports only classes and functions of codecs and clocks, and it calls
no constructor except for msgspec structs. Objects of the daemon (ledger, steady time, observer) are external: the
state contains only their names.

A state is valid for one version of imud. If a class has other attributes, the reader raises StateError, and the replay
starts with a new clock.
"""

from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from functools import partial
from importlib import import_module
from types import FunctionType, MethodType
from typing import Any, Final

import msgspec

from imud.model.errors import ImudError, reason_of

# modules of the classes and functions that a state may contain
MODULES: Final = (
    "imud.sampling.", "imud.contracts.", "imud.drivers.", "imud.formats.", "imud.model.sample:", "imud.host.clock:",
)  # fmt: skip
# Maximum depth of objects inside objects. Codecs and clocks have a depth of ten. The reader needs four calls per
# object, and Python allows 1000 nested calls.
DEPTH_MAX: Final = 100

Attributes = dict[str, Any]


class StateError(ImudError):
    """Failure to write or restore a state. Example: a recording of another version of imud."""


def attributes(value: object) -> Attributes:
    """Return the attributes of an object, from `__slots__` and `__dict__`."""
    found: Attributes = {}
    for class_ in type(value).__mro__:
        slots = class_.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                found[name] = getattr(value, name)
    return found | getattr(value, "__dict__", {})


class StateWriter:
    def __init__(self, external: Mapping[str, object], excluded: frozenset[str] = frozenset()) -> None:
        """`external` are the objects of the daemon by name, `excluded` the attributes of the roots that it omits."""
        self._external = {id(one): name for name, one in external.items()}
        self._excluded = excluded
        self._numbers: dict[int, int] = {}
        self._kept: list[object] = []

    def write(self, roots: Mapping[str, object]) -> bytes:
        """Return the state of the roots. Raises StateError for an object that cannot be written."""
        tree = {}
        for root in roots.values():
            self._numbers[id(root)] = len(self._numbers)
        for name, root in roots.items():
            parts = {key: one for key, one in attributes(root).items() if key not in self._excluded}
            written = {key: self._value(one, f"{name}.{key}", 0) for key, one in parts.items()}
            tree[name] = (self._numbers[id(root)], written)
        try:
            return msgspec.msgpack.encode(tree)
        except (OverflowError, TypeError, ValueError) as error:
            raise StateError(f"cannot write the state: {reason_of(error)}") from None

    def _value(self, value: Any, path: str, depth: int) -> Any:  # noqa: PLR0911 - one for each kind of value
        if value is None or type(value) in (bool, int, float, str, bytes):
            return value
        if depth > DEPTH_MAX:
            raise StateError(f"cannot write the state: {path} is deeper than {DEPTH_MAX} objects")
        if id(value) in self._external:
            return ["x", self._external[id(value)]]
        if id(value) in self._numbers:
            return ["r", self._numbers[id(value)]]
        if isinstance(value, Enum):
            return ["e", _name_of(type(value)), value.name]
        if isinstance(value, type | FunctionType):
            return ["f", _name_of(value)]
        if isinstance(value, MethodType):
            return ["b", self._value(value.__self__, path, depth + 1), value.__name__]
        self._numbers[id(value)] = len(self._numbers)
        self._kept.append(value)  # another object must not get this id
        return [self._numbers[id(value)], *self._object(value, path, depth + 1)]

    def _object(self, value: Any, path: str, depth: int) -> list[Any]:
        kind = type(value)
        if kind in _CONTAINERS or isinstance(value, tuple):
            items = [self._value(one, path, depth) for one in value]
            if kind is deque:
                return ["deque", value.maxlen, items]
            return [kind.__name__ if kind in _CONTAINERS else _name_of(kind), items]
        if isinstance(value, Mapping):
            pairs = [[self._value(key, path, depth), self._value(one, path, depth)] for key, one in value.items()]
            return ["dict", pairs]
        if isinstance(value, partial):
            rest = [value.func, value.args, value.keywords]
            return ["partial", *(self._value(one, path, depth) for one in rest)]
        if isinstance(value, bytearray):
            return ["bytearray", bytes(value)]
        parts = msgspec.structs.asdict(value) if isinstance(value, msgspec.Struct) else attributes(value)
        made = {key: self._value(one, f"{path}.{key}", depth) for key, one in parts.items()}
        return ["object", _name_of(kind), made]


_CONTAINERS: Final[Mapping[type, Callable[[list[Any]], Any]]] = {
    list: list, tuple: tuple, set: set, frozenset: frozenset, deque: deque,
}  # fmt: skip
_BY_NAME: Final = {kind.__name__: kind for kind in _CONTAINERS}


def _name_of(value: Any) -> str:
    """Return the name of a class or function. Raises StateError if a state may not contain it."""
    name = f"{value.__module__}:{value.__qualname__}"
    # "<": a lambda or a local class, which no import finds
    if not name.startswith(MODULES) or "<" in name:
        raise StateError(f"cannot write the state: {name} is not part of a codec or clock")
    return name


def _named(name: Any) -> Any:
    """Return the class or function of a name. Raises StateError if a state may not contain it."""
    # "__": __class__, __globals__ and the like lead out of the allowed modules
    if not isinstance(name, str) or not name.startswith(MODULES) or "__" in name:
        raise StateError(f"cannot restore the state: expected a class of a codec or clock, got {str(name)[:80]!r}")
    module, _, path = name.partition(":")
    try:
        found: Any = import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError):
        raise StateError(f"cannot restore the state: this imud has no {name[:80]}") from None
    # a module also contains the names that it imports
    if getattr(found, "__module__", "") != module or not isinstance(found, type | FunctionType):
        raise StateError(f"cannot restore the state: {name[:80]} is not a class or function")
    return found


class StateReader:
    def __init__(self, state: bytes, external: Mapping[str, object]) -> None:
        """`external` are the objects of the daemon by name. Raises StateError for an invalid state."""
        self._external = external
        self._made: dict[int, Any] = {}
        try:
            self._tree = msgspec.msgpack.decode(state, type=dict[str, tuple[int, dict[str, Any]]])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise StateError(f"cannot read the state: {reason_of(error)}") from None

    def restore(self, name: str, root: object) -> None:
        """Set the attributes of a root. Restore the roots in the order of the state.

        Raises StateError. After this error, do not use the root.
        """
        known = attributes(root)
        if name not in self._tree:
            raise StateError(f"cannot restore the state: it does not contain {name}")
        number, parts = self._tree[name]
        self._made[number] = root
        for key, written in parts.items():
            if key not in known:
                raise StateError(f"cannot restore the state: this imud has no attribute {name}.{key}")
            _set(root, key, self._value(written, 0))

    def _value(self, written: Any, depth: int) -> Any:
        if not isinstance(written, list):
            return written
        if depth > DEPTH_MAX:
            raise StateError(f"cannot restore the state: it is deeper than {DEPTH_MAX} objects")
        try:
            return self._object(written, depth + 1)
        except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
            raise StateError(f"cannot restore the state: {reason_of(error)}") from None

    def _object(self, written: list[Any], depth: int) -> Any:  # noqa: PLR0911 - one for each kind of value
        match written:
            case ["x", name]:
                return self._external[name]
            case ["r", int(number)]:
                return self._made[number]
            case ["e", name, member]:
                return _named(name)[member]
            case ["f", name]:
                return _named(name)
            case ["b", owner, str(name)] if not name.startswith("__"):
                return getattr(self._value(owner, depth), name)
            case [int(number), "object", name, dict(parts)]:
                return self._instance(number, _named(name), parts, depth)
            case [int(number), *rest]:
                made = self._made[number] = self._container(number, rest, depth)
                return made
        raise StateError(f"cannot restore the state: unexpected value {str(written)[:80]}")

    def _container(self, number: int, written: list[Any], depth: int) -> Any:  # noqa: PLR0911 - one for each kind of value
        match written:
            case ["deque", most, list(items)]:
                return deque((self._value(one, depth) for one in items), maxlen=most)
            case ["list", list(items)]:
                made = self._made[number] = list[Any]()  # before its items, which may refer to it
                made.extend(self._value(one, depth) for one in items)
                return made
            case ["dict", list(pairs)]:
                return {self._value(key, depth): self._value(one, depth) for key, one in pairs}
            case ["partial", function, arguments, keywords]:
                return partial(
                    self._value(function, depth), *self._value(arguments, depth), **self._value(keywords, depth)
                )
            case ["bytearray", bytes(data)]:
                return bytearray(data)
            case [str(name), list(items)] if name in _BY_NAME:
                return _CONTAINERS[_BY_NAME[name]]([self._value(one, depth) for one in items])
            case [str(name), list(items)]:
                return _named(name)._make([self._value(one, depth) for one in items])  # named tuples
        raise StateError(f"cannot restore the state: unexpected value {str(written)[:80]}")

    def _instance(self, number: int, kind: Any, parts: dict[str, Any], depth: int) -> Any:
        if not isinstance(kind, type) or issubclass(kind, BaseException):
            raise StateError(f"cannot restore the state: an object must not be of {kind}")
        if issubclass(kind, msgspec.Struct):
            made: Any = kind(**{key: self._value(one, depth) for key, one in parts.items()})
            self._made[number] = made
            return made
        made = self._made[number] = object.__new__(kind)
        for key, one in parts.items():
            _set(made, key, self._value(one, depth))
        return made


def _set(target: object, name: str, value: object) -> None:
    if name.startswith("__"):
        raise StateError(f"cannot restore the state: an attribute must not be named {name}")
    object.__setattr__(target, name, value)
