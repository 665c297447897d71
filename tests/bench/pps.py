"""Simulates late pulses per second: `python -m tests.bench.pps` prints the errors of UTC."""

from statistics import mean, pstdev

from tests.utc.test_pps import Receiver

PULSES = 500


def row(late_ns: float) -> str:
    receiver, errors, told = Receiver(50.0, late_ns), list[float](), list[int]()
    receiver.go(20)
    for _ in range(PULSES):
        receiver.go(1)
        errors.append(receiver.error_ns(0.5) / 1000)
        told.append(receiver.known(0.5).error_ns)
    within = mean(abs(error) * 1000 <= 2 * one for error, one in zip(errors, told, strict=True))
    cells = f"{late_ns / 1000:g} µs | {mean(errors):.1f} µs | {pstdev(errors):.1f} µs | {mean(told) / 1000:.1f} µs"
    return f"| {cells} | {within:.3f} |"


if __name__ == "__main__":
    for late_ns in (0.0, 5e3, 20e3, 50e3, 100e3):
        print(row(late_ns))
