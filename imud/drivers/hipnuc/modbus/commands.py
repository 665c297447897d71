"""Transfer scripts of a HiPNUC device on RS-485. imud reads back each written setting if it is readable.

Manual "IMU配置手冊" V1.5.9, section 4.3. Settings are lost at power-off unless `save` follows. A new address takes
effect immediately (section 4.3.3); the scripts also support a device that uses it after save and restart. The manual
does not state when a new baud rate takes effect; it does after save and restart. SET_LV and URFR are not readable: the
confirmation is the only evidence.

The scripts that can change the address (`change_address`, `restart`, `factory_reset`) follow the device by
`Transfer.then_at`. They first check that no other device has the address. The serial number identifies the device.
"""

import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from enum import Enum
from typing import Any, Final, Literal

from imud.contracts.command import Target, VerbResult
from imud.contracts.driver import Identity
from imud.contracts.script import TransferScript
from imud.contracts.setting import DeviceReport, Reports, Written
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.modbus.registers import (
    BAUD_RATES,
    BY_NAME,
    FACTORY_BAUD,
    FACTORY_ID,
    ID_MAX,
    IDENTITY_FIRST,
    IDENTITY_REGISTERS,
    MANUAL_ID_MAX,
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
from imud.model.errors import BadArgument, DeviceRefused, NoReply, NotApplied, TransferError

READ_IDENTITY: Final = read_registers(IDENTITY_FIRST, IDENTITY_REGISTERS)
READ_SETTINGS: Final = read_registers(BY_NAME["UART1_BAUD"].address, 3)
READ_SERIAL: Final = read_registers(BY_NAME["SN"].address, BY_NAME["SN"].count)
READ_ADDRESS: Final = read_registers(BY_NAME["MD_ID"].address, 1)
SAVE: Final = 0x0000
FACTORY_RESET: Final = 0x0001
RESTART: Final = 0x00FF
WRITE_MS: Final = 2500  # maximum time to the confirmation of a write, ms; 2 s were observed for a save
# Number of requests without reply before an address counts as unused or a device as absent: noise can destroy one
TRIES: Final = 3
# together 3 s for a restart; the manual states no time
BOOT_TRIES: Final = 30
BOOT_REPLY_MS: Final = 100


Mode = Literal["6-axis", "9-axis"]
MODES: Final[Mapping[Mode, AttitudeMode]] = {"6-axis": AttitudeMode.SIX_AXIS, "9-axis": AttitudeMode.NINE_AXIS}
MODE_OF: Final = {mode.value: name for name, mode in MODES.items()}


class LineMounting(Enum):
    """The five mountings of register URFR."""

    LEVEL = 0
    Y_DOWN = 1
    Y_UP = 2
    X_UP = 3
    X_DOWN = 4


def places_of(target: Target) -> tuple[int, ...]:
    """Return the possible addresses of the device, the present one first. Raises BadArgument if none is known."""
    if not target.places:
        raise BadArgument("expected a device on an RS-485 bus with a known address, got none")
    return target.places


def probe(_settings: object) -> TransferScript[Identity]:
    """Read name, versions and serial number. Raises DeviceRefused for another device."""
    words = registers_of((yield READ_IDENTITY), IDENTITY_REGISTERS)
    return identity_of(struct.pack(f">{len(words)}H", *words))


def identity_of(data: bytes) -> Identity:
    """Decode registers 0x70 … 0x83. Raises DeviceRefused if the name is not text."""
    name = data[:NAME_BYTES].rstrip(b"\0 ")
    if not name or any(byte not in range(0x20, 0x7F) for byte in name):
        raise DeviceRefused(f"expected a product name at register 0x70, got {data[:NAME_BYTES].hex(' ')}")
    firmware, loader = VERSIONS.unpack_from(data, NAME_BYTES)
    serial = data[SERIAL_AT : SERIAL_AT + SERIAL_BYTES].hex().upper()
    return Identity(name.decode("ascii"), serial, ".".join(str(firmware)), {"BL_VERSION": str(loader)})


def read_settings() -> TransferScript[Reports]:
    """Read baud rate, address and heading mode in one report. Raises DeviceRefused, TransferError."""
    baud, slave, heading = registers_of((yield READ_SETTINGS), 3)
    words = {
        "baud": str(BAUD_RATES[baud]) if baud < len(BAUD_RATES) else f"code {baud}",
        "id": str(slave),
        "heading_mode": {0: "six axes", 1: "nine axes"}.get(heading, f"code {heading}"),
    }
    values: dict[str, Any] = {"address": slave}
    if heading in MODE_OF:
        values["mode"] = MODE_OF[heading]
    if baud < len(BAUD_RATES):
        values["baud"] = BAUD_RATES[baud]
    return {"": DeviceReport(words, values)}


def save() -> TransferScript[None]:
    """Write all settings to flash. Raises DeviceRefused, TransferError."""
    return _write_only(BY_NAME["CTRL"], SAVE)


def restart(places: tuple[int, ...], line_baud: int) -> TransferScript[str | VerbResult]:
    """Restart the device, as after power-on, wait until it replies, and return a report, with evidence if there is any.

    A new address shows the restart. A pause of the replies does not: a busy device pauses too.

    The script tries `places`, the present address first, and the address in its register. `line_baud` is the baud rate
    of the bus; 0 if it is not known. Raises DeviceRefused, TransferError, NoReply.
    """
    serial = yield from _own_serial()
    baud, address, _ = yield from read_present()
    yield from send_control(RESTART)
    rate = BAUD_RATES[baud] if baud is not None and baud < len(BAUD_RATES) else line_baud
    if line_baud and rate != line_baud:
        words = f"the device now uses {rate} baud and the RS-485 bus does not; set the bus to {rate} baud"
        return VerbResult(False, "imud cannot receive the device at another baud rate", words)
    known = (address, *places) if address is not None and address in SLAVES else places
    place = yield from _await(serial, tuple(dict.fromkeys(known)), places[0])
    words = f"found at address {place}"
    if place != places[0]:
        return VerbResult(True, f"the device moved from address {places[0]} to {place}", words)
    return words


def factory_reset(places: tuple[int, ...], line_baud: int) -> TransferScript[str]:
    """Restore the factory settings: address 80 and 115200 baud, effective after a restart at the latest.

    The script follows the device if the bus has this baud rate. Raises BadArgument if another device has address 80,
    DeviceRefused, TransferError, NoReply.
    """
    serial = yield from _own_serial()
    yield from _refuse_taken(FACTORY_ID, serial, places[0])
    yield from send_control(FACTORY_RESET)
    yield from send_control(RESTART, lost_is_fine=True)
    if line_baud not in (0, FACTORY_BAUD):
        return f"restored; the device has {FACTORY_BAUD} baud and address {FACTORY_ID} after the next restart"
    place = yield from _await(serial, tuple(dict.fromkeys((FACTORY_ID, *places))), places[0])
    return f"found at address {place}"


def change_address(at: int, new: int) -> TransferScript[Written]:
    """Set the address of the device at address `at`, 1 … 247, and follow it.

    Raises BadArgument for an address in use on the bus, DeviceRefused, and NoReply for a device without reply at both
    addresses (imud then commands it back).
    """
    if new not in BY_NAME["MD_ID"].values:
        raise BadArgument(f"address: expected 1 … {ID_MAX}, got {new!r}")
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
                raise DeviceRefused(f"MD_ID: expected {new} after the write, got {now}{_id_hint(new)}")
            return Written.VERIFIED if new == at else Written.PENDING
    with suppress(TransferError):
        yield replace(write_register(BY_NAME["MD_ID"].address, at), at=new)
    raise NoReply(f"the device replied neither at address {new} nor at {at}; imud commanded it back to {at}")


def set_baud(baud: BaudRate) -> TransferScript[Written]:
    """Set the baud rate, effective after save and restart. Raises DeviceRefused, NoReply, TransferError."""
    code = BAUD_RATES.index(baud)
    yield from _write_unheard(BY_NAME["UART1_BAUD"], code)
    for _ in range(TRIES):
        with suppress(TransferError):
            (now,) = yield from read(BY_NAME["UART1_BAUD"])
            if now != code:
                raise DeviceRefused(f"UART1_BAUD: expected {code} after the write, got {now}")
            return Written.PENDING
    raise NoReply(
        f"the device does not reply: it now uses {baud} baud, the RS-485 bus does not; set the bus to {baud} baud"
    )


def set_id(new_id: int) -> TransferScript[None]:
    """Set the address, 1 … 247. The confirmation may come from the old address, from the new address, or not at all.

    Raises BadArgument, DeviceRefused.
    """
    if new_id not in BY_NAME["MD_ID"].values:
        raise BadArgument(f"MD_ID: expected 1 … {ID_MAX}, got {new_id!r}")
    try:
        yield from _write_unheard(BY_NAME["MD_ID"], new_id)
    except DeviceRefused as error:
        raise DeviceRefused(f"{error}{_id_hint(new_id)}") from error


def _id_hint(new_id: int) -> str:
    """Return the next step if a device rejects an address above the range of the manual; empty for other addresses."""
    hint = f"; older firmware accepts 1 … {MANUAL_ID_MAX}: try `imud modbus assign PORT --serial SN --id {new_id}`"
    return hint if new_id > MANUAL_ID_MAX else ""


def set_heading_mode(mode: AttitudeMode) -> TransferScript[Written]:
    """Set 6-axis or 9-axis mode."""
    return _write(BY_NAME["HEADING_MODE"], mode.value)


def set_mounting(mounting: LineMounting) -> TransferScript[Written]:
    """Set the mounting of the device."""
    return _write(BY_NAME["URFR"], mounting.value)


def auto_level(kind: LevelReset) -> TransferScript[None]:
    """Make the present attitude level, or cancel it. The device must be at rest."""
    return _write_only(BY_NAME["SET_LV"], kind.value)


def read(register: Register) -> TransferScript[tuple[int, ...]]:
    """Read the words of one register. Raises DeviceRefused, TransferError."""
    return registers_of((yield read_registers(register.address, register.count)), register.count)


def send_control(value: int, *, lost_is_fine: bool = False) -> TransferScript[None]:
    """Write CTRL for a restart or a reset, with or without confirmation. `lost_is_fine`: the device may not reply."""
    try:
        yield from _write_unheard(BY_NAME["CTRL"], value)
    except DeviceRefused:
        if not lost_is_fine:
            raise


def read_present() -> TransferScript[tuple[int | None, int | None, int | None]]:
    """Read baud code, address and heading mode from the registers; None for a device that does not report them."""
    try:
        baud, address, heading = registers_of((yield READ_SETTINGS), 3)
    except (TransferError, DeviceRefused):
        return None, None, None
    return baud, address, heading


# --- parts of scripts -------------------------------------------------------------------------------------------


def _write(register: Register, value: int) -> TransferScript[Written]:
    """Write a register and read it back if it is readable. Raises DeviceRefused, TransferError."""
    yield from _write_only(register, value)
    if "R" not in register.access:
        return Written.UNVERIFIED
    try:
        (now,) = yield from read(register)
    except (TransferError, DeviceRefused):
        return Written.UNVERIFIED
    if now != value:
        raise NotApplied(f"{register.name}: expected {value} after the write, got {now}")
    return Written.VERIFIED


def _write_only(register: Register, value: int) -> TransferScript[None]:
    # the reads of the samples do not show how long a write takes
    request = replace(write_register(register.address, value), reply_ms=WRITE_MS)
    check_written((yield request), request)


def _write_unheard(register: Register, value: int) -> TransferScript[None]:
    """Write a setting that may change the address of the reply. Raises DeviceRefused for an exception only."""
    request = replace(write_register(register.address, value), holds=True)
    try:
        reply = yield request
    except TransferError:
        return
    check_written(reply, request)


def _own_serial() -> TransferScript[tuple[int, ...]]:
    """Read the serial number, which identifies the device later. Raises DeviceRefused, TransferError."""
    count = BY_NAME["SN"].count
    for _ in range(TRIES - 1):
        with suppress(TransferError):
            return registers_of((yield READ_SERIAL), count)
    return registers_of((yield READ_SERIAL), count)


def _refuse_taken(address: int, serial: tuple[int, ...], own: int) -> TransferScript[None]:
    """Raise BadArgument if another device replies at an address."""
    if address == own:
        return
    for _ in range(TRIES):
        try:
            there = registers_of((yield replace(READ_SERIAL, at=address)), BY_NAME["SN"].count)
        except TransferError:
            continue
        except DeviceRefused as error:
            raise BadArgument(f"address {address} is in use: got a reply ({error})") from error
        if there == serial:
            return
        words = "".join(f"{word:04X}" for word in there)
        raise BadArgument(f"address {address} is in use by the device with serial number {words}")


def _is_at(serial: tuple[int, ...], address: int, reply_ms: int = 0) -> TransferScript[bool]:
    """Return whether the device with this serial number replies at an address."""
    try:
        reply = yield replace(READ_SERIAL, at=address, reply_ms=reply_ms, holds=True)
        return registers_of(reply, BY_NAME["SN"].count) == serial
    except (TransferError, DeviceRefused):
        return False


def _move(address: int) -> TransferScript[None]:
    """Use the address of the device in all following transfers."""
    with suppress(TransferError):
        yield replace(READ_ADDRESS, at=address, then_at=address)


def _await(serial: tuple[int, ...], places: tuple[int, ...], at: int) -> TransferScript[int]:
    """Wait until a restarting device replies at one of the addresses. Return this address. Raises NoReply."""
    for attempt in range(BOOT_TRIES):
        place = places[attempt % len(places)]
        if (yield from _is_at(serial, place, BOOT_REPLY_MS)):
            if place != at:
                yield from _move(place)
            return place
    words = " or ".join(map(str, places))
    raise NoReply(f"the device does not reply at address {words} after its restart; does it use another baud rate now?")
