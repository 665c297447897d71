"""Row `DRIVER` of the Forsense IMU61x on a UART: verbs and calibrations."""

from collections.abc import Callable, Mapping
from random import Random
from typing import Annotated, Any, Final

from msgspec import Meta

from imud.attitude.conventions import FLU_LEVEL
from imud.contracts.command import (
    GYRO_ZERO,
    YAW_ZERO,
    Calibration,
    Calibrations,
    Handling,
    Kept,
    Risk,
    Target,
    Verb,
    Verbs,
)
from imud.contracts.driver import StreamDriver, random_vector
from imud.contracts.script import RequestScript, pause
from imud.drivers.imu61x.common import (
    EULER_CONVENTION,
    NAVIGATION_FRAME,
    SHEET,
    relative_heading,
)
from imud.drivers.imu61x.uart import commands, settings
from imud.drivers.imu61x.uart.codec import (
    RESULT_DONE,
    TIMER_MODULUS,
    Imu61xCodec,
    encode_ahrs,
    parse_acknowledgement,
    parse_status,
)
from imud.drivers.imu61x.uart.commands import (
    BAUD_RATES,
    Imu61xUartOptions,
    acknowledged,
    answered,
    in_command_mode,
    read3,
    settled,
)
from imud.drivers.imu61x.uart.settings import (
    GYRO_OFFSETS,
    INSTALLATION_ANGLES,
    SETTINGS,
    codes_of,
    identify,
    read_settings,
    wake,
)
from imud.model.errors import NoReply
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

POLL_NS: Final = 500 * NS_PER_MS
POLLS_MAX: Final = 120  # one minute; the manual states no time
# Time for the gyroscope calibration of a device that does not report its end, ns (assumed)
GYRO_NS: Final = 10 * NS_PER_S

# Returns whether the calibration has ended, and the state of the device as text
Finished = Callable[[], RequestScript[tuple[bool, str]]]


def calibrate_gyro(*, done: int = RESULT_DONE, rest: int = 0) -> RequestScript[Vector3]:
    """Measure the zero bias of the gyroscope at rest (CMD 10). Return it in °/s. Not saved.

    `done`: result of an acknowledgement, `rest`: calibration status, that mean finished. Raises NoReply, Rejected.
    """

    def calibrate() -> RequestScript[Vector3]:
        before = yield from read3(GYRO_OFFSETS)
        yield from acknowledged(commands.calibrate_gyro(), done)
        status = yield from settled()
        if status.calibration_status is None:
            yield from _until_changed(before)
        else:
            yield from _until("gyro calibration", lambda: _by_status(rest))
        return (yield from read3(GYRO_OFFSETS))

    return in_command_mode(calibrate)


def calibrate_installation(*, done: int = RESULT_DONE, rest: int = 0) -> RequestScript[Vector3]:
    """Measure the mounting error (CMD 7) and wait for the end. Return the angles about X, Y, Z in °. Not saved.

    `done` and `rest` as for the gyroscope. Raises NoReply, Rejected.
    """

    def calibrate() -> RequestScript[Vector3]:
        yield from acknowledged(commands.start_installation_calibration(), done)
        status = yield from settled()
        by_result = status.calibration_status is None
        finished = (lambda: _by_result(done)) if by_result else (lambda: _by_status(rest))
        yield from _until("installation calibration", finished)
        return (yield from read3(INSTALLATION_ANGLES))

    return in_command_mode(calibrate)


def installation_status() -> RequestScript[int | None]:
    """Read the state of the installation calibration (CMD 8); None if the reply does not contain it. Raises NoReply."""
    return in_command_mode(_installation_status)


def _installation_status() -> RequestScript[int | None]:
    message = yield from answered(commands.ask_installation_status())
    if (reply := parse_acknowledgement(message)) is not None:
        return reply.result
    status = parse_status(message)
    return status.calibration_status if status is not None else None


# --- end of a calibration ---------------------------------------------------------------------------------------


def _until(what: str, finished: Finished) -> RequestScript[None]:
    words = "none"
    for _ in range(POLLS_MAX):
        yield pause(POLL_NS)
        over, words = yield from finished()
        if over:
            return
    raise NoReply(
        f"{what}: expected its end within {POLLS_MAX * POLL_NS / NS_PER_S:.0f} s, got {words}; keep the device at rest"
    )


def _by_status(rest: int) -> RequestScript[tuple[bool, str]]:
    status = (yield from settled()).calibration_status
    return status == rest, f"calibration status {status} (`options.calibration_done`: {rest})"


def _by_result(done: int) -> RequestScript[tuple[bool, str]]:
    result = yield from _installation_status()
    return result == done, f"result {result} (`options.result_done`: {done})"


