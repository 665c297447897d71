"""Items of the manuals: the reaction of imud to each item, its place in the code, its tests, and its drivers.

A test names its items with a mark, `@pytest.mark.manual("B 2.2.3 SERIALCONFIG", …)`, or the row of an item names its
tests. The audit reads marks and names from the source of the tests, without imports.
"""

import ast
import importlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import msgspec

from imud.contracts.driver import Driver
from imud.drivers import DRIVERS

TESTS: Final = Path(__file__).parents[1]
MARK: Final = "manual"


@dataclass(frozen=True, slots=True)
class Item:
    key: str
    """Letter of the manual, section, and a short name; as in the marks."""
    words: str
    code: str
    """`module:name` below `imud` of the code for the item, or `left:` and the reason why imud does not implement it."""
    tests: tuple[str, ...] = ()
    """Tests of the item as `path::name`, in addition to the tests with its mark."""

    @property
    def left(self) -> str:
        """Reason why imud does not implement the item; empty for an implemented item."""
        return self.code.partition("left: ")[2]

    @property
    def section(self) -> str:
        """Letter and number, for example `B 2.2.3`."""
        return " ".join(self.key.split(" ")[:2])

    @property
    def code_exists(self) -> bool:
        """Return whether the name in `code` exists."""
        module, _, name = self.code.partition(":")
        try:
            return hasattr(importlib.import_module(f"imud.{module}"), name)
        except ImportError:
            return False


def item_of(row: str) -> Item:
    """Return the item of a row: key | words | code | tests. The tests are optional."""
    key, words, code, *tests = map(str.strip, row.split("|"))
    return Item(key, words, code, tuple(test for names in tests for test in names.split()))


def evidence_of(items: Iterable[Item]) -> dict[str, list[str]]:
    """Return the existing tests by the key of each item: tests with its mark, and tests in its row."""
    found = {key: list(tests) for key, tests in marks().items()}
    for item in items:
        if tests := [test for test in item.tests if test in _marks_by_test()]:
            found.setdefault(item.key, []).extend(tests)
    return found


@cache
def marks() -> dict[str, list[str]]:
    """Return the tests, as `path::name`, by the key of each item that they have a mark for."""
    found: dict[str, list[str]] = {}
    for test, keys in _marks_by_test().items():
        for key in keys:
            found.setdefault(key, []).append(test)
    return found


@cache
def _marks_by_test() -> dict[str, tuple[str, ...]]:
    """Return the keys in the marks of each test."""
    found: dict[str, tuple[str, ...]] = {}
    for path in sorted(TESTS.rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_"):
                keys = tuple(key for decorator in node.decorator_list for key in _keys(decorator))
                found[f"{path.relative_to(TESTS)}::{node.name}"] = keys
    return found


def _keys(decorator: ast.expr) -> Iterator[str]:
    """The arguments of `pytest.mark.manual(…)`; none for any other decorator."""
    if isinstance(decorator, ast.Call) and isinstance(decorator.func, ast.Attribute) and decorator.func.attr == MARK:
        for argument in decorator.args:
            assert isinstance(argument, ast.Constant), "a mark has its keys as they are, so that they can be read"
            yield str(argument.value)


def faults(items: Mapping[str, Item], marked: Mapping[str, list[str]]) -> Iterator[str]:
    """Yield the faults of the account, one line each: items without code or tests, marks without an item."""
    for key, item in items.items():
        if item.left and key in marked:
            yield f"{key}: left, although it has a test"
        if item.left:
            continue
        if not item.code_exists:
            yield f"{key}: no {item.code} in imud"
        if key not in marked:
            yield f"{key}: no test"
        yield from (f"{key}: no test {test}" for test in item.tests if test not in _marks_by_test())
    for key, tests in marked.items():
        if key not in items:
            yield f"{key}: no such item, although {tests[0]} has a mark for it"


MANUALS: Final = {"imu61x": "A", "hipnuc": "B"}
"""Letter of the manual by the first word of a driver's name."""
_SECTION: Final = re.compile(r"^(\d+(?:\.\d+)*)")


def described() -> dict[str, list[str]]:
    """Return the descriptions of the drivers by section, for example `B 2.2.4: hipnuc-uart: action mode (axes)`."""
    found: dict[str, list[str]] = {}
    for driver in DRIVERS.values():
        letter = MANUALS[driver.name.partition("-")[0]]
        for section, words in _of(driver):
            if match := _SECTION.match(section):
                found.setdefault(f"{letter} {match[1]}", []).append(f"{driver.name}: {words}")
    return found


def _of(driver: Driver) -> Iterator[tuple[str, str]]:
    for name, action in driver.verbs.items():
        for field in msgspec.structs.fields(action.parameters):
            if section := _section(field.type):
                yield section, f"action {name} ({field.name})"
    for kind, calibration in driver.calibrations.items():
        yield calibration.section, f"calibration {kind}"
    if driver.device_settings is not None:
        for name, setting in driver.device_settings.table.items():
            yield _section(setting.type), f"setting {name}"


def _section(annotated: Any) -> str:
    info = msgspec.inspect.type_info(annotated)
    extra = info.extra if isinstance(info, msgspec.inspect.Metadata) else None
    return str((extra or {}).get("section", ""))
