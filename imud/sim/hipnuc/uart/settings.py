"""Hardware of a simulated HiPNUC module, its settings in RAM and flash, the commands that change them, status bits.

IMU configuration manual V1.5.9, chapters 2.2.3 to 2.2.6 and 8.2. The forms of the USRCONFIG and COMCONFIG replies
beyond `ATT_MODE: 0` are assumed: the manual does not print them.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from imud.attitude import Matrix3, is_rotation
from imud.devices.hipnuc.uart.commands import BAUD_RATES
from imud.sample import Quaternion, Vector3
from imud.sim.hipnuc.uart.behaviour import AS_IN_MANUAL, Behaviour
from imud.sim.hipnuc.uart.utc import Epoch
from imud.sim.physics.motion import Truth
from imud.sim.sensor import SensorHardware

PMUX_FIRMWARE: Final = 155
"""PMUX commands need firmware 1.5.5 (chapter 2.2.4)."""
URFR_TOLERANCE: Final = 1e-3
"""Assumed: how far from a rotation a URFR matrix may be. Users type three or four digits."""


class CommandRefused(ValueError):
    """A known command with a value out of range; the module answers `ERR`."""


@dataclass(frozen=True, slots=True)
class Output:
    """An output message: sent every `period_ms` (0: never), or with each pulse on SIN."""

    period_ms: int = 0
    on_mark: bool = False

    def __str__(self) -> str:
        return "ONMARK 1" if self.on_mark else f"ONTIME {self.period_ms / 1000:g}"


@dataclass(frozen=True, slots=True)
class AlarmSetting:
    """Angle alarm of one axis (PMUX5), angles in degrees."""

    low_deg: float = -5.0
    high_deg: float = 5.0
    enabled: bool = False

    def __str__(self) -> str:
        return f"{self.low_deg:g},{self.high_deg:g},0,{self.enabled:d}"


@dataclass(frozen=True, slots=True)
class ModuleSettings:
    """Settings that SAVECONFIG saves. The defaults are the factory's (chapter 3.2: HI91 at 100 Hz)."""

    baud: int = 115_200
    att_mode: int = 0
    """0: six axes; 1: nine axes, heading from the magnetic field."""
    urfr: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    """C in v_before = C · v_after, rows first (CONFIG IMU URFR)."""
    level: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Turn of the attitude about the body that ATT RST found."""
    level_accel: bool = False
    """Whether the accelerometer is turned as well (ATT RST 3)."""
    mag_calibration: bool = True
    hi91: Output = Output(10)
    hi92: Output = Output()
    pins: tuple[int, ...] = (1, 2, 5, 6, 9)
    """IO pin of PMUX1 … PMUX5."""
    sout_div: int = 8
    alarm_x: AlarmSetting = AlarmSetting()
    alarm_y: AlarmSetting = AlarmSetting()

    def user_lines(self) -> list[str]:
        """Reply to LOG USRCONFIG."""
        return [
            f"ATT_MODE: {self.att_mode}",
            "URFR: " + ",".join(f"{value:g}" for value in self.urfr),
            f"EN_MCAL: {self.mag_calibration:d}",
            *(f"PMUX{number}: IO{pin}" for number, pin in enumerate(self.pins, 1)),
            f"SOUT_DIV: {self.sout_div}",
            f"ALARM_X: {self.alarm_x}",
            f"ALARM_Y: {self.alarm_y}",
        ]

    def port_lines(self) -> list[str]:
        """Reply to LOG COMCONFIG."""
        return [f"BAUD: {self.baud}", f"LOG HI91 {self.hi91}", f"LOG HI92 {self.hi92}"]


def changed(settings: ModuleSettings, line: str, firmware: int) -> ModuleSettings | None:
    """The settings after the command in `line`; None if it changes none. Raises CommandRefused."""
    for pattern, change in _CHANGES:
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
    """A finite number within bounds. Raises CommandRefused."""
    try:
        value = float(text)
    except ValueError:
        raise CommandRefused(text) from None
    if not low <= value <= high:  # NaN is refused too
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
    """The nine numbers of URFR as a matrix."""
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
    if 0 < period_s < 0.001:  # the fastest is 1 kHz (table 3.7)
        raise CommandRefused(period)
    return _with_output(settings, message, Output(round(period_s * 1000)))


def _on_mark(settings: ModuleSettings, message: str, switch: str) -> ModuleSettings:
    return _with_output(settings, message, Output(on_mark=bool(_whole(switch, (0, 1)))))


def _with_output(settings: ModuleSettings, message: str, output: Output) -> ModuleSettings:
    return replace(settings, hi92=output) if message == "HI92" else replace(settings, hi91=output)


def _unlog_all(settings: ModuleSettings) -> ModuleSettings:
    hi91, hi92 = (output if output.on_mark else Output() for output in (settings.hi91, settings.hi92))
    return replace(settings, hi91=hi91, hi92=hi92)


_CHANGES: Final[tuple[tuple[re.Pattern[str], Callable[..., ModuleSettings]], ...]] = (
    (re.compile(r"SERIALCONFIG (\S+)"), _baud),
    (re.compile(r"CONFIG ATT MODE (\S+)"), _att_mode),
    (re.compile(r"CONFIG IMU URFR (\S+)"), _urfr),
    (re.compile(r"CONFIG IMU EN_MCAL (\S+)"), _mag_calibration),
    (re.compile(r"CONFIG PMUX([1-5]) IO(\S+)"), _pin),
    (re.compile(r"CONFIG PMUX4 DIV(\S+)"), _sout_div),
    (re.compile(r"CONFIG PMUX5 ([XY]),([^,]+,[^,]+,[^,]+,[^,]+)"), _alarm),
    (re.compile(r"LOG (IMU91|HI91|HI92) ONTIME (\S+)"), _on_time),
    (re.compile(r"LOG (IMU91|HI91|HI92) ONMARK (?!ONCE$)(\S+)"), _on_mark),
    (re.compile(r"UNLOGALL"), _unlog_all),
)
"""Commands that change settings and nothing else."""


MARK_SPREAD_NS: Final = 15_000
"""Assumed: the manual (section 1.2.1) gives the mean only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HipnucHardware(SensorHardware):
    """Hardware of a module; settings are in `ModuleSettings`. `processing_ns` counts from an edge on SIN too."""

    product: str = "HI14R3"
    build: str = "Oct 15 2024"
    uuid: str = "043995698D6E1708"
    firmware: int = 156
    bootloader: int = 109
    mark_spread_ns: int = MARK_SPREAD_NS
    """Largest deviation of the processing time after an edge on SIN."""
    mark_seed: int = 1
    utc_epoch: Epoch = "unix"
    """Epoch of UTC in ms."""
    uptime_ms: int = 0
    """Device time at the first power-on, to begin near the end of a counter's range."""
    mag_bias_t: Vector3 = (0.0, 0.0, 0.0)
    """Result of its magnetic calibration before it was powered on; zero: never calibrated."""
    hard_iron_t: Vector3 = (0.0, 0.0, 0.0)
    """Field of what turns with it: the result of a calibration while it is powered on."""
    behaviour: Behaviour = AS_IN_MANUAL
    """What it does where the manual leaves it open."""


STATIC_GYRO_RAD_S: Final = 0.02
GYRO_SETTLED_MS: Final = 5000
ATTITUDE_SETTLED_MS: Final = 1000
"""Assumed times after power-on until bias and attitude count as converged."""

GYRO_UNSETTLED, ATTITUDE_UNSETTLED = 1 << 3, 1 << 7
STATIC, MAG_AIDING, NO_UTC, SYNC_OUT = 1 << 9, 1 << 10, 1 << 11, 1 << 12


def main_status(reading: Truth, uptime_ms: int, *, nine_axis: bool, utc: bool) -> int:
    """MAIN_STATUS (HI91 bytes 1-2 since firmware 1.6.9); a SOUT pulse goes before every frame."""
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
