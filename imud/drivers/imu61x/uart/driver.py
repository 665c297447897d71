"""Row `DRIVER` of the Forsense IMU61x on a UART: verbs and calibrations."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
    Proof,
    Risk,
    Target,
    Verb,
    VerbResult,
    Verbs,
    Verdict,
    yaw_at,
)
from imud.contracts.driver import StreamDriver, random_vector
from imud.contracts.script import Reply, ReplyFrame, Request, RequestScript, pause
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
    encode_ahrs,
    frame_name,
)
from imud.drivers.imu61x.uart.commands import (
    BAUD_RATES,
    REPLY_TIMEOUT_NS,
    STREAM,
    Imu61xUartOptions,
    Parameters3,
    answered,
    in_command_mode,
    no_acknowledgement,
    ordered,
    read3,
    settled,
)
from imud.drivers.imu61x.uart.raw import make_codec
from imud.drivers.imu61x.uart.settings import (
    GYRO_OFFSETS,
    INSTALLATION_ANGLES,
    SETTINGS,
    codes_of,
    identify,
    wake,
)
from imud.model.errors import NoReply
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

POLL_NS: Final = 500 * NS_PER_MS
# Number of polls with equal parameters after a change, 3 s: a device can write intermediate values (assumed)
EQUAL_POLLS: Final = 6
# Maximum time of a calibration until its parameters change, ns (assumed: the manual states no time)
CALIBRATION_NS: Final = 30 * NS_PER_S
GYRO_KEY: Final = "gyro_offset_deg_s"
INSTALLATION_KEY: Final = "installation_angles_deg"


@dataclass(frozen=True, slots=True)
class Calibrated:
    """Result of a calibration."""

    values: Vector3  # parameters after the calibration: °/s for the gyroscope, ° for the mounting error
    doubt: str = ""  # reason why the parameters do not show the end of the calibration; empty if they show it

    @property
    def changed(self) -> bool:
        """Whether the parameters changed, which shows the end of the calibration."""
        return not self.doubt

    @property
    def words(self) -> str:
        """Result with its evidence."""
        return f"{'verified' if self.changed else 'sent, not verified'}: {self.evidence}"

    @property
    def evidence(self) -> str:
        """Evidence, or the reason of a result that is not verified."""
        if self.changed:
            return f"the parameters changed to {_shown(self.values)}"
        return f"{self.doubt}: keep the device at rest, check the samples, and repeat the calibration"


def _shown(values: Vector3) -> str:
    return ", ".join(f"{value:g}" for value in values)


def calibrate_gyro(*, done: int = RESULT_DONE) -> RequestScript[Calibrated]:
    """Measure the zero bias of the gyroscope at rest (CMD 10). Return the offsets, °/s. Not saved.

    `done`: result of an acknowledgement that means executed. Raises NoReply, Rejected.
    """
    return in_command_mode(lambda: _calibrated(commands.calibrate_gyro(), GYRO_OFFSETS, done))


def calibrate_installation(*, done: int = RESULT_DONE) -> RequestScript[Calibrated]:
    """Measure the mounting error (CMD 7). Return the angles about X, Y, Z, °. Not saved. Raises NoReply, Rejected."""
    return in_command_mode(lambda: _calibrated(commands.start_installation_calibration(), INSTALLATION_ANGLES, done))


def _calibrated(request: Request, parameters: Parameters3, done: int) -> RequestScript[Calibrated]:
    """Start a calibration, and wait until its parameters changed and are constant, at most CALIBRATION_NS.

    An acknowledgement shows only that the device received the command. S1 contains no progress, and no document states
    the reply to CMD 8. Zeros can be the start of a calibration: the device may clear its parameters first.
    """
    before = last = yield from read3(parameters)
    fault = (yield from settled()).calibration_fault
    is_acknowledged = yield from ordered(request, done)
    left_ns, equal = CALIBRATION_NS, 0
    while left_ns > 0 and not (equal >= EQUAL_POLLS and last != before and any(last)):
        yield pause(POLL_NS)
        left_ns -= POLL_NS
        try:
            values = yield from read3(parameters, tries=1)
        except NoReply:  # the device is busy
            left_ns -= REPLY_TIMEOUT_NS
            continue
        equal, last = equal + 1 if values == last else 0, values
    status = yield from settled()  # raises NoReply if the device does not reply at all
    if status.calibration_fault not in (0, None, fault):
        return Calibrated(last, f"the device reports calibration fault {status.calibration_fault}")
    if last == before:
        if not is_acknowledged:
            raise no_acknowledgement(request)
        limit_s = CALIBRATION_NS // NS_PER_S
        words = f"the parameters stayed at {_shown(last)} for {limit_s} s"
        return Calibrated(last, f"{words}; nothing else shows the end of a calibration")
    if equal < EQUAL_POLLS:
        return Calibrated(last, f"the parameters still change, to {_shown(last)}")
    if not any(last):
        return Calibrated(last, "the parameters changed to 0, 0, 0, which can be the start of a calibration")
    return Calibrated(last)


def installation_status() -> RequestScript[Mapping[str, str]]:
    """Request the state of the installation calibration (CMD 8). Return the frame as sent. Raises NoReply."""
    return in_command_mode(_installation_status)


def _installation_status() -> RequestScript[Mapping[str, str]]:
    frame = yield from answered(commands.ask_installation_status())
    assert isinstance(frame, ReplyFrame)  # nothing else ends the request
    return {"frame_id": f"{frame.frame_id:#06x}", "payload": frame.payload.hex(" ")}


Heading = Annotated[
    float,
    Meta(
        ge=0,
        le=360,
        description="heading as imud publishes it, with `convention`, `frame` and `declination_deg`",
        extra={"unit": "°", "section": "1.6, table 12, CMD 4"},
    ),
]
DEGREES_PER_TURN: Final = 360.0
Answer = Mapping[str, Any]  # result of a verb, by name

_STOP_NOTE: Final = "no samples until `start_streaming`; with `save`, the device is silent after every power-on"


def _done(target: Target) -> int:
    return codes_of(target).result_done


def _factory_reset(target: Target) -> RequestScript[VerbResult]:
    had_factory_values = not (yield from settings.read_differences_from_factory())
    script = settings.factory_reset(target.baud, done=_done(target))
    change = yield from settings.with_advice(script, target.fixed_baud)
    if had_factory_values:
        return VerbResult(False, "all parameters had their factory values before the command", change)
    return VerbResult(True, "all parameters have their factory values, and some had other values before", change)


def _streams() -> RequestScript[bool]:
    """Return whether the device sends samples without a request."""
    return isinstance((yield commands.await_sample(settings.QUIET_NS)), Reply)


def _sample_once(_target: Target) -> RequestScript[VerbResult]:
    is_streaming = yield from _streams()
    words = yield from settings.sample_once()
    if is_streaming:
        return VerbResult(False, "the device also sends samples without the request", words)
    return VerbResult(True, "a sample arrived, and none arrived before the request", words)


def _start(target: Target) -> RequestScript[VerbResult]:
    was_streaming = yield from _streams()
    yield from settings.start_streaming(done=_done(target))
    if was_streaming:
        return VerbResult(False, "the device also sent samples before the command")
    return VerbResult(True, "a sample arrived, and none arrived before the command")


def _stop(target: Target) -> RequestScript[VerbResult]:
    was_streaming = yield from _streams()
    yield from settings.stop_streaming(done=_done(target))
    result = {"output_mode": "command", "configuration": _STOP_NOTE}
    if was_streaming:
        return VerbResult(True, "samples arrived before the command, and none after it", result)
    return VerbResult(False, "the device also sent no samples before the command", result)


def _heading(target: Target, *, heading_deg: Heading = 0.0) -> RequestScript[None]:
    return settings.reset_heading(heading_deg % DEGREES_PER_TURN, done=_done(target))


def _gyro(target: Target) -> RequestScript[VerbResult]:
    result = yield from calibrate_gyro(done=_done(target))
    return VerbResult(result.changed, result.evidence, {GYRO_KEY: result.values})


def _installation(target: Target) -> RequestScript[VerbResult]:
    result = yield from calibrate_installation(done=_done(target))
    return VerbResult(result.changed, result.evidence, {INSTALLATION_KEY: result.values})


def _verdict(calibrate: Callable[..., RequestScript[Calibrated]]) -> Callable[[Target], RequestScript[Verdict]]:
    def begin(target: Target) -> RequestScript[Verdict]:
        result = yield from calibrate(done=_done(target))
        return Verdict(result.changed, result.words)

    return begin


SAVED: Final = "the device acknowledged it, and imud cannot read the flash"

VERBS: Final[Verbs] = {
    "status": Verb(
        "read versions, model and state; names that end in _raw have no documented unit",
        lambda _target: settings.device_status(),
        changes=False,
    ),
    "sample_once": Verb(
        "read and publish one sample, also in command mode",
        _sample_once,
        changes=False,
        proof=Proof.SCRIPT,
        evidence="a sample arrives, and none arrived for 1.2 s before",
    ),
    "start_streaming": Verb(
        "start sending samples and wait for the first sample",
        _start,
        proof=Proof.SCRIPT,
        evidence="a sample arrives, and none arrived for 1.2 s before",
    ),
    "stop_streaming": Verb(
        "enter command mode: send only replies until `start_streaming`; no program receives samples",
        _stop,
        proof=Proof.SCRIPT,
        evidence="no sample arrives for 1.2 s, and samples arrived before",
    ),
    "save": Verb(
        "write all parameters to flash",
        lambda target: settings.save(done=_done(target)),
        saves=True,
        changes=False,
        proof=Proof.NONE,
        evidence=SAVED,
    ),
    "restart": Verb(
        "restart the device, wait until it replies and check that its timer restarted; unsaved settings are lost",
        lambda target: settings.restart(done=_done(target)),
        restarts=True,
        proof=Proof.SCRIPT,
        evidence="the timer restarted",
    ),
    "factory_reset": Verb(
        "restore, check and save the factory settings and follow the device to 115200 baud; then change a fixed "
        "`uart.baud`",
        _factory_reset,
        Risk.RESET,
        saves=True,
        restarts=True,
        proof=Proof.SCRIPT,
        evidence="all parameters have their factory values, and some had other values before",
    ),
    "heading": Verb(
        "set the heading",
        _heading,
        changes=False,
        heading="heading_deg",
        proof=Proof.SAMPLES,
        expected=lambda given: (yaw_at(given.heading_deg),),
    ),
    "calibrate_gyro": Verb(
        "measure the bias of the gyroscope at rest, and wait until the offsets change, at most 30 s",
        _gyro,
        proof=Proof.SCRIPT,
        evidence="the offsets change, and are then constant",
    ),
    "calibrate_installation": Verb(
        "measure the mounting error, and wait until the angles change, at most 30 s",
        _installation,
        proof=Proof.SCRIPT,
        evidence="the angles change, and are then constant",
    ),
    "installation_status": Verb(
        "request the state of the installation calibration; returns the frame as sent (no document describes it)",
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
        begin=_verdict(calibrate_gyro),
        expected=(GYRO_ZERO,),
        kept=Kept.BY_SAVE,
        save=_SAVE,
    ),
    # no document states the effect of the angles on the samples: imud returns and does not check them
    "installation": Calibration(
        help="measure the mounting error",
        section="1.6, CMD 7",
        handling=Handling.REST,
        instructions=("Mount the device, level the body with the device, and let it rest.",),
        begin=_verdict(calibrate_installation),
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
        mag_t=random.choice((None, random_vector(random, 5e-5))),
    )


DRIVER: Final = StreamDriver(
    name="imu61x-uart",
    title="Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B (UART)",
    baud_rates=BAUD_RATES,
    settings=Imu61xUartOptions,
    make_codec=make_codec,
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
    wake=wake,
    output_on=STREAM,
    example_frame=_example_frame,
    unknown_name=frame_name,
    decoded="imud decodes the AHRS frame (identifier 0x0002): select this output with the program of the vendor",
)
