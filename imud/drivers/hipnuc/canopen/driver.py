"""Row `DRIVER` of HiPNUC devices on CANopen: settings and verbs."""

from collections.abc import Collection, Mapping
from random import Random
from typing import Annotated, Any, Final, Literal, get_args

from msgspec import Meta

from imud.contracts.command import Proof, Risk, Target, Verb, VerbResult, Verbs
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver, DataSheet, random_vector
from imud.contracts.script import RequestScript
from imud.contracts.setting import DeviceReport, Effect, Reports, Setting, SettingsTable
from imud.drivers.hipnuc.bus_load import (
    MS_PER_S,
    RATE_NOTE,
    CyclicMessage,
    refuse_other_rate,
    refuse_overload,
    refuse_short_intervals,
)
from imud.drivers.hipnuc.canopen import commands
from imud.drivers.hipnuc.canopen.cia301 import (
    EMERGENCY,
    FUNCTION_MASK,
    HEARTBEAT,
    NODE_DEFAULT,
    NODE_MASK,
    NODE_MAX,
    SDO_REPLY,
    SYNC,
    TPDO_FUNCTIONS,
    NmtCommand,
    TpdoNumber,
)
from imud.drivers.hipnuc.canopen.codec import (
    ACCEL_M_S2_PER_LSB,
    GYRO_RAD_S_PER_LSB,
    LAYOUTS,
    HipnucCanopenCodec,
    HipnucCanopenOptions,
    encode_tpdos,
)
from imud.drivers.hipnuc.canopen.commands import (
    BIT_RATE_OF,
    PERIOD_MAX_MS,
    PERIOD_MIN_MS,
    SETTING_PLACES,
    TPDO_OBJECTS,
    TPDO_TIMER,
    TPDO_TYPE,
    BitRate,
    InclinometerZero,
    Place,
    Transmission,
    identify,
)
from imud.drivers.hipnuc.canopen.firmware import FIRMWARE
from imud.drivers.hipnuc.common import DOCUMENT, inclinometer_zero, refuse_all, save_verb, zeroed
from imud.formats.can import STANDARD_ID_MAX, CanFilter, CanFrame, CyclicFrame
from imud.model.units import NS_PER_S, NS_PER_US

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
    """Return the name of the setting for the interval of a TPDO."""
    return f"tpdo{tpdo}_interval_ms"


def transmission_name(tpdo: int) -> str:
    """Return the name of the setting for the transmission of a TPDO."""
    return f"tpdo{tpdo}_by"


def values_of(values: Mapping[Place, int]) -> dict[str, Any]:
    """Return settings by name from objects, without values outside the table."""
    reported: dict[str, Any] = {}
    for tpdo, index in TPDO_OBJECTS.items():
        reported[interval_name(tpdo)] = values.get((index, TPDO_TIMER))
        reported[transmission_name(tpdo)] = _BY_OF.get(values.get((index, TPDO_TYPE), -1))
    signs = {"incli_x_reversed": commands.INCLI_SIGN_X, "incli_y_reversed": commands.INCLI_SIGN_Y}
    reported |= {name: {0: False, 1: True}.get(values.get((index, 0), -1)) for name, index in signs.items()}
    reported["heartbeat_ms"] = values.get((commands.HEARTBEAT_TIME, 0))
    reported["bit_rate"] = BIT_RATE_OF.get(values.get((commands.BIT_RATE, 0), -1))
    reported["node"] = values.get((commands.NODE_ID, 0))
    return {name: value for name, value in reported.items() if value is not None}


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
    """Raise BadArgument for another bit rate than the bus, and for TPDOs that exceed it."""
    refuse_all(
        lambda: refuse_short_intervals(values, map(interval_name, TPDOS), PERIOD_MIN_MS, PERIOD_MAX_MS),
        lambda: refuse_other_rate(target, values),
        lambda: _refuse_overload(target, values),
    )


def report_name(place: Place) -> str:
    """Return the name of the report of an object, for example `1800.5`."""
    index, sub = place
    return f"{index:04X}.{sub}"


REPORTS: Final = {report_name(place): place for place in SETTING_PLACES}


def _read(target: Target, names: Collection[str] | None) -> RequestScript[Reports]:
    places = [place for name, place in REPORTS.items() if names is None or name in names]
    values = yield from commands.read_values(target.settings.node, places)
    return {
        report_name(place): DeviceReport({report_name(place): str(value)}, values_of({place: value}))
        for place, value in values.items()
    }


