"""Checks of the configuration, the unit, the socket, the outputs, the device states and their counters."""

import asyncio
import errno
import os
from typing import Any
from unittest import mock

import msgspec
import pytest

from imud.cli.doctor import daemon as checks
from imud.cli.doctor.command import examine, exit_status
from imud.cli.doctor.surroundings import DoctorCheck, fetch_over_http
from imud.config.host_values import HostFinding
from imud.contracts.status import CKernelStatus, DeviceState, DeviceStatus, KernelCounters, LinesStatus
from imud.contracts.status import SerialLineCounters as Counters
from imud.model.errors import LinkDenied, LinkMissing, ServerError
from imud.publishers.metrics.publisher import MetricsOptions, MetricsPublisher
from tests.support.metrics import POLLING, ask, device
from tests.support.publisher_context import publisher_context
from tests.support.surroundings import Machine

CONFIGURATION, SERVICE, SOCKET, STALE, STATES, PROMETHEUS, SHARED, HEARD, HALF, LINES, KERNEL = (
    DoctorCheck("c", check) for check in (
        checks.configuration, checks.service, checks.socket, checks.stale_configuration, checks.device_states,
        checks.prometheus, checks.shared_memory, checks.heard, checks.half_duplex, checks.lines, checks.c_kernel,
    )
)  # fmt: skip
BOW = "bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}}"
ACTIVE = ("ActiveState=active", "UnitFileState=enabled", "Result=success", "NRestarts=2", "NeedDaemonReload=no")


def test_configurations_and_a_service_without_systemd_or_a_unit_or_with_a_fault(machine: Machine) -> None:
    machine.tells(CONFIGURATION, "error", "No such file", "`sudo imud setup`")
    for number in (errno.EACCES, errno.EPERM):
        with mock.patch("imud.cli.doctor.daemon.open_regular", side_effect=OSError(number, "denied")):
            machine.tells(CONFIGURATION, "not checked", "this user cannot read /etc/imud.yaml", "`sudo imud doctor`")
    machine.configure(BOW, "old: {enabled: false, driver: hipnuc-uart, uart: {port: /dev/ttyUSB1, baud: 115200}}")
    assert machine.told(CONFIGURATION) == [
        ("ok", "/etc/imud.yaml is valid; devices: bow → "),
        ("note", "device old is disabled in /etc/imud.yaml → "),
    ]
    machine.host_findings = [
        HostFinding(("devices", "bow", "uart", "port"), "expected a serial port, got /dev/null", is_error=True),
        HostFinding(("state_dir",), "expected an absolute path, got state", is_error=False),
    ]
    assert machine.told(CONFIGURATION)[1] == (
        "error",
        "/etc/imud.yaml: devices.bow.uart.port: expected a serial port, got /dev/null → run `imud check "
        "/etc/imud.yaml`, which names the line, and correct the file",
    )
    assert len(machine.told(CONFIGURATION)) == 3
    machine.host_findings = []
    machine.configure()
    assert [finding.severity for finding in machine.find(CONFIGURATION)] == ["warning"]
    machine.configure("bow: {driver: hipnuc-uart, uart: {prt: /dev/ttyUSB0}}")
    found = machine.told(CONFIGURATION)
    assert found
    assert {severity for severity, _ in found} == {"error"}
    assert any("imud.yaml:2:" in text and "prt" in text for _, text in found)
    assert machine.find(SERVICE)[0].severity == "not checked"
    machine.prints("systemctl show", "LoadState=not-found\n")
    assert machine.find(SERVICE)[0].severity == "warning"
    machine.unit(*ACTIVE)
    assert [finding.severity for finding in machine.find(SERVICE)] == ["ok", "ok"]
    for changed, severity, words in [
        ("UnitFileState=disabled", "warning", "sudo systemctl enable imud"),
        ("UnitFileState=masked", "error", "sudo systemctl unmask imud"),
        ("ActiveState=inactive", "error", "sudo systemctl start imud"),
        ("ActiveState=activating", "warning", "again in a minute"),
        ("NRestarts=3", "warning", "restarted imud.service 3 times"),
        ("NeedDaemonReload=yes", "warning", "daemon-reload"),
    ]:
        key = changed.partition("=")[0]
        machine.unit(*(line for line in ACTIVE if not line.startswith(f"{key}=")), changed)
        ((got, text),) = [found for found in machine.told(SERVICE) if found[0] != "ok"]
        assert (got, words in text) == (severity, True), changed
    machine.unit("UnitFileState=enabled", "ActiveState=failed", "Result=exit-code", "ExecMainStatus=78")
    assert "with `imud check`" in machine.told(SERVICE)[-1][1]


