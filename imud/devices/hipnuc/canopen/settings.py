"""Settings that a HiPNUC module on CANopen keeps. Manual "IMU配置手冊" V1.5.9, section 5.4; heartbeat of CiA 301.

The zero of the inclinometer (0x20A5) is no setting: it makes the position of that moment zero, and writing it again
would do so again. It is the action `zero`.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, get_args

from msgspec import Meta

from imud.contracts.action import Target
from imud.contracts.device_settings import DeviceSettings, Effect, Setting, Written
from imud.contracts.session import RequestScript
from imud.devices.hipnuc.canopen import moves, session
from imud.devices.hipnuc.canopen.cia301 import NODE_MAX, TpdoNumber
from imud.devices.hipnuc.canopen.codec import LAYOUTS
from imud.devices.hipnuc.canopen.session import (
    BIT_RATE_OF,
    PERIOD_MAX_MS,
    PERIOD_MIN_MS,
    SETTING_PLACES,
    TPDO_OBJECTS,
    TPDO_TIMER,
    TPDO_TYPE,
    BitRate,
    Place,
    Transmission,
)
from imud.devices.hipnuc.common.bus_load import MS_PER_S, CyclicMessage, refuse_other_rate, refuse_overload
from imud.errors import BadArgument

TPDOS: Final[tuple[TpdoNumber, ...]] = get_args(TpdoNumber)
CONTENT: Final = {
    1: "acceleration", 2: "angular rate", 3: "angles", 4: "quaternion", 6: "pressure", 7: "inclinometer",
}  # fmt: skip
By = Literal["timer", "sync"]
TRANSMISSIONS: Final[Mapping[By, Transmission]] = {"timer": Transmission.TIMER, "sync": Transmission.SYNC}
_BY_OF: Final[Mapping[int, By]] = {
    Transmission.TIMER.value: "timer",
    Transmission.TIMER_MANUFACTURER.value: "timer",
    Transmission.SYNC.value: "sync",
}


def interval_name(tpdo: int) -> str:
    """Name of the setting of a TPDO's interval."""
    return f"tpdo{tpdo}_interval_ms"


def transmission_name(tpdo: int) -> str:
    """Name of the setting of a TPDO's transmission."""
    return f"tpdo{tpdo}_by"


def values_of(values: Mapping[Place, int]) -> dict[str, Any]:
    """Settings by name from objects; what stands in none of the forms of the table is left out."""
    reported: dict[str, Any] = {}
    for tpdo, index in TPDO_OBJECTS.items():
        reported[interval_name(tpdo)] = values.get((index, TPDO_TIMER))
        reported[transmission_name(tpdo)] = _BY_OF.get(values.get((index, TPDO_TYPE), -1))
    signs = {"incli_x_reversed": session.INCLI_SIGN_X, "incli_y_reversed": session.INCLI_SIGN_Y}
    reported |= {name: {0: False, 1: True}.get(values.get((index, 0), -1)) for name, index in signs.items()}
    reported["heartbeat_ms"] = values.get((session.HEARTBEAT_TIME, 0))
    reported["bit_rate"] = BIT_RATE_OF.get(values.get((session.BIT_RATE, 0), -1))
    reported["node"] = values.get((session.NODE_ID, 0))
    return {name: value for name, value in reported.items() if value is not None}


def set_interval(target: Target, tpdo: TpdoNumber, interval_ms: int) -> RequestScript[Written]:
    """Set a TPDO's interval. Raises BadArgument where the TPDOs of the node are then more than the bus carries."""
    session.check_period(interval_ms)
    if interval_ms and target.baud:
        places = [(index, sub) for index in TPDO_OBJECTS.values() for sub in (TPDO_TYPE, TPDO_TIMER)]
        present = yield from session.read_values(target.settings.node, places, silent_is_fine=True)
        _refuse_overload(target, values_of(present) | {interval_name(tpdo): interval_ms})
    return (yield from session.set_tpdo_period(target.settings.node, tpdo, interval_ms))


