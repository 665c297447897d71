"""Table: calibrations of a HiPNUC module on RS-485. Manual "IMU配置手冊" V1.5.9, sections 4.2, 4.3.5 and chapter 8.

State and progress of the magnetic calibration are registers of newer firmware (0x0A, 0x0B); what the numbers of the
state mean is in no source, so progress decides.
"""

from typing import Final

from imud.contracts.action import Target
from imud.contracts.control.calibration import (
    Calibrations,
    Verdict,
)
from imud.contracts.polling import TransferScript
from imud.devices.hipnuc.common.calibrations import NINE_AXES_NEEDED, levels, magnetometer
from imud.devices.hipnuc.modbus import session
from imud.devices.hipnuc.modbus.registers import BY_NAME
from imud.devices.hipnuc.uart.commands import AttitudeMode

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
    "magnetometer": magnetometer(_nothing_to_start, _magnetometer_verdict, _nine_axes_needed),
    **levels("4.3.5", 15, lambda kind: lambda _target: session.auto_level(kind), lambda _target: session.save()),
}
