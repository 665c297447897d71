"""Row `DRIVER` of HiPNUC devices on SAE J1939: settings and verbs."""

from collections.abc import Collection, Mapping
from random import Random
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.attitude.rotation import euler312_from_quat
from imud.contracts.command import Proof, Risk, Target, Verb, VerbResult, Verbs
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver, random_vector
from imud.contracts.script import RequestScript
from imud.contracts.setting import DeviceReport, Effect, Reports, Setting, SettingsTable
from imud.drivers.hipnuc.bus_load import (
    RATE_NOTE,
    CyclicMessage,
    refuse_other_rate,
    refuse_overload,
    refuse_short_intervals,
)
from imud.drivers.hipnuc.common import REGISTERS, inclinometer_zero, random_quaternion, refuse_all, save_verb, zeroed
from imud.drivers.hipnuc.j1939 import codec, commands
from imud.drivers.hipnuc.j1939.codec import (
    CONFIGURE,
    HOST_ADDRESS,
    HipnucJ1939Codec,
    HipnucJ1939Options,
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
from imud.formats.j1939 import all_of, filter_of, pgn_name, sender_of

CONTENT: Final = {
    codec.UTC: "UTC", codec.ACCEL: "acceleration", codec.GYRO: "angular rate", codec.MAG: "magnetic field",
    codec.ROLL_PITCH: "roll and pitch", codec.HEADING: "heading", codec.TEMPERATURE: "temperature",
    codec.QUATERNION: "quaternion", codec.INCLINOMETER: "inclinometer", codec.PLACE: "latitude and longitude",
    codec.HEIGHT: "height", codec.GNSS: "state of the position", codec.VELOCITY: "velocity",
    codec.FAST_OLD: "sample on CAN FD, older", codec.FAST: "sample on CAN FD",
}  # fmt: skip


def interval_name(pgn: int) -> str:
    """Return the name of the setting for the interval of a message."""
    return f"{pgn:04x}_interval_ms"


# Registers of the settings, by name, in the order of the table
SETTING_REGISTERS: Final = {
    **{interval_name(pgn): register for pgn, register in INTERVALS.items()},
    "output_enabled": commands.OUTPUT,
    "x_reversed": commands.X_SIGN,
    "y_reversed": commands.Y_SIGN,
    "bit_rate": commands.BITRATE,
    "address": commands.ADDRESS,
}


def values_of(values: Mapping[int, int]) -> dict[str, Any]:
    """Return settings by name from registers, without values outside the table."""
    reported: dict[str, Any] = {name: values.get(register) for name, register in SETTING_REGISTERS.items()}
    for name in ("output_enabled", "x_reversed", "y_reversed"):
        reported[name] = {0: False, 1: True}.get(-1 if reported[name] is None else reported[name])
    code = reported["bit_rate"]
    reported["bit_rate"] = BITRATES[code] if code is not None and code < len(BITRATES) else None
    return {name: value for name, value in reported.items() if value is not None}


def _refuse_overload(target: Target, values: Mapping[str, Any]) -> None:
    sent = {
        f"{pgn:04X}": CyclicMessage(codec.MESSAGE_BYTES, True, values.get(interval_name(pgn), 0)) for pgn in INTERVALS
    }
    refuse_overload(sent, target.other_bits_per_s, target.baud)


def _check(target: Target, values: Mapping[str, Any]) -> None:
    """Raise BadArgument for another bit rate than the bus, short intervals, and messages that exceed the bus."""
    refuse_all(
        lambda: refuse_other_rate(target, values),
        lambda: refuse_short_intervals(values, map(interval_name, INTERVALS), INTERVAL_MIN_MS, INTERVAL_MAX_MS),
        lambda: _refuse_overload(target, values),
    )


def _read(target: Target, names: Collection[str] | None) -> RequestScript[Reports]:
    """Read registers; each register is a report with the name of its setting."""
    wanted = [number for name, number in SETTING_REGISTERS.items() if names is None or name in names]
    known, newer = ([one for one in wanted if (one in _NEWER) is is_newer] for is_newer in (False, True))
    values = yield from commands.read_values(target.settings.peer, known)
    if values or not known:
        # older firmware does not reply, and the script then stops after the first registers
        values |= yield from commands.read_values(target.settings.peer, newer)
    return {
        name: DeviceReport({_WORDS[number]: _text(number, values[number])}, values_of({number: values[number]}))
        for name, number in SETTING_REGISTERS.items()
        if number in values
    }


_WORDS: Final = {
    commands.ADDRESS: "address", commands.BITRATE: "bitrate", commands.X_SIGN: "x_reversed",
    commands.Y_SIGN: "y_reversed", commands.OUTPUT: "output_enabled",
    **{register: f"interval_ms_{pgn:04X}" for pgn, register in INTERVALS.items()},
}  # fmt: skip


NEWER: Final = "not in V1.5.9"  # section of a setting that the manual does not contain
# Registers of newer firmware
_NEWER: Final = {commands.OUTPUT, *(INTERVALS[pgn] for pgn in codec.NEWER_PGNS)}


def _text(register: int, value: int) -> str:
    return str(BITRATES[value] if register == commands.BITRATE and value < len(BITRATES) else value)


def _interval_setting(pgn: int) -> Setting:
    return Setting(
        type=Annotated[
            int,
            Meta(
                ge=commands.NEVER_MS,
                le=INTERVAL_MAX_MS,
                description=f"interval of the message with the {CONTENT[pgn]} (PGN {pgn:04X}), at least "
                f"{INTERVAL_MIN_MS}; 0: never",
                extra={"unit": "ms", "section": "6.2.2" if pgn in codec.MANUAL_PGNS else NEWER},
            ),
        ],
        write=lambda target, interval_ms: commands.set_interval(target.settings.peer, pgn, interval_ms),
        report=interval_name(pgn),
    )


def _sign(axis: Literal["X", "Y"]) -> Setting:
    words = f"whether the sign of the angle about {axis} is reversed"
    return Setting(
        type=Annotated[bool, Meta(description=words, extra={"section": "6.2.2"})],
        write=lambda target, is_reversed: commands.set_direction(target.settings.peer, axis, is_reversed),
        report=f"{axis.lower()}_reversed",
    )


SETTINGS: Final = SettingsTable(
    table={
        **{interval_name(pgn): _interval_setting(pgn) for pgn in INTERVALS},
        "output_enabled": Setting(
            type=Annotated[
                bool,
                Meta(description="whether the device sends messages periodically", extra={"section": NEWER}),
            ],
            write=lambda target, is_on: commands.set_output(target.settings.peer, is_on),
            report="output_enabled",
        ),
        "x_reversed": _sign("X"),
        "y_reversed": _sign("Y"),
        "bit_rate": Setting(
            type=Annotated[
                BitRate,
                Meta(
                    description="bit rate of the bus; another rate takes effect after `imud command NAME restart`",
                    extra={"unit": "bit/s", "section": "6.2.2"},
                ),
            ],
            write=lambda target, rate: commands.set_bitrate(target.settings.peer, rate),
            report="bit_rate",
            effect=Effect.AFTER_RESTART,
            connection=True,
            bus_rate=True,
            note=RATE_NOTE,
        ),
        "address": Setting(
            type=Annotated[
                int,
                Meta(
                    ge=MODULE_ADDRESS_MIN,
                    le=MODULE_ADDRESS_MAX,
                    description="address that is unused on the bus",
                    extra={"section": "6.2.2"},
                ),
            ],
            write=lambda target, address: commands.change_address(target.settings, address),
            report="address",
            effect=Effect.AFTER_RESTART,
            connection=True,
        ),
    },
    read=_read,
    save=lambda target: commands.save(target.settings.peer),
    restart=lambda target: commands.restart(target.settings, target.baud),
    check=_check,
)

Pgn = Annotated[PgnName, Meta(description="last four digits of the PGN", extra={"section": "6.1"})]


def _send_once(target: Target, *, pgn: Pgn) -> RequestScript[VerbResult]:
    return commands.send_once(target.settings.peer, int(pgn, 16))


def _zero(
    target: Target, *, zero: Annotated[Literal["here", "cancel"], Meta(extra={"section": "6.2.2"})]
) -> RequestScript[None]:
    return commands.zero(target.settings.peer, Zero[zero.upper()])


VERBS: Final[Verbs] = {
    "save": save_verb(lambda target: commands.save(target.settings.peer)),
    "restart": Verb(
        "restart the device and wait for its frames, also from a new address; unsaved settings are lost",
        lambda target: commands.restart(target.settings, target.baud),
        restarts=True,
        proof=Proof.RESTART,
        evidence="the device moves to another address or reports other settings; on CAN FD also: its counter restarts",
    ),
    "factory_reset": Verb(
        "restore the factory settings with address 8 and its bit rate, effective after a restart at the latest; "
        "imud rejects it if another node on the bus has address 8",
        lambda target: commands.factory_reset_and_find(target.settings),
        Risk.RESET,
        restarts=True,
        proof=Proof.SETTINGS,
    ),
    "send_once": Verb(
        "send a message once immediately and wait for it",
        _send_once,
        changes=False,
        proof=Proof.SCRIPT,
        evidence="the message arrives, and did not arrive for 1.1 s before",
    ),
    "zero": Verb("make the present position zero, or cancel it", _zero, proof=Proof.SAMPLES, expected=zeroed),
}


RENAMED: Final[Mapping[str, str]] = {
    "interval": "{pgn}_interval_ms={interval_ms}",
    "bitrate": "bit_rate={bitrate} --save",
    "address": "address={address} --save",
    "direction": "{axis}_reversed={reversed}",
}


def _example_frames(random: Random) -> list[CanFrame]:
    """Return a sample of the four PGNs that every device sends, with random values."""
    quat = random_quaternion(random)
    roll, pitch, yaw = euler312_from_quat(quat)

    made = (
        encode(codec.ACCEL, codec.pack_accel(random_vector(random, 9.8))),
        encode(codec.GYRO, codec.pack_gyro(random_vector(random, 2))),
        encode(codec.ROLL_PITCH, codec.pack_roll_pitch(roll, pitch)),
        encode(codec.HEADING, codec.pack_heading(yaw)),
    )
    return [CanFrame(can_id, True, data, 0) for can_id, data in made]


def _filters(settings: HipnucJ1939Options) -> list[CanFilter]:
    """Return the filters for the messages and replies of one device."""
    wanted = [filter_of(pgn, settings.address) for pgn in (codec.UTC, *settings.measured())]
    hosts = sorted({settings.host_address, HOST_ADDRESS})
    return wanted + [filter_of(CONFIGURE, settings.address, host) for host in hosts]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    return sender_of(can_id, extended, data, codec.MEASURED)


DRIVER: Final = CanDriver(
    name="hipnuc-j1939",
    title="HiPNUC CH0x0, CH10x, HI14 (CAN, SAE J1939)",
    settings=HipnucJ1939Options,
    make_codec=HipnucJ1939Codec,
    filters=_filters,
    sent_by=lambda settings: [all_of(settings.address)],
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above; "
    "NaN for an angle that the device does not send",
    navigation_frame="ENU",
    data_sheet=REGISTERS,
    verbs=VERBS,
    renamed=RENAMED,
    device_settings=SETTINGS,
    calibrations=inclinometer_zero("6.2.2", VERBS),
    node_of=_node_of,
    node_settings=lambda address: HipnucJ1939Options(address=address),
    node_title=lambda address: f"address {address}",
    identify=lambda settings: commands.identify(settings.peer),
    sample_frames=4,
    example_frames=_example_frames,
    unknown_name=pgn_name,
    decoded=f"imud decodes {', '.join(f'{pgn:04X}' for pgn in codec.MEASURED)}: enable one of these PGNs in "
    "the device, or check options.pgns",
)
