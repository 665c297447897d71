"""Calibrations of a HiPNUC module on a UART. Manual "IMU配置手冊" V1.5.9, section 2.2.4 and chapter 8.

The magnetometer is calibrated by the module itself, in the background, while it is turned in 9-axis mode; it saves the
result. That it is done shows in the bias of MAGCONFIG, which is zero before.
"""

from dataclasses import replace
from typing import Final

from imud.contracts.action import Target
from imud.contracts.control.calibration import (
    YAW_ZERO,
    Calibration,
    Calibrations,
    Handling,
    Kept,
    Verdict,
)
from imud.contracts.session import Rejection, RequestScript, Silence
from imud.devices.hipnuc.common.calibrations import NINE_AXES_NEEDED, levels, magnetometer
from imud.devices.hipnuc.uart import commands
from imud.devices.hipnuc.uart.commands import Query, YawMode, ask
from imud.devices.hipnuc.uart.replies import parse_magconfig
from imud.devices.hipnuc.uart.session import read_settings, send
from imud.errors import NoReply, Rejected


def _nine_axes_needed(_target: Target) -> RequestScript[str]:
    settings = yield from read_settings()
    if settings.get("ATT_MODE") == "0":
        return f"{NINE_AXES_NEEDED}: action mode, axes=9"
    return ""


def _start_magnetometer(_target: Target) -> RequestScript[None]:
    return send(commands.magnetic_calibration(enabled=True))


def _magnetometer_verdict(_target: Target) -> RequestScript[Verdict]:
    """Ask for the bias of the magnetometer. Raises NoReply, Rejected."""
    outcome = yield ask(Query.MAGCONFIG)
    if isinstance(outcome, Silence):
        raise NoReply("LOG MAGCONFIG: expected lines up to OK, got nothing; has the module a magnetometer?")
    if isinstance(outcome, Rejection):
        raise Rejected(f"LOG MAGCONFIG: the module refused: {' / '.join(outcome.lines)}")
    bias = parse_magconfig(outcome.lines).bias_ut
    if bias is None:
        return Verdict(done=False, words="it does not tell its bias")
    words = "bias " + ", ".join(f"{value:g}" for value in bias) + " µT"
    return Verdict(done=any(bias), words=words)


def _keep_magnetometer(_target: Target) -> RequestScript[None]:
    yield from send(commands.magnetic_calibration(enabled=False))
    yield from send(commands.save_config())


def _save(_target: Target) -> RequestScript[None]:
    return send(commands.save_config())


_MAGNETOMETER: Final = magnetometer(_start_magnetometer, _magnetometer_verdict, _nine_axes_needed)

CALIBRATIONS: Final[Calibrations] = {
    "magnetometer": _MAGNETOMETER,
    "magnetometer_once": replace(
        _MAGNETOMETER,
        help="the same, and with `save` no further calibration in the background",
        section="8.2",
        kept=Kept.BY_SAVE,
        save=_keep_magnetometer,
    ),
    **levels("2.2.4", 5, lambda kind: lambda _target: send(commands.level_reset(kind)), _save),
    "heading": Calibration(
        help="make the present heading zero",
        section="2.2.4",
        handling=Handling.REST,
        instructions=("Point the module to where its heading is to be zero, and do not touch it.",),
        begin=lambda _target: send(commands.yaw(YawMode.ABSOLUTE, 0.0)),
        expected=(YAW_ZERO,),
        kept=Kept.NEVER,
    ),
}
