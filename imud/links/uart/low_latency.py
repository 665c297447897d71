"""How long a serial adapter holds bytes back, and making that short.

FTDI-like USB adapters send a packet when 62 bytes are there or their latency timer (16 ms as delivered) runs out.
ASYNC_LOW_LATENCY (linux/serial.h) or sysfs `latency_timer` sets it to 1 ms. Native UARTs and ptys hold nothing back;
CDC ACM devices answer the host's polls of 1 ms (USB full-speed frame).
"""

import contextlib
import os
from pathlib import Path
from typing import Final

import serial

from imud.units import NS_PER_MS

UNKNOWN_USB_HOLD_NS: Final = 16 * NS_PER_MS
"""USB adapters whose driver does not tell: as long as the worst common one."""
ACM_HOLD_NS: Final = 1 * NS_PER_MS


def request_low_latency(port: serial.Serial, path: str, sys: Path) -> None:
    """Ask driver and adapter to hand over bytes at once. Absent support is normal (ptys, many drivers)."""
    with contextlib.suppress(ValueError):  # pyserial's word for a driver without TIOCSSERIAL
        port.set_low_latency_mode(True)
    timer_ms = read_latency_timer_ms(path, sys)
    if timer_ms is not None and timer_ms > 1:
        with contextlib.suppress(OSError):  # writable for root only
            _timer(path, sys).write_text("1")


def hold_ns(path: str, sys: Path) -> int:
    """How long bytes may wait in the adapter behind `path` now, ns."""
    timer_ms = read_latency_timer_ms(path, sys)
    if timer_ms is not None:
        return timer_ms * NS_PER_MS
    name = _node(path)
    if name.startswith("ttyUSB"):
        return UNKNOWN_USB_HOLD_NS
    return ACM_HOLD_NS if name.startswith("ttyACM") else 0


def read_latency_timer_ms(path: str, sys: Path) -> int | None:
    """The adapter's latency timer in ms, or None where it has none."""
    try:
        return int(_timer(path, sys).read_text())
    except (OSError, ValueError):
        return None


def _timer(path: str, sys: Path) -> Path:
    return sys / "class" / "tty" / _node(path) / "device" / "latency_timer"


def _node(path: str) -> str:
    return os.path.basename(os.path.realpath(path))
