"""Each row of each registry refers to an object of that name. An error for a wrong name contains the valid names."""

from typing import Any

import pytest

from imud.contracts.driver import Driver
from imud.contracts.link import LinkType
from imud.contracts.publisher import PublisherType
from imud.contracts.registry import Registry
from imud.drivers import DRIVERS
from imud.links import LINKS
from imud.publishers import PUBLISHERS

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
