"""Calibrations of a HiPNUC module on RS-485. Manual "IMU配置手冊" V1.5.9, sections 4.2, 4.3.5 and chapter 8.

State and progress of the magnetic calibration are registers of newer firmware (0x0A, 0x0B); what the numbers of the
state mean is in no source, so progress decides.
"""

from typing import Final

from imud.contracts.action import Target
from imud.contracts.control.calibration import (
    ACCEL_LEVEL,
    PITCH_ZERO,
    ROLL_ZERO,
    Calibration,
    Calibrations,
    Handling,
    Kept,
    Verdict,
)
from imud.contracts.polling import TransferScript
from imud.devices.hipnuc.common.calibrations import LEVELLING, NINE_AXES_NEEDED, TURNING
from imud.devices.hipnuc.modbus import session
from imud.devices.hipnuc.modbus.registers import BY_NAME
from imud.devices.hipnuc.uart.commands import AttitudeMode, LevelReset

DONE_PERCENT: Final = 100


def _nine_axes_needed(_target: Target) -> TransferScript[str]:
    (mode,) = yield from session.read(BY_NAME["HEADING_MODE"])
    if mode == AttitudeMode.SIX_AXIS.value:
        return f"{NINE_AXES_NEEDED}: action attitude_mode, axes=9"
    return ""


def _nothing_to_start(_target: Target) -> TransferScript[None]:
    """In 9-axis mode the module calibrates by itself."""
    return
    yield  # makes it a generator


def _magnetometer_verdict(_target: Target) -> TransferScript[Verdict]:
    (state,) = yield from session.read(BY_NAME["MAG_CALIBRATION"])
    (percent,) = yield from session.read(BY_NAME["MAG_PROGRESS"])
    return Verdict(percent >= DONE_PERCENT, f"state {state}, {percent} %", min(percent / DONE_PERCENT, 1.0))


CALIBRATIONS: Final[Calibrations] = {
    "magnetometer": Calibration(
        help="measure the field of what the module is mounted on; goes on in the background afterwards",
        section="8.1.1",
        handling=Handling.TURN,
        instructions=TURNING,
        begin=_nothing_to_start,
        verdict=_magnetometer_verdict,
        unready=_nine_axes_needed,
        kept=Kept.BY_DEVICE,
    ),
    "level": Calibration(
        help="make the present pitch and roll zero, at any tilt",
        section="4.3.5",
        handling=Handling.REST,
        instructions=LEVELLING,
        begin=lambda _target: session.auto_level(LevelReset.RELATIVE),
        expected=(ROLL_ZERO, PITCH_ZERO),
        kept=Kept.BY_SAVE,
        save=lambda _target: session.save(),
    ),
    "accelerometer_level": Calibration(
        help="make pitch, roll and the horizontal acceleration zero, within 15° of level or of upside down",
        section="4.2, register 0xA5",
        handling=Handling.REST,
        instructions=("Put the module on a level surface, within 15° of level, and do not touch it.",),
        begin=lambda _target: session.auto_level(LevelReset.AUTOMATIC),
        expected=(PITCH_ZERO, ACCEL_LEVEL),
        kept=Kept.BY_SAVE,
        save=lambda _target: session.save(),
    ),
}
