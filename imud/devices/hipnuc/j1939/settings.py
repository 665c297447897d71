"""Settings that a HiPNUC module on J1939 keeps. Manual "IMU配置手冊" V1.5.9, section 6.2.2.

The zero (register 0x00A5) is no setting: it makes the position of that moment zero, and writing it again would do so
again. It is the action `zero`. A message cannot be switched off: its interval is 1000 ms at most.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.contracts.action import Target
from imud.contracts.device_settings import DeviceSettings, Effect, Setting, Written
from imud.contracts.session import RequestScript
from imud.devices.hipnuc.common.bus_load import CyclicMessage, refuse_other_rate, refuse_overload
from imud.devices.hipnuc.j1939 import messages, moves, session
from imud.devices.hipnuc.j1939.session import (
    BITRATES,
    INTERVAL_MAX_MS,
    INTERVAL_MIN_MS,
    INTERVALS,
    MODULE_ADDRESS_MAX,
    MODULE_ADDRESS_MIN,
    BitRate,
)

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


SETTINGS: Final = DeviceSettings(
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
