"""Kinds of host objects that values of the configuration name."""

from collections.abc import Iterator
from typing import Final

import msgspec
from msgspec import inspect

from imud.config.schema import TABLES

# Names of keys with a path, an address or a group. Each such key must state the kind of its value.
PATH_NAMES: Final = ("_file", "directory", "_dir", "address", "group", "chip", "serial_port", "chrony")


def test_every_path_of_the_configuration_states_its_kind() -> None:
    """A new key with such a name, and text as its value, has a type of `imud.model.host_object`."""
    schemas: list[type[msgspec.Struct]] = [row.settings for row in TABLES.publishers.values()]
    schemas.extend(row.settings for row in TABLES.links.values())
    missing = []
    while schemas:
        info = inspect.type_info(schemas.pop())
        assert isinstance(info, inspect.StructType)
        for field in info.fields:
            encoded = str(field.type)
            is_path = field.name.endswith(PATH_NAMES) and "StrType" in encoded
            if is_path and "HostObject" not in encoded:
                missing.append(f"{info.cls.__name__}.{field.name}")
            schemas += [choice.cls for choice in _structs(field.type)]
    assert missing == []


def _structs(info: inspect.Type) -> Iterator[inspect.StructType]:
    if isinstance(info, inspect.StructType):
        yield info
    for name in ("types", "type", "item_type", "key_type", "value_type"):
        inner = getattr(info, name, None)
        for part in inner if isinstance(inner, tuple) else (inner,):
            if isinstance(part, inspect.Type):
                yield from _structs(part)
