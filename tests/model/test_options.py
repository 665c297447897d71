"""Error texts of wrong values, for every structure that users fill: configuration, options, arguments."""

import re
from collections.abc import Iterator
from typing import Annotated, Any

import msgspec
import pytest
from msgspec import Meta

from docs.generate import references
from imud.contracts.lines import LINE_SCHEMAS
from imud.drivers import DRIVERS
from imud.model.options import Options, WrongValue, wrong_values
from imud.publishers.socket.methods import METHODS

LEAKS = re.compile(r"`|\$|Object|missing required|ValidationError|<class|Expected|NoneType|\bstr\b|\bint\b|\bfloat\b")
"""Words of msgspec and of Python that a user does not know."""
WRONG: tuple[Any, ...] = (
    None, True, -1, 10**30, 1.5, -1e9, "", "no such word", "a\nb", [], [1], ["x"], [None], [[1]], {}, {"a": 1},
    {"a": {"b": [1]}},
)  # fmt: skip


def schemas() -> Iterator[Any]:
    """Yield all structures that imud fills with values of the user."""
    for title, _, schema in references.settings_parts():
        yield pytest.param(schema, id=title)
    for name, schema in LINE_SCHEMAS.items():
        yield pytest.param(schema, id=f"line {name}")
    for name, driver in DRIVERS.items():
        for action, one in driver.verbs.items():
            yield pytest.param(one.parameters, id=f"{name} {action}")
        if driver.device_settings is not None:
            yield pytest.param(driver.device_settings.declarable, id=f"{name} settings")
    for name, method in METHODS.items():
        yield pytest.param(method.params, id=f"method {name}")


@pytest.mark.parametrize("schema", list(schemas()))
def test_every_wrong_value_is_described_in_words(schema: type[msgspec.Struct]) -> None:
    names = schema.__struct_fields__
    whole: list[dict[str, Any]] = [{"no_such_name": 1}, dict.fromkeys(names), {}]
    for given in (*whole, *({name: wrong} for name in names for wrong in WRONG)):
        for problem in wrong_values(schema, given):
            assert not LEAKS.search(problem.message), (given, str(problem))
            assert problem.message.startswith("expected "), (given, str(problem))


class Trip(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    rate_hz: Annotated[float, Meta(gt=0)]
    names: tuple[str, ...] = ()
    groups: dict[str, list[int]] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.names == ("both",):
            raise ValueError("names: expected one or many, got both")
        if self.names == ("none",):
            raise ValueError("this cannot be")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"rate_hz": 1}, []),
        ({}, [("", "expected the word rate_hz (a number above 0), got none")]),
        ({"rate_hz": "x"}, [("rate_hz", 'expected a number above 0, got "x"')]),
        ({"rate_hz": 1, "names": ["a", 2]}, [("names", "expected a list, each item text, got a list with 2 at [1]")]),
        (
            {"rate_hz": 1, "groups": {"a": 5}},
            [("groups", "expected keys, each with a list, each item a whole number, got keys and values")],
        ),
        (
            {"rate_hz": 1, "rate": 2},
            [("", 'expected a word that imud knows, got "rate"; did you mean rate_hz? known: groups, names, rate_hz')],
        ),
        (
            {"rate_hz": None, "names": None},
            [
                ("rate_hz", "expected a number above 0, got nothing"),
                ("names", "expected a list, each item text, got nothing"),
            ],
        ),
        ({"rate_hz": 1, "names": ["both"]}, [("names", "expected one or many, got both")]),
        ({"rate_hz": 1, "names": ["none"]}, [("", "this cannot be")]),
    ],
)  # fmt: skip
def test_wrong_values(given: dict[str, Any], expected: list[tuple[str, str]]) -> None:
    assert wrong_values(Trip, given, "word") == [WrongValue(*one) for one in expected]
