"""A simulated I2C device that is similar to most sensors: byte registers and a register pointer."""

from tests.lab import wire


class RegisterDevice:
    def __init__(self, contents: dict[int, int] | None = None) -> None:
        self.registers = bytearray(256)
        self.pointer = 0
        for register, value in (contents or {}).items():
            self.registers[register] = value

    def __call__(self, transfer: wire.I2cTransfer) -> bytes:
        return b"".join(self._segment(segment) for segment in transfer.segments)

    def _segment(self, segment: wire.I2cSegment) -> bytes:
        if segment.reads:
            return bytes(self._next() for _ in range(segment.length))
        if segment.data:
            self.pointer = segment.data[0]
        for value in segment.data[1:]:
            self.registers[self.pointer] = value
            self.pointer = (self.pointer + 1) % 256
        return b""

    def _next(self) -> int:
        value = self.registers[self.pointer]
        self.pointer = (self.pointer + 1) % 256
        return value
