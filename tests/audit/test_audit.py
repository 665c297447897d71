"""Every item of both manuals and of newer firmware has code and a test."""

import re

from tests.audit import manuals, newer
from tests.audit.__main__ import ITEMS
from tests.audit.item import described, evidence_of, faults


def test_every_item_has_code_and_a_test() -> None:
    assert list(faults(ITEMS, evidence_of(ITEMS.values()))) == []


def test_keys_are_in_the_order_of_their_manual_and_stand_once() -> None:
    assert len(ITEMS) == len(manuals.ITEMS) + len(newer.ITEMS)
    assert all(re.match(r"[ABC] \d+(\.\d+)* \S", key) for key in ITEMS)
    numbers = [(key[0], [int(part) for part in key.split(" ")[1].split(".")]) for key in ITEMS]
    assert numbers == sorted(numbers)


def test_a_section_that_a_driver_describes_has_items() -> None:
    """A command or setting whose section has no item here would escape the account."""
    sections = {item.section for item in ITEMS.values()}
    unknown = {section for section in described() if not any(known.startswith(section) for known in sections)}
    assert unknown == set()
