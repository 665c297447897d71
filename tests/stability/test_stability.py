"""Test that the interfaces of docs/stability.md are equal to their stored facts."""

import re

import pytest

from imud.fleet.messages import CommandRequest
from tests.stability.facts import INPUT, OUTPUT, module_facts, type_facts
from tests.stability.interfaces import INTERFACES, database, series
from tests.stability.snapshots import FOLDER, VERSION, advice, changes, present, problem, stored


@pytest.mark.parametrize("name", INTERFACES)
def test_an_interface_is_as_stored(name: str) -> None:
    interface = INTERFACES[name]
    text = advice(name, interface, stored(name), present(interface))
    if text:
        pytest.fail(text, pytrace=False)


def test_each_file_belongs_to_an_interface() -> None:
    assert {file.stem for file in FOLDER.glob("*.txt")} == INTERFACES.keys()


def test_only_an_incompatible_change_needs_another_version() -> None:
    before = {VERSION: "1", "a": "optional, integer", "b": "member"}
    for after, words in (
        (before | {"c": "optional, integer"}, []),
        (before | {"a.c": "required, integer"}, ["added    a.c: required, integer"]),
        (before | {"c": "required, integer"}, ["added    c: required, integer"]),
        (before | {"c": "function", "c(x)": "required, integer"}, []),
        (before | {"a": "optional, string"}, ["changed  a: optional, integer  ->  optional, string"]),
        ({VERSION: "1", "a": "optional, integer"}, ["removed  b: member"]),
    ):
        assert [str(one) for one in changes(before, after) if not one.is_compatible] == words
        assert problem(before, after, "X").partition(",")[0] == ("incompatible changes: 1" if words else "")
        assert problem(before, after | {VERSION: "2"}, "X") == ""
        text = advice("socket", INTERFACES["socket"], before, after)
        assert all(f"  incompatible: {one}" in text for one in words)
        assert ("increment PROTOCOL in imud/formats/jsonrpc.py" in text) == bool(words)


def test_a_release_series_is_the_part_that_an_incompatible_change_increments() -> None:
    assert [series(version) for version in ("0.1.0", "0.1.7", "0.2.0.dev1", "1.0.0", "1.4.2")] == [
        "0.1", "0.1", "0.2", "1", "1",
    ]  # fmt: skip


def test_facts_of_a_module_are_its_public_names() -> None:
    facts = module_facts("imud.client")
    assert facts["imud.client.Client.watch(rate_hz)"].startswith("optional, place 3: float | None")
    assert facts["imud.client.Client.call(method)"] == "required, place 1: str"
    assert facts["imud.client.Client.discarded"] == "attribute"
    assert not [name for name in facts if "._" in name.replace("__", "")]
    assert module_facts("imud.contracts.codec")["imud.contracts.codec.StreamCodec.feed"].startswith("required method")


def test_facts_of_a_type_differ_for_input_and_output() -> None:
    facts = type_facts(CommandRequest, "request", INPUT)
    assert (facts["request.v"], facts["request.arguments"]) == ("required, integer", "optional, object")
    assert type_facts(CommandRequest, "request", OUTPUT)["request.v"] == "always, integer"


UNIT_OF = {
    "m_s2": "m/s²", "rad_s": "rad/s", "m_s": "m/s", "rad": "rad", "t": "T", "c": "°C", "pa": "Pa", "m": "m", "ns": "ns",
    "ms": "ms", "s": "s", "bytes": "bytes",
}  # fmt: skip


def test_the_name_of_a_column_of_the_database_ends_in_its_unit() -> None:
    for name, text in database().items():
        unit = text.partition(", ")[2] if "." in name else ""
        end = re.search(rf"_({'|'.join(UNIT_OF)}|ns)$", name)
        assert unit in (("",) if end is None else ("ns", "ns since 1970") if end[1] == "ns" else (UNIT_OF[end[1]],)), (
            name
        )
