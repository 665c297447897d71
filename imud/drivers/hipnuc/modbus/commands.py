"""Transfer scripts of a HiPNUC module on RS-485. Settings are read back after a write where they can be read.

Manual "IMU配置手冊" V1.5.9, section 4.3. Settings are lost at power-off unless `save` follows. A new address is in
force at once by section 4.3.3; a module in which it waits for saving and restarting is dealt with too. When a new baud
rate is in force the manual does not say; saved and restarted, it is. SET_LV and URFR cannot be read: their confirmation
is all there is.

The scripts after which a module can have another address (`change_address`, `restart`, `factory_reset`) follow it by
`Transfer.then_at`. They ask before whether another module is there; which one answers is known by its serial number.
"""

import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from enum import Enum
from typing import Final

from imud.contracts.command import Target
from imud.contracts.driver import Identity
from imud.contracts.script import TransferScript
from imud.contracts.setting import Written
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.modbus.registers import (
    BAUD_RATES,
    BY_NAME,
    FACTORY_BAUD,
    FACTORY_ID,
    ID_MAX,
    IDENTITY_FIRST,
    IDENTITY_REGISTERS,
    NAME_BYTES,
    SERIAL_AT,
    SERIAL_BYTES,
    VERSIONS,
    BaudRate,
    Register,
    check_written,
    read_registers,
    registers_of,
    write_register,
)
from imud.formats.modbus import SLAVES
from imud.model.errors import BadArgument, DeviceRefused, NoReply, TransferError

READ_IDENTITY: Final = read_registers(IDENTITY_FIRST, IDENTITY_REGISTERS)
READ_SETTINGS: Final = read_registers(BY_NAME["UART1_BAUD"].address, 3)
READ_SERIAL: Final = read_registers(BY_NAME["SN"].address, BY_NAME["SN"].count)
READ_ADDRESS: Final = read_registers(BY_NAME["MD_ID"].address, 1)
SAVE: Final = 0x0000
FACTORY_RESET: Final = 0x0001
RESTART: Final = 0x00FF
FLASH_MS: Final = 2500
"""Longest time until a save is confirmed: 2 s were seen."""
TRIES: Final = 3
"""Requests without a reply until an address counts as free, or a module as absent: noise can hit one of them."""
BOOT_TRIES: Final = 30
BOOT_REPLY_MS: Final = 100
"""Together 3 s for a restart; the manual gives no time."""


class LineMounting(Enum):
    """The five mountings that register URFR has."""

    LEVEL = 0
    Y_DOWN = 1
    Y_UP = 2
    X_UP = 3
    X_DOWN = 4


def places_of(target: Target) -> tuple[int, ...]:
    """Addresses at which the module can be, the present one first. Raises BadArgument where none is known."""
    if not target.places:
        raise BadArgument("expected the address of the module, got none: is it read on an RS-485 line?")
    return target.places


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
    """Write all settings to flash. Raises DeviceRefused, TransferError."""
    return _write_only(BY_NAME["CTRL"], SAVE, FLASH_MS)


def restart(places: tuple[int, ...], line_baud: int) -> TransferScript[str]:
    """Restart, as by power-on, and wait until the module answers again: at `places`, of which the first is the present
    address, or at the one that its register has.

    `line_baud` is the rate of the line, 0 where it is not known. Returns what became of it. Raises DeviceRefused,
    TransferError, NoReply.
    """
    serial = yield from _own_serial()
    baud, address, _ = yield from read_present()
    yield from send_control(RESTART)
    rate = BAUD_RATES[baud] if baud is not None and baud < len(BAUD_RATES) else line_baud
    if line_baud and rate != line_baud:
        return f"restarted; it has {rate} baud now, which this line has not"
    known = (address, *places) if address is not None and address in SLAVES else places
    return (yield from _await(serial, tuple(dict.fromkeys(known)), places[0]))


