"""Checks of I2C and SPI: nodes, transfers, likely causes."""

import errno

import msgspec
import pytest

from imud.cli.doctor.buses import bus_nodes, i2c_transfers, spi_transfers
from imud.cli.doctor.surroundings import DoctorCheck
from imud.contracts.status import DeviceState, DeviceStatus, PollingStatus
from imud.drivers.imu61x.registers import identity_of
from imud.links.spi import WR_BITS_PER_WORD, WR_MODE, SpiLink, SpiOptions
from imud.model.errors import DeviceRefused, LinkError
from tests.support.metrics import device
from tests.support.surroundings import Machine

NODES, I2C, SPI = DoctorCheck("n", bus_nodes), DoctorCheck("i", i2c_transfers), DoctorCheck("s", spi_transfers)
KEEL = "keel: {driver: imu61x-i2c, i2c: {bus: 3, address: 0x18}}"
MAST = "mast: {driver: imu61x-spi, spi: {port: /dev/spidev0.0, mode: 3}}"


def polled(name: str, state: DeviceState = DeviceState.RUNNING, counts: dict[str, int] | None = None) -> DeviceStatus:
    made = device(
        name, state=state, polling=PollingStatus(**(counts or {})), problem="" if state == "running" else "no answer"
    )
    return msgspec.structs.replace(made, ledger=dict.fromkeys(made.ledger, 0))


def test_nodes(machine: Machine) -> None:
    machine.configure(KEEL, MAST)
    machine.write("/dev/i2c-1")
    found = machine.told(NODES)
    assert [severity for severity, _ in found] == ["error", "error"]
    assert "/dev/i2c-3 does not exist; existing nodes of this kind: /dev/i2c-1" in found[0][1]
    assert "dtparam=spi=on" in found[1][1]
    machine.write("/dev/i2c-3")
    machine.write("/dev/spidev0.0")
    assert [finding.severity for finding in machine.find(NODES)] == ["ok", "ok"]


def test_transfers_need_the_daemon_and_the_device_in_it(machine: Machine) -> None:
    machine.configure(KEEL, MAST)
    assert [machine.find(check)[0].severity for check in (I2C, SPI)] == ["not checked", "not checked"]
    machine.status = []
    assert "does not use this device" in machine.told(I2C)[0][1]


def test_failed_transfers_damaged_answers_and_clock_stretching(machine: Machine) -> None:
    for counts, severity, words in [
        ({"polls": 10_000, "failed": 10}, "ok", "10 failed"),
        ({"polls": 10_000, "failed": 11}, "warning", "11 of 10000 transfers failed"),
        ({"polls": 10_000, "vanished": 1}, "warning", "vanished 1 times"),
        ({"polls": 10_000, "stale": 5000}, "ok", "0 failed"),
        ({"polls": 10_000, "stale": 5001}, "note", "returned no new sample"),
        ({}, "not checked", "has not read the device yet"),
    ]:
        machine.configure(KEEL)
        machine.status = [polled("keel", counts=counts)]
        machine.tells(I2C, severity, words)
    machine.configure(MAST)
    one = polled("mast", counts={"polls": 1000})
    machine.status = [msgspec.structs.replace(one, ledger=one.ledger | {"frames_bad_crc": 1})]
    machine.tells(SPI, "ok", "1000 transfers")
    machine.status = [msgspec.structs.replace(one, ledger=one.ledger | {"frames_bad_crc": 2})]
    assert (
        "2 of 1000 replies were damaged → use shorter wires, or a lower clock than 1000000 Hz"
        in machine.told(SPI)[0][1]
    )
    machine.configure(KEEL)
    machine.status = [polled("keel", counts={"polls": 100, "failed": 50})]
    assert "stretching" not in machine.told(I2C)[0][1]
    machine.write("/sys/class/i2c-adapter/i2c-3/name", "bcm2835 (i2c@7e804000)\n")
    assert "defect in clock stretching" in machine.told(I2C)[0][1]


def test_a_device_that_does_not_answer(machine: Machine) -> None:
    machine.configure(KEEL, MAST)
    machine.status = [polled("keel", DeviceState.SEARCHING), polled("mast", DeviceState.FAILED)]
    machine.tells(I2C, "error", "`sudo i2cdetect -y 3` should show 18. If no device replies at address 0x18")
    assert "words of 8 bits" in machine.told(SPI)[0][1]
    assert "mode 3 (try" in machine.told(SPI)[0][1]
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


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        # 00 00 'IMU614': 0000 494D 5536 3134; one bit early: 0000 929A AA6C 6268; late: 0000 24A6 AA9B 189A
        (refused("0000929aaa6c6268"), "→ SPI mode: the reply is shifted by one bit"),
        (refused("000024a6aa9b189a"), "→ SPI mode"),
        (refused("800024a6aa9b189a"), "→ SPI mode"),
        (refused("00004d4936553431"), "→ word size: the two bytes of each word are swapped"),
        (refused("0000494d55363130"), "→ if all bytes are 00"),
        (refused("0000000000000000"), "→ if all bytes are 00"),
        (f"{refused('ffffffffffffffff')}; {refused('00004d4936553431')}", "→ word size"),
        (unusable(request=WR_BITS_PER_WORD), "→ the controller refuses words of 16 and 8 bits"),
        (unusable(request=WR_MODE, least=3), "→ the controller does not support this mode"),
    ],
)
def test_mode_and_word_size_by_what_was_read(machine: Machine, problem: str, words: str) -> None:
    machine.configure(MAST)
    machine.status = [msgspec.structs.replace(polled("mast", DeviceState.SEARCHING), problem=problem)]
    machine.tells(SPI, "error", words)
