"""The object dictionary of a simulated HiPNUC module: what can be read and written over SDO, and what that does.

Manual "IMU配置手冊" V1.5.9, section 5.4. It names no object for reading; that settings can be read, and that 0x2000 and
0x20A5 cannot, is a guess. TPDO parameters, signs, zero and heartbeat apply at once; node number and bit rate when the
module starts again. What is not saved is gone then. A factory reset clears the flash and changes nothing before that.
"""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Final, NamedTuple

from imud.devices.hipnuc.canopen import session as objects
from imud.devices.hipnuc.canopen.cob_ids import NODE_DEFAULT, NODE_MAX, TPDO_FUNCTIONS
from imud.devices.hipnuc.canopen.sdo import ABORT, READ, READ_SIZES, WRITE, WRITTEN, abort_frame
from imud.devices.hipnuc.canopen.session import BIT_RATES, IDENTITY_SUBS, TPDO_OBJECTS, TPDO_TIMER, TPDO_TYPE
from imud.sample import Pair

NO_SUCH_OBJECT: Final = 0x0602_0000
NO_SUCH_SUB_INDEX: Final = 0x0609_0011
WRITE_ONLY: Final = 0x0601_0001
READ_ONLY: Final = 0x0601_0002
BAD_LENGTH: Final = 0x0607_0010
BAD_VALUE: Final = 0x0609_0030
BAD_COMMAND: Final = 0x0504_0001

DEVICE_TYPE: Final = 0
NAME: Final = b"HI14"
IDENTITY_VALUES: Final = {1: 0x0000_03E8, 2: 0x0000_0E14, 3: 0x0000_009C, 4: 0x1708_0042}
"""Made up, as the manual shows none."""
PERIODS_MS: Final = (0, *range(5, 1001))
_BIT_RATE_OF: Final = {code: bit_s for bit_s, code in BIT_RATES.items()}
_COMMANDS: Final = {size: command for command, size in reversed(READ_SIZES.items())}


class Control(Enum):
    """What a write asks of the module besides a new setting."""

    NONE = auto()
    ZERO = auto()
    CANCEL_ZERO = auto()
    RESTART = auto()


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """What can be saved."""

    node: int = NODE_DEFAULT
    bit_rate: int = 500_000
    """In bit/s; 0: frames take no time."""
    periods_ms: Mapping[int, int] = field(default_factory=lambda: {1: 10, 2: 10, 3: 10, 4: 10, 6: 50, 7: 10})
    types: Mapping[int, int] = field(default_factory=lambda: dict.fromkeys(TPDO_FUNCTIONS, 0xFF))
    invert_x: int = 0
    invert_y: int = 0
    heartbeat_ms: int = 0

    def signed(self, tilt: Pair, zero: Pair) -> Pair:
        """The inclinometer's angles as they are sent."""
        x, y = tilt[0] - zero[0], tilt[1] - zero[1]
        return (-x if self.invert_x else x, -y if self.invert_y else y)


class _Entry(NamedTuple):
    size: int
    read: Callable[[NodeSettings], int] | None
    values: Container[int] = ()
    """What may be written; empty for read-only."""
    write: Callable[[NodeSettings, int], NodeSettings] | None = None