def factory_reset(places: tuple[int, ...], line_baud: int) -> TransferScript[str]:
    """Restore the factory settings: address 80 and 115200 baud; in force after a restart at the latest.

    The module is followed where the line has that rate. Raises BadArgument where another module has address 80,
    DeviceRefused, TransferError, NoReply.
    """
    serial = yield from _own_serial()
    yield from _refuse_taken(FACTORY_ID, serial, places[0])
    yield from send_control(FACTORY_RESET)
    yield from send_control(RESTART, lost_is_fine=True)
    if line_baud not in (0, FACTORY_BAUD):
        return f"restored; it has {FACTORY_BAUD} baud and address {FACTORY_ID} after the next restart at the latest"
    return (yield from _await(serial, tuple(dict.fromkeys((FACTORY_ID, *places))), places[0]))


def change_address(at: int, new: int) -> TransferScript[Written]:
    """Give the module at address `at` another one, 1 … 128, and follow it there.

    Raises BadArgument for an address that another module of the line has, DeviceRefused, and NoReply for a module that
    is heard neither there nor at its former address; it is commanded to go back then.
    """
    if new not in BY_NAME["MD_ID"].values:
        raise BadArgument(f"address: expected 1 … {ID_MAX}, got {new!r}; higher ones go by serial number")
    serial = yield from _own_serial()
    yield from _refuse_taken(new, serial, at)
    yield from set_id(new)
    for _ in range(TRIES):
        if new != at and (yield from _is_at(serial, new)):
            yield from _move(new)
            return Written.VERIFIED
        if (yield from _is_at(serial, at)):
            (now,) = yield from read(BY_NAME["MD_ID"])
            if now != new:
                raise DeviceRefused(f"MD_ID: wrote {new}, the module has {now}")
            return Written.VERIFIED if new == at else Written.PENDING
    with suppress(TransferError):
        yield replace(write_register(BY_NAME["MD_ID"].address, at), at=new)
    raise NoReply(f"the module answers neither at address {new} nor at {at}: it was commanded to go back to {at}")


def set_baud(baud: BaudRate) -> TransferScript[Written]:
    """Set the baud rate, in force after saving and restarting. Raises DeviceRefused, NoReply, TransferError."""
    code = BAUD_RATES.index(baud)
    yield from _write_unheard(BY_NAME["UART1_BAUD"], code)
    for _ in range(TRIES):
        with suppress(TransferError):
            (now,) = yield from read(BY_NAME["UART1_BAUD"])
            if now != code:
                raise DeviceRefused(f"UART1_BAUD: wrote {code}, the module has {now}")
            return Written.PENDING
    raise NoReply(f"the module no longer answers: it has {baud} baud at once, the line has not")


def set_id(new_id: int) -> TransferScript[None]:
    """Set the address, 1 … 128. The confirmation may come from the old address, the new one, or not at all.

    Raises BadArgument for an address beyond that, which goes by serial number only; DeviceRefused.
    """
    if new_id not in BY_NAME["MD_ID"].values:
        raise BadArgument(f"MD_ID: expected 1 … {ID_MAX}, got {new_id!r}; higher ones go by serial number")
    return _write_unheard(BY_NAME["MD_ID"], new_id)


def set_heading_mode(mode: AttitudeMode) -> TransferScript[Written]:
    """Choose six or nine axes."""
    return _write(BY_NAME["HEADING_MODE"], mode.value)


def set_mounting(mounting: LineMounting) -> TransferScript[Written]:
    """Set the mounting of the module."""
    return _write(BY_NAME["URFR"], mounting.value)


def auto_level(kind: LevelReset) -> TransferScript[None]:
    """Make the present attitude level, or cancel that. The module must be at rest."""
    return _write_only(BY_NAME["SET_LV"], kind.value)


def read(register: Register) -> TransferScript[tuple[int, ...]]:
    """The words of one register. Raises DeviceRefused, TransferError."""
    return registers_of((yield read_registers(register.address, register.count)), register.count)


