"""Common parts of the targets of stream, CAN and polled codecs: lists of drivers, option combinations, checksums."""

import re
from collections.abc import Callable, Mapping
from itertools import product
from random import Random
from typing import Any, Final, Literal, TypeVar, get_args, get_origin, get_type_hints

from imud import drivers as devices
from imud.contracts.driver import Driver, of_kind
from imud.model.options import Options
from tests.fuzz.target import as_it_is

D = TypeVar("D", bound=Driver)
Mend = Callable[[bytes, Random], bytes]
EXAMPLES: Final = 12


def names_of(kind: type[Driver]) -> list[str]:
    return [driver.name for driver in of_kind(devices.DRIVERS.values(), kind)]


def row(name: str, kind: type[D]) -> D:
    driver = devices.DRIVERS[name]
    assert isinstance(driver, kind)
    return driver


def variants(settings: type[Options]) -> list[Any]:
    """Return options with every combination of the values of choices. The first options are the defaults."""
    hints = get_type_hints(settings)
    choices = {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Literal}
    combinations = [dict(zip(choices, values, strict=True)) for values in product(*choices.values())]
    return [settings(), *(settings(**values) for values in combinations)]


def mender(name: str) -> Mend:
    return _MENDERS.get(name, as_it_is)


def spliced(data: bytes, random: Random, example: bytes) -> bytes:
    """Insert an example into `data` at a random place."""
    at = random.randint(0, len(data))
    return data[:at] + example + data[at:]


def _mend_hipnuc_uart(data: bytes, _random: Random) -> bytes:
    from binascii import crc_hqx

    return _mend_frames(data, b"\x5a\xa5", 2, 6, 4, 2, lambda frame: crc_hqx(frame[6:], crc_hqx(frame[:4], 0)))


def _mend_imu61x_uart(data: bytes, _random: Random) -> bytes:
    from imud.drivers.imu61x.common import crc32

    return _mend_frames(data, b"\xaa\x55", 4, 10, None, 4, lambda frame: crc32(frame[:-4]))


def _mend_frames(
    data: bytes, sync: bytes, length_at: int, overhead: int, crc_at: int | None, crc_bytes: int,
    crc: Callable[[bytes], int],
) -> bytes:  # fmt: skip
    """Correct the checksum of each complete frame. The length field has two bytes, little-endian."""
    mended = bytearray(data)
    at = 0
    for found in re.finditer(re.escape(sync), data):
        begin = found.start()
        end = begin + overhead + int.from_bytes(data[begin + length_at : begin + length_at + 2], "little")
        if begin < at or end > len(data):
            continue
        place = end - crc_bytes if crc_at is None else begin + crc_at
        mended[place : place + crc_bytes] = crc(bytes(mended[begin:end])).to_bytes(crc_bytes, "little")
        at = end
    return bytes(mended)


def mend_reading(name: str, data: bytes) -> bytes:
    """Return the bytes of one transfer with a correct checksum."""
    from imud.drivers.imu61x.common import crc32
    from imud.formats.modbus import crc16_modbus

    if name == "hipnuc-modbus" and len(data) > 2:
        return data[:-2] + crc16_modbus(data[:-2]).to_bytes(2, "little")
    if name == "imu61x-i2c" and len(data) == 32:
        return data[:28] + crc32(data[:28]).to_bytes(4, "little")
    if name == "imu61x-spi" and len(data) == 32:
        words = sum(int.from_bytes(data[at : at + 2], "big") for at in range(4, 28, 2))
        return data[:28] + (words & 0xFFFF).to_bytes(2, "big") + (words >> 16).to_bytes(2, "big")
    if name == "imu61x-spi" and len(data) == 52:
        memory = b"".join(data[at + 1 : at - 1 if at else None : -1] for at in range(4, 52, 2))
        memory = memory[:44] + crc32(memory[:44]).to_bytes(4, "little")
        return data[:4] + b"".join(bytes((memory[at + 1], memory[at])) for at in range(0, 48, 2))
    return data


_MENDERS: Final[Mapping[str, Mend]] = {"hipnuc-uart": _mend_hipnuc_uart, "imu61x-uart": _mend_imu61x_uart}
