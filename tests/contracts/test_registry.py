"""Each row of each registry refers to an object of that name. An error for a wrong name contains the valid names.

A row of another package that imud cannot use disables only itself.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from imud.config import Tables, parse
from imud.contracts.driver import Driver
from imud.contracts.link import LinkType
from imud.contracts.publisher import PublisherType
from imud.contracts.registry import INTERFACE_VERSION, PluginGroup, Registry, problems_of
from imud.drivers import DRIVERS
from imud.links import LINKS
from imud.model.errors import ConfigError
from imud.publishers import PUBLISHERS
from tests.support.plugin_package import write_package

TABLES: list[tuple[Registry[Any], type]] = [(DRIVERS, Driver), (LINKS, LinkType), (PUBLISHERS, PublisherType)]


@pytest.mark.parametrize(("table", "kind"), TABLES, ids=lambda value: getattr(value, "kind", ""))
def test_rows_lead_to_objects_that_know_their_name(table: Registry[Any], kind: type) -> None:
    assert len(table) > 0
    for name, row in table.items():
        assert isinstance(row, kind)
        assert row.name == name  # type: ignore[attr-defined]  # every kind of row has one


def test_rows_are_imported_on_first_use_and_unknown_names_list_the_known_ones() -> None:
    table: Registry[object] = Registry("thing", {"bad": "imud.no_such_module:X", "good": "imud.model.units:NS_PER_S"})
    assert table["good"] == 1_000_000_000
    with pytest.raises(ModuleNotFoundError):
        table["bad"]
    with pytest.raises(KeyError, match=r"no driver named 'bno055'; expected one of: .*hipnuc-uart"):
        DRIVERS["bno055"]


@dataclass(frozen=True)
class Row:
    """A row of another package."""

    name: str
    interface: int = INTERFACE_VERSION
    required: bool = False


class Foreign(NamedTuple):
    """A registry and the folder of the packages that it reads."""

    folder: Path
    monkeypatch: pytest.MonkeyPatch

    def add(self, package: str, points: dict[str, str], text: str = "", folder: str = "site") -> None:
        module = f"{package.replace('-', '_')}_{self.folder.name}"
        head = f"from {__name__} import Row\n" if "Row" in text else ""
        rows = {name: f"{module}:{value}" for name, value in points.items()}
        write_package(self.folder / folder, package, {"imud.things": rows}, {f"{module}.py": head + text})
        self.monkeypatch.syspath_prepend(str(self.folder / folder))

    def read(self) -> Registry[Row]:
        return Registry("thing", {"own": f"{__name__}:OWN"}, PluginGroup("imud.things", Row, reserved=("auto",)))


OWN = Row("own")


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Foreign:
    monkeypatch.delenv("IMUD_PLUGINS")
    return Foreign(tmp_path, monkeypatch)


def test_rows_of_other_packages_are_read_once_unless_imud_finds_the_name_in_its_own_rows(foreign: Foreign) -> None:
    foreign.add("one", {"a": "A", "old": "A"}, "A = Row('a')")
    foreign.add("one", {"a": "A"}, "A = Row('a')", "a-second-installation-of-the-same-package")
    table = foreign.read()
    assert table["own"] is OWN
    assert "_plugins" not in vars(table), "a row of imud needs no entry points"
    assert ([*table], len(table), table["a"], table.get("b")) == (["own", "a"], 2, Row("a"), None)
    assert table["a"] is table["a"]
    assert (table.plugin_problems, problems_of(table), problems_of({})) == ({}, {}, {})
    foreign.add("two", {"b": "B"}, "B = Row('b')")
    assert [*table] == ["own", "a"]
    assert [*foreign.read()] == ["own", "a", "b"]
    foreign.monkeypatch.setenv("IMUD_PLUGINS", "off")
    assert [*foreign.read()] == ["own"]
    assert "importlib.metadata" in sys.modules


HEAD = "cannot use the thing {} of bad-one 1.0: expected "
TAIL = "; install a version of the package for interface 1 of imud"
PATTERN = "a name of 1 to 32 characters of a-z, 0-9, _ and -, except auto; uninstall"
BROKEN = {
    "no module": ("x", "import nowhere", "the object MODULE:X, got ModuleNotFoundError: No module named 'nowhere'"),
    "no object": ("x", "Y = 1", "the object MODULE:X, got AttributeError: module 'MODULE' has no attribute 'X'"),
    "end": ("x", "raise SystemExit('bye')", "the object MODULE:X, got SystemExit: bye"),
    "type": ("x", "X = 1", "a Row at MODULE:X, got a int"),
    "no version": ("x", "X = Row('x', 0)", "interface=1 at MODULE:X, got no version"),
    "version": ("x", "X = Row('x', 2)", "interface=1 at MODULE:X, got interface=2"),
    "other name": ("x", "X = Row('y')", "name='x' at MODULE:X, got name='y'"),
    "required": ("x", "X = Row('x', required=True)", "required=False at MODULE:X, got required=True"),
    "own": ("own", "X = Row('own')", "a name that imud does not use, got the name of a row of imud; uninstall"),
    "reserved": ("auto", "X = Row('auto')", PATTERN),
    "characters": ("X y", "X = Row('X y')", PATTERN),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_a_row_that_imud_cannot_use_has_a_reason_and_changes_no_other_row(foreign: Foreign, case: str) -> None:
    name, text, reason = BROKEN[case]
    foreign.add("good", {"a": "A"}, "A = Row('a')")
    foreign.add("bad-one", {name: "X", "b": "B"}, f"B = Row('b')\n{text}")
    table = foreign.read()
    found = problems_of(table)[name]
    module = f"bad_one_{foreign.folder.name}"
    wanted = HEAD.format(name) + reason.replace("MODULE", module)
    assert found.startswith(wanted)
    assert "uninstall" in reason or TAIL in found
    imported = case not in ("no module", "end")
    assert [*table] == ["own"] + ["b"] * imported + ["a"]
    assert table["own"] is OWN
    if name != "own":
        assert table.get(name) is None
        with pytest.raises(KeyError) as error:
            table[name]
        assert error.value.args == (found,)


def test_two_packages_with_one_name_are_both_rejected(foreign: Foreign) -> None:
    for package in ("one", "two"):
        foreign.add(package, {"a": "A"}, "A = Row('a')")
    assert problems_of(foreign.read()) == {
        "a": "cannot use the thing a of one 1.0 and of two 1.0: expected one entry point with this name, got 2; "
        "uninstall the other packages"
    }


def test_a_configuration_ignores_devices_and_outputs_of_packages_with_a_problem(foreign: Foreign) -> None:
    foreign.add("bad", {"x": "X", "y": "X"}, "X = 1")
    drivers: Any = Registry("driver", {}, PluginGroup("imud.things", Row))
    outputs: Any = Registry("output", {}, PluginGroup("imud.things", Row))
    text = """
devices:
  bow: {driver: x, uart: {port: /dev/a}, anything: 1}
  mast: {uart: {port: /dev/b}}
y: {enabled: true}
"""
    read = parse(text, "f.yaml", Tables(drivers, LINKS, outputs))
    assert [device.name for device in read.devices] == ["mast"]
    assert [line.partition(": expected")[0] for line in read.ignored] == [
        "f.yaml:5:4: y: imud ignores this output: cannot use the output y of bad 1.0",
        "f.yaml:3:17: devices.bow.driver: imud ignores this device: cannot use the driver x of bad 1.0",
        "cannot use the driver y of bad 1.0",
        "cannot use the output x of bad 1.0",
    ]
    with pytest.raises(ConfigError, match='expected a driver that imud knows, got "w"'):
        parse(text.replace("driver: x", "driver: w"), "f.yaml", Tables(drivers, LINKS, outputs))
