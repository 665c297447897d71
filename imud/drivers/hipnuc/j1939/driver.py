"""Table: the row `DRIVER` of HiPNUC modules on SAE J1939."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from random import Random
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.attitude.rotation import euler312_from_quat, quat_normalized
from imud.contracts.command import Action, Actions, Risk, Target
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver
from imud.contracts.script import RequestScript
from imud.contracts.setting import Effect, Setting, SettingsTable, Written
from imud.drivers.hipnuc.bus_load import CyclicMessage, refuse_other_rate, refuse_overload
from imud.drivers.hipnuc.common import REGISTERS, inclinometer_zero
from imud.drivers.hipnuc.j1939 import codec as messages
from imud.drivers.hipnuc.j1939 import commands as moves
from imud.drivers.hipnuc.j1939 import commands as session
from imud.drivers.hipnuc.j1939.codec import (
    CONFIGURE,
    HOST_ADDRESS,
    HipnucJ1939Codec,
    HipnucJ1939Options,
    J1939Node,
    PgnName,
    encode,
)
from imud.drivers.hipnuc.j1939.commands import (
    BITRATES,
    INTERVAL_MAX_MS,
    INTERVAL_MIN_MS,
    INTERVALS,
    MODULE_ADDRESS_MAX,
    MODULE_ADDRESS_MIN,
    BitRate,
    Zero,
)
from imud.formats.can import CanFilter, CanFrame
from imud.formats.j1939 import filter_of, sender_of
from imud.model.sample import Vector3

CONTENT: Final = {
    messages.UTC: "UTC", messages.ACCEL: "acceleration", messages.GYRO: "angular rate", messages.MAG: "magnetic field",
    messages.ROLL_PITCH: "roll and pitch", messages.HEADING: "heading", messages.TEMPERATURE: "temperature",
    messages.QUATERNION: "quaternion", messages.INCLINOMETER: "inclinometer",
}  # fmt: skip


def interval_name(pgn: int) -> str:
    """Name of the setting of a message's interval."""
    return f"{pgn:04x}_interval_ms"


SETTING_REGISTERS: Final = {
    **{interval_name(pgn): register for pgn, register in INTERVALS.items()},
    "x_reversed": session.X_SIGN,
    "y_reversed": session.Y_SIGN,
    "bit_rate": session.BITRATE,
    "address": session.ADDRESS,
}
"""Registers of the settings, by name, in the order of the table."""


def values_of(values: Mapping[int, int]) -> dict[str, Any]:
    """Settings by name from registers; what has none of the values of the table is left out."""
    reported: dict[str, Any] = {name: values.get(register) for name, register in SETTING_REGISTERS.items()}
    for pgn in INTERVALS:  # 0 or nothing: a message that this firmware does not send
        reported[interval_name(pgn)] = reported[interval_name(pgn)] or None
    for name in ("x_reversed", "y_reversed"):
        reported[name] = {0: False, 1: True}.get(-1 if reported[name] is None else reported[name])
    code = reported["bit_rate"]
    reported["bit_rate"] = BITRATES[code] if code is not None and code < len(BITRATES) else None
    return {name: value for name, value in reported.items() if value is not None}


def set_interval(target: Target, pgn: int, interval_ms: int) -> RequestScript[Written]:
    """Set a message's interval. Raises BadArgument where the messages are then more than the bus carries."""
    peer = target.settings.peer
    if target.baud:
        present = yield from session.read_values(peer, tuple(INTERVALS.values()))
        _refuse_overload(target, values_of(present) | {interval_name(pgn): interval_ms})
    return (yield from session.set_interval(peer, pgn, interval_ms))


def _refuse_overload(target: Target, values: Mapping[str, Any]) -> None:
    sent = {
        f"{pgn:04X}": CyclicMessage(messages.MESSAGE_BYTES, True, values.get(interval_name(pgn), 0))
        for pgn in INTERVALS
    }
    refuse_overload(sent, target.other_bits_per_s, target.baud)


