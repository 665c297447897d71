"""Every item of both manuals has code and a test, and the account that says so can fail."""

import re

from tests.audit.__main__ import ITEMS, count, report
from tests.audit.descriptions import described
from tests.audit.item import Item, faults, marks


def test_every_item_has_code_and_a_test() -> None:
    assert list(faults(ITEMS, marks())) == []


def test_keys_are_in_the_order_of_their_manual_and_stand_once() -> None:
    from tests.audit.manual_a import MANUAL_A
    from tests.audit.manual_b import MANUAL_B

    for letter, manual in (("A", MANUAL_A), ("B", MANUAL_B)):
        keys = [item.key for item in manual]
        assert len(set(keys)) == len(keys)
        assert all(re.match(rf"{letter} \d+(\.\d+)* \S", key) or re.match(rf"{letter} \d+ \S", key) for key in keys)
        numbers = [[int(part) for part in key.split(" ")[1].split(".")] for key in keys]
        assert numbers == sorted(numbers)


def test_a_section_that_a_driver_describes_has_items() -> None:
    """A command or setting whose section has no item here would escape the account."""
    sections = {item.section for item in ITEMS.values()}
    unknown = {section for section in described() if not any(known.startswith(section) for known in sections)}
    assert unknown == set()


def test_what_is_missing_is_told() -> None:
    items = {
        "B 1 a": Item("B 1 a", "", "units:NS_PER_S"),
        "B 1 b": Item("B 1 b", "", "units:NOTHING"),
        "B 1 c": Item("B 1 c", "", "nowhere:NOTHING"),
        "B 1 d": Item("B 1 d", "", left="it is wiring"),
        "B 1 e": Item("B 1 e", "", "units:NS_PER_S"),
    }
    marked = {"B 1 b": ["x"], "B 1 c": ["x"], "B 1 d": ["x"], "B 1 e": ["x"], "B 9 z": ["test_x.py::test_z"]}
    assert list(faults(items, marked)) == [
        "B 1 a: no test has a mark for it",
        "B 1 b: no units:NOTHING in imud",
        "B 1 c: no nowhere:NOTHING in imud",
        "B 1 d: left, although it has code or a test",
        "B 9 z: no such item, although test_x.py::test_z has a mark for it",
    ]


def test_the_report_names_all() -> None:
    text = "\n".join(report(marks()))
    assert "test  devices/hipnuc/uart/test_codec.py::test_manual_hi91" in text
    assert "described by hipnuc-uart: action mode (axes)" in text
    assert re.fullmatch(
        r"Forsense IMU61x: \d+ of \d+ items have code and a test, \d+ left with a reason", count("A", {})
    )
