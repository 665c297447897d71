"""The state of a device's codec, clock and path as bytes, so that a recording can begin in the middle of a run.

The objects below a root are written as what they are: class, attributes, containers, references to what was written
before. Nothing is imported or called from the bytes but classes and functions of imud's own codecs and clocks, and no
constructor runs: a recording is a foreign file. What belongs to the daemon (ledger, host's time) is external: it has a
name, and whoever restores the state gives his own.

The state is that of one version of imud: where a class has other attributes than those that were written, restoring
raises, and a replay begins with an empty clock instead.
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

MODULES: Final = (
    "imud.sampling.", "imud.contracts.", "imud.drivers.", "imud.formats.", "imud.model.sample:", "imud.host.clock:",
)  # fmt: skip
"""Modules whose classes and functions a state may have."""
DEPTH_MAX: Final = 200
"""Objects inside objects; codecs and clocks have ten."""

Attributes = dict[str, Any]


class StateError(ImudError):
    """A state cannot be written or restored. Example: a recording of another version of imud."""


def attributes(value: object) -> Attributes:
    """Return the attributes of an object, in slots or not."""
    found: Attributes = {}
    for class_ in type(value).__mro__:
        slots = class_.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                found[name] = getattr(value, name)
    return found | getattr(value, "__dict__", {})


class StateWriter:
    """Writer of one state. `external` names what belongs to the daemon, `leave` attributes of the roots."""

    def __init__(self, external: Mapping[str, object], leave: frozenset[str] = frozenset()) -> None:
        self._external = {id(one): name for name, one in external.items()}
        self._leave = leave
        self._numbers: dict[int, int] = {}
        self._kept: list[object] = []

    def write(self, roots: Mapping[str, object]) -> bytes:
        """Return the state of these objects. Raises StateError for what cannot be written."""
        tree = {}
        for root in roots.values():
            self._numbers[id(root)] = len(self._numbers)
        for name, root in roots.items():
            parts = {key: one for key, one in attributes(root).items() if key not in self._leave}
            written = {key: self._value(one, f"{name}.{key}", 0) for key, one in parts.items()}
            tree[name] = (self._numbers[id(root)], written)
        try:
            return msgspec.msgpack.encode(tree)
        except (OverflowError, TypeError, ValueError) as error:
            raise StateError(f"the state cannot be written: {reason_of(error)}") from None

    def _value(self, value: Any, path: str, depth: int) -> Any:  # noqa: PLR0911 - one for each kind of value
        if value is None or type(value) in (bool, int, float, str, bytes):
            return value
        if depth > DEPTH_MAX:
            raise StateError(f"the state is deeper than {DEPTH_MAX} at {path}")
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
        self._kept.append(value)  # or another object could get its id
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
    """Name of a class or function. Raises StateError for one that a state may not have."""
    name = f"{value.__module__}:{value.__qualname__}"
    if not name.startswith(MODULES) or "<" in name:
        raise StateError(f"the state has a {name}, which cannot be written")
    return name


def _named(name: Any) -> Any:
    """The class or function of a name. Raises StateError for one that a state may not have."""
    if not isinstance(name, str) or not name.startswith(MODULES) or "__" in name:
        raise StateError(f"the state has a {str(name)[:80]!r}, which is no part of a codec or a clock")
    module, _, path = name.partition(":")
    try:
        found: Any = import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError):
        raise StateError(f"the state has a {name[:80]}, which this imud does not have") from None
    if getattr(found, "__module__", "") != module or not isinstance(found, type | FunctionType):
        raise StateError(f"the state has a {name[:80]}, which is neither a class nor a function")
    return found


class StateReader:
    """Reader of one state."""

    def __init__(self, state: bytes, external: Mapping[str, object]) -> None:
        """Raises StateError for bytes that are none."""
        self._external = external
        self._made: dict[int, Any] = {}
        try:
            self._tree = msgspec.msgpack.decode(state, type=dict[str, tuple[int, dict[str, Any]]])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise StateError(f"the state cannot be read: {reason_of(error)}") from None

    def restore(self, name: str, root: object) -> None:
        """Give a root the attributes that were written; roots in the order in which they were written.

        Raises StateError; the root is of no use then.
        """
        known = attributes(root)
        if name not in self._tree:
            raise StateError(f"the state has no {name}")
        number, parts = self._tree[name]
        self._made[number] = root
        for key, written in parts.items():
            if key not in known:
                raise StateError(f"the state has {name}.{key}, which this imud does not have")
            _set(root, key, self._value(written, 0))

    def _value(self, written: Any, depth: int) -> Any:
        if not isinstance(written, list):
            return written
        if depth > DEPTH_MAX:
            raise StateError(f"the state is deeper than {DEPTH_MAX}")
        try:
            return self._object(written, depth + 1)
        except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
            raise StateError(f"the state cannot be restored: {reason_of(error)}") from None

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
        raise StateError(f"the state cannot be restored: {str(written)[:80]}")

    def _container(self, number: int, written: list[Any], depth: int) -> Any:  # noqa: PLR0911 - one for each kind of value
        match written:
            case ["deque", most, list(items)]:
                return deque((self._value(one, depth) for one in items), maxlen=most)
            case ["list", list(items)]:
                made = self._made[number] = list[Any]()
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
                return _named(name)._make([self._value(one, depth) for one in items])
        raise StateError(f"the state cannot be restored: {str(written)[:80]}")

    def _instance(self, number: int, kind: Any, parts: dict[str, Any], depth: int) -> Any:
        if not isinstance(kind, type) or issubclass(kind, BaseException):
            raise StateError(f"the state has an object of {kind}")
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
        raise StateError(f"the state has an attribute {name}")
    object.__setattr__(target, name, value)
