"""What holds for every table of fields in shared memory."""

import struct
from collections.abc import Iterable

from imud.formats.slot import SlotField


def check_layout(fields: Iterable[SlotField], size_bytes: int) -> None:
    """Each field begins where the one before it ends, on a multiple of its size; together they fill the record."""
    at = 0
    for field in fields:
        assert field.offset == at, field.name
        size = struct.calcsize("<" + field.code)
        assert field.offset % size == 0, f"{field.name} is not aligned to its size"
        at += size * field.count
    assert at == size_bytes