class ObjectDictionary:
    """Live settings, those in flash, and the SDO server in front of them."""

    def __init__(self, factory: NodeSettings) -> None:
        self.settings = factory
        self._factory = self._saved = factory

    def restore(self) -> None:
        """The module starts: what was saved counts."""
        self.settings = self._saved

    def serve(self, data: bytes) -> tuple[bytes, Control]:
        """Answer an SDO request of eight bytes: the reply's data, and what else is to be done."""
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        entry = _ENTRIES.get((index, sub))
        if entry is None:
            known = any(other == index for other, _ in _ENTRIES)
            return abort_frame(index, sub, NO_SUCH_SUB_INDEX if known else NO_SUCH_OBJECT), Control.NONE
        if data[0] == READ:
            return self._read(data, entry), Control.NONE
        if data[0] in WRITE.values():
            return self._write(data, entry)
        return abort_frame(index, sub, BAD_COMMAND), Control.NONE

    def _read(self, data: bytes, entry: _Entry) -> bytes:
        if entry.read is None:
            return _abort(data, WRITE_ONLY)
        value = entry.read(self.settings).to_bytes(entry.size, "little")
        return bytes([_COMMANDS[entry.size]]) + data[1:4] + value.ljust(4, b"\0")

    def _write(self, data: bytes, entry: _Entry) -> tuple[bytes, Control]:
        if not entry.values:
            return _abort(data, READ_ONLY), Control.NONE
        if data[0] != WRITE[entry.size]:
            return _abort(data, BAD_LENGTH), Control.NONE
        value = int.from_bytes(data[4 : 4 + entry.size], "little")
        if value not in entry.values:
            return _abort(data, BAD_VALUE), Control.NONE
        if entry.write is not None:
            self.settings = entry.write(self.settings, value)
        control = self._control(int.from_bytes(data[1:3], "little"), value)
        return bytes([WRITTEN]) + data[1:4] + bytes(4), control

    def _control(self, index: int, value: int) -> Control:
        if index == objects.INCLI_ZERO:
            return Control.ZERO if value == objects.InclinometerZero.SET.value else Control.CANCEL_ZERO
        if index == objects.CONTROL:
            if value == objects.RESTART:
                return Control.RESTART
            self._saved = self.settings if value == objects.SAVE else self._factory
        return Control.NONE


def _abort(data: bytes, code: int) -> bytes:
    return bytes([ABORT]) + data[1:4] + code.to_bytes(4, "little")


def _with(mapping: Mapping[int, int], key: int, value: int) -> dict[int, int]:
    return {**mapping, key: value}


def _tpdo_entries(number: int, index: int) -> dict[tuple[int, int], _Entry]:
    def set_type(settings: NodeSettings, value: int) -> NodeSettings:
        return replace(settings, types=_with(settings.types, number, value))

    def set_period(settings: NodeSettings, value: int) -> NodeSettings:
        return replace(settings, periods_ms=_with(settings.periods_ms, number, value))

    return {
        (index, 0): _Entry(1, lambda _: TPDO_TIMER),
        (index, 1): _Entry(4, lambda s: TPDO_FUNCTIONS[number] + s.node),
        (index, TPDO_TYPE): _Entry(1, lambda s: s.types[number], (1, 0xFE, 0xFF), set_type),
        (index, TPDO_TIMER): _Entry(2, lambda s: s.periods_ms[number], PERIODS_MS, set_period),
    }


def _entries() -> dict[tuple[int, int], _Entry]:
    entries = {
        (objects.DEVICE_TYPE, 0): _Entry(4, lambda _: DEVICE_TYPE),
        (objects.DEVICE_NAME, 0): _Entry(4, lambda _: int.from_bytes(NAME, "little")),
        (objects.IDENTITY, 0): _Entry(1, lambda _: len(IDENTITY_SUBS)),
        (objects.HEARTBEAT_TIME, 0): _Entry(
            2, lambda s: s.heartbeat_ms, range(1 << 16), lambda s, value: replace(s, heartbeat_ms=value)
        ),
        (objects.CONTROL, 0): _Entry(4, None, (objects.SAVE, objects.FACTORY_RESET, objects.RESTART)),
        (objects.INCLI_ZERO, 0): _Entry(4, None, tuple(zero.value for zero in objects.InclinometerZero)),
        (objects.NODE_ID, 0): _Entry(
            4, lambda s: s.node, range(1, NODE_MAX + 1), lambda s, value: replace(s, node=value)
        ),
        (objects.BIT_RATE, 0): _Entry(
            4,
            lambda s: BIT_RATES.get(s.bit_rate, 2),
            _BIT_RATE_OF,
            lambda s, value: replace(s, bit_rate=_BIT_RATE_OF[value]),
        ),
        (objects.INCLI_SIGN_X, 0): _Entry(4, lambda s: s.invert_x, (0, 1), lambda s, value: replace(s, invert_x=value)),
        (objects.INCLI_SIGN_Y, 0): _Entry(4, lambda s: s.invert_y, (0, 1), lambda s, value: replace(s, invert_y=value)),
    }
    for sub, value in IDENTITY_VALUES.items():
        entries[objects.IDENTITY, sub] = _Entry(4, lambda _, value=value: value)  # type: ignore[misc]  # a default binds it
    for number, index in TPDO_OBJECTS.items():
        entries |= _tpdo_entries(number, index)
    return entries


_ENTRIES: Final = _entries()
