"""Schema of the configuration file: keys of the daemon and of a device, and the registries of the other keys.

A new row of a registry (DRIVERS, LINKS, PUBLISHERS) needs no change here.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from imud.attitude.conventions import AttitudeSource, Convention
from imud.config.yaml import PROBLEMS_MAX, Problem, YamlTree
from imud.config.yaml import Path as KeyPath
from imud.contracts.driver import Driver
from imud.contracts.link import LinkType
from imud.contracts.publisher import PublisherType
from imud.contracts.registry import problems_of
from imud.contracts.setting import OnDifference
from imud.drivers import DRIVERS
from imud.links import LINKS
from imud.model.host_object import Directory
from imud.model.options import Options, disagreements, expected, got, unknown_name, value_problem
from imud.publishers import PUBLISHERS


class General(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of the daemon."""

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level of log messages."""
    state_dir: Directory = "/var/lib/imud"
    """Directory of the state: found devices, flash writes, backups of device settings. imud creates it. A change needs
    a restart. STATE_DIRECTORY of systemd overrides this key."""


class DeviceGeneral(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of a device, without the keys of its link and its driver."""

    driver: str = "auto"
    """Wire protocol of the device. `auto`: imud listens and detects it."""
    enabled: bool = True
    """False: imud ignores the device, but checks its keys."""
    identify: bool = True
    """Whether imud may request product, serial number and firmware. The requests do not change the device."""
    on_difference: OnDifference = OnDifference.REPORT
    """Reaction if the device differs from `settings`: report the difference, apply the settings, or apply and save
    them."""
    convention: Convention | None = None
    """Axes and angles of the published samples; null: the convention of the device, or enu-flu if `frame` is set
    (docs/frames.md)."""
    declination_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)] | None = None
    """Direction of magnetic north from true north, east positive. imud adds it to a magnetic heading; null: no
    change."""
    attitude: AttitudeSource = AttitudeSource.DEVICE
    """`host`: imud computes the attitude of a device that sends only angular rate and acceleration
    (docs/attitude.md). Needs the extra `imud[attitude]`."""


Row = Driver | LinkType[Any] | PublisherType


@dataclass(frozen=True, slots=True)
class Tables:
    """The tables that the schema is made from."""

    drivers: Mapping[str, Driver]
    links: Mapping[str, LinkType[Any]]
    publishers: Mapping[str, PublisherType]


TABLES: Final = Tables(DRIVERS, LINKS, PUBLISHERS)

S = TypeVar("S", bound=Options)

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")


class Keys:
    """Keys of a file, and the problems found so far."""

    def __init__(self, tree: YamlTree) -> None:
        self.tree = tree
        self.problems: list[Problem] = []
        self.ignored: list[Problem] = []  # parts that imud ignores, because the driver or output has a problem

    def problems_besides(self, known: Sequence[Problem]) -> Iterator[Problem]:
        """Yield the problems, without the consequences of a `known` problem at the same place or inside it."""
        paths = [problem.path for problem in known]
        return (p for p in self.problems if not any(path[: len(p.path)] == p.path for path in paths))

    def ignores(self, table: Mapping[str, Row], name: object, path: KeyPath, part: str) -> bool:
        """Return whether the row is in a package with a problem. Note the problem at `path`."""
        problem = problems_of(table).get(name) if isinstance(name, str) and name not in table else None
        if problem is not None:
            self.ignored.append(Problem(self.tree.mark(path), path, f"imud ignores this {part}: {problem}"))
        return problem is not None

    def mapping(self, path: KeyPath, data: object) -> Mapping[str, Any] | None:
        """Return `data` if it is a mapping; otherwise add a problem and return None."""
        if isinstance(data, dict):
            return data
        self.problem(path, f"expected keys and values, got {got(data)}")
        return None

    def unknown_keys(self, path: KeyPath, keys: Mapping[str, Any], known: Sequence[str]) -> None:
        """Add a problem for each key that is not `known`."""
        for key in keys:
            if key not in known and len(self.problems) < PROBLEMS_MAX:
                self.problem((*path, key), unknown_name("a key", key, known), at_key=True)

    def row(self, table: Mapping[str, Row], name: str, data: object, path: KeyPath | None = None) -> Options | None:
        """Read the options of row `name`. An empty value means the defaults."""
        path = path or (name,)
        try:
            schema = table[name].settings
        except ImportError as error:
            self.problem(path, f"expected the installed packages of {name}, got: {error}", at_key=True)
            return None
        return self.part(schema, data, path)

    def part(self, schema: type[S], data: object, path: KeyPath) -> S | None:
        """Read the options of one part by its schema. An empty value means the defaults."""
        keys = self.mapping(path, {} if data is None else data)
        if keys is None:
            return None
        self.unknown_keys(path, keys, schema.__struct_fields__)
        return self.settings(schema, path, {key: keys[key] for key in schema.__struct_fields__ if key in keys})

    def settings(self, schema: type[S], path: KeyPath, keys: Mapping[str, Any]) -> S | None:
        """Convert each of the known `keys` to `schema` separately, so that the reader reports every invalid value."""
        good = True
        for field in msgspec.structs.fields(schema):
            if field.name in keys:
                good &= self._value_fits((*path, field.name), keys[field.name], field.type)
            elif field.required:
                self.problem(path, f"expected the key {field.name} ({expected(field.type)}), got none", at_key=True)
                good = False
        if not good:
            return None
        for name, message in disagreements(schema, keys):
            self.problem((*path, name) if name else path, message)
            return None
        return msgspec.convert(keys, schema)

    def problem(self, path: KeyPath, message: str, *, at_key: bool = False) -> None:
        """Add a problem at `path`, with its value or with the key itself."""
        mark = self.tree.key_mark(path) if at_key else self.tree.mark(path)
        self.problems.append(Problem(mark, path, message))

    def _value_fits(self, path: KeyPath, value: object, field_type: Any) -> bool:
        before = len(self.problems)
        if isinstance(value, dict):
            self._check_inside(path, value, field_type)
        if len(self.problems) > before:
            return False
        if problem := value_problem(value, field_type):
            self.problem(path, problem)
            return False
        text = _controlling(value)
        if text is not None:
            self.problem(path, f"expected text without control characters, got {got(text)}")
        return text is None

    def _check_inside(self, path: KeyPath, values: Mapping[str, Any], field_type: Any) -> None:
        """Add the problems of the keys and values of a mapping if `field_type` contains mappings."""
        for choice in _choices(field_type):
            if isinstance(choice, type) and issubclass(choice, Options):
                self.part(choice, values, path)
            elif get_origin(choice) is dict:
                key_type, value_type = get_args(choice)
                known = get_args(key_type) if get_origin(key_type) is Literal else None
                if known is not None:
                    self.unknown_keys(path, values, known)
                for key, value in values.items():
                    if (known is None or key in known) and len(self.problems) < PROBLEMS_MAX:
                        self._value_fits((*path, key), value, value_type)


def _choices(field_type: Any) -> Iterator[Any]:
    """Yield the types of a union or the single type, without annotations."""
    origin = get_origin(field_type)
    if origin is Annotated:
        yield from _choices(get_args(field_type)[0])
    elif origin is Union or origin is UnionType:
        for one in get_args(field_type):
            yield from _choices(one)
    else:
        yield field_type


def _controlling(value: object) -> str | None:
    """Return a text in `value` with control characters, which no path or name contains; None without such text."""
    if isinstance(value, str):
        return value if _CONTROL.search(value) else None
    parts = value if isinstance(value, list) else value.values() if isinstance(value, dict) else ()
    return next((text for text in map(_controlling, parts) if text is not None), None)
