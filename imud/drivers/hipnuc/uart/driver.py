"""Row `DRIVER` of HiPNUC devices on a UART: verbs and calibrations."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import remainder
from random import Random
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.attitude.rotation import euler312_from_quat
from imud.contracts.codec import StreamCodec
from imud.contracts.command import (
    YAW_ZERO,
    Calibration,
    Calibrations,
    Handling,
    Kept,
    Proof,
    Risk,
    Target,
    Verb,
    Verbs,
    Verdict,
    yaw_at,
)
from imud.contracts.driver import Identity, StreamDriver, random_vector
from imud.contracts.script import RequestScript, Silence
from imud.drivers.hipnuc.common import (
    FLOATS,
    MAIN_STATUS,
    NINE_AXES_NEEDED,
    TURNING,
    LevelReset,
    heading_by_mode,
    levelled,
    levels,
    magnetometer,
    random_quaternion,
    save_verb,
)
from imud.drivers.hipnuc.uart import commands, firmware
from imud.drivers.hipnuc.uart.codec import (
    HEADER,
    PPS_STAMP_MODULUS_MS,
    TIME_BITS,
    HipnucCodec,
    HipnucOptions,
    encode_frame,
    encode_hi91,
    encode_hi92,
    tag_name,
)
from imud.drivers.hipnuc.uart.commands import (
    BAUD_RATES,
    OutputMessage,
    Query,
    YawMode,
    ask,
    identify,
    send,
    wake,
)
from imud.drivers.hipnuc.uart.ins import FIELDS, WEEK_MS, pack_hi81, pack_hi83
from imud.drivers.hipnuc.uart.kboot import FIRMWARE
from imud.drivers.hipnuc.uart.replies import numbers_of, parse_report
from imud.drivers.hipnuc.uart.settings import (
    RFU_312,
    SETTINGS,
    alarm_ranges,
    axes_by_settings,
    declared_line_differences,
    line_differences,
    message_limits,
    shown,
    why_silent,
)
from imud.model.errors import NoReply, Rejected
from imud.model.sample import Measurement, Position
from imud.model.units import NS_PER_MS, T_PER_UT

Message = Annotated[OutputMessage, Meta(extra={"section": "2.2.5"})]
DEGREES_PER_TURN: Final = 360.0
Degrees = Annotated[
    float,
    Meta(
        ge=-180,
        le=360,
        description="heading as imud publishes it, with `convention`, `frame` and `declination_deg`; without them "
        "counter-clockwise from above",
        extra={"unit": "°", "section": "2.2.4"},
    ),
]


def _restart(target: Target) -> RequestScript[Identity]:
    return commands.restart(target.baud)


def _factory_reset(target: Target) -> RequestScript[dict[str, int | str]]:
    return _followed(target, commands.reset_to_factory(target.baud))


def _followed(target: Target, script: RequestScript[int]) -> RequestScript[dict[str, int | str]]:
    """Return the new baud rate of the device, and a necessary change of the configuration."""
    baud = yield from script
    answer: dict[str, int | str] = {"baud": baud}
    if advice := commands.advice(baud, target.fixed_baud):
        answer["configuration"] = advice
    return answer


def _wake(target: Target) -> RequestScript[str]:
    return commands.wake_by_force(target.baud)


def _output_once(_target: Target, *, message: Message) -> RequestScript[None]:
    return commands.send_once(message)


def _level(
    _target: Target,
    *,
    level: Annotated[Literal["relative", "automatic", "cancel"], Meta(extra={"section": "2.2.4"})],
) -> RequestScript[None]:
    return send(commands.level_reset(LevelReset[level.upper()]))


def _yaw(
    _target: Target,
    *,
    angle_deg: Degrees,
    relative: Annotated[bool, Meta(description="whether to add the angle to the present heading")] = False,
) -> RequestScript[None]:
    mode = YawMode.RELATIVE if relative else YawMode.ABSOLUTE
    return send(commands.yaw(mode, remainder(angle_deg, DEGREES_PER_TURN)))


VERBS: Final[Verbs] = {
    "save": save_verb(lambda _target: send(commands.save_config())),
    "restart": Verb(
        "restart the device and wait until it replies; unsaved settings are lost",
        _restart,
        restarts=True,
        proof=Proof.RESTART,
    ),
    "factory_reset": Verb(
        "restore the factory settings with 115200 baud, restart the device and follow it",
        _factory_reset,
        Risk.RESET,
        restarts=True,
        proof=Proof.SETTINGS,
    ),
    "wake": Verb(
        "enable frames, and send HI91 if no message has a rate, also in place of output on mark; not saved",
        _wake,
        proof=Proof.STREAM,
    ),
    "output_once": Verb(
        "send a message once, as after a pulse on SIN", _output_once, changes=False, proof=Proof.ONE_SAMPLE
    ),
    "level": Verb(
        "make the present pitch and roll zero, or level a nearly level device, or cancel; only at rest",
        _level,
        proof=Proof.SAMPLES,
        expected=levelled,
    ),
    "yaw": Verb(
        "set the heading; lost at power-off",
        _yaw,
        changes=False,
        heading="angle_deg",
        proof=Proof.SAMPLES,
        expected=lambda given: () if given.relative else (yaw_at(given.angle_deg),),
    ),
    "reset_attitude": Verb(
        "send ATT RST 1 or 4 of older firmware",
        firmware.reset_attitude,
        proof=Proof.NONE,
        evidence="no document describes the effect",
    ),
    "ins_config": Verb("read the configuration of an INS model", firmware.ins_config, changes=False),
}


RENAMED: Final[Mapping[str, str]] = {
    "baud": "baud={baud} --save",
    "output": "output.{message}={rate_hz}",
    "output_on_mark": "output.{message}=on_mark",
    "output_none": "output.hi91=0 output.hi92=0",
    "output_enabled": "output_enabled={enabled}",
    "mode": "mode={axes}-axis",
    "mounting": "mounting={turned} --save",
    "magnetic_calibration": "magnetic_calibration={enabled}",
    "pin": "pins.{function}={pin}",
    "alarm": "alarm.{axis}.min_deg={min_deg} alarm.{axis}.max_deg={max_deg} alarm.{axis}.enabled={enabled|true}",
    "sout_divider": "sout_divisor={divisor}",
}


def _nine_axes_needed(_target: Target) -> RequestScript[str]:
    settings = yield from commands.read_report(Query.USRCONFIG)
    if settings is not None and settings.get("ATT_MODE") == "0":
        return NINE_AXES_NEEDED
    return ""


def _start_magnetometer(_target: Target) -> RequestScript[None]:
    return send(commands.magnetic_calibration(enabled=True))


def _magnetometer_verdict(_target: Target) -> RequestScript[Verdict]:
    """Read the bias of the magnetometer. Raises NoReply, Rejected."""
    request = ask(Query.MAGCONFIG)
    outcome = yield request
    if isinstance(outcome, Silence):
        raise NoReply("LOG MAGCONFIG: expected lines up to OK, got no reply; does the device have a magnetometer?")
    bias = numbers_of(parse_report(commands.require_reply(request, outcome)).values.get("MB", ""), 3)
    if bias is None:
        return Verdict(done=False, words="the device does not report its bias")
    words = "bias " + ", ".join(f"{value:g}" for value in bias) + " µT"
    x, y, z = (value * T_PER_UT for value in bias)
    return Verdict(done=any(bias), words=words, bias_t=(x, y, z))


def _keep_magnetometer(_target: Target) -> RequestScript[None]:
    yield from send(commands.magnetic_calibration(enabled=False))
    yield from send(commands.save_config())


def _save(_target: Target) -> RequestScript[None]:
    return send(commands.save_config())


def _start(planar: bool) -> Callable[[Target], RequestScript[object]]:
    return lambda _target: commands.send_if_known(firmware.start_calibration(planar))


def _started_verdict(target: Target) -> RequestScript[Verdict]:
    """Read the state of a calibration that a command started, then its bias. Raises NoReply, Rejected.

    A bias that imud reads before the state can be older than the end of the calibration.
    """
    state = yield from firmware.calibration_state()
    bias = yield from _magnetometer_verdict(target)
    words = ", ".join(filter(None, (bias.words, state.words)))
    return replace(state, words=words, bias_t=bias.bias_t)


def _calibration_unknown(_target: Target) -> RequestScript[str]:
    """Return why the firmware cannot start a calibration by a command; empty if it can."""
    try:
        yield from commands.send_if_known(firmware.ask_calibration())
    except Rejected as error:
        return str(error)
    return ""


_MAGNETOMETER: Final = magnetometer(_start_magnetometer, _magnetometer_verdict, _nine_axes_needed)

CALIBRATIONS: Final[Calibrations] = {
    "magnetometer": _MAGNETOMETER,
    "magnetometer_once": replace(
        _MAGNETOMETER,
        help="measure the magnetic field of the mount; `save` disables the background calibration",
        section="8.2",
        kept=Kept.BY_SAVE,
        save=_keep_magnetometer,
    ),
    "magnetometer_start": replace(
        _MAGNETOMETER,
        help="measure the magnetic field of the mount by a command of newer firmware, with its progress",
        section=firmware.SOURCE,
        begin=_start(planar=False),
        verdict=_started_verdict,
        reports_start=True,
        unready=_calibration_unknown,
    ),
    "magnetometer_2d": replace(
        _MAGNETOMETER,
        help="measure the horizontal magnetic field of a vehicle by a command of newer firmware, with its progress",
        section=firmware.SOURCE,
        handling=Handling.SPIN,
        instructions=(
            TURNING[0],
            "Turn the vehicle slowly, level and in one place: at least two full turns. The second turn verifies the "
            "result.",
        ),
        begin=_start(planar=True),
        verdict=_started_verdict,
        reports_start=True,
        unready=_calibration_unknown,
    ),
    **levels("2.2.4", 5, lambda kind: lambda _target: send(commands.level_reset(kind)), _save),
    "heading": Calibration(
        help="make the present heading zero",
        section="2.2.4",
        handling=Handling.REST,
        instructions=("Point the device in the direction of heading zero, and do not touch it.",),
        begin=lambda _target: send(commands.yaw(YawMode.ABSOLUTE, 0.0)),
        expected=(YAW_ZERO,),
        kept=Kept.NEVER,
    ),
}


def _example_frame(random: Random) -> bytes:
    """Return HI91, HI92, both, HI81 or HI83 with random values."""
    quat = random_quaternion(random)
    common: Mapping[str, Any] = {
        "accel_m_s2": (random.gauss(0, 5), random.gauss(0, 5), random.gauss(9.8, 5)),
        "gyro_rad_s": random_vector(random, 2),
        "mag_t": random_vector(random, 5e-5),
        "quat_wxyz": quat,
        "euler_rad": euler312_from_quat(quat),
        "temperature_c": random.uniform(-40, 85),
        "pressure_pa": random.uniform(80_000, 110_000),
    }
    word = random.randrange(PPS_STAMP_MODULUS_MS)
    floats = encode_hi91(system_time_ms=random.randrange(2**32), word_1_2=word, **common)
    integers = encode_hi92(pps_stamp_ms=word, status=random.randrange(2**16), **common)
    both = encode_frame(floats[HEADER.size :] + integers[HEADER.size :])
    place = Position(
        random.uniform(-1.5, 1.5), random.uniform(-3, 3), random.uniform(-400, 9000), random.randrange(6),
        random.randrange(60),
    )  # fmt: skip
    moving = Measurement(
        0, 0, None, **common, velocity_enu_m_s=random_vector(random, 10), position=place, heave_m=random.gauss(0, 1),
        gnss_utc_ns=random.randrange(1_600_000_000_000, 1_900_000_000_000) * NS_PER_MS,
    )  # fmt: skip
    week, tow_ms = random.randrange(1, 4000), random.randrange(WEEK_MS)
    hi81 = encode_frame(pack_hi81(moving, ins_status=3, week=week, tow_ms=tow_ms))
    bitmap = sum(1 << bit for bit in random.sample(sorted(FIELDS), 5))  # at most 134 bytes, as HI91 and HI92 together
    hi83 = encode_frame(pack_hi83(moving, bitmap, ins_status=3, system_time_us=random.getrandbits(48)))
    return random.choice((floats, floats, integers, both, hi81, hi83))


def _apply_identity(codec: StreamCodec, identity: Identity) -> None:
    version = (identity.details or {}).get("APP_VER", "")
    if isinstance(codec, HipnucCodec) and version.isdecimal():
        codec.learn_app_ver(int(version))


DRIVER: Final = StreamDriver(
    name="hipnuc-uart",
    title="HiPNUC CH0x0, CH10x, HI14 (UART, RS-232, USB)",
    baud_rates=BAUD_RATES,
    settings=HipnucOptions,
    make_codec=HipnucCodec,
    tick_ns=NS_PER_MS,
    tick_modulus=2**32,
    stamp_modulus=PPS_STAMP_MODULUS_MS,
    euler_convention=RFU_312.euler_convention,
    navigation_frame=RFU_312.navigation_frame,
    axes_by_settings=axes_by_settings,
    heading=heading_by_mode,
    lines=frozenset({"sout", "sout_div", "sin", "alarm", "pps"}),
    alarm_ranges=alarm_ranges,
    time_bits=TIME_BITS,
    status_bits=MAIN_STATUS,
    data_sheet=FLOATS,
    shown_settings=shown,
    line_differences=line_differences,
    declared_line_differences=declared_line_differences,
    limits=message_limits,
    verbs=VERBS,
    renamed=RENAMED,
    device_settings=SETTINGS,
    firmware=FIRMWARE,
    calibrations=CALIBRATIONS,
    identify=identify,
    apply_identity=_apply_identity,
    wake=wake,
    why_silent=why_silent,
    example_frame=_example_frame,
    unknown_name=tag_name,
    decoded="imud decodes HI91, HI92, HI81 and HI83: select one with `imud settings NAME --set output.hi91=100`",
)
