"""Checks of CAN interfaces with a simulated /sys and recorded JSON of ip(8)."""

import json
import re
from copy import deepcopy
from typing import Any

import pytest

from imud.cli.doctor.buses import can_bitrate, can_state, can_up, interfaces
from imud.cli.doctor.command import examine
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import DeviceState
from tests.support.files import ROOT
from tests.support.metrics import device
from tests.support.surroundings import Machine

UP, STATE, RATE = DoctorCheck("u", can_up), DoctorCheck("s", can_state), DoctorCheck("r", can_bitrate)

RECORDED: dict[str, Any] = json.loads((ROOT / "tests/cli/doctor/ip_link_can0.json").read_text())
COMMAND = "ip -json -details -statistics link show can0"


@pytest.fixture
def mast(machine: Machine) -> Machine:
    machine.configure("mast: {driver: hipnuc-canopen, socketcan: {interface: can0}}")
    return machine


def interface(
    machine: Machine, flags: str = "0x40081", *, packets: int = 0, data: dict[str, Any] | None = None
) -> None:
    """Set the recorded reply of `ip` with changed members. Without `data`, the interface is virtual."""
    up(machine, flags)
    answer = deepcopy(RECORDED["error-active"])
    (link,) = answer
    link["stats64"]["rx"]["packets"] = packets
    data = dict(data or {})
    link["linkinfo"]["info_xstats"]["bus_off"] = data.pop("bus_off", 0)
    link["linkinfo"]["info_data"].update(data)
    if not data:
        link["linkinfo"] = {"info_kind": "vcan"}
    machine.prints(COMMAND, json.dumps(answer))


def up(machine: Machine, flags: str = "0x40081") -> None:
    machine.write("/sys/class/net/can0/type", "280\n")
    machine.write("/sys/class/net/can0/flags", flags + "\n")


def controller(state: str = "ERROR-ACTIVE", tx: int = 0, rx: int = 0, **more: object) -> dict[str, object]:
    counters = {"tx": tx, "rx": rx}
    return {
        "state": state, "berr_counter": counters, "restart_ms": 100, "bittiming": {"bitrate": 500_000}, **more
    }  # fmt: skip


def test_an_interface_that_is_absent_down_up_or_virtual(mast: Machine) -> None:
    assert mast.told(UP)[0][1].startswith("can0 does not exist; CAN interfaces of this host: none →")
    up(mast, "0x40080")
    mast.prints(COMMAND, json.dumps(RECORDED["down"]))
    mast.tells(UP, "error", "can0 is down", "up type can bitrate")
    assert mast.find(STATE) == []  # the state of an interface that is down is unknown
    interface(mast)
    assert mast.find(UP)[0].severity == "ok"
    interface(mast)
    assert mast.told(STATE) == [("ok", "can0 is a virtual interface without a controller → ")]
    assert mast.find(RATE) == []


@pytest.mark.parametrize(
    ("data", "packets", "severity", "words"),
    [
        (controller(), 100, "ok", "100 frames received"),
        (controller("BUS-OFF", 248, 0), 100, "error", "left the bus"),
        (controller("ERROR-PASSIVE", 128, 0), 0, "error", "no other node acknowledges"),
        (controller("ERROR-WARNING", 0, 100), 0, "error", "a terminator is missing, or the bit rate is wrong"),
        (controller("ERROR-PASSIVE", 0, 130), 100, "warning", "60 Ω"),
        (controller("ERROR-ACTIVE", 0, 96), 100, "warning", "60 Ω"),
        (controller("ERROR-ACTIVE", 0, 3), 100, "ok", "rx 3"),
    ],
)
def test_state_and_error_counters(
    mast: Machine, data: dict[str, object], packets: int, severity: str, words: str
) -> None:
    interface(mast, packets=packets, data=data)
    mast.on_pause = lambda: interface(mast, packets=packets + 20, data=data)
    mast.tells(STATE, severity, words)


def test_errors_on_a_bus_that_carried_frames_before(mast: Machine) -> None:
    """The kernel also counts frames from before a change of the bit rate, or from before the device was unplugged."""
    interface(mast, packets=100, data=controller("ERROR-PASSIVE", 128, 0))
    mast.tells(STATE, "error", "100 frames received, no frame arrives now → no other node acknowledges")
    mast.status = [device("mast", state=DeviceState.RUNNING)]  # a device that sends only after a request
    assert mast.find(STATE)[0].severity == "warning"


