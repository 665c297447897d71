"""Request scripts of an IMU61x on a UART that calibrate it: gyroscope and installation, until the device has finished.

Manual "IMU61X Interface Protocol and Instructions", table 12: CMD 7, 8, 10. An acknowledgement (K1) may come when the
device begins, so it is not the end. What is, decides `calibration_status` in S1 (CMD 1), where the device sends it; its
codes are not documented, `Imu61xUartSettings.calibration_done` is the one at rest. Devices with a shorter S1 are asked
by CMD 8 for the installation, where the code of K1 for done is the end; for the gyroscope they are given time.
"""

from collections.abc import Callable
from typing import Final

from imud.contracts.session import RequestScript, pause
from imud.devices.imu61x.uart import commands
from imud.devices.imu61x.uart.contact import acknowledged, answered, in_contact, read3, settled
from imud.devices.imu61x.uart.replies import RESULT_DONE, parse_acknowledgement, parse_status
from imud.devices.imu61x.uart.session import GYRO_OFFSETS, INSTALLATION_ANGLES
from imud.errors import NoReply
from imud.sample import Vector3
from imud.units import NS_PER_MS, NS_PER_S

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
