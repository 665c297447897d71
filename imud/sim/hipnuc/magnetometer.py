"""The calibration of its magnetometer that a simulated module does by itself. Manual V1.5.9, sections 8.1.3 and 8.2.

The manual says that the module needs to be turned through many attitudes, and not when it has enough. The simulated one
has enough after one turn about each axis. What it finds it keeps without a command to save.

    field of the earth + field of what turns with it − what it knows of that = what it sends
"""

from math import tau
from typing import Final

from imud.sample import Vector3
from imud.units import NS_PER_S

NOT_CALIBRATED, CALIBRATED = 0, 1
"""State as register 0x0A shows it; the true numbers are in no source."""
TURN_RAD: Final = tau
STEP_MAX_NS: Final = NS_PER_S
"""A longer time between two samples adds no turn."""
_NO_TURN: Final[Vector3] = (0.0, 0.0, 0.0)


class SelfCalibration:
    """Bias of one magnetometer, and what the module knows of it."""

    def __init__(self, hard_iron_t: Vector3, found_t: Vector3) -> None:
        """`hard_iron_t` is the field of what turns with the module; `found_t` is what it knows of that already."""
        self._hard_iron_t = hard_iron_t
        self.found_t = found_t
        self.finished = any(found_t)
        """Whether it was calibrated."""
        self._turned: Vector3 = _NO_TURN
        self._before_ns: int | None = None

    @property
    def state(self) -> int:
        """NOT_CALIBRATED or CALIBRATED."""
        return CALIBRATED if self.finished else NOT_CALIBRATED

    @property
    def progress(self) -> float:
        """Share of the turning that it needs, 0 … 1; 1 once it was calibrated."""
        return 1.0 if self.finished else min(self._turned) / TURN_RAD

    def sample(self, device_ns: int, gyro_rad_s: Vector3) -> None:
        """Take one sample in 9-axis mode while the calibration in the background is on.

        `device_ns` is the time of the module's own clock.
        """
        before, self._before_ns = self._before_ns, device_ns
        if before is None or not 0 < device_ns - before <= STEP_MAX_NS:
            return
        step_s = (device_ns - before) / NS_PER_S
        x, y, z = (turned + abs(rate) * step_s for turned, rate in zip(self._turned, gyro_rad_s, strict=True))
        self._turned = (x, y, z)
        if min(self._turned) >= TURN_RAD:
            self.finished, self.found_t, self._turned = True, self._hard_iron_t, _NO_TURN

    def measured(self, field_t: Vector3) -> Vector3:
        """The field as the module sends it: with what it does not know of its bias."""
        (a, b, c), (d, e, f), (x, y, z) = self._hard_iron_t, self.found_t, field_t
        return (x + a - d, y + b - e, z + c - f)