def _check(target: Target, values: Mapping[str, Any]) -> None:
    """Refuse another bit rate than that of the bus, and more than it carries. Raises BadArgument."""
    refuse_other_rate(target, values)
    _refuse_overload(target, values)


def _read(target: Target) -> RequestScript[dict[str, Any]]:
    return values_of((yield from session.read_values(target.settings.peer, tuple(SETTING_REGISTERS.values()))))


def _interval_setting(pgn: int) -> Setting:
    return Setting(
        type=Annotated[
            int,
            Meta(
                ge=INTERVAL_MIN_MS,
                le=INTERVAL_MAX_MS,
                description=f"interval of the message with the {CONTENT[pgn]} (PGN {pgn:04X})",
                extra={"unit": "ms", "section": "6.2.2"},
            ),
        ],
        write=lambda target, interval_ms: session.set_interval(target.settings.peer, pgn, interval_ms),
    )


def _sign(axis: Literal["X", "Y"]) -> Setting:
    words = f"sign of the angle about {axis} turned around"
    return Setting(
        type=Annotated[bool, Meta(description=words, extra={"section": "6.2.2"})],
        write=lambda target, is_reversed: session.set_direction(target.settings.peer, axis, is_reversed),
    )


SETTINGS: Final = SettingsTable(
    table={
        **{interval_name(pgn): _interval_setting(pgn) for pgn in INTERVALS},
        "x_reversed": _sign("X"),
        "y_reversed": _sign("Y"),
        "bit_rate": Setting(
            type=Annotated[
                BitRate,
                Meta(
                    description="that of the bus: a module that would take another one at its restart is set back",
                    extra={"unit": "bit/s", "section": "6.2.2"},
                ),
            ],
            write=lambda target, rate: session.set_bitrate(target.settings.peer, rate),
            effect=Effect.AFTER_RESTART,
            connection=True,
        ),
        "address": Setting(
            type=Annotated[
                int,
                Meta(
                    ge=MODULE_ADDRESS_MIN,
                    le=MODULE_ADDRESS_MAX,
                    description="one that nothing on the bus has",
                    extra={"section": "6.2.2"},
                ),
            ],
            write=lambda target, address: moves.change_address(target.settings, address),
            effect=Effect.AFTER_RESTART,
            connection=True,
        ),
    },
    read=_read,
    save=lambda target: session.save(target.settings.peer),
    restart=lambda target: moves.restart(target.settings, target.baud),
    check=_check,
)

Pgn = Annotated[PgnName, Meta(description="the last four digits of its number", extra={"section": "6.1"})]


def _simple(words: str, begin: Callable[[J1939Node], RequestScript[None]], risk: Risk = Risk.NONE) -> Action:
    """An action without arguments."""
    return Action(words, lambda target: begin(target.settings.peer), risk)


def _interval(
    target: Target,
    *,
    pgn: Pgn,
    interval_ms: Annotated[int, Meta(ge=INTERVAL_MIN_MS, le=INTERVAL_MAX_MS, extra={"unit": "ms", "section": "6.2.2"})],
) -> RequestScript[str]:
    return set_interval(target, int(pgn, 16), interval_ms)


def _send_once(target: Target, *, pgn: Pgn) -> RequestScript[None]:
    return session.send_once(target.settings.peer, int(pgn, 16))


def _bitrate(
    target: Target,
    *,
    bitrate: Annotated[BitRate, Meta(description="rate of the bus", extra={"unit": "bit/s", "section": "6.2.2"})],
) -> RequestScript[str]:
    return session.set_bitrate(target.settings.peer, bitrate)


def _address(
    target: Target,
    *,
    address: Annotated[
        int,
        Meta(
            ge=MODULE_ADDRESS_MIN,
            le=MODULE_ADDRESS_MAX,
            description="one that no other module of the bus has",
            extra={"section": "6.2.2"},
        ),
    ],
) -> RequestScript[str]:
    return moves.change_address(target.settings, address)


