"""Hardware of a simulated HiPNUC device, its settings in RAM and flash, the commands that change them, status bits.

IMU configuration manual V1.5.9, chapters 2.2.3 to 2.2.6 and 8.2. The manual prints only `ATT_MODE: 0` of the replies to
USRCONFIG and COMCONFIG. The other lines are assumptions.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import product
from math import tau
from typing import Any, Final, Literal

from imud.attitude.rotation import Matrix3, euler_zyx_from_quat, is_rotation, quat_product
from imud.drivers.hipnuc.uart.commands import BAUD_RATES
from imud.formats.nmea0183 import Rmc, parse
from imud.model.sample import Quaternion, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.physics import Truth
from imud.sim.sensor import SensorHardware


class RateChange(Enum):
    """Moments at which SERIALCONFIG changes the baud rate."""

    AFTER_RESTART = "after restart"  # after SAVECONFIG and REBOOT
    BEFORE_ANSWER = "before answer"  # immediately: the reply has the new rate
    AFTER_ANSWER = "after answer"  # immediately after the reply: the reply has the old rate


class ResetEffect(Enum):
    """Moments at which FRESET applies the factory settings."""

    RATE_AFTER_RESTART = "rate after restart"  # all settings immediately, the baud rate after a restart
    AFTER_RESTART = "after restart"  # all settings after a restart
    BEFORE_ANSWER = "before answer"  # all settings immediately: the reply has the rate of the factory


class CalibrationFault(Enum):
    """Faults of the calibration that CONFIG MCAL START starts. Each fault still replies OK to the command."""

    NONE = "none"
    IGNORED = "ignored"  # the device does nothing, and still reports the state of an earlier calibration
    NO_BIAS = "no bias"  # the device reports RUNNING and then DONE, and its bias stays 0
    FAILS = "fails"  # the device reports RUNNING and then FAILED


@dataclass(frozen=True, slots=True, kw_only=True)
class Behaviour:
    """One interpretation of the manual."""

    rate_change: RateChange = RateChange.AFTER_RESTART
    factory_reset: ResetEffect = ResetEffect.RATE_AFTER_RESTART
    flash_ms: int = 0  # Time of SAVECONFIG and FRESET until their reply, ms. The device sends no frame in this time.
    quiet_ms: int = 0  # time after a reply without frames, ms
    refuses: tuple[str, ...] = ()  # first words of commands that the device refuses with ERR
    ignores: tuple[str, ...] = ()  # First words of commands that the device does not know. It sends no reply.
    firmware: int = 156  # firmware version without another option
    # Firmware 1.6.9 and newer: COORD, URFR by digits, MCAL, two ports, NMEA sentences between the lines of a reply,
    # `system_time` modulo 24 h, ERR for unknown commands. The lines of its reports are assumptions.
    newer: bool = False
    calibration: CalibrationFault = CalibrationFault.NONE
    # First words of commands. The reply to the first command with these words is lost on the wire.
    loses: tuple[str, ...] = ()
    older: bool = False  # codes of older firmware: ZARU, ABW, ARG, GBW, GRG, INC_FMT, and ATT RST 1 and 4
    ins: bool = False  # messages and commands of INS models; the device does not send these messages


AS_IN_MANUAL: Final = Behaviour()

# Simulated variants by name.
VARIANTS: Final[Mapping[str, Behaviour]] = {
    "as in the manual": AS_IN_MANUAL,
    "rate changes before the answer": Behaviour(rate_change=RateChange.BEFORE_ANSWER),
    "rate changes after the answer": Behaviour(rate_change=RateChange.AFTER_ANSWER),
    "factory reset after restart": Behaviour(factory_reset=ResetEffect.AFTER_RESTART),
    "factory reset at once": Behaviour(factory_reset=ResetEffect.BEFORE_ANSWER),
    "slow flash": Behaviour(flash_ms=2000),
    "no magnetometer": Behaviour(ignores=("LOG MAGCONFIG",)),
    "magnetometer refused": Behaviour(refuses=("LOG MAGCONFIG",)),
    "quiet after an answer": Behaviour(quiet_ms=700),
    "firmware 1.7": Behaviour(newer=True, firmware=170),
    "calibration ignored": Behaviour(newer=True, firmware=170, calibration=CalibrationFault.IGNORED),
    "calibration without bias": Behaviour(newer=True, firmware=170, calibration=CalibrationFault.NO_BIAS),
    "calibration fails": Behaviour(newer=True, firmware=170, calibration=CalibrationFault.FAILS),
    "lost replies": Behaviour(newer=True, firmware=170, loses=("LOG MCAL STAT", "CONFIG MCAL START", "CONFIG IMU")),
    "INS, firmware 1.7": Behaviour(newer=True, ins=True, firmware=170),
    "older firmware": Behaviour(older=True, firmware=120),
    "all at once": Behaviour(
        rate_change=RateChange.BEFORE_ANSWER, factory_reset=ResetEffect.BEFORE_ANSWER, flash_ms=2000, quiet_ms=300
    ),
}

Epoch = Literal["unix", "day"]
MODULUS_MS: Final[dict[Epoch, int]] = {"unix": 2**32, "day": 86_400_000}
MS_PER_S: Final = 1000
STEP_TOLERANCE_NS: Final = 10 * NS_PER_MS
INTERVALS_NEEDED: Final = 2
SENTENCES_NEEDED: Final = 2
# Maximum distance of a pulse from a full second at which it counts without a sentence, ns.
REGAIN_NS: Final = 100 * NS_PER_MS
LOST_NS: Final = 2 * NS_PER_S
UPTIME_MODULUS_MS: Final = 2**32


class UtcTime:
    """UTC in the frames of the device. Arguments are device time since power-on, ns. Synchronization: one thread."""

    def __init__(self, epoch: Epoch, *, wraps_daily: bool = False) -> None:
        """`wraps_daily`: the device counts modulo 24 h, also without UTC."""
        self._modulus_ms = MODULUS_MS["day" if wraps_daily else epoch]
        self._uptime_modulus_ms = MODULUS_MS["day"] if wraps_daily else UPTIME_MODULUS_MS
        self._anchor: tuple[int, int] | None = None  # device time of a pulse and the UTC second of this pulse
        self._pulse_ns: int | None = None
        self._intervals = 0  # number of correct intervals up to the last pulse
        self._claim_s: int | None = None  # UTC second that sentences give for the last pulse
        self._agreed = 0

    def pulse(self, device_ns: int) -> None:
        """Process a rising edge on SIN/PPS."""
        in_step = self._pulse_ns is not None and abs(device_ns - self._pulse_ns - NS_PER_S) <= STEP_TOLERANCE_NS
        if in_step and self._claim_s is not None:
            self._claim_s += 1
        elif not in_step:
            self._claim_s, self._agreed = None, 0
        self._intervals = self._intervals + 1 if in_step else 0
        self._pulse_ns = device_ns
        if self._anchor is not None:
            anchor_ns, second = self._anchor
            seconds = round((device_ns - anchor_ns) / NS_PER_S)
            if seconds and abs(device_ns - anchor_ns - seconds * NS_PER_S) <= REGAIN_NS:
                self._anchor = device_ns, second + seconds

    def sentence(self, line: bytes, device_ns: int) -> None:
        """Process a line that starts with `$`. Ignore all lines except valid RMC sentences."""
        rmc = parse(line)
        if not isinstance(rmc, Rmc) or not rmc.valid or self._pulse_ns is None:
            return
        age_ns = device_ns - self._pulse_ns
        if self._intervals < INTERVALS_NEEDED or not rmc.fraction_ns <= age_ns < NS_PER_S:
            return
        self._agreed = self._agreed + 1 if rmc.unix_s == self._claim_s else 1
        self._claim_s = rmc.unix_s
        if self._agreed >= SENTENCES_NEEDED:
            self._anchor = self._pulse_ns, rmc.unix_s

    def synchronised(self, device_ns: int) -> bool:
        """Return whether the time is UTC and pulses keep it correct."""
        return self._anchor is not None and device_ns - self._anchor[0] < LOST_NS

    def shown_ms(self, device_ns: int) -> int:
        """Return `system_time` of a frame sampled now."""
        if self._anchor is None:
            return device_ns // NS_PER_MS % self._uptime_modulus_ms
        anchor_ns, second = self._anchor
        return (second * MS_PER_S + (device_ns - anchor_ns) // NS_PER_MS) % self._modulus_ms


PMUX_FIRMWARE: Final = 155  # minimum firmware for PMUX commands, 1.5.5 (chapter 2.2.4)
# Maximum deviation of a URFR matrix from a rotation (assumption). Users type three or four digits.
URFR_TOLERANCE: Final = 1e-3


class CommandRefused(ValueError):
    """A known command with a value out of range. The reply is `ERR`."""


@dataclass(frozen=True, slots=True)
class Output:
    """Output of one message: every `period_ms` (0: off), or with each pulse on SIN."""

    period_ms: int = 0
    on_mark: bool = False

    def __str__(self) -> str:
        return "ONMARK 1" if self.on_mark else f"ONTIME {self.period_ms / 1000:g}"


@dataclass(frozen=True, slots=True)
class AlarmSetting:
    """Angle alarm of one axis (PMUX5), degrees."""

    low_deg: float = -5.0
    high_deg: float = 5.0
    enabled: bool = False

    def __str__(self) -> str:
        return f"{self.low_deg:g},{self.high_deg:g},0,{self.enabled:d}"


@dataclass(frozen=True, slots=True)
class ModuleSettings:
    """Settings that SAVECONFIG saves. The defaults are the defaults of the factory (chapter 3.2: HI91 at 100 Hz)."""

    baud: int = 115_200
    att_mode: int = 0  # 0: six axes; 1: nine axes, heading from the magnetic field
    # Matrix C in v_before = C · v_after, row by row (CONFIG IMU URFR).
    urfr: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    level: Quaternion = (1.0, 0.0, 0.0, 0.0)  # rotation of the attitude about the body from ATT RST
    level_accel: bool = False  # True if the rotation also applies to the accelerometer (ATT RST 3)
    mag_calibration: bool = True
    hi91: Output = Output(10)
    hi92: Output = Output()
    hi81: Output = Output()
    hi83: Output = Output()
    pins: tuple[int, ...] = (1, 2, 5, 6, 9)  # IO pin of PMUX1 … PMUX5
    sout_div: int = 8
    alarm_x: AlarmSetting = AlarmSetting()
    alarm_y: AlarmSetting = AlarmSetting()
    coord: int = 0  # axes of newer firmware: 0 as in the manual, 4 NWU
    outputs: Mapping[str, Output] = field(default_factory=dict)  # other messages and ports, by name: `COM2 HI91`, `GGA`
    port_baud: int = 115_200  # baud rate of COM2, newer firmware
    codes: Mapping[str, str] = field(default_factory=dict)  # codes of older firmware
    baseline_m: float = 1.0  # INS models

    def user_lines(self, behaviour: Behaviour = AS_IN_MANUAL) -> list[str]:
        """Return the lines of the reply to LOG USRCONFIG."""
        if behaviour.newer:
            digits = [name for name, turned in DIGITS.items() if turned == self.urfr]
            urfr = digits[0] if digits else ",".join(f"{value:g}" for value in self.urfr)
            lines = replace(self, coord=0).user_lines()
            return [
                *(line.replace(": ", "=") for line in lines if not line.startswith("URFR")),
                f"URFR={urfr}",
                f"COORD={self.coord}",
            ]
        return [
            *(f"{name}: {value}" for name, value in self.codes.items()),
            f"ATT_MODE: {self.att_mode}",
            "URFR: " + ",".join(f"{value:g}" for value in self.urfr),
            f"EN_MCAL: {self.mag_calibration:d}",
            *(f"PMUX{number}: IO{pin}" for number, pin in enumerate(self.pins, 1)),
            f"SOUT_DIV: {self.sout_div}",
            f"ALARM_X: {self.alarm_x}",
            f"ALARM_Y: {self.alarm_y}",
            *([f"COORD {self.coord}"] if self.coord else []),
        ]

    def port_lines(self, behaviour: Behaviour = AS_IN_MANUAL) -> list[str]:
        """Return the lines of the reply to LOG COMCONFIG."""
        lines = [f"BAUD: {self.baud}", f"LOG HI91 {self.hi91}", f"LOG HI92 {self.hi92}"]
        shown = [("HI81", self.hi81)] if behaviour.ins or self.hi81 != Output() else []
        shown += [("HI83", self.hi83)] if self.hi83 != Output() else []
        silent = dict.fromkeys(INS_MESSAGES * behaviour.ins, Output())
        if behaviour.newer:
            lines.append(f"SERIALCONFIG COM2 {self.port_baud}")
            silent |= {"COM2 HI91": Output(), "COM2 HI92": Output()}
        others = [*shown, *(silent | dict(self.outputs)).items()]
        return [*lines, *(f"LOG {name} {output}" for name, output in others)]


INS_MESSAGES: Final = ("GGA", "RMC", "SXT")
# Matrix of URFR by its digits, the direction of the physical axes: right, left, front, back, up, down
_DIRECTIONS: Final = (
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0),
)
DIGITS: Final = {
    f"{x}{y}{z}": _DIRECTIONS[x] + _DIRECTIONS[y] + _DIRECTIONS[z]
    for x, y, z in product(range(6), repeat=3)
    if is_rotation((_DIRECTIONS[x], _DIRECTIONS[y], _DIRECTIONS[z]))
}
NWU: Final = 4  # value of COORD
_QUARTER: Final = (0.5**0.5, 0.0, 0.0, 0.5**0.5)  # quarter turn about Z: from FLU to RFU axes, and from ENU to NWU


def in_nwu(truth: Truth) -> Truth:
    """Return the measurement with x forward, y left, z up, the navigation frame NWU, and the order 321."""
    w, x, y, z = _QUARTER
    to_nwu = quat_product((w, -x, -y, -z), truth.quat_wxyz)
    quat = quat_product(to_nwu, _QUARTER)
    return truth._replace(
        accel_m_s2=_forward(truth.accel_m_s2), gyro_rad_s=_forward(truth.gyro_rad_s), mag_t=_forward(truth.mag_t),
        quat_wxyz=quat, euler_rad=euler_zyx_from_quat(quat),
    )  # fmt: skip


def _forward(vector: Vector3) -> Vector3:
    """Return a vector of right, forward, up in forward, left, up."""
    right, forward, up = vector
    return forward, -right, up


def changed(
    settings: ModuleSettings, line: str, firmware: int, behaviour: Behaviour = AS_IN_MANUAL
) -> ModuleSettings | None:
    """Return the settings after the command in `line`; None if it changes no setting. Raises CommandRefused."""
    more = (*_NEWER * behaviour.newer, *_OLDER * behaviour.older, *_INS * behaviour.ins)
    for pattern, change in (*more, *_CHANGES):
        if match := pattern.fullmatch(line):
            if "PMUX" in line and firmware < PMUX_FIRMWARE:
                return None
            return change(settings, *match.groups())
    return None


def _whole(text: str, allowed: range | tuple[int, ...]) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", text) or int(text) not in allowed:
        raise CommandRefused(text)
    return int(text)


def number(text: str, low: float, high: float) -> float:
    """Return a finite number within the limits. Raises CommandRefused."""
    try:
        value = float(text)
    except ValueError:
        raise CommandRefused(text) from None
    if not low <= value <= high:  # also refuses NaN
        raise CommandRefused(text)
    return value


def _baud(settings: ModuleSettings, text: str) -> ModuleSettings:
    return replace(settings, baud=_whole(text, BAUD_RATES))


def _att_mode(settings: ModuleSettings, text: str) -> ModuleSettings:
    return replace(settings, att_mode=_whole(text, (0, 1)))


def _urfr(settings: ModuleSettings, text: str) -> ModuleSettings:
    values = tuple(number(part, -2.0, 2.0) for part in text.split(","))
    if len(values) != 9 or not is_rotation(rows(values), URFR_TOLERANCE):
        raise CommandRefused(text)
    return replace(settings, urfr=values)


def rows(urfr: tuple[float, ...]) -> Matrix3:
    """Return the nine numbers of URFR as a matrix."""
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = urfr
    return (c00, c01, c02), (c10, c11, c12), (c20, c21, c22)


def _mag_calibration(settings: ModuleSettings, text: str) -> ModuleSettings:
    return replace(settings, mag_calibration=bool(_whole(text, (0, 1))))


def _pin(settings: ModuleSettings, function: str, pin: str) -> ModuleSettings:
    pins = list(settings.pins)
    pins[int(function) - 1] = _whole(pin, range(1, 10))
    return replace(settings, pins=tuple(pins))


def _sout_div(settings: ModuleSettings, text: str) -> ModuleSettings:
    return replace(settings, sout_div=_whole(text, range(1, 65)))


def _alarm(settings: ModuleSettings, axis: str, values: str) -> ModuleSettings:
    low, high, reserved, enabled = values.split(",")
    _whole(reserved, (0,))
    alarm = AlarmSetting(number(low, -180, 180), number(high, -180, 180), bool(_whole(enabled, (0, 1))))
    if alarm.low_deg > alarm.high_deg:
        raise CommandRefused(values)
    return replace(settings, alarm_x=alarm) if axis == "X" else replace(settings, alarm_y=alarm)


def _on_time(settings: ModuleSettings, message: str, period: str) -> ModuleSettings:
    period_s = number(period, 0.0, 1.0)
    if 0 < period_s < 0.001:  # the maximum rate is 1 kHz (table 3.7)
        raise CommandRefused(period)
    return _with_output(settings, message, Output(round(period_s * 1000)))


def _on_mark(settings: ModuleSettings, message: str, switch: str) -> ModuleSettings:
    return _with_output(settings, message, Output(on_mark=bool(_whole(switch, (0, 1)))))


def _with_output(settings: ModuleSettings, message: str, output: Output) -> ModuleSettings:
    name = "hi91" if message == "IMU91" else message.lower()
    chosen: dict[str, Any] = {name: output}
    return replace(settings, **chosen)


def _unlog_all(settings: ModuleSettings) -> ModuleSettings:
    names = ("hi91", "hi92", "hi81", "hi83")
    off: dict[str, Any] = {name: Output() for name in names if not getattr(settings, name).on_mark}
    return replace(settings, **off)


# Commands that only change settings.
_CHANGES: Final[tuple[tuple[re.Pattern[str], Callable[..., ModuleSettings]], ...]] = (
    (re.compile(r"SERIALCONFIG (\S+)"), _baud),
    (re.compile(r"CONFIG ATT MODE (\S+)"), _att_mode),
    (re.compile(r"CONFIG IMU URFR (\S+)"), _urfr),
    (re.compile(r"CONFIG IMU EN_MCAL (\S+)"), _mag_calibration),
    (re.compile(r"CONFIG PMUX([1-5]) IO(\S+)"), _pin),
    (re.compile(r"CONFIG PMUX4 DIV(\S+)"), _sout_div),
    (re.compile(r"CONFIG PMUX5 ([XY]),([^,]+,[^,]+,[^,]+,[^,]+)"), _alarm),
    (re.compile(r"LOG (IMU91|HI91|HI92|HI81|HI83) ONTIME (\S+)"), _on_time),
    (re.compile(r"LOG (IMU91|HI91|HI92|HI81|HI83) ONMARK (?!ONCE$)(\S+)"), _on_mark),
    (re.compile(r"UNLOGALL"), _unlog_all),
)


def _newer_mode(settings: ModuleSettings, text: str) -> ModuleSettings:
    return replace(settings, att_mode=_whole(text, (0, 1, 4, 5, 7)))


def _coord(settings: ModuleSettings, text: str) -> ModuleSettings:
    return replace(settings, coord=_whole(text, (0, 2, 4)))


def _digits(settings: ModuleSettings, text: str) -> ModuleSettings:
    if text not in DIGITS:
        raise CommandRefused(text)
    return replace(settings, urfr=DIGITS[text])


def _other_baud(settings: ModuleSettings, port: str, text: str) -> ModuleSettings:
    """The host is connected to COM1."""
    return _baud(settings, text) if port == "1" else replace(settings, port_baud=_whole(text, BAUD_RATES))


def _other_output(settings: ModuleSettings, name: str, mode: str, value: str) -> ModuleSettings:
    if name.startswith("COM1 "):
        message = name.removeprefix("COM1 ")
        return (_on_time if mode == "ONTIME" else _on_mark)(settings, message, value)
    output = Output(round(number(value, 0.0, 1.0) * 1000)) if mode == "ONTIME" else Output(on_mark=value == "1")
    return replace(settings, outputs={**settings.outputs, name.replace("IMU91", "HI91"): output})


def _set_code(settings: ModuleSettings, name: str, value: str) -> ModuleSettings:
    most = {"ABW": 6, "ARG": 3, "GBW": 6, "GRG": 3, "INC_FMT": 1, "ZARU": 100}[name]
    number(value, 0, most)
    return replace(settings, codes={**settings.codes, name: value})


def _set_baseline(settings: ModuleSettings, text: str) -> ModuleSettings:
    return replace(settings, baseline_m=number(text, -1000, 1000))


# Commands of other firmware that only change settings. `changed` tries them first.
_NEWER: Final[tuple[tuple[re.Pattern[str], Callable[..., ModuleSettings]], ...]] = (
    (re.compile(r"CONFIG ATT MODE (\S+)"), _newer_mode),
    (re.compile(r"CONFIG IMU COORD (\S+)"), _coord),
    (re.compile(r"CONFIG IMU URFR ([0-9]+)"), _digits),
    (re.compile(r"SERIALCONFIG COM([12]) (\S+)"), _other_baud),
    (re.compile(r"LOG (COM[12] (?:IMU91|HI91|HI92)) (ONTIME|ONMARK) (?!ONCE$)(\S+)"), _other_output),
)
_OLDER: Final[tuple[tuple[re.Pattern[str], Callable[..., ModuleSettings]], ...]] = (
    (re.compile(r"CONFIG IMU (ZARU|ABW|ARG|GBW|GRG|INC_FMT) (\S+)"), _set_code),
)
_INS: Final[tuple[tuple[re.Pattern[str], Callable[..., ModuleSettings]], ...]] = (
    (re.compile(r"LOG (COM2 HI81|(?:COM2 )?(?:GGA|RMC|SXT)) (ONTIME|ONMARK) (?!ONCE$)(\S+)"), _other_output),
    (re.compile(r"SETBASELINE (.+)"), _set_baseline),
)


# Spread of the processing time, ns (assumption). Section 1.2.1 of the manual gives only the mean.
MARK_SPREAD_NS: Final = 15_000


@dataclass(frozen=True, slots=True, kw_only=True)
class HipnucHardware(SensorHardware):
    """Hardware of a device. Its settings are in `ModuleSettings`. `processing_ns` also counts from an edge on SIN."""

    product: str = "HI14R3"
    build: str = "Oct 15 2024"
    uuid: str = "043995698D6E1708"
    baud_after_update: int = 0  # baud rate that an update of the firmware sets, bit/s; 0: unchanged
    firmware: int = 156
    bootloader: int = 109
    mark_spread_ns: int = MARK_SPREAD_NS  # maximum deviation of the processing time after an edge on SIN, ns
    mark_seed: int = 1
    utc_epoch: Epoch = "unix"  # epoch of UTC in ms
    hi83_bitmap: int = 0xD5FF  # fields of HI83: bits 0 to 8, heave, velocity, position and its quality
    uptime_ms: int = 0  # device time at the first power-on, ms, for a start near the end of the counter
    mag_bias_t: Vector3 = (0.0, 0.0, 0.0)  # result of an earlier magnetic calibration, T; zero: never calibrated
    # Magnetic field of parts that turn with the device, T. A calibration finds it.
    hard_iron_t: Vector3 = (0.0, 0.0, 0.0)
    behaviour: Behaviour = AS_IN_MANUAL  # behavior that the manual does not define


STATIC_GYRO_RAD_S: Final = 0.02
GYRO_SETTLED_MS: Final = 5000
ATTITUDE_SETTLED_MS: Final = 1000  # time after power-on until bias and attitude count as converged, ms (assumption)

GYRO_UNSETTLED, ATTITUDE_UNSETTLED = 1 << 3, 1 << 7
STATIC, MAG_AIDING, NO_UTC, SYNC_OUT = 1 << 9, 1 << 10, 1 << 11, 1 << 12


def main_status(reading: Truth, uptime_ms: int, *, nine_axis: bool, utc: bool) -> int:
    """Return MAIN_STATUS (HI91 bytes 1-2 since firmware 1.6.9). A SOUT pulse precedes each frame."""
    status = SYNC_OUT
    if not utc:
        status |= NO_UTC
    if uptime_ms < GYRO_SETTLED_MS:
        status |= GYRO_UNSETTLED
    if uptime_ms < ATTITUDE_SETTLED_MS:
        status |= ATTITUDE_UNSETTLED
    if max(map(abs, reading.gyro_rad_s)) < STATIC_GYRO_RAD_S:
        status |= STATIC
    return status | MAG_AIDING if nine_axis else status


NOT_CALIBRATED, CALIBRATED = 0, 1  # States of register 0x0A. No source contains the true numbers.
TURN_RAD: Final = tau
STEP_MAX_NS: Final = NS_PER_S  # maximum time between two samples that adds to the rotation, ns
_NO_TURN: Final[Vector3] = (0.0, 0.0, 0.0)


class SelfCalibration:
    """Bias of one magnetometer, and the part of it that the device knows."""

    def __init__(self, hard_iron_t: Vector3, found_t: Vector3, fault: CalibrationFault = CalibrationFault.NONE) -> None:
        """`hard_iron_t`: field of parts that turn with the device; `found_t`: the part that the device knows."""
        self._hard_iron_t = hard_iron_t
        self._fault = fault
        self.found_t = found_t
        self.finished = any(found_t)  # True after a calibration
        self._turned: Vector3 = _NO_TURN
        self._planar = False
        self._before_ns: int | None = None

    @property
    def state(self) -> int:
        """Return NOT_CALIBRATED or CALIBRATED."""
        return CALIBRATED if self.finished else NOT_CALIBRATED

    @property
    def progress(self) -> float:
        """Return the completed share of the required rotation, 0 to 1; 1 after a calibration."""
        return 1.0 if self.finished else (max if self._planar else min)(self._turned) / TURN_RAD

    def restart(self, *, planar: bool) -> None:
        """Start a calibration by a command. `planar`: a turn about one axis is enough."""
        if self._fault is CalibrationFault.IGNORED:
            return
        self.finished, self.found_t, self._turned, self._planar = False, _NO_TURN, _NO_TURN, planar

    def sample(self, device_ns: int, gyro_rad_s: Vector3) -> None:
        """Process one sample in 9-axis mode while the background calibration is on.

        `device_ns` is the device time.
        """
        before, self._before_ns = self._before_ns, device_ns
        if before is None or not 0 < device_ns - before <= STEP_MAX_NS:
            return
        step_s = (device_ns - before) / NS_PER_S
        x, y, z = (turned + abs(rate) * step_s for turned, rate in zip(self._turned, gyro_rad_s, strict=True))
        self._turned = (x, y, z)
        if self.progress >= 1.0:
            self.finished, self._turned = True, _NO_TURN
            if self._fault is CalibrationFault.NONE:
                self.found_t = self._hard_iron_t

    def state_text(self, *, is_started: bool) -> str:
        """Return the state of LOG MCAL STAT. `is_started`: a command has started a calibration since power-on."""
        if not is_started or self._fault is CalibrationFault.IGNORED:
            return "DONE"
        if not self.finished:
            return "RUNNING"
        return "FAILED" if self._fault is CalibrationFault.FAILS else "DONE"

    def measured(self, field_t: Vector3) -> Vector3:
        """Return the field that the device sends: the field with the unknown part of the bias."""
        (a, b, c), (d, e, f), (x, y, z) = self._hard_iron_t, self.found_t, field_t
        return (x + a - d, y + b - e, z + c - f)
