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
    FILTERS,
    NAVIGATION_FRAME,
    SHEET,
    filter_code,
    i2c_address,
    relative_heading,
)
from imud.drivers.imu61x.uart import commands, settings
from imud.drivers.imu61x.uart.codec import (
    RESULT_DONE,
    TIMER_MODULUS,
    Imu61xCodec,
    Parameter,
    encode_ahrs,
    parse_acknowledgement,
    parse_status,
)
from imud.drivers.imu61x.uart.commands import (
    BAUD_RATES,
    BusMode,
    Imu61xUartOptions,
    acknowledged,
    answered,
    in_command_mode,
    read3,
    require_fit,
    settled,
)
from imud.drivers.imu61x.uart.settings import (
    GYRO_OFFSETS,
    INSTALLATION_ANGLES,
    SETTINGS,
    AccelFilter,
    Address,
    Baud,
    GyroFilter,
    OutputRate,
    SecondBus,
    codes_of,
    identify,
    read_settings,
    wake,
)
from imud.model.errors import BadArgument, NoReply
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

_BUS_NOTE: Final = (
    "effective immediately or after the next start (not documented); a host on the previously selected bus "
    "loses the device: change driver and link in its configuration"
)
_ADDRESS_NOTE: Final = (
    "effective immediately or after the next start (not documented); a host that uses the old address "
    "loses the device: change `i2c.address` in its configuration to the new address or `auto`"
)
_STOP_NOTE: Final = "no samples until `start_streaming`; with `save`, the device is silent after every power-on"


def _done(target: Target) -> int:
    return codes_of(target).result_done


def _factory_reset(target: Target) -> RequestScript[settings.BaudChange]:
    return settings.with_advice(settings.factory_reset(target.baud, done=_done(target)), target.fixed_baud)


def _baud(target: Target, *, baud: Baud) -> RequestScript[settings.BaudChange]:
    script = settings.change_baud(baud, target.baud, done=_done(target))
    return settings.with_advice(script, target.fixed_baud)


def _rate(target: Target, *, rate_hz: OutputRate) -> RequestScript[None]:
    if target.baud:
        try:
            require_fit(rate_hz, target.baud)
        except BadArgument as error:
            raise BadArgument(f"rate_hz: {error}; first change the baud rate with the verb `baud`") from None
    return settings.write_parameter(Parameter.AHRS_RATE, rate_hz)


def _filter(_target: Target, *, accel_filter: AccelFilter, gyro_filter: GyroFilter) -> RequestScript[Answer]:
    accel, gyro = filter_code(accel_filter), filter_code(gyro_filter)
    yield from settings.write_filters(accel, gyro)
    return {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro]}


def _i2c_address(_target: Target, *, address: Address) -> RequestScript[Answer]:
    number = i2c_address(address)
    yield from settings.write_parameter(Parameter.I2C_ADDRESS, number)
    return {"i2c_address": f"{number:#04x}", "configuration": _ADDRESS_NOTE}


def _bus(_target: Target, *, bus: SecondBus) -> RequestScript[Answer]:
    yield from settings.write_parameter(Parameter.BUS_MODE, BusMode[bus.upper()])
    return {"second_bus": bus, "configuration": _BUS_NOTE}


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
    "settings": Verb(
        "read all settings from the device, with units in their names",
        lambda _target: settings.read_settings(),
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
    "baud": Verb(
        "set and save the baud rate and follow the device; then change a fixed `uart.baud` in the configuration",
        _baud,
        Risk.CONNECTION,
        saves=True,
    ),
    "rate": Verb("set the output rate; the baud rate limits it", _rate),
    "filter": Verb("set the low-pass filters, by name or by code in the order of the names", _filter),
    "i2c_address": Verb(
        "set the I2C address; a host that uses the old address loses the device until you change its `i2c.address`",
        _i2c_address,
    ),
    "bus": Verb(
        "select the bus in addition to the UART; a host on the other bus loses the device and needs another link and "
        "driver",
        _bus,
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
    calibrations=CALIBRATIONS,
    device_settings=SETTINGS,
    identify=identify,
    read_settings=read_settings,
    wake=wake,
    example_frame=_example_frame,
)
