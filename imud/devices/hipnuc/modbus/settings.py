"""Settings that a HiPNUC module on RS-485 keeps. Manual "IMU配置手冊" V1.5.9, section 4.3.

SET_LV (section 4.3.5) is no setting: it makes the attitude of that moment level, and writing it again would do so
again. It is the action `level`.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.contracts.action import Target
from imud.contracts.device_settings import DeviceSettings, Effect, Setting
from imud.contracts.polling import TransferScript
from imud.devices.hipnuc.modbus import session
from imud.devices.hipnuc.modbus.registers import BAUD_RATES, ID_MAX, BaudRate
from imud.devices.hipnuc.modbus.session import LineMounting
from imud.devices.hipnuc.uart.commands import AttitudeMode
from imud.errors import BadArgument

Mode = Literal["6-axis", "9-axis"]
Mounting = Literal["level", "x_up", "x_down", "y_up", "y_down"]

MODES: Final[Mapping[Mode, AttitudeMode]] = {"6-axis": AttitudeMode.SIX_AXIS, "9-axis": AttitudeMode.NINE_AXIS}
_MODE_OF: Final = {mode.value: name for name, mode in MODES.items()}


def _read_settings(_target: Target) -> TransferScript[dict[str, object]]:
    baud, address, heading = yield from session.read_present()
    found: dict[str, object] = {}
    if heading in _MODE_OF:
        found["mode"] = _MODE_OF[heading]
    if address is not None:
        found["address"] = address
    if baud is not None and baud < len(BAUD_RATES):
        found["baud"] = BAUD_RATES[baud]
    return found


def _check(target: Target, values: Mapping[str, Any]) -> None:
    """A module of another rate than its line is lost, and spoils the replies of the others."""
    baud = values.get("baud")
    if baud is not None and target.baud and baud != target.baud:
        raise BadArgument(
            f"baud: expected {target.baud}, the rate of the line, got {baud}; to change the rate of a line give all of "
            "its modules the new one with the actions `baud`, `save` and `restart`, then set `rs485.baud`"
        )


SETTINGS: Final = DeviceSettings(
    table={
        "mode": Setting(
            type=Annotated[
                Mode,
                Meta(description="without or with the magnetometer in the heading", extra={"section": "4.3.6"}),
            ],
            write=lambda _target, mode: session.set_heading_mode(MODES[mode]),
        ),
        "mounting": Setting(
            type=Annotated[Mounting, Meta(description="the axis that points up or down", extra={"section": "4.3.4"})],
            write=lambda _target, mounting: session.set_mounting(LineMounting[mounting.upper()]),
            effect=Effect.AFTER_RESTART,
            readable=False,
        ),
        "baud": Setting(
            type=Annotated[
                BaudRate,
                Meta(
                    description="that of the line: a module that would take another one at its restart is set back",
                    extra={"unit": "bit/s", "section": "4.3.2"},
                ),
            ],
            write=lambda _target, baud: session.set_baud(baud),
            effect=Effect.AFTER_RESTART,
            connection=True,
        ),
        "address": Setting(
            type=Annotated[
                int,
                Meta(
                    ge=1,
                    le=ID_MAX,
                    description="one that no other module of the line has",
                    extra={"section": "4.3.3"},
                ),
            ],
            write=lambda target, address: session.change_address(session.places_of(target)[0], address),
            connection=True,
        ),
    },
    read=_read_settings,
    save=lambda _target: session.save(),
    restart=lambda target: session.restart(session.places_of(target), target.baud),
    check=_check,
)
