"""Table: the row `DRIVER` of the Forsense IMU61x on a UART."""

from collections.abc import Callable, Mapping
from random import Random
from typing import Annotated, Any, Final

from msgspec import Meta

from imud.attitude.conventions import FLU_LEVEL
from imud.contracts.command import (
    GYRO_ZERO,
    YAW_ZERO,
    Action,
    Actions,
    Calibration,
    Calibrations,
    Handling,
    Kept,
    Risk,
    Target,
)
from imud.contracts.driver import StreamDriver
from imud.contracts.script import RequestScript, pause
from imud.drivers.imu61x.common import (
    EULER_CONVENTION,
    FILTER_CODES,
    FILTERS,
    NAVIGATION_FRAME,
    SHEET,
    filter_code,
    i2c_address,
    random_vector,
    relative_heading,
)
from imud.drivers.imu61x.uart import commands
from imud.drivers.imu61x.uart import settings as following
from imud.drivers.imu61x.uart import settings as session
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
    in_contact,
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
POLLS_MAX: Final = 120
"""A minute; the manual gives no time."""
GYRO_NS: Final = 10 * NS_PER_S
"""Time for the gyroscope of a device that does not tell when it has finished (assumed)."""

Finished = Callable[[], RequestScript[tuple[bool, str]]]
"""Asks whether the calibration is over, and for the device's state in words."""


