"""Transfer scripts of a HiPNUC module on RS-485. Settings are read back after a write where they can be read.

Manual "IMU配置手冊" V1.5.9, section 4.3. Settings are lost at power-off unless `save` follows. A new ID is in force at
once: what comes next goes to the new address. When a new baud rate is in force the manual does not say; saved and
restarted, it is. SET_LV and URFR cannot be read: their confirmation is all there is.
"""

import struct
from collections.abc import Mapping
from enum import Enum
from typing import Final

from imud.contracts.driver import Identity
from imud.contracts.polling import TransferScript
from imud.devices.hipnuc.modbus.frames import (
    NAME_BYTES,
    SERIAL_AT,
    SERIAL_BYTES,
    VERSIONS,
    check_written,
    read_registers,
    registers_of,
    write_register,
)
from imud.devices.hipnuc.modbus.registers import (
    BAUD_RATES,
    BY_NAME,
    ID_MAX,
    IDENTITY_FIRST,
    IDENTITY_REGISTERS,
    BaudRate,
    Register,
)
from imud.devices.hipnuc.uart.commands import AttitudeMode, LevelReset
from imud.errors import BadArgument, DeviceRefused, TransferError

READ_IDENTITY: Final = read_registers(IDENTITY_FIRST, IDENTITY_REGISTERS)
READ_SETTINGS: Final = read_registers(BY_NAME["UART1_BAUD"].address, 3)
SAVE: Final = 0x0000
FACTORY_RESET: Final = 0x0001
RESTART: Final = 0x00FF


class LineMounting(Enum):
    """The five mountings that register URFR has."""

    LEVEL = 0
    Y_DOWN = 1
    Y_UP = 2
    X_UP = 3
    X_DOWN = 4


def probe(_settings: object) -> TransferScript[Identity]:
    """Name, versions and serial number. Raises DeviceRefused for what is no HiPNUC module."""
    words = registers_of((yield READ_IDENTITY), IDENTITY_REGISTERS)
    return identity_of(struct.pack(f">{len(words)}H", *words))


def identity_of(data: bytes) -> Identity:
    """Decode registers 0x70 … 0x83. Raises DeviceRefused where the name is no text."""
    name = data[:NAME_BYTES].rstrip(b"\0 ")
    if not name or any(byte not in range(0x20, 0x7F) for byte in name):
        raise DeviceRefused(f"expected the name of a product at register 0x70, got {data[:NAME_BYTES].hex(' ')}")
    firmware, loader = VERSIONS.unpack_from(data, NAME_BYTES)
    serial = data[SERIAL_AT : SERIAL_AT + SERIAL_BYTES].hex().upper()
    return Identity(name.decode("ascii"), serial, ".".join(str(firmware)), {"BL_VERSION": str(loader)})


def set_up(_settings: object) -> TransferScript[Mapping[str, str]]:
    """Read baud rate, ID and heading mode; nothing is written. Raises DeviceRefused."""
    baud, slave, heading = registers_of((yield READ_SETTINGS), 3)
    return {
        "baud": str(BAUD_RATES[baud]) if baud < len(BAUD_RATES) else f"code {baud}",
        "id": str(slave),
        "heading_mode": {0: "six axes", 1: "nine axes"}.get(heading, f"code {heading}"),
    }


def save() -> TransferScript[None]:
    """Write all settings to flash."""
    return _write(BY_NAME["CTRL"], SAVE)


def factory_reset() -> TransferScript[None]:
    """Restore the factory settings, ID and baud rate included; they are in force after a restart at the latest."""
    return _write_unheard(BY_NAME["CTRL"], FACTORY_RESET)


def restart() -> TransferScript[None]:
    """Restart, as by power-on. No confirmation is documented, so silence is no failure."""
    return _write_unheard(BY_NAME["CTRL"], RESTART)


def set_baud(baud: BaudRate) -> TransferScript[None]:
    """Set the baud rate. Raises DeviceRefused, TransferError."""
    return _write_unheard(BY_NAME["UART1_BAUD"], BAUD_RATES.index(baud))


def set_id(new_id: int) -> TransferScript[None]:
    """Set the address, 1 … 128. The confirmation may come from the old address, the new one, or not at all.

    Raises BadArgument for an address beyond that, which goes by serial number only; DeviceRefused.
    """
    if new_id not in BY_NAME["MD_ID"].values:
        raise BadArgument(f"MD_ID: expected 1 … {ID_MAX}, got {new_id!r}; higher ones go by serial number")
    return _write_unheard(BY_NAME["MD_ID"], new_id)


def set_heading_mode(mode: AttitudeMode) -> TransferScript[None]:
    """Choose six or nine axes."""
    return _write(BY_NAME["HEADING_MODE"], mode.value)


def set_mounting(mounting: LineMounting) -> TransferScript[None]:
    """Set the mounting of the module."""
    return _write(BY_NAME["URFR"], mounting.value)


def auto_level(kind: LevelReset) -> TransferScript[None]:
    """Make the present attitude level, or cancel that. The module must be at rest."""
    return _write(BY_NAME["SET_LV"], kind.value)


def read(register: Register) -> TransferScript[tuple[int, ...]]:
    """The words of one register. Raises DeviceRefused, TransferError."""
    return registers_of((yield read_registers(register.address, register.count)), register.count)


def _write(register: Register, value: int) -> TransferScript[None]:
    """Write, and read back what can be read. Raises DeviceRefused, TransferError."""
    request = write_register(register.address, value)
    check_written((yield request), request)
    if "R" in register.access:
        (now,) = yield from read(register)
        if now != value:
            raise DeviceRefused(f"{register.name}: wrote {value}, the module has {now}")


def _write_unheard(register: Register, value: int) -> TransferScript[None]:
    """Write a setting that may change where the module answers. Raises DeviceRefused for an exception only."""
    request = write_register(register.address, value)
    try:
        reply = yield request
    except TransferError:
        return
    check_written(reply, request)