def _interval_setting(tpdo: TpdoNumber) -> Setting:
    return Setting(
        type=Annotated[
            int,
            Meta(
                ge=0,
                le=PERIOD_MAX_MS,
                description=f"interval of the message with the {CONTENT[tpdo]}, at least {PERIOD_MIN_MS}; 0: never",
                extra={"unit": "ms", "section": "5.4.1"},
            ),
        ],
        write=lambda target, interval_ms: commands.set_tpdo_period(target.settings.node, tpdo, interval_ms),
        report=report_name((TPDO_OBJECTS[tpdo], TPDO_TIMER)),
    )


def _transmission_setting(tpdo: TpdoNumber) -> Setting:
    words = f"trigger of the message with the {CONTENT[tpdo]}, interval or SYNC (`options.sync_hz`)"
    return Setting(
        type=Annotated[By, Meta(description=words, extra={"section": "5.4.2"})],
        write=lambda target, by: commands.set_tpdo_type(target.settings.node, tpdo, TRANSMISSIONS[by]),
        report=report_name((TPDO_OBJECTS[tpdo], TPDO_TYPE)),
    )


SIGNS: Final = {"x": commands.INCLI_SIGN_X, "y": commands.INCLI_SIGN_Y}


def _sign(axis: Literal["x", "y"]) -> Setting:
    return Setting(
        type=Annotated[
            bool, Meta(description="whether the sign of the inclinometer is reversed", extra={"section": "5.4.1"})
        ],
        write=lambda target, invert: commands.set_inclinometer_sign(target.settings.node, axis, invert=invert),
        report=report_name((SIGNS[axis], 0)),
    )


SETTINGS: Final = SettingsTable(
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
                    description="interval of the heartbeat, 0: never; some firmware versions lack it",
                    extra={"unit": "ms", "section": "CiA 301, 7.5.2.17"},
                ),
            ],
            write=lambda target, period_ms: commands.set_heartbeat(target.settings.node, period_ms),
            report=report_name((commands.HEARTBEAT_TIME, 0)),
        ),
        "bit_rate": Setting(
            type=Annotated[
                BitRate,
                Meta(
                    description="bit rate of the bus; another rate takes effect after `imud command NAME restart`",
                    extra={"unit": "bit/s", "section": "5.4.1"},
                ),
            ],
            write=lambda target, rate: commands.set_bit_rate(target.settings.node, rate),
            report=report_name((commands.BIT_RATE, 0)),
            effect=Effect.AFTER_RESTART,
            connection=True,
            bus_rate=True,
            note=RATE_NOTE,
        ),
        "node": Setting(
            type=Annotated[
                int,
                Meta(
                    ge=1, le=NODE_MAX, description="node number that is unused on the bus", extra={"section": "5.4.1"}
                ),
            ],
            write=lambda target, node: commands.change_node(target.settings, node),
            report=report_name((commands.NODE_ID, 0)),
            effect=Effect.AFTER_RESTART,
            connection=True,
        ),
    },
    read=_read,
    save=lambda target: commands.save(target.settings.node),
    restart=lambda target: commands.restart(target.settings, target.baud),
    check=_check,
)

_ZEROS: Final = {"here": InclinometerZero.SET, "cancel": InclinometerZero.CANCEL}


def _zero(
    target: Target, *, zero: Annotated[Literal["here", "cancel"], Meta(extra={"section": "5.4.1"})]
) -> RequestScript[None]:
    return commands.set_inclinometer_zero(target.settings.node, _ZEROS[zero])


RESETS: Final = frozenset({"reset_node", "reset_communication"})  # NMT commands after which unsaved settings are lost


def _nmt(
    target: Target,
    *,
    command: Annotated[
        Literal["start", "stop", "pre_operational", "reset_node", "reset_communication"],
        Meta(
            description="after `stop` and `pre_operational` the node sends no samples until `start`",
            extra={"section": "CiA 301, 7.2.8.2"},
        ),
    ],
) -> RequestScript[str | VerbResult | None]:
    made = NmtCommand[command.upper()]
    if command in RESETS:
        return commands.reset(target.settings, target.baud, made)
    return commands.nmt(target.settings.node, made)