@pytest.mark.parametrize("kind", ["fifo", "directory", "device"])
def test_configuration_that_is_not_a_regular_file(machine: Machine, kind: str) -> None:
    """Opening a FIFO waited for its writer without output."""
    path = machine.root / "etc" / "imud.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "directory":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    (finding,) = machine.told(CONFIGURATION)
    assert finding[0] == "error"
    assert "cannot read" in finding[1]
    assert machine.surroundings().text("/etc/imud.yaml") is None


def test_answers_of_the_socket_and_use_of_the_kernel_in_c(machine: Machine) -> None:
    answers: list[tuple[Any, str]] = [
        ([device("bow")], "ok"), (LinkMissing("no daemon"), "error"), (LinkDenied("group imud?"), "not checked"),
        (ServerError("another protocol"), "error"), (TimeoutError("waited in vain"), "error"),
    ]  # fmt: skip
    for machine.status, severity in answers:
        assert [finding.severity for finding in machine.find(SOCKET)] == [severity], machine.status
    assert machine.find(KERNEL) == []  # no daemon
    machine.status = []
    machine.tells(KERNEL, "ok", "uses its C kernel")
    machine.c_kernel = CKernelStatus(False, "IMUD_KERNEL=0 switches it off")
    machine.tells(KERNEL, "note", "IMUD_KERNEL=0", "C compiler")
    machine.c_kernel = None  # a daemon of an older version
    assert machine.find(KERNEL) == []


def test_a_daemon_with_other_devices_or_an_older_configuration(machine: Machine) -> None:
    assert machine.find(STALE)[0].severity == "not checked"
    machine.configure(BOW)
    assert machine.find(STALE)[0].severity == "not checked"
    machine.status = [device("stern")]
    machine.tells(STALE, "warning", "uses the devices stern, /etc/imud.yaml contains bow")
    machine.status = [device("bow")]
    assert machine.find(STALE)[0].severity == "ok"
    machine.unit(*ACTIVE, "StateChangeTimestampMonotonic=5000000")
    machine.boot_utc_ns = 1_000 * 10**9  # the reload was at 1005 s
    file = machine.root / "etc/imud.yaml"
    os.utime(file, (1004, 1004))
    assert machine.find(STALE)[0].severity == "ok"
    os.utime(file, (1007, 1007))
    assert machine.told(STALE) == [
        ("warning", "/etc/imud.yaml changed after the last reload of the daemon → `sudo systemctl reload imud`")
    ]


def test_states_come_with_the_reason_of_the_daemon(machine: Machine) -> None:
    assert machine.find(STATES)[0].severity == "not checked"
    down = device("b", state=DeviceState.MISSING, problem="/dev/ttyUSB1 is not there")
    machine.status = [device("a"), down, device("c", problem="can0 is error-passive")]
    found = machine.told(STATES)
    assert [severity for severity, _ in found] == ["ok", "error", "error"]
    assert "b: /dev/ttyUSB1 is not there" in found[1][1]


AT = ("127.0.0.1", 9321, "/scrapes")


@pytest.fixture
def running(machine: Machine) -> Machine:
    machine.configure()
    machine.status = []
    return machine


def test_scrapes(running: Machine) -> None:
    for page, severity, words in [
        ('{"scrapes":0,"age_s":9.0}', "note", "no scrape of 127.0.0.1 port 9321 since imud opened it 9 s ago"),
        ('{"scrapes":0,"age_s":3000.0}', "note", "opened it 50 minutes ago"),
        ('{"scrapes":7,"age_s":9.0}', "ok", "7 scrapes, the last 9 s ago"),
        ('{"scrapes":7,"age_s":301.0}', "warning", "for 5 minutes, after 7 scrapes"),
        ("<html>", "error", "is not imud"),
    ]:
        running.pages[AT] = page
        running.tells(PROMETHEUS, severity, words)
    for age_s, severity in [(300.0, "note"), (301.0, "warning")]:
        running.configure(more="metrics: {port: 9321}\n")
        running.pages[AT] = f'{{"scrapes":0,"age_s":{age_s}}}'
        examined = examine([PROMETHEUS], running.surroundings())
        assert [finding.severity for finding in examined[0].findings] == [severity]
        assert exit_status(examined) == (severity == "warning")


