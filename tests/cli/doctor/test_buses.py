"""Checks of I2C and SPI: nodes, transfers, likely causes."""

import errno
import json
import re
from copy import deepcopy
from functools import partial
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from imud.cli.doctor.buses import bus_nodes, can_bitrate, can_state, can_up, i2c_transfers, interfaces, spi_transfers
from imud.cli.doctor.command import examine
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import DeviceState, DeviceStatus, PollingStatus
from imud.drivers.imu61x.registers import identity_of
from imud.links.spi import WR_BITS_PER_WORD, WR_MODE, SpiLink, SpiOptions
from imud.model.errors import DeviceRefused, LinkError
from tests.support.files import ROOT
from tests.support.metrics import device
from tests.support.surroundings import Machine

NODES, I2C, SPI = DoctorCheck("n", bus_nodes), DoctorCheck("i", i2c_transfers), DoctorCheck("s", spi_transfers)
KEEL = "keel: {driver: imu61x-i2c, i2c: {bus: 3, address: 0x18}}"
MAST = "mast: {driver: imu61x-spi, spi: {port: /dev/spidev0.0, mode: 3}}"


def polled(name: str, state: DeviceState = DeviceState.RUNNING, /, **counts: int) -> DeviceStatus:
    problem = "" if state == "running" else "no answer"
    made = device(name, state=state, polling=PollingStatus(**counts), problem=problem)
    return msgspec.structs.replace(made, ledger=dict.fromkeys(made.ledger, 0))


def test_nodes_and_transfers(machine: Machine) -> None:
    machine.configure(KEEL, MAST)
    machine.write("/dev/i2c-1")
    found = machine.told(NODES)
    assert [severity for severity, _ in found] == ["error", "error"]
    assert "/dev/i2c-3 does not exist; existing nodes of this kind: /dev/i2c-1" in found[0][1]
    assert "dtparam=spi=on" in found[1][1]
    machine.write("/dev/i2c-3")
    machine.write("/dev/spidev0.0")
    assert [finding.severity for finding in machine.find(NODES)] == ["ok", "ok"]
    machine.configure(KEEL, MAST)
    assert [machine.find(check)[0].severity for check in (I2C, SPI)] == ["not checked", "not checked"]
    machine.status = []
    assert "does not use this device" in machine.told(I2C)[0][1]
    for counts, severity, words in [
        ({"polls": 10_000, "failed": 10}, "ok", "10 failed"),
        ({"polls": 10_000, "failed": 11}, "warning", "11 of 10000 transfers failed"),
        ({"polls": 10_000, "vanished": 1}, "warning", "vanished 1 times"),
        ({"polls": 10_000, "stale": 5000}, "ok", "0 failed"),
        ({"polls": 10_000, "stale": 5001}, "note", "returned no new sample"),
        ({}, "not checked", "has not read the device yet"),
    ]:
        machine.configure(KEEL)
        machine.status = [polled("keel", **counts)]
        machine.tells(I2C, severity, words)
    machine.configure(MAST)
    one = polled("mast", polls=1000)
    machine.status = [msgspec.structs.replace(one, ledger=one.ledger | {"frames_bad_crc": 1})]
    machine.tells(SPI, "ok", "1000 transfers")
    machine.status = [msgspec.structs.replace(one, ledger=one.ledger | {"frames_bad_crc": 2})]
    advice = "use shorter wires, or a lower clock than 1000000 Hz"
    assert f"2 of 1000 replies were damaged → {advice}" in machine.told(SPI)[0][1]
    machine.configure(KEEL)
    machine.status = [polled("keel", polls=100, failed=50)]
    assert "stretching" not in machine.told(I2C)[0][1]
    machine.write("/sys/class/i2c-adapter/i2c-3/name", "bcm2835 (i2c@7e804000)\n")
    assert "defect in clock stretching" in machine.told(I2C)[0][1]


def test_a_device_that_does_not_answer(machine: Machine) -> None:
    machine.configure(KEEL, MAST)
    machine.status = [polled("keel", DeviceState.SEARCHING), polled("mast", DeviceState.FAILED)]
    machine.tells(I2C, "error", "`sudo i2cdetect -y 3` should show 18. If no device replies at address 0x18")
    assert [words for words in ("words of 8 bits", "mode 3 (try") if words not in machine.told(SPI)[0][1]] == []
    machine.configure("mast: {driver: imu61x-spi, spi: {port: /dev/spidev0.0}}")
    assert "uses mode 0 or 3" in machine.told(SPI)[0][1]


def refused(product_id: str) -> str:
    """Return the problem that the driver reports for a product id with these bytes."""
    with pytest.raises(DeviceRefused) as refusal:
        identity_of(bytes.fromhex(product_id))
    return f"mode 0: {refusal.value}"


