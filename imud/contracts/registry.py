"""Registry: name → "module:NAME". imud imports a row at its first use, so a missing library disables one row only.

A registry with a group also contains the rows of other packages (docs/drivers.md). imud reads their entry points at the
first use of a name that is not a row of imud, and at the first iteration.
"""

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, cached_property
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar, cast

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

INTERFACE_VERSION: Final = 1
"""Version of the interface for other packages. A change that breaks the code of such a package increments it."""
PLUGINS_VARIABLE: Final = "IMUD_PLUGINS"  # environment variable: with the value `off`, imud ignores other packages
PLUGIN_NAME: Final = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
ROW: Final = re.compile(r"[a-z_][a-z0-9_.]*:[A-Za-z_][A-Za-z0-9_]*")  # row of a registry: module and name
_PREFIX: Final = "imud."  # start of the names of all groups

T = TypeVar("T")


def load(row: str) -> Any:
    """Import and return the object `module:NAME` of a row in the code. Never call it with a name from outside."""
    module, _, attribute = row.partition(":")
    return getattr(import_module(module), attribute)


class PluginGroup(NamedTuple):
    """Rows that other packages add to a registry."""

    name: str  # group of the entry points
    row_type: type
    reserved: tuple[str, ...] = ()  # names that have another meaning in the configuration
    guard: str = ""  # function `module:NAME` that returns a row whose functions raise only errors of imud


class Plugin(NamedTuple):
    """Entry point of another package."""

    package: str  # name and version of the package
    point: "EntryPoint"


@cache
def installed_plugins(search_path: tuple[str, ...]) -> Sequence[Plugin]:
    """Return the entry points for imud of the packages in these folders, by package."""
    # the import of importlib.metadata takes 36 ms, this search 1.5 ms for 100 packages
    if not any(map(_has_plugins, search_path)):
        return ()
    from importlib.metadata import distributions

    found: dict[str, list[Plugin]] = {}
    for one in distributions(path=list(search_path)):
        points = [point for point in one.entry_points if point.group.startswith(_PREFIX)]
        name = str(one.metadata["Name"])
        # Python imports the first of several installations of a package
        if points and name not in found:
            found[name] = [Plugin(f"{name} {one.version}", point) for point in points]
    return [plugin for _, plugins in sorted(found.items()) for plugin in plugins]


def _has_plugins(folder: str) -> bool:
    """Return whether a folder contains the metadata of a package with an entry point for imud."""
    try:
        with os.scandir(folder or ".") as entries:
            metadata = [entry.path for entry in entries if entry.name.endswith((".dist-info", ".egg-info"))]
    except OSError:  # an absent folder, or a zip file
        return False
    return any(map(_names_imud, metadata))


def _names_imud(metadata: str) -> bool:
    try:
        with open(f"{metadata}/entry_points.txt", "rb") as file:
            return f"[{_PREFIX}".encode() in file.read().replace(b" ", b"")
    except OSError:
        return False


def problems_of(table: Mapping[str, Any]) -> Mapping[str, str]:
    """Return the rows of other packages that imud cannot use: the reason and the next step, by name."""
    return table.plugin_problems if isinstance(table, Registry) else {}


class Registry(Mapping[str, T], Generic[T]):
    """Mapping from a name to the object of its row. A new part needs one module and one row. Raises KeyError for an
    unknown name; the message lists the known names.

    A name can come from a configuration, a recording or a peer. It only selects a row of the fixed table, or an entry
    point of an installed package. It is never the name of a module.
    """

    def __init__(self, kind: str, rows: Mapping[str, str], group: PluginGroup | None = None) -> None:
        """Raises ValueError for a row of another form than `module:NAME`."""
        for name, row in rows.items():
            if not PLUGIN_NAME.fullmatch(name) or not ROW.fullmatch(row):
                raise ValueError(f"{kind} {name}: expected a row `module:NAME`, got {row!r}")
        self.kind = kind
        self.rows: Final = MappingProxyType(dict(rows))
        self._group = group

    def __getitem__(self, name: str) -> T:
        if name in self.rows:
            return cast(T, load(self.rows[name]))
        plugins, problems = self._plugins
        if name in plugins:
            return plugins[name]
        known = f"expected one of: {', '.join(sorted(self))}"
        raise KeyError(problems.get(name) or f"no {self.kind} named {name!r}; {known}")

    def __iter__(self) -> Iterator[str]:
        yield from self.rows
        yield from self._plugins[0]

    def __len__(self) -> int:
        return len(self.rows) + len(self._plugins[0])

    @property
    def plugin_problems(self) -> Mapping[str, str]:
        """Rows of `problems_of`."""
        return self._plugins[1]

    @cached_property
    def _plugins(self) -> tuple[dict[str, T], dict[str, str]]:
        """Rows of other packages by name, and the reasons why imud cannot use a row."""
        rows: dict[str, T] = {}
        problems: dict[str, str] = {}
        group = self._group
        if group is None or os.environ.get(PLUGINS_VARIABLE) == "off":
            return rows, problems
        plugins = [one for one in installed_plugins(tuple(sys.path)) if one.point.group == group.name]
        for point in dict.fromkeys(one.point.name for one in plugins):
            same = [one for one in plugins if one.point.name == point]
            problem = self._clash(point, len(same), group)
            if not problem:
                row, problem = _loaded(same[0].point, group)
            if problem:
                packages = " and of ".join(one.package for one in same)
                problems[point] = f"cannot use the {self.kind} {point} of {packages}: {problem}"
            else:
                rows[point] = cast(T, row)
        return rows, problems

    def _clash(self, name: str, count: int, group: PluginGroup) -> str:
        """Return the problem of the name of `count` rows; empty if the name is valid."""
        if name in self.rows:
            return "expected a name that imud does not use, got the name of a row of imud; uninstall the package"
        if count > 1:
            return f"expected one entry point with this name, got {count}; uninstall the other packages"
        if name in group.reserved or not PLUGIN_NAME.fullmatch(name):
            reserved = f", except {', '.join(group.reserved)}" if group.reserved else ""
            return f"expected a name of 1 to 32 characters of a-z, 0-9, _ and -{reserved}; uninstall the package"
        return ""


def _loaded(point: "EntryPoint", group: PluginGroup) -> tuple[Any, str]:
    """Import a row of another package. Return the row and its problem; the problem of a valid row is empty."""
    advice = f"install a version of the package for interface {INTERFACE_VERSION} of imud"
    try:
        found = point.load()
    except BaseException as error:  # noqa: BLE001 - foreign code can raise any exception
        got = f"{type(error).__name__}: {error}"
        return None, f"expected the object {point.value}, got {got}; {advice} and the libraries that the package needs"
    expected, got = "", ""
    row: Any = found
    if not isinstance(found, group.row_type):
        expected, got = f"a {group.row_type.__name__}", f"a {type(found).__name__}"
    elif row.interface != INTERFACE_VERSION:
        expected, got = (
            f"interface={INTERFACE_VERSION}",
            f"interface={row.interface}" if row.interface else "no version",
        )
    elif row.name != point.name:
        expected, got = f"name={point.name!r}", f"name={row.name!r}"
    elif getattr(row, "required", False):
        expected, got = "required=False", "required=True"
    if expected:
        return row, f"expected {expected} at {point.value}, got {got}; {advice}"
    return (load(group.guard)(row) if group.guard else row), ""