@pytest.mark.parametrize(
    ("state", "severities", "words"),
    [
        ("error-active", ["ok", "note"], "can0 is ERROR-ACTIVE, error counters tx 0, rx 0, 2 frames received → "),
        (
            "bus-off",
            ["error", "note"],
            "the controller left the bus → restart it: `sudo ip link set can0 down`, then `sudo ip",
        ),
        (
            "error-passive",
            ["error", "warning", "note"],
            "2 frames received, no frame arrives now → no other node acknowledges",
        ),
    ],
)
def test_states_as_they_were_recorded(mast: Machine, state: str, severities: list[str], words: str) -> None:
    up(mast)
    mast.prints(COMMAND, json.dumps(RECORDED[state]))
    found = mast.told(STATE)
    assert [severity for severity, _ in found] == severities
    assert words in found[0][1]
    assert mast.told(RATE) == [("ok", "can0 has 500000 bit/s, 2 frames received → ")]


def test_bus_off_before_and_no_restart(mast: Machine) -> None:
    interface(mast, packets=9, data=controller(bus_off=4, restart_ms=0))
    found = mast.told(STATE)
    assert [severity for severity, _ in found] == ["ok", "warning", "note"]
    assert "bus-off 4 times" in found[1][1]
    interface(mast, data=controller("BUS-OFF", restart_ms=0))
    commands = "`sudo ip link set can0 down`, then `sudo ip link set can0 up type can restart-ms 100`"
    assert f"restart it: {commands}; check" in mast.told(STATE)[0][1]
    assert mast.told(STATE)[-1][1].endswith(commands)


@pytest.mark.parametrize("file", ["docs/can.md", "docs/monitoring.md", "etc/prometheus/imud.rules.yml"])
def test_documents_set_restart_ms_while_the_interface_is_down(file: str) -> None:
    """Otherwise the kernel refuses restart-ms with EBUSY (drivers/net/can/dev/netlink.c)."""
    text = (ROOT / file).read_text()
    commands = re.findall(r"^.*?type can .*?restart-ms", text, re.MULTILINE)
    assert commands
    for command in commands:
        assert re.search(r"\bdown\b.* up type|pre-up ip|^ip link set can0 type can bitrate", command), command


def test_bit_rates(mast: Machine) -> None:
    for bitrate, packets, state, severity in [
        (500_000, 0, DeviceState.SEARCHING, "error"),
        (500_000, 9, DeviceState.SEARCHING, "error"),
        (500_000, 9, DeviceState.SILENT, "error"),
        (500_000, 0, DeviceState.RUNNING, "ok"),
        (100_000, 9, DeviceState.RUNNING, "warning"),
    ]:
        interface(mast, packets=packets, data=controller(bittiming={"bitrate": bitrate}))
        mast.status = [device("mast", state=state)]
        ((got, text),) = mast.told(RATE)
        assert got == severity
        if severity == "error":
            assert "mast: no frame arrives at 500000 bit/s on can0 → try 125000, 250000, 1000000" in text
    interface(mast, packets=9, data=controller())
    mast.status = [device("mast", state=DeviceState.SEARCHING)]
    mast.on_pause = lambda: interface(mast, packets=10, data=controller())
    assert mast.told(RATE) == [("ok", "can0 has 500000 bit/s, 9 frames received → ")]


def test_ip_that_fails_is_missing_or_answers_in_another_form_is_not_checked(mast: Machine) -> None:
    for answer in ["", "{}", "[]", "[1]", '[{"linkinfo": 3}]']:
        interface(mast)
        mast.prints(COMMAND, answer)
        (examined,) = examine([STATE], mast.surroundings())
        assert [finding.severity for finding in examined.findings] == ["not checked"]
    interface(mast)
    mast.prints("ip", "", 1, "Device does not exist")
    mast.outputs[COMMAND] = FileNotFoundError(2, "No such file", "ip")
    (examined,) = examine([STATE], mast.surroundings())
    assert examined.findings[0].seen == "s: ip does not exist or is not installed"


def test_interfaces_of_other_backends_are_not_the_kernels(machine: Machine) -> None:
    machine.configure("a: {driver: hipnuc-canopen, socketcan: {interface: x, backend: virtual}}")
    assert interfaces(machine.surroundings()) == []
