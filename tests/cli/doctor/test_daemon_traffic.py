"""Checks that find wrong wires, baud rates, supplies and GPIO lines in the counters of the daemon."""

from typing import Any

import msgspec
import pytest

from imud.cli.doctor.daemon import half_duplex, heard, lines
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import DeviceState, DeviceStatus, KernelCounters, LinesStatus, SerialLineCounters
from tests.support.metrics import POLLING, device
from tests.support.surroundings import Machine

HEARD, HALF, LINES = (
    DoctorCheck("h", heard), DoctorCheck("d", half_duplex), DoctorCheck("l", lines),
)  # fmt: skip
UART = "bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}}"
WIRED = "bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}, lines: {sout: {line: GPIO17}}}"
RS485 = "bow: {driver: hipnuc-modbus, rs485: {line: /dev/ttyUSB0, address: 80}}"

GOOD: dict[str, Any] = {"frames_good": 5000, "samples": 5000}


def counted(state: DeviceState = DeviceState.SEARCHING, **counts: int) -> DeviceStatus:
    """Return the status of a device with these counters. Other counters and kernel errors are 0."""
    made = device("bow", state=state, kernel=KernelCounters())
    return msgspec.structs.replace(made, ledger=dict.fromkeys(made.ledger, 0) | counts)


def test_without_the_daemon_a_port_or_samples(machine: Machine) -> None:
    machine.configure(WIRED)
    for check in (HEARD, LINES):
        assert [finding.severity for finding in machine.find(check)] == ["not checked"]
    assert machine.find(HALF) == []  # this line is not configured
    machine.configure(UART)
    machine.status = [counted(DeviceState.MISSING)]
    assert machine.find(HEARD) == []


@pytest.mark.parametrize(
    ("status", "severity", "words"),
    [
        (counted(), "error", "are TX and RX swapped"),
        (counted(bytes_in=199), "error", "echoes of imud's requests"),
        (counted(bytes_in=200), "error", "the baud rate, the driver or the device is wrong"),
        (msgspec.structs.replace(counted(bytes_in=5000), kernel=KernelCounters(framing=9)), "error",
         "9 framing errors"),
        (counted(bytes_in=5000, frames_good=7, frames_in_replies=7), "error", "but no sample in 7 frames"),
        (counted(bytes_in=5000, frames_good=7, frames_ignored=7), "error",
         "valid frames of unknown types, but no sample"),
        (counted(DeviceState.RUNNING, **GOOD, frames_bad_crc=5), "ok", "5 damaged"),
        (counted(DeviceState.RUNNING, **GOOD, frames_bad_crc=6), "warning", "6 damaged and"),
        (msgspec.structs.replace(counted(**GOOD), kernel=KernelCounters(overrun=2)), "warning", "overrun"),
    ],
)  # fmt: skip
def test_serial_data(machine: Machine, status: DeviceStatus, severity: str, words: str) -> None:
    machine.configure(UART)
    machine.status = [status]
    machine.tells(HEARD, severity, words)


def one_way(**changes: object) -> DeviceStatus:
    """Return a device that sent samples at 100 Hz for 70 s and never replied."""
    made = counted(DeviceState.RUNNING, frames_good=7000, samples=7000)
    made = msgspec.structs.replace(made, identity={}, expected_rate_hz=100.0)
    return msgspec.structs.replace(made, **changes)


@pytest.mark.parametrize(
    ("status", "severities"),
    [
        (one_way(), ["ok", "warning"]), (one_way(identity={"product": "HI14"}), ["ok"]),
        (one_way(ledger=one_way().ledger | {"frames_in_replies": 1}), ["ok"]),
        (one_way(ledger=one_way().ledger | {"samples": 6000}), ["ok"]), (one_way(state=DeviceState.SILENT), ["ok"]),
        (one_way(expected_rate_hz=0.0, rate_hz=0.0), ["ok"]),
    ],
)  # fmt: skip
def test_a_device_that_never_answers_does_not_hear_imud(
    machine: Machine, status: DeviceStatus, severities: list[str]
) -> None:
    machine.configure(UART)
    machine.status = [status]
    told = machine.told(HEARD)
    assert [severity for severity, _ in told] == severities
    assert all("RX of the device is not connected" in text for severity, text in told if severity == "warning")
    machine.configure(UART.replace("bow: {", "bow: {identify: false, "))
    assert [finding.severity for finding in machine.find(HEARD)] == ["ok"]


@pytest.mark.parametrize(
    ("state", "line", "severity", "words"),
    [
        (DeviceState.RUNNING, SerialLineCounters(timeouts=10, echoes=1000), "ok", "ignores the echoes"),
        (DeviceState.RUNNING, SerialLineCounters(timeouts=10, strange_bytes=10), "ok", "bus works"),
        (DeviceState.RUNNING, SerialLineCounters(strange_bytes=1), "ok", "bus works"),
        (DeviceState.RUNNING, SerialLineCounters(timeouts=11), "warning", "11 requests without a reply"),
        (DeviceState.RUNNING, SerialLineCounters(strange_bytes=5), "warning", "5 invalid bytes"),
        (DeviceState.SEARCHING, SerialLineCounters(timeouts=9, echoes=9), "error", "only 9 echoes"),
        (DeviceState.SEARCHING, SerialLineCounters(timeouts=9), "error", "no byte arrived"),
    ],
)
def test_rs485(machine: Machine, state: DeviceState, line: SerialLineCounters, severity: str, words: str) -> None:
    machine.configure(RS485)
    machine.status = [device("bow", state=state, serial_line=line, polling=POLLING)]  # 1000 reads
    machine.tells(HALF, severity, words)


@pytest.mark.parametrize(
    ("samples", "found", "severity", "words"),
    [
        (5000, LinesStatus({}, {"sout": 4999}, {"sout": 0}), "ok", "4999 edges"),
        (5000, LinesStatus({}, {"sout": 4990}, {"sout": 9}), "warning", "the kernel lost 9 of 4999 edges"),
        (101, LinesStatus({}, {"sout": 0}, {}), "warning", "no edge in 101 samples"),
        (100, LinesStatus({}, {"sout": 0}, {}), "not checked", "too few samples"),
        (5000, LinesStatus({}, {"alarm": 0}, {}), "note", "no edge so far"),
        (1000, LinesStatus({}, {"pps": 0}, {}), "not checked", "too few samples"),
        (1001, LinesStatus({}, {"pps": 0}, {}), "warning", "does the receiver have a fix"),
        (5000, LinesStatus({"sout": "GPIO17 is in use"}, {"sout": 0}, {}), "error", "GPIO17 is in use"),
    ],
)
def test_edges_of_lines(machine: Machine, samples: int, found: LinesStatus, severity: str, words: str) -> None:
    machine.configure(WIRED)
    running = counted(DeviceState.RUNNING, samples=samples)
    machine.status = [msgspec.structs.replace(running, lines=found, expected_rate_hz=100.0)]
    machine.tells(LINES, severity, words)