def send_control(value: int, *, lost_is_fine: bool = False) -> TransferScript[None]:
    """Write CTRL for a restart or a reset, which may not be confirmed. `lost_is_fine`: nobody may be there."""
    try:
        yield from _write_unheard(BY_NAME["CTRL"], value)
    except DeviceRefused:
        if not lost_is_fine:
            raise


def read_present() -> TransferScript[tuple[int | None, int | None, int | None]]:
    """Baud code, address and heading mode as its registers have them; None for a module that does not tell."""
    try:
        baud, address, heading = registers_of((yield READ_SETTINGS), 3)
    except (TransferError, DeviceRefused):
        return None, None, None
    return baud, address, heading


# --- parts of them ----------------------------------------------------------------------------------------------------


def _write(register: Register, value: int) -> TransferScript[Written]:
    """Write, and read back what can be read. Raises DeviceRefused, TransferError."""
    yield from _write_only(register, value)
    if "R" not in register.access:
        return Written.UNVERIFIED
    try:
        (now,) = yield from read(register)
    except (TransferError, DeviceRefused):
        return Written.UNVERIFIED
    if now != value:
        raise DeviceRefused(f"{register.name}: wrote {value}, the module has {now}")
    return Written.VERIFIED


def _write_only(register: Register, value: int, reply_ms: int = 0) -> TransferScript[None]:
    request = replace(write_register(register.address, value), reply_ms=reply_ms)
    check_written((yield request), request)


def _write_unheard(register: Register, value: int) -> TransferScript[None]:
    """Write a setting that may change where the module answers. Raises DeviceRefused for an exception only."""
    request = replace(write_register(register.address, value), holds=True)
    try:
        reply = yield request
    except TransferError:
        return
    check_written(reply, request)


def _own_serial() -> TransferScript[tuple[int, ...]]:
    """The serial number by which the module is known again. Raises DeviceRefused, TransferError."""
    count = BY_NAME["SN"].count
    for _ in range(TRIES - 1):
        with suppress(TransferError):
            return registers_of((yield READ_SERIAL), count)
    return registers_of((yield READ_SERIAL), count)


def _refuse_taken(address: int, serial: tuple[int, ...], own: int) -> TransferScript[None]:
    """Raises BadArgument where another module answers at an address."""
    if address == own:
        return
    for _ in range(TRIES):
        try:
            there = registers_of((yield replace(READ_SERIAL, at=address)), BY_NAME["SN"].count)
        except TransferError:
            continue
        except DeviceRefused as error:
            raise BadArgument(f"address {address} is taken: something answers there ({error})") from error
        if there == serial:
            return
        words = "".join(f"{word:04X}" for word in there)
        raise BadArgument(f"address {address} is taken: the module with serial number {words} answers there")


def _is_at(serial: tuple[int, ...], address: int, reply_ms: int = 0) -> TransferScript[bool]:
    """Whether the module with this serial number answers at an address."""
    try:
        reply = yield replace(READ_SERIAL, at=address, reply_ms=reply_ms, holds=True)
        return registers_of(reply, BY_NAME["SN"].count) == serial
    except (TransferError, DeviceRefused):
        return False


def _move(address: int) -> TransferScript[None]:
    """Go on at an address at which the module was heard."""
    with suppress(TransferError):
        yield replace(READ_ADDRESS, at=address, then_at=address)


def _await(serial: tuple[int, ...], places: tuple[int, ...], at: int) -> TransferScript[str]:
    """Wait until a module that restarts answers at one of some addresses. Raises NoReply."""
    for attempt in range(BOOT_TRIES):
        place = places[attempt % len(places)]
        if (yield from _is_at(serial, place, BOOT_REPLY_MS)):
            if place != at:
                yield from _move(place)
            return f"restarted, at address {place}"
    words = " or ".join(map(str, places))
    raise NoReply(f"the module does not answer at address {words} after its restart: has it another baud rate now?")