def calibrate_gyro(*, done: int = RESULT_DONE, rest: int = 0) -> RequestScript[Vector3]:
    """Measure the gyroscope's zero bias (CMD 10), the device at rest; return it in °/s. Not saved.

    `done` is the result of an acknowledgement, `rest` the calibration status, that means finished.
    Raises NoReply, Rejected.
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

    return in_contact(calibrate)


def calibrate_installation(*, done: int = RESULT_DONE, rest: int = 0) -> RequestScript[Vector3]:
    """Measure the mounting error (CMD 7) and wait for the end; return the angles about X, Y, Z in °. Not saved.

    `done` and `rest` as for the gyroscope. Raises NoReply, Rejected.
    """

    def calibrate() -> RequestScript[Vector3]:
        yield from acknowledged(commands.start_installation_calibration(), done)
        status = yield from settled()
        by_result = status.calibration_status is None
        finished = (lambda: _by_result(done)) if by_result else (lambda: _by_status(rest))
        yield from _until("installation calibration", finished)
        return (yield from read3(INSTALLATION_ANGLES))

    return in_contact(calibrate)


def installation_status() -> RequestScript[int | None]:
    """Read the state of the installation calibration (CMD 8); None where the reply has none. Raises NoReply."""
    return in_contact(_installation_status)


def _installation_status() -> RequestScript[int | None]:
    message = yield from answered(commands.ask_installation_status())
    if (reply := parse_acknowledgement(message)) is not None:
        return reply.result
    status = parse_status(message)
    return status.calibration_status if status is not None else None


# --- the end ----------------------------------------------------------------------------------------------------------


def _until(what: str, finished: Finished) -> RequestScript[None]:
    words = "none"
    for _ in range(POLLS_MAX):
        yield pause(POLL_NS)
        over, words = yield from finished()
        if over:
            return
    raise NoReply(
        f"{what}: expected its end within {POLLS_MAX * POLL_NS / NS_PER_S:.0f} s, got {words}; is the device at rest?"
    )


def _by_status(rest: int) -> RequestScript[tuple[bool, str]]:
    status = (yield from settled()).calibration_status
    return status == rest, f"calibration status {status} (`options.calibration_done`: {rest})"


def _by_result(done: int) -> RequestScript[tuple[bool, str]]:
    result = yield from _installation_status()
    return result == done, f"result {result} (`options.result_done`: {done})"


def _until_changed(before: Vector3) -> RequestScript[None]:
    """Wait for new offsets, GYRO_NS at most: those of before may be found again."""
    for _ in range(GYRO_NS // POLL_NS):
        yield pause(POLL_NS)
        if (yield from read3(GYRO_OFFSETS)) != before:
            return


Heading = Annotated[
    float, Meta(ge=0, le=360, description="the new heading", extra={"unit": "°", "section": "1.6, table 12, CMD 4"})
]
Answer = Mapping[str, Any]
"""What an action answers, by name."""

_BUS_NOTE: Final = (
    "in force at once or at the next start, which the manual leaves open; a host on the bus that was selected before "
    "loses the device: there, a driver and link of the new bus belong in the configuration"
)
_ADDRESS_NOTE: Final = (
    "in force at once or at the next start, which the manual leaves open; a host that reads it at the old address "
    "loses it: there, `i2c.address` must be the new one, or `auto`"
)
_STOP_NOTE: Final = "no samples until `start_streaming`; saved now, it starts silent at every power-on"


def _done(target: Target) -> int:
    return codes_of(target).result_done


def _factory_reset(target: Target) -> RequestScript[following.BaudChange]:
    return following.with_advice(following.factory_reset(target.baud, done=_done(target)), target.fixed_baud)


def _baud(target: Target, *, baud: Baud) -> RequestScript[following.BaudChange]:
    script = following.change_baud(baud, target.baud, done=_done(target))
    return following.with_advice(script, target.fixed_baud)


def _rate(target: Target, *, rate_hz: OutputRate) -> RequestScript[None]:
    if target.baud:
        try:
            require_fit(rate_hz, target.baud)
        except BadArgument as error:
            raise BadArgument(f"rate_hz: {error}; set that first (`baud`)") from None
    return session.write_parameter(Parameter.AHRS_RATE, rate_hz)


def _filter(_target: Target, *, accel_filter: AccelFilter, gyro_filter: GyroFilter) -> RequestScript[Answer]:
    accel, gyro = filter_code(accel_filter), filter_code(gyro_filter)
    yield from session.write_filters(accel, gyro)
    return {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro]}


def _i2c_address(_target: Target, *, address: Address) -> RequestScript[Answer]:
    number = i2c_address(address)
    yield from session.write_parameter(Parameter.I2C_ADDRESS, number)
    return {"i2c_address": f"{number:#04x}", "configuration": _ADDRESS_NOTE}


def _bus(_target: Target, *, bus: SecondBus) -> RequestScript[Answer]:
    yield from session.write_parameter(Parameter.BUS_MODE, BusMode[bus.upper()])
    return {"second_bus": bus, "configuration": _BUS_NOTE}


def _stop(target: Target) -> RequestScript[Answer]:
    yield from session.stop_streaming(done=_done(target))
    return {"output_mode": "command", "configuration": _STOP_NOTE}


def _heading(target: Target, *, heading_deg: Heading = 0.0) -> RequestScript[None]:
    return session.reset_heading(heading_deg, done=_done(target))


def _gyro(target: Target) -> RequestScript[Vector3]:
    return calibrate_gyro(done=_done(target), rest=codes_of(target).calibration_done)


def _installation(target: Target) -> RequestScript[Vector3]:
    return calibrate_installation(done=_done(target), rest=codes_of(target).calibration_done)


ACTIONS: Final[Actions] = {
    "status": Action(
        "ask for versions, model and state, by name; names that end in _raw have no documented unit",
        lambda _target: session.device_status(),
    ),
    "settings": Action(
        "read all settings from the device, units in their names", lambda _target: session.read_settings()
    ),
    "sample_once": Action(
        "ask for one sample, also in command mode; answers and publishes it", lambda _target: session.sample_once()
    ),
    "start_streaming": Action(
        "send samples; waits for the first", lambda target: session.start_streaming(done=_done(target))
    ),
    "stop_streaming": Action(
        "command mode: send nothing but replies, until `start_streaming`; cuts off all programs that read samples",
        _stop,
    ),
    "save": Action("write all parameters to flash", lambda target: session.save(done=_done(target)), saves=True),
    "restart": Action(
        "restart it, wait until it answers, and see that its timer began again; what was not saved is lost",
        lambda target: following.restart(done=_done(target)),
    ),
    "factory_reset": Action(
        "factory settings, read back, saved, and followed to their 115200 baud, which a fixed `uart.baud` must then be",
        _factory_reset,
        Risk.RESET,
        saves=True,
    ),
    "baud": Action(
        "set and save the baud rate and follow; a fixed `uart.baud` in the configuration must then be the new one",
        _baud,
        Risk.CONNECTION,
        saves=True,
    ),
    "rate": Action("set the output rate, as far as the baud rate carries it", _rate),
    "filter": Action(f"set the low-pass filters, by name or code: {FILTER_CODES}", _filter),
    "i2c_address": Action(
        "set the I2C address; a host that reads the device at the old one loses it until `i2c.address` there is the "
        "new one",
        _i2c_address,
    ),
    "bus": Action(
        "set the second bus, next to the UART; a host on the other bus loses the device, and needs the other link and "
        "driver",
        _bus,
    ),
    "heading": Action("set the heading", _heading),
    "calibrate_gyro": Action(
        "measure the gyroscope's bias, the device at rest, and wait for the end; answers it in °/s", _gyro
    ),
    "calibrate_installation": Action(
        "measure the mounting error and wait for its end; answers the angles in °", _installation
    ),
    "installation_status": Action(
        "state of the installation calibration, as sent", lambda _target: installation_status()
    ),
}

_SAVE: Final = ACTIONS["save"].begin

CALIBRATIONS: Final[Calibrations] = {
    "gyro": Calibration(
        help="measure the bias of the gyroscope",
        section="1.6, CMD 10",
        handling=Handling.REST,
        instructions=("Put the device down, away from vibration, and do not touch it.",),
        begin=ACTIONS["calibrate_gyro"].begin,
        expected=(GYRO_ZERO,),
        kept=Kept.BY_SAVE,
        save=_SAVE,
    ),
    "installation": Calibration(
        help="measure the mounting error and wait for the end",
        section="1.6, CMD 7 and 8",
        handling=Handling.REST,
        instructions=("Mount the device, bring the body that carries it to level, and let it rest.",),
        begin=ACTIONS["calibrate_installation"].begin,
        kept=Kept.BY_SAVE,
        save=_SAVE,
    ),
    "heading": Calibration(
        help="make the present heading zero",
        section="1.6, CMD 4",
        handling=Handling.REST,
        instructions=("Point the device to where its heading is to be zero, and do not touch it.",),
        begin=ACTIONS["heading"].begin,
        expected=(YAW_ZERO,),
        kept=Kept.NEVER,
    ),
}
"""What the angles of `installation` do to the samples is in no source: they are answered and not checked."""


def _example_frame(random: Random) -> bytes:
    """An AHRS frame with random values."""
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
    actions=ACTIONS,
    calibrations=CALIBRATIONS,
    device_settings=SETTINGS,
    identify=identify,
    read_settings=read_settings,
    wake=wake,
    example_frame=_example_frame,
)