def _until_changed(before: Vector3) -> RequestScript[None]:
    """Wait for new offsets, at most GYRO_NS, because the new offsets may be equal to the old ones."""
    for _ in range(GYRO_NS // POLL_NS):
        yield pause(POLL_NS)
        if (yield from read3(GYRO_OFFSETS)) != before:
            return


Heading = Annotated[
    float, Meta(ge=0, le=360, description="the new heading", extra={"unit": "°", "section": "1.6, table 12, CMD 4"})
]
Answer = Mapping[str, Any]  # result of a verb, by name

_STOP_NOTE: Final = "no samples until `start_streaming`; with `save`, the device is silent after every power-on"


def _done(target: Target) -> int:
    return codes_of(target).result_done


def _factory_reset(target: Target) -> RequestScript[settings.BaudChange]:
    return settings.with_advice(settings.factory_reset(target.baud, done=_done(target)), target.fixed_baud)


def _stop(target: Target) -> RequestScript[Answer]:
    yield from settings.stop_streaming(done=_done(target))
    return {"output_mode": "command", "configuration": _STOP_NOTE}


def _heading(target: Target, *, heading_deg: Heading = 0.0) -> RequestScript[None]:
    return settings.reset_heading(heading_deg, done=_done(target))


def _gyro(target: Target) -> RequestScript[Vector3]:
    return calibrate_gyro(done=_done(target), rest=codes_of(target).calibration_done)


def _installation(target: Target) -> RequestScript[Vector3]:
    return calibrate_installation(done=_done(target), rest=codes_of(target).calibration_done)


VERBS: Final[Verbs] = {
    "status": Verb(
        "read versions, model and state; names that end in _raw have no documented unit",
        lambda _target: settings.device_status(),
        changes=False,
    ),
    "sample_once": Verb(
        "read and publish one sample, also in command mode", lambda _target: settings.sample_once(), changes=False
    ),
    "start_streaming": Verb(
        "start sending samples and wait for the first sample",
        lambda target: settings.start_streaming(done=_done(target)),
    ),
    "stop_streaming": Verb(
        "enter command mode: send only replies until `start_streaming`; no program receives samples",
        _stop,
    ),
    "save": Verb(
        "write all parameters to flash", lambda target: settings.save(done=_done(target)), saves=True, changes=False
    ),
    "restart": Verb(
        "restart the device, wait until it replies and check that its timer restarted; unsaved settings are lost",
        lambda target: settings.restart(done=_done(target)),
    ),
    "factory_reset": Verb(
        "restore, check and save the factory settings and follow the device to 115200 baud; then change a fixed "
        "`uart.baud`",
        _factory_reset,
        Risk.RESET,
        saves=True,
    ),
    "heading": Verb("set the heading", _heading),
    "calibrate_gyro": Verb("measure the bias of the gyroscope at rest and wait for the end; returns it in °/s", _gyro),
    "calibrate_installation": Verb(
        "measure the mounting error and wait for the end; returns the angles in °", _installation
    ),
    "installation_status": Verb(
        "read the state of the installation calibration, as sent",
        lambda _target: installation_status(),
        changes=False,
    ),
}

RENAMED: Final[Mapping[str, str]] = {
    "settings": "",
    "baud": "baud={baud} --save",
    "rate": "output_rate_hz={rate_hz}",
    "filter": "accel_filter={accel_filter} gyro_filter={gyro_filter}",
    "i2c_address": "i2c_address={address}",
    "bus": "second_bus={bus}",
}

_SAVE: Final = VERBS["save"].begin

CALIBRATIONS: Final[Calibrations] = {
    "gyro": Calibration(
        help="measure the bias of the gyroscope",
        section="1.6, CMD 10",
        handling=Handling.REST,
        instructions=("Put the device down, away from vibration, and do not touch it.",),
        begin=VERBS["calibrate_gyro"].begin,
        expected=(GYRO_ZERO,),
        kept=Kept.BY_SAVE,
        save=_SAVE,
    ),
    # no document states the effect of the angles on the samples: imud returns and does not check them
    "installation": Calibration(
        help="measure the mounting error and wait for the end",
        section="1.6, CMD 7 and 8",
        handling=Handling.REST,
        instructions=("Mount the device, level the body with the device, and let it rest.",),
        begin=VERBS["calibrate_installation"].begin,
        kept=Kept.BY_SAVE,
        save=_SAVE,
    ),
    "heading": Calibration(
        help="make the present heading zero",
        section="1.6, CMD 4",
        handling=Handling.REST,
        instructions=("Point the device in the direction of heading zero, and do not touch it.",),
        begin=VERBS["heading"].begin,
        expected=(YAW_ZERO,),
        kept=Kept.NEVER,
    ),
}


def _example_frame(random: Random) -> bytes:
    return encode_ahrs(
        timer_us=random.randrange(TIMER_MODULUS),
        accel_m_s2=random_vector(random, 9.8),
        gyro_rad_s=random_vector(random, 2),
        euler_rad=(random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)),
        temperature_c=random.uniform(-40, 85),
    )


DRIVER: Final = StreamDriver(
    name="imu61x-uart",
    title="Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B (UART)",
    baud_rates=BAUD_RATES,
    settings=Imu61xUartOptions,
    make_codec=Imu61xCodec,
    tick_ns=NS_PER_US,
    tick_modulus=TIMER_MODULUS,
    euler_convention=EULER_CONVENTION,
    navigation_frame=NAVIGATION_FRAME,
    data_sheet=SHEET,
    axes=FLU_LEVEL,
    heading=relative_heading,
    lines=frozenset({"reset"}),
    verbs=VERBS,
    renamed=RENAMED,
    calibrations=CALIBRATIONS,
    device_settings=SETTINGS,
    identify=identify,
    read_settings=read_settings,
    wake=wake,
    example_frame=_example_frame,
)
