"""Which parts a run of `make bench` has; the measurements themselves are no part of `make test`."""

from importlib import import_module
from inspect import signature

import pytest

from tests.bench.__main__ import PARTS, parts_of
from tests.bench.writer import sentence


def test_the_short_form_has_all_parts_but_those_of_the_lab() -> None:
    assert parts_of(short=False) == PARTS
    assert set(PARTS) - set(parts_of(short=True)) == {"can"}


@pytest.mark.parametrize("part", PARTS)
def test_every_part_has_rows_that_can_be_quick(part: str) -> None:
    assert "quick" in signature(import_module(f"tests.bench.{part}").rows).parameters


def test_gpsd_gets_sentences_of_19_fields_with_their_check_value() -> None:
    """With fewer it takes no attitude from $OHPR. The sum by hand: the XOR of all between $ and *."""
    text = sentence(123).decode()
    assert text.startswith("$OHPR,12.3,-2.5,1.3,")
    assert text.endswith("\r\n")
    body, check = text[1:].rstrip().split("*")
    assert len(body.split(",")) == 19
    total = 0
    for character in body:
        total ^= ord(character)
    assert int(check, 16) == total