def _zero(
    target: Target, *, zero: Annotated[Literal["here", "cancel"], Meta(extra={"section": "6.2.2"})]
) -> RequestScript[None]:
    return session.zero(target.settings.peer, Zero[zero.upper()])


def _direction(
    target: Target, *, axis: Annotated[Literal["X", "Y"], Meta(extra={"section": "6.2.2"})], reversed: bool
) -> RequestScript[str]:
    return session.set_direction(target.settings.peer, axis, reversed)


ACTIONS: Final[Actions] = {
    "save": replace(_simple("write all settings to flash", session.save), saves=True),
    "restart": Action(
        "restart it and wait until it is heard, also at another address; what was not saved is lost",
        lambda target: moves.restart(target.settings, target.baud),
    ),
    "factory_reset": Action(
        "factory settings, address 8 and its bit rate included, in force after a restart at the latest; refused if "
        "another node of the bus has address 8",
        lambda target: moves.factory_reset_and_find(target.settings),
        Risk.RESET,
    ),
    "interval": Action("how often a message is sent; refused if the bus cannot carry it", _interval),
    "send_once": Action("send a message once, now, and wait for it", _send_once),
    "bitrate": Action(
        "set the bit rate, in force after `save` and `restart`: the module is off the bus then, and disturbs it, until "
        "interface and all others have the same",
        _bitrate,
        Risk.CONNECTION,
    ),
    "address": Action(
        "set its address, in force after `save` and `restart`, in some modules at once: imud follows. Refused if "
        "something on the bus has it already",
        _address,
        Risk.CONNECTION,
    ),
    "zero": Action("make the present position zero, or cancel that", _zero),
    "direction": Action("turn the sign of an angle", _direction),
}


def _example_frames(random: Random) -> list[CanFrame]:
    """A sample of the four PGNs that every module sends, with random values."""
    quat = quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1)))
    roll, pitch, yaw = euler312_from_quat(quat)

    def three(spread: float) -> Vector3:
        return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))

    made = (
        encode(messages.ACCEL, messages.pack_accel(three(9.8))),
        encode(messages.GYRO, messages.pack_gyro(three(2))),
        encode(messages.ROLL_PITCH, messages.pack_roll_pitch(roll, pitch)),
        encode(messages.HEADING, messages.pack_heading(yaw)),
    )
    return [CanFrame(can_id, True, data, 0) for can_id, data in made]


def _filters(settings: HipnucJ1939Options) -> list[CanFilter]:
    """The messages of one module, and its replies."""
    wanted = [filter_of(pgn, settings.address) for pgn in (messages.UTC, *settings.measured())]
    hosts = sorted({settings.host_address, HOST_ADDRESS})
    return wanted + [filter_of(CONFIGURE, settings.address, host) for host in hosts]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """The sender of a message that samples are made of."""
    return sender_of(can_id, extended, data, messages.MEASURED)


DRIVER: Final = CanDriver(
    name="hipnuc-j1939",
    title="HiPNUC CH0x0, CH10x, HI14 (CAN, SAE J1939)",
    settings=HipnucJ1939Options,
    make_codec=HipnucJ1939Codec,
    filters=_filters,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above; "
    "NaN for an angle that the module does not send",
    navigation_frame="ENU",
    data_sheet=REGISTERS,
    actions=ACTIONS,
    device_settings=SETTINGS,
    calibrations=inclinometer_zero("6.2.2", ACTIONS),
    node_of=_node_of,
    node_settings=lambda address: HipnucJ1939Options(address=address),
    node_title=lambda address: f"address {address}",
    identify=lambda settings: session.identify(settings.peer),
    read_settings=lambda settings: session.read_settings(settings.peer),
    sample_frames=4,
    example_frames=_example_frames,
)