def _refuse_overload(target: Target, values: Mapping[str, Any]) -> None:
    sync_ms = MS_PER_S / target.settings.sync_hz if target.settings.sync_hz else 0.0
    messages = {
        f"TPDO{tpdo}": CyclicMessage(
            LAYOUTS[tpdo].size,
            False,
            sync_ms if values.get(transmission_name(tpdo)) == "sync" else values.get(interval_name(tpdo), 0),
        )
        for tpdo in TPDOS
    }
    refuse_overload(messages, target.other_bits_per_s, target.baud)


def _check(target: Target, values: Mapping[str, Any]) -> None:
    """Refuse another bit rate than that of the bus, and more than it carries. Raises BadArgument."""
    refuse_other_rate(target, values)
    for tpdo in TPDOS:
        if 0 < values.get(interval_name(tpdo), 0) < PERIOD_MIN_MS:
            got = values[interval_name(tpdo)]
            raise BadArgument(f"{interval_name(tpdo)}: expected 0 or {PERIOD_MIN_MS} … {PERIOD_MAX_MS}, got {got}")
    _refuse_overload(target, values)


def _read(target: Target) -> RequestScript[dict[str, Any]]:
    return values_of((yield from session.read_values(target.settings.node, SETTING_PLACES, silent_is_fine=True)))


def _interval_setting(tpdo: TpdoNumber) -> Setting:
    return Setting(
        type=Annotated[
            int,
            Meta(
                ge=0,
                le=PERIOD_MAX_MS,
                description=f"interval of the message with the {CONTENT[tpdo]}, {PERIOD_MIN_MS} or more; 0 for never",
                extra={"unit": "ms", "section": "5.4.1"},
            ),
        ],
        write=lambda target, interval_ms: session.set_tpdo_period(target.settings.node, tpdo, interval_ms),
    )


def _transmission_setting(tpdo: TpdoNumber) -> Setting:
    words = (
        f"when the message with the {CONTENT[tpdo]} is sent: at its interval, or when SYNC comes (`options.sync_hz`)"
    )
    return Setting(
        type=Annotated[By, Meta(description=words, extra={"section": "5.4.2"})],
        write=lambda target, by: session.set_tpdo_type(target.settings.node, tpdo, TRANSMISSIONS[by]),
    )


def _sign(axis: Literal["x", "y"]) -> Setting:
    return Setting(
        type=Annotated[bool, Meta(description="sign of the inclinometer turned around", extra={"section": "5.4.1"})],
        write=lambda target, invert: session.set_inclinometer_sign(target.settings.node, axis, invert=invert),
    )


SETTINGS: Final = DeviceSettings(
    table={
        **{interval_name(tpdo): _interval_setting(tpdo) for tpdo in TPDOS},
        **{transmission_name(tpdo): _transmission_setting(tpdo) for tpdo in TPDOS},
        "incli_x_reversed": _sign("x"),
        "incli_y_reversed": _sign("y"),
        "heartbeat_ms": Setting(
            type=Annotated[
                int,
                Meta(
                    ge=0,
                    le=65535,
                    description="interval of the heartbeat, 0 for none; not every firmware has it",
                    extra={"unit": "ms", "section": "CiA 301, 7.5.2.17"},
                ),
            ],
            write=lambda target, period_ms: session.set_heartbeat(target.settings.node, period_ms),
        ),
        "bit_rate": Setting(
            type=Annotated[
                BitRate,
                Meta(
                    description="that of the bus: a module that would take another one at its restart is set back",
                    extra={"unit": "bit/s", "section": "5.4.1"},
                ),
            ],
            write=lambda target, rate: session.set_bit_rate(target.settings.node, rate),
            effect=Effect.AFTER_RESTART,
            connection=True,
        ),
        "node": Setting(
            type=Annotated[
                int,
                Meta(ge=1, le=NODE_MAX, description="one that nothing on the bus has", extra={"section": "5.4.1"}),
            ],
            write=lambda target, node: moves.change_node(target.settings, node),
            effect=Effect.AFTER_RESTART,
            connection=True,
        ),
    },
    read=_read,
    save=lambda target: session.save(target.settings.node),
    restart=lambda target: moves.restart(target.settings, target.baud),
    check=_check,
)