def test_no_daemon_no_answer_another_address_and_switched_off(machine: Machine) -> None:
    assert machine.find(PROMETHEUS)[0].severity == "not checked"
    machine.configure()
    assert "no daemon runs" in machine.told(PROMETHEUS)[0][1]
    machine.status = []
    machine.tells(PROMETHEUS, "error", "do not reply at 127.0.0.1 port 9321: Connection refused")
    machine.configure(more="metrics: {enabled: false}\n")
    assert machine.find(PROMETHEUS)[0].severity == "note"
    machine.configure(more="metrics: {port: 0}\n")
    assert machine.find(PROMETHEUS)[0].severity == "not checked"
    machine.configure(more="metrics: {address: 0.0.0.0}\n")
    machine.pages[AT] = '{"scrapes":7,"age_s":9.0}'
    assert machine.find(PROMETHEUS)[0].severity == "ok"


def test_the_endpoint_itself_is_understood(running: Machine) -> None:
    async def serve() -> list[str]:
        made = MetricsPublisher(MetricsOptions(port=0), publisher_context(lambda: (), 1, lambda: 5_000_000_000))
        made.start()
        pages = []
        try:
            pages.append(await asyncio.to_thread(fetch_over_http, "127.0.0.1", made.port, "/scrapes"))
            await ask(made.port)
            pages.append(await asyncio.to_thread(fetch_over_http, "127.0.0.1", made.port, "/scrapes"))
            with pytest.raises(OSError, match="got 404"):
                await asyncio.to_thread(fetch_over_http, "127.0.0.1", made.port, "/other")
        finally:
            made.close()
        return pages

    severities = []
    for page in asyncio.run(serve()):
        running.pages[AT] = page
        severities.append(str(running.find(PROMETHEUS)[0].severity))
    assert severities == ["note", "ok"]


RINGS, FLIGHT = "shm: {directory: /dev/shm}\n", "recorder: {flight: {enabled: true, directory: /dev/shm/imud-flight}}\n"


def test_files_in_shared_memory_that_systemd_removes(machine: Machine) -> None:
    for more, removes, severities in [
        (RINGS + FLIGHT, "yes", ["warning", "warning"]), (RINGS + FLIGHT, "no", ["ok", "ok"]),
        (FLIGHT, "yes", ["warning"]), (FLIGHT.replace("true", "false"), "yes", []),
        ("shm: {directory: /dev/shmem}\n", "yes", []), ("", "yes", []),
    ]:  # fmt: skip
        machine.configure(more=more)
        machine.outputs.clear()
        assert machine.find(SHARED) == [], "without a service nothing removes them"
        machine.unit(f"RemoveIPC={removes}")
        told = machine.told(SHARED)
        assert [severity for severity, _ in told] == severities
        assert all("RemoveIPC=no" in text for severity, text in told if severity == "warning")


WIRED = "bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0, baud: 115200}, lines: {sout: {line: GPIO17}}}"
RS485 = "bow: {driver: hipnuc-modbus, rs485: {line: /dev/ttyUSB0, address: 80}}"

GOOD: dict[str, Any] = {"frames_good": 5000, "samples": 5000}


def counted(state: DeviceState = DeviceState.SEARCHING, **counts: int) -> DeviceStatus:
    """Return the status of a device with these counters. Other counters and kernel errors are 0."""
    made = device("bow", state=state, kernel=KernelCounters())
    return msgspec.structs.replace(made, ledger=dict.fromkeys(made.ledger, 0) | counts)


def test_serial_data(machine: Machine) -> None:
    machine.configure(WIRED)
    for check in (HEARD, LINES):
        assert [finding.severity for finding in machine.find(check)] == ["not checked"]
    assert machine.find(HALF) == []  # this line is not configured
    machine.configure(BOW)
    machine.status = [counted(DeviceState.MISSING)]
    assert machine.find(HEARD) == []
    for status, severity, words in [
        (counted(), "error", "are TX and RX swapped"),
        (counted(bytes_in=199), "error", "echoes of imud's requests"),
        (counted(bytes_in=200), "error", "the baud rate, the driver or the device is wrong"),
        (msgspec.structs.replace(counted(bytes_in=5000), kernel=KernelCounters(framing=9)), "error",
         "9 framing errors"),
        (counted(bytes_in=5000, frames_good=7, frames_in_replies=7), "error", "but no sample in 7 frames"),
        (counted(bytes_in=5000, frames_good=7, frames_ignored=7), "error",
         "valid frames of unknown types, but no sample"),
        (msgspec.structs.replace(counted(bytes_in=5000, frames_ignored=3), problem="x", unused="types (tag 0x77: 3)"),
         "error", "bow: types (tag 0x77: 3)"),
        (counted(DeviceState.RUNNING, **GOOD, frames_bad_crc=5), "ok", "5 damaged"),
        (counted(DeviceState.RUNNING, **GOOD, frames_bad_crc=6), "warning", "6 damaged and"),
        (msgspec.structs.replace(counted(**GOOD), kernel=KernelCounters(overrun=2)), "warning", "overrun"),
    ]:  # fmt: skip
        machine.status = [status]
        machine.tells(HEARD, severity, words)
    machine.status = [msgspec.structs.replace(counted(**GOOD), unused="valid frames of unknown types (tag 0x77: 3)")]
    (severity, text), _ = machine.told(HEARD)
    assert (severity, "does not use valid frames of unknown types (tag 0x77: 3)" in text) == ("warning", True)


