"""A simulated HiPNUC module on the bench: ask it, listen to it, with time in milliseconds."""

import struct
from math import radians
from typing import NamedTuple

from imud.sim.hipnuc.uart.settings import HipnucHardware, ModuleSettings, Output
from imud.sim.hipnuc.uart.simulator import HipnucModule
from imud.sim.physics.motion import Still
from imud.sim.simulator import Burst
from imud.units import NS_PER_MS

BEGIN_NS = 1_234_567_890_123
STILL = HipnucHardware(motion=Still(radians(2), radians(-3), radians(40)), skew_ppm=0)
FAST = ModuleSettings(baud=921_600, hi91=Output(1))


class Frame(NamedTuple):
    """HI91 as it stands on the wire, units of the manual."""

    word_1_2: int
    temperature_c: int
    pressure_pa: float
    system_time_ms: int
    accel_g: tuple[float, ...]
    gyro_deg_s: tuple[float, ...]
    mag_ut: tuple[float, ...]
    euler_deg: tuple[float, ...]
    quat_wxyz: tuple[float, ...]


def hi91(data: bytes) -> Frame:
    """Take a frame apart by offsets of manual 3.3.1, without the codec."""
    assert data[:4] == b"\x5a\xa5\x4c\x00"
    assert data[6] == 0x91
    _, word, temperature, pressure, time, *rest = struct.unpack("<BHbfI16f", data[6:])
    parts = [tuple(rest[i:j]) for i, j in ((0, 3), (3, 6), (6, 9), (9, 12), (12, 16))]
    return Frame(word, temperature, pressure, time, *parts)


class Bench:
    """A module that has booted, and the time."""

    def __init__(self, settings: ModuleSettings | None = None, hardware: HipnucHardware | None = None) -> None:
        self.now_ns = BEGIN_NS
        self.module = HipnucModule(BEGIN_NS, settings, hardware)
        self.wait(self.module.hardware.boot_ms)

    def wait(self, duration_ms: float) -> list[Burst]:
        """Let time pass; return what the module sent."""
        self.now_ns += round(duration_ms * NS_PER_MS)
        return self.module.advance(self.now_ns)

    def frames(self, duration_ms: float) -> list[Frame]:
        """Let time pass; return the HI91 frames."""
        return [hi91(burst.data) for burst in self.wait(duration_ms) if burst.sample_ns is not None]

    def ask(self, command: str, duration_ms: float = 30.0) -> list[str]:
        """Send a command; return the lines of text that came."""
        self.module.receive(command.encode() + b"\r\n", self.now_ns)
        return self.text(duration_ms)

    def text(self, duration_ms: float) -> list[str]:
        """Let time pass; return the lines of text that came."""
        text = b"".join(burst.data for burst in self.wait(duration_ms) if burst.sample_ns is None)
        assert not text or text.endswith(b"\r\n")
        return text.decode("ascii").split("\r\n")[:-1]

    def reboot(self) -> None:
        """Switch off and on, and wait until it has booted."""
        self.module.reboot(self.now_ns)
        self.wait(self.module.hardware.boot_ms)
