"""Checks of arguments: the value comes back, or an error that names what was expected."""

from enum import Enum

import pytest

from imud.devices.arguments import listed, member, one_of
from imud.errors import BadArgument


class Colour(Enum):
    RED = 1
    BLUE = 2


def test_what_fits_comes_back() -> None:
    assert member("colour", Colour.RED, Colour) is Colour.RED
    assert one_of("rate", 5, (1, 5)) == 5


@pytest.mark.parametrize("value", [1, "RED", None])
def test_a_bare_value_is_no_member(value: object) -> None:
    with pytest.raises(BadArgument, match=r"colour: expected one of Colour.RED, Colour.BLUE, got"):
        member("colour", value, Colour)  # type: ignore[type-var]  # what the check is for


@pytest.mark.parametrize("value", [2, True, 1.0, "1"])
def test_only_whole_numbers_of_the_list_fit(value: object) -> None:
    with pytest.raises(BadArgument, match="rate: expected one of 1, 5, got"):
        one_of("rate", value, (5, 1))  # type: ignore[arg-type]  # what the check is for


def test_listed() -> None:
    assert listed(range(3)) == "0, 1, 2"
