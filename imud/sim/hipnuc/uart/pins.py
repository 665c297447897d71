"""Output pins of a simulated HiPNUC module: SOUT, SOUT_DIV, ALARM. Manual V1.5.9, sections 1.2.2 and 2.2.4 (PMUX).

    SOUT      ____/▔▔▔▔▔▔\\___________/▔▔▔▔▔▔\\____      high for 80 µs before each frame, low otherwise
    TX        ------------< frame >-----------< frame >   its first byte right after the falling edge

Text (replies) has no pulse. SOUT_DIV repeats every n-th pulse; that it does so with the same 80 µs and begins with the
n-th after power-on or a change of the divider is assumed. ALARM is high while an angle is below the range's low end or
above its high end; that the module looks every 10 ms, and that X means the turn about X (pitch) and Y that about Y
(roll), is assumed: the manual gives no drawing of its axes there. Pins are named by function, whatever IO they are on.
"""

from bisect import bisect_right, insort
from math import degrees
from typing import Final

from imud.sample import Vector3
from imud.sim.hipnuc.uart.settings import ModuleSettings
from imud.sim.ports.pins import Pin, PinEdge
from imud.units import NS_PER_US

SOUT_HIGH_NS: Final = 80 * NS_PER_US
ALARM_PERIOD_MS: Final = 10
EDGES_MAX: Final = 8192
"""Edges kept for an owner that does not ask for them, the newest."""


class HipnucPins:
    """Pending edges and present levels. Synchronization: one thread."""

    def __init__(self) -> None:
        self._waiting: list[PinEdge] = []
        self._alarm = False
        """Level of ALARM after all edges that wait."""
        self._pulses = 0
        """SOUT pulses since the last that SOUT_DIV repeated."""

    def restart_divider(self) -> None:
        """Restart the count of the divider: it was set anew."""
        self._pulses = 0

    def frame(self, start_ns: int, high_ns: int, divider: int, sample_ns: int) -> None:
        """Schedule the pulse, `high_ns` long, before a frame that begins on the wire at `start_ns`."""
        pins = [Pin.SOUT]
        self._pulses += 1
        if self._pulses >= divider:
            self._pulses = 0
            pins.append(Pin.SOUT_DIV)
        for pin in pins:
            self._add(PinEdge(start_ns - high_ns, pin, True, sample_ns))
            self._add(PinEdge(start_ns, pin, False, sample_ns))

    def alarm(self, at_ns: int, active: bool) -> None:
        """Set the level of ALARM from now on."""
        if active != self._alarm:
            self._alarm = active
            self._add(PinEdge(at_ns, Pin.ALARM, active))

    def edges(self, now_ns: int) -> list[PinEdge]:
        """Return and remove the edges that have happened by now."""
        count = bisect_right(self._waiting, now_ns, key=_due_ns)
        done, self._waiting = self._waiting[:count], self._waiting[count:]
        return done

    def next_ns(self) -> int | None:
        """Time of the next edge that is known."""
        return self._waiting[0].due_ns if self._waiting else None

    def power_lost(self, now_ns: int) -> None:
        """Cancel pending edges; pins that are high fall."""
        count = bisect_right(self._waiting, now_ns, key=_due_ns)
        dropped = self._waiting[count:]
        del self._waiting[count:]
        self._pulses = 0
        first_dropped = {edge.pin: edge for edge in reversed(dropped)}
        for pin in Pin:
            dropped_edge = first_dropped.get(pin)
            high = not dropped_edge.rising if dropped_edge else pin is Pin.ALARM and self._alarm
            if high:
                self._add(PinEdge(now_ns, pin, False))
        self._alarm = False

    def _add(self, edge: PinEdge) -> None:
        if len(self._waiting) >= EDGES_MAX:
            del self._waiting[: EDGES_MAX // 2]
        insort(self._waiting, edge, key=_due_ns)


def is_alarming(settings: ModuleSettings, euler_rad: Vector3) -> bool:
    """Whether an angle is out of the range that PMUX5 has set for it."""
    roll, pitch, _ = euler_rad
    return any(
        alarm.enabled and not alarm.low_deg <= degrees(angle_rad) <= alarm.high_deg
        for alarm, angle_rad in ((settings.alarm_x, pitch), (settings.alarm_y, roll))
    )


def _due_ns(edge: PinEdge) -> int:
    return edge.due_ns
