"""Keys of the GPIO lines of a device, as in docs/configuration.md."""

import pytest

from imud.contracts.lines import LINE_SCHEMAS
from imud.contracts.status import Deviations
from tests.support.documented import check_schema


@pytest.mark.parametrize("name", LINE_SCHEMAS)
def test_keys_of_a_line_accept_the_documented_values(name: str) -> None:
    check_schema(f"Line `{name}`", LINE_SCHEMAS[name])


def test_deviations_are_above_zero() -> None:
    assert check_schema("Noise of a device", Deviations) == 6
