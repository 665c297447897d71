"""Error texts of wrong values, for every structure that users fill: configuration, options, arguments."""

import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta

from docs.generate.settings_parts import settings_parts
from imud.contracts.lines import LINE_SCHEMAS
from imud.drivers import DRIVERS
from imud.model.options import Options, WrongValue, expected, got, is_host, json_or_text, value_problem, wrong_values
from imud.publishers.socket.methods import METHODS

LEAKS = re.compile(r"`|\$|Object|missing required|ValidationError|<class|Expected|NoneType|\bstr\b|\bint\b|\bfloat\b")
"""Words of msgspec and of Python that a user does not know."""
WRONG: tuple[Any, ...] = (
    None, True, -1, 10**30, 1.5, -1e9, "", "no such word", "a\nb", [], [1], ["x"], [None], [[1]], {}, {"a": 1},
    {"a": {"b": [1]}},
)  # fmt: skip


def schemas() -> Iterator[Any]:
    """Yield all structures that imud fills with values of the user."""
    for title, _, schema in settings_parts():
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
        if self.names == ("rate",):
            raise ValueError("rate: this cannot be")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"rate_hz": 1}, []),
        ({}, [("", "expected the word rate_hz (a number above 0), got none")]),
        ({"rate_hz": "x"}, [("rate_hz", 'expected a number above 0, got "x"')]),
        ({"rate_hz": 1, "names": ["a", 2]}, [("names", "expected a list, each item text, got a list with 2 at [1]")]),
        ({"rate_hz": 1, "groups": {"a": 5}},
         [("groups", "expected keys, each with a list, each item a whole number, got keys and values")]),
        ({"rate_hz": 1, "rate": 2},
         [("", 'expected a word that imud knows, got "rate"; did you mean rate_hz? known: groups, names, rate_hz')]),
        (
            {"rate_hz": None, "names": None},
            [("rate_hz", "expected a number above 0, got nothing"),
             ("names", "expected a list, each item text, got nothing")],
        ),
        ({"rate_hz": 1, "names": ["both"]}, [("names", "expected one or many, got both")]),
        ({"rate_hz": 1, "names": ["none"]}, [("", "this cannot be")]),
        ({"rate_hz": 1, "names": ["rate"]}, [("", "rate: this cannot be")]),
    ],
)  # fmt: skip
def test_wrong_values(given: dict[str, Any], expected: list[tuple[str, str]]) -> None:
    assert wrong_values(Trip, given, "word") == [WrongValue(*one) for one in expected]


@pytest.mark.parametrize(
    ("field_type", "words"),
    [
        (bool, "true or false"), (int, "a whole number"), (float | None, "a number, or null"), (str, "text"),
        (Annotated[float, Meta(gt=0, lt=2.5)], "a number above 0 below 2.5"),
        (Annotated[str, Meta(pattern="^x")], "text matching ^x"), (dict[str, int], "keys, each with a whole number"),
        (
            Trip, "the keys rate_hz (a number above 0), names (a list, each item text), groups (keys, each with a "
            "list, each item a whole number)",
        ),
        (Annotated[int, Meta(ge=0, le=3)] | None, "a whole number from 0 to 3, or null"),
        (Annotated[int, Meta(ge=-4_000_000)], "a whole number from -4000000"),
        (list[bool], "a list, each item true or false"),
        (Annotated[list[int], Meta(min_length=2, max_length=2)], "a list of 2, each item a whole number"),
        (Annotated[list[int], Meta(min_length=2)], "a list of at least 2, each item a whole number"),
        (Annotated[list[int], Meta(min_length=1, max_length=3)], "a list of 1 to 3, each item a whole number"),
        (Annotated[list[int], Meta(max_length=3)], "a list of 0 to 3, each item a whole number"),
        (Literal["2 Hz", "10 Hz", 5], 'one of 5, "2 Hz", "10 Hz"'),
        (Literal["auto"], '"auto"'),
        (dict[str, Any], "keys, each with any value"),
        (dict[Literal["b", "a"], int], "keys a, b, each with a whole number"),
        (Annotated[str, Meta(min_length=1)], "text that is not empty"),
        (Annotated[str, Meta(pattern="^/", extra={"words": "an absolute path"})], "an absolute path"),
    ],
)  # fmt: skip
def test_types_in_words(field_type: Any, words: str) -> None:
    assert expected(field_type) == words


def test_the_place_of_a_wrong_part() -> None:
    assert value_problem([1, "x"], list[int]).endswith(' with "x" at [1]')
    assert value_problem(["", 1], list[int]).endswith(' with "" at [0]')
    assert value_problem({"rate_hz": 1, "names": ["a", 2]}, Trip).endswith(" with 2 at names[1]")
    assert value_problem({"rate_hz": 0}, Trip | None) == "rate_hz: expected a number above 0, got 0"
    words = 'expected a number above 0, got "x", at "a.rate_hz"'
    assert value_problem({"b": {"rate_hz": 1}, "a": {"rate_hz": "x"}}, dict[str, Trip]) == words
    assert value_problem({"a": {}}, dict[str, Trip]).endswith(' (a number above 0), got none, at "a"')


def test_the_text_of_a_value_is_short_and_printable_and_a_text_can_be_json() -> None:
    assert got("a" * 60) == got("a" * 61) == '"' + "a" * 60 + '"'
    words = ["nothing", "true", "1.5", '"x"', "a list", "keys and values"]
    assert [got(v) for v in (None, True, 1.5, "x", [1], {"a": 1})] == words
    assert got("é\u2028\x9f") == '"é\\u2028\\u009f"'
    texts = ("1", "true", "[1]", '"1"', "6-axis", "")
    assert [json_or_text(text) for text in texts] == [1, True, [1], "1", "6-axis", ""]


@pytest.mark.parametrize(
    ("text", "is_valid"),
    [
        ("gateway.example", True), ("gateway.example.", True), ("::1", True), ("192.0.2.1", True), ("a", True),
        ("192.0.2.256", False), ("a.1", False), ("-a", False), ("a-", False), ("a..b", False), ("", False),
        ("a" * 63, True), ("a" * 64, False),
        (".".join(["a" * 63] * 3) + "." + "a" * 61, True), (".".join(["a" * 63] * 3) + "." + "a" * 62, False),
    ],
)  # fmt: skip
def test_hosts_have_at_most_253_characters_and_labels_63(text: str, is_valid: bool) -> None:
    assert is_host(text) == is_valid
