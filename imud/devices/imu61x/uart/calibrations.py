"""Table: calibrations of an IMU61x on a UART. Manual "IMU61X Interface Protocol and Instructions", section 1.6."""

from typing import Final

from imud.contracts.control.calibration import GYRO_ZERO, YAW_ZERO, Calibration, Calibrations, Handling, Kept
from imud.devices.imu61x.uart.actions import ACTIONS

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