def one_way(**changes: object) -> DeviceStatus:
    """Return a device that sent samples at 100 Hz for 70 s and never replied."""
    made = counted(DeviceState.RUNNING, frames_good=7000, samples=7000)
    made = msgspec.structs.replace(made, identity={}, expected_rate_hz=100.0)
    return msgspec.structs.replace(made, **changes)


def test_a_device_that_never_answers_does_not_hear_imud(machine: Machine) -> None:
    for status, severities in [
        (one_way(), ["ok", "warning"]), (one_way(identity={"product": "HI14"}), ["ok"]),
        (one_way(ledger=one_way().ledger | {"frames_in_replies": 1}), ["ok"]),
        (one_way(ledger=one_way().ledger | {"samples": 6000}), ["ok"]), (one_way(state=DeviceState.SILENT), ["ok"]),
        (one_way(expected_rate_hz=0.0, rate_hz=0.0), ["ok"]),
    ]:  # fmt: skip
        machine.configure(BOW)
        machine.status = [status]
        told = machine.told(HEARD)
        assert [severity for severity, _ in told] == severities
        assert all("RX of the device is not connected" in text for severity, text in told if severity == "warning")
        machine.configure(BOW.replace("bow: {", "bow: {identify: false, "))
        assert [finding.severity for finding in machine.find(HEARD)] == ["ok"]


def test_rs485(machine: Machine) -> None:
    machine.configure(RS485)
    machine.tells(HALF, "not checked")
    machine.status = [device("bow")]  # a daemon of an older version sends no counters
    assert machine.find(HALF) == []
    for state, line, severity, words in [
        (DeviceState.RUNNING, Counters(timeouts=10, echoes=1000), "ok", "ignores the echoes"),
        (DeviceState.RUNNING, Counters(timeouts=10, strange_bytes=10), "ok", "bus works"),
        (DeviceState.RUNNING, Counters(strange_bytes=1), "ok", "bus works"),
        (DeviceState.RUNNING, Counters(timeouts=11), "warning", "11 requests without a reply"),
        (DeviceState.RUNNING, Counters(strange_bytes=5), "warning", "5 invalid bytes"),
        (DeviceState.SEARCHING, Counters(timeouts=9, echoes=9), "error", "only 9 echoes"),
        (DeviceState.SEARCHING, Counters(timeouts=9), "error", "no byte arrived"),
    ]:
        machine.configure(RS485)
        machine.status = [device("bow", state=state, serial_line=line, polling=POLLING)]  # 1000 reads
        machine.tells(HALF, severity, words)


def test_edges_of_lines(machine: Machine) -> None:
    machine.configure(WIRED)
    machine.status = [device("bow", lines=None)]
    assert machine.find(LINES) == []
    for samples, found, severity, words in [
        (5000, LinesStatus({}, {"sout": 4999}, {"sout": 0}), "ok", "4999 edges"),
        (5000, LinesStatus({}, {"sout": 4990}, {"sout": 9}), "warning", "the kernel lost 9 of 4999 edges"),
        (101, LinesStatus({}, {"sout": 0}, {}), "warning", "no edge in 101 samples"),
        (100, LinesStatus({}, {"sout": 0}, {}), "not checked", "too few samples"),
        (5000, LinesStatus({}, {"alarm": 0}, {}), "note", "no edge so far"),
        (1000, LinesStatus({}, {"pps": 0}, {}), "not checked", "too few samples"),
        (1001, LinesStatus({}, {"pps": 0}, {}), "warning", "does the receiver have a fix"),
        (5000, LinesStatus({"sout": "GPIO17 is in use"}, {"sout": 0}, {}), "error", "GPIO17 is in use"),
    ]:
        machine.configure(WIRED)
        running = counted(DeviceState.RUNNING, samples=samples)
        machine.status = [msgspec.structs.replace(running, lines=found, expected_rate_hz=100.0)]
        machine.tells(LINES, severity, words)