def unusable(**refuse: int) -> str:
    """Return the problem of an SPI node. The kernel refuses requests of one number with EINVAL, from one mode."""

    def ioctl(_fd: int, request: int, argument: bytes) -> None:
        if request == refuse["request"] and argument[0] >= refuse.get("least", 0):
            raise OSError(errno.EINVAL, "Invalid argument")

    link = SpiLink(SpiOptions(port="/dev/spidev0.0"), ioctl=ioctl, open_node=lambda *_: 0, close_node=lambda _: None)
    try:
        link.open()
        link.select(3)
    except LinkError as error:
        return str(error)
    raise AssertionError("it was not refused")


def test_mode_and_word_size_by_what_was_read(machine: Machine) -> None:
    for problem, words in [
        # 00 00 'IMU614': 0000 494D 5536 3134; one bit early: 0000 929A AA6C 6268; late: 0000 24A6 AA9B 189A
        (refused("0000929aaa6c6268"), "→ SPI mode: the reply is shifted by one bit"),
        (refused("000024a6aa9b189a"), "→ SPI mode"),
        (refused("800024a6aa9b189a"), "→ SPI mode"),
        (refused("00004d4936553431"), "→ word size: the two bytes of each word are swapped"),
        (refused("0000494d55363130"), "→ if all bytes are 00"),
        (refused("0000000000000000"), "→ if all bytes are 00"),
        (f"{refused('ffffffffffffffff')}; {refused('00004d4936553431')}", "→ word size"),
        (unusable(request=WR_BITS_PER_WORD), "→ the controller refuses words of 16 and 8 bits"),
        (unusable(request=WR_BITS_PER_WORD).replace("Invalid argument", "Permission denied"), "→ if all bytes are 00"),
        (unusable(request=WR_MODE, least=3), "→ the controller does not support this mode"),
    ]:
        machine.configure(MAST)
        machine.status = [msgspec.structs.replace(polled("mast", DeviceState.SEARCHING), problem=problem)]
        ((severity, text),) = machine.told(SPI)
        assert (severity, words in text) == ("error", True), text


UP, STATE, RATE = DoctorCheck("u", can_up), DoctorCheck("s", can_state), DoctorCheck("r", can_bitrate)

RECORDED: dict[str, Any] = json.loads((ROOT / "tests/cli/doctor/ip_link_can0.json").read_text())
COMMAND = "ip -json -details -statistics link show can0"


@pytest.fixture
def mast(machine: Machine) -> Machine:
    machine.configure("mast: {driver: hipnuc-canopen, socketcan: {interface: can0}}")
    return machine


def interface(machine: Machine, *, packets: int = 0, data: dict[str, Any] | None = None) -> None:
    """Set the recorded reply of `ip` with changed members. Without `data`, the interface is virtual."""
    up(machine)
    answer = deepcopy(RECORDED["error-active"])
    (link,) = answer
    link["stats64"]["rx"]["packets"] = packets
    if data is None:
        link["linkinfo"] = {"info_kind": "vcan"}
    else:
        link["linkinfo"]["info_xstats"]["bus_off"] = data.get("bus_off", 0)
        link["linkinfo"]["info_data"].update(data)
    machine.prints(COMMAND, json.dumps(answer))


def up(machine: Machine, flags: str = "0x40081") -> None:
    machine.write("/sys/class/net/can0/type", "280\n")
    machine.write("/sys/class/net/can0/flags", flags + "\n")


def controller(state: str = "ERROR-ACTIVE", tx: int = 0, rx: int = 0, **more: object) -> dict[str, object]:
    fixed = {"berr_counter": {"tx": tx, "rx": rx}, "restart_ms": 100, "bittiming": {"bitrate": 500_000}}
    return {"state": state, **fixed, **more}


def test_an_interface_that_is_absent_down_up_or_virtual(mast: Machine) -> None:
    assert mast.told(UP)[0][1].startswith("can0 does not exist; CAN interfaces of this host: none →")
    mast.write("/sys/class/net/can1/type", "280\n")
    mast.write("/sys/class/net/can1/flags", "0x40080\n")
    assert mast.told(UP)[0][1].startswith("can0 does not exist; CAN interfaces of this host: can1 →")
    up(mast, "0x40080")
    mast.prints(COMMAND, json.dumps(RECORDED["down"]))
    mast.tells(UP, "error", "can0 is down", "up type can bitrate")
    assert mast.find(STATE) == []  # the state of an interface that is down is unknown
    interface(mast)
    assert mast.find(UP)[0].severity == "ok"
    assert mast.told(STATE) == [("ok", "can0 is a virtual interface without a controller → ")]
    assert mast.find(RATE) == []