VERBS: Final[Verbs] = {
    "save": save_verb(lambda target: commands.save(target.settings.node)),
    "restart": Verb(
        "restart the device and wait for its frames, also from a new node number; unsaved settings are lost",
        lambda target: commands.restart(target.settings, target.baud),
        restarts=True,
        proof=Proof.RESTART,
        evidence="the node sends its boot-up message (0x700 + node), or moves to another number",
    ),
    "factory_reset": Verb(
        "restore the factory settings with node 8 and 500 kbit/s, effective after a restart; imud rejects it if "
        "another node on the bus has number 8",
        lambda target: commands.factory_reset_and_find(target.settings),
        Risk.RESET,
        restarts=True,
        proof=Proof.SETTINGS,
    ),
    "zero": Verb(
        "make the present position the zero of the inclinometer, or cancel it; effective immediately",
        _zero,
        proof=Proof.SAMPLES,
        expected=zeroed,
    ),
    "nmt": Verb(
        "start or stop the TPDOs, or reset the node and follow it",
        _nmt,
        restarts=True,
        restarts_with=lambda given: given.command in RESETS,
        proof=Proof.NONE,
        evidence="no node confirms an NMT command; watch the samples",
    ),
}

RENAMED: Final[Mapping[str, str]] = {
    "interval": "tpdo{tpdo}_interval_ms={interval_ms}",
    "transmission": "tpdo{tpdo}_by={by}",
    "bitrate": "bit_rate={bitrate} --save",
    "node": "node={node} --save",
    "direction": "incli_x_reversed={x_reversed} incli_y_reversed={y_reversed}",
}

US_PER_S: Final = NS_PER_S // NS_PER_US


def _example_frames(random: Random) -> list[CanFrame]:
    frames = encode_tpdos(
        accel_m_s2=random_vector(random, 5),
        gyro_rad_s=random_vector(random, 2),
        euler_rad=(random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)),
        quat_wxyz=(random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1)),
    )
    return [CanFrame(TPDO_FUNCTIONS[number] + NODE_DEFAULT, False, data, 0) for number, data in frames.items()]


def _filters(settings: HipnucCanopenOptions) -> list[CanFilter]:
    functions = (*TPDO_FUNCTIONS.values(), SDO_REPLY, HEARTBEAT, EMERGENCY)
    return [CanFilter(function + settings.node, STANDARD_ID_MAX, False) for function in functions]


_SIZES: Final = {function: LAYOUTS[number].size for number, function in TPDO_FUNCTIONS.items()}


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """Return the node number of a frame with the function and the length of a TPDO."""
    node = can_id & NODE_MASK
    return node if node and not extended and _SIZES.get(can_id & FUNCTION_MASK) == len(data) else None


def _cyclic(settings: HipnucCanopenOptions) -> list[CyclicFrame]:
    return [CyclicFrame(SYNC, False, b"", round(US_PER_S / settings.sync_hz) * NS_PER_US)] if settings.sync_hz else []


DRIVER: Final = CanDriver(
    name="hipnuc-canopen",
    never_sends=frozenset({"temperature_c"}),
    title="HiPNUC CH0x0, CH10x, HI14 (CANopen)",
    settings=HipnucCanopenOptions,
    make_codec=HipnucCanopenCodec,
    filters=_filters,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312 (Z-X-Y): pitch about X, roll about Y, yaw about Z counter-clockwise from above",
    navigation_frame="ENU",
    data_sheet=DataSheet(document=DOCUMENT, gyro_step_rad_s=GYRO_RAD_S_PER_LSB, accel_step_m_s2=ACCEL_M_S2_PER_LSB),
    verbs=VERBS,
    renamed=RENAMED,
    calibrations=inclinometer_zero("5.4.1", VERBS),
    device_settings=SETTINGS,
    firmware=FIRMWARE,
    sent_by=lambda settings: [CanFilter(settings.node, NODE_MASK, False)],
    node_of=_node_of,
    node_settings=lambda node: HipnucCanopenOptions(node=node),
    node_title=lambda node: f"node {node}",
    identify=lambda settings: identify(settings.node),
    sample_frames=4,
    example_frames=_example_frames,
    cyclic=_cyclic,
    unknown_name=lambda can_id: f"COB-ID 0x{can_id:03X}",
    decoded="imud decodes TPDO "
    + ", ".join(f"{number} (0x{function:03X} + node)" for number, function in TPDO_FUNCTIONS.items())
    + ": enable one of them in the device",
)