def test_state_and_error_counters(mast: Machine) -> None:
    """The kernel also counts frames from before a change of the bit rate, or from before the device was unplugged."""
    for data, packets, severity, words in [
        (controller(), 100, "ok", "100 frames received"),
        (controller("BUS-OFF", 248, 0), 100, "error", "left the bus"),
        (controller("ERROR-PASSIVE", 128, 0), 0, "error", "no other node acknowledges"),
        (controller("ERROR-WARNING", 0, 100), 0, "error", "a terminator is missing, or the bit rate is wrong"),
        (controller("ERROR-PASSIVE", 0, 130), 100, "warning", "60 Ω"),
        (controller("ERROR-ACTIVE", 0, 96), 100, "warning", "60 Ω"),
        (controller("ERROR-ACTIVE", 0, 3), 100, "ok", "rx 3"),
    ]:
        interface(mast, packets=packets, data=data)
        mast.on_pause = partial(interface, mast, packets=packets + 20, data=data)
        mast.tells(STATE, severity, words)
    mast.on_pause, mast.paused_s = Mock(), 0.0
    interface(mast, packets=100, data=controller("ERROR-PASSIVE", 128, 0))
    mast.tells(STATE, "error", "100 frames received, no frame arrives now → no other node acknowledges")
    assert mast.paused_s == 2.0
    mast.status = [device("mast", state=DeviceState.RUNNING)]  # a device that sends only after a request
    assert mast.find(STATE)[0].severity == "warning"


def test_recorded_states_and_bus_off_before(mast: Machine) -> None:
    for state, severities, words in [
        ("error-active", ["ok", "note"], "can0 is ERROR-ACTIVE, error counters tx 0, rx 0, 2 frames received → "),
        ("bus-off", ["error", "note"],
         "the controller left the bus → restart it: `sudo ip link set can0 down`, then `sudo ip"),
        ("error-passive", ["error", "warning", "note"],
         "2 frames received, no frame arrives now → no other node acknowledges"),
    ]:  # fmt: skip
        up(mast)
        mast.prints(COMMAND, json.dumps(RECORDED[state]))
        found = mast.told(STATE)
        assert [severity for severity, _ in found] == severities, state
        assert words in found[0][1]
        assert mast.told(RATE) == [("ok", "can0 has 500000 bit/s, 2 frames received → ")]
    interface(mast, packets=9, data=controller(bus_off=4, restart_ms=0))
    found = mast.told(STATE)
    assert [severity for severity, _ in found] == ["ok", "warning", "note"]
    assert "bus-off 4 times" in found[1][1]
    interface(mast, data=controller("BUS-OFF", restart_ms=0))
    commands = "`sudo ip link set can0 down`, then `sudo ip link set can0 up type can restart-ms 100`"
    assert f"restart it: {commands}; check" in mast.told(STATE)[0][1]
    assert mast.told(STATE)[-1][1].endswith(commands)


def test_documents_set_restart_ms_while_the_interface_is_down() -> None:
    """Otherwise the kernel refuses restart-ms with EBUSY (drivers/net/can/dev/netlink.c)."""
    for file in ("docs/can.md", "docs/monitoring.md", "etc/prometheus/imud.rules.yml"):
        commands = re.findall(r"^.*?type can .*?restart-ms", (ROOT / file).read_text(), re.MULTILINE)
        assert commands, file
        for command in commands:
            pattern = r"\bdown\b.* up type|pre-up ip|^(sudo )?ip link set can0 type can bitrate"
            assert re.search(pattern, command), command


def test_bit_rates(mast: Machine) -> None:
    for bitrate, packets, state, severity in [
        (500_000, 0, DeviceState.SEARCHING, "error"), (500_000, 9, DeviceState.SEARCHING, "error"),
        (500_000, 9, DeviceState.SILENT, "error"), (500_000, 0, DeviceState.RUNNING, "ok"),
        (100_000, 9, DeviceState.RUNNING, "warning"),
    ]:  # fmt: skip
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
    mast.prints(COMMAND, "", 1, "Device does not exist")
    (examined,) = examine([STATE], mast.surroundings())
    assert "ip link show can0: Device does not exist" in examined.findings[0].seen
    mast.prints("ip", "", 1, "Device does not exist")
    mast.outputs[COMMAND] = FileNotFoundError(2, "No such file", "ip")
    (examined,) = examine([STATE], mast.surroundings())
    assert examined.findings[0].seen == "s: ip does not exist or is not installed"


def test_interfaces_of_other_backends_are_not_the_kernels(machine: Machine) -> None:
    machine.configure("a: {driver: hipnuc-canopen, socketcan: {interface: x, backend: virtual}}")
    assert interfaces(machine.surroundings()) == []
