"""Checks of I2C and SPI: the node, transfers that fail, the address, clock stretching, SPI mode and word size."""

import re
from collections.abc import Iterator
from typing import Final

from imud.cli.doctor.finding import DoctorFinding, Findings, error, not_checked, note, ok, warning
from imud.cli.doctor.surroundings import Surroundings
from imud.config import DeviceConfig
from imud.contracts.status import DeviceState, DeviceStatus
from imud.devices.imu61x.common.family import PRODUCTS, product_id_of

FAILED_SHARE: Final = 0.001
STALE_SHARE: Final = 0.5
BROADCOM: Final = "bcm2835"
"""In the name of the I2C controller of Raspberry Pi 1 to 4, which handles clock stretching wrongly."""
READ_ID: Final = re.compile(r"PROD_ID: .* got ((?:[0-9a-f]{2} ){7}[0-9a-f]{2})")
"""In the problem of a device: the eight bytes that were read in place of a product id."""
WORD_BITS: Final = 16
STRETCHING: Final = (
    "this controller mishandles clock stretching: a lower bus clock (dtparam=i2c_arm_baudrate=50000), or the bus by "
    "software (dtoverlay=i2c-gpio)"
)


def bus_nodes(at: Surroundings) -> Findings:
    """Look whether each configured I2C and SPI node exists."""
    for path, enable in _nodes(at):
        if at.at(path).exists():
            yield ok(f"{path} is there")
            continue
        folder, begin = ("/dev", "i2c-" if "i2c" in path else "spidev")
        there = ", ".join(sorted(f"/dev/{node.name}" for node in at.at(folder).glob(f"{begin}*"))) or "none"
        yield error(f"{path} is not there; of its kind there are: {there}", enable)


def _nodes(at: Surroundings) -> list[tuple[str, str]]:
    """Path of each configured node, and how it is enabled."""
    found = {
        f"/dev/i2c-{getattr(one.link_settings, 'bus', 1)}": "enable the bus: on a Raspberry Pi dtparam=i2c_arm=on in "
        "/boot/firmware/config.txt; elsewhere `sudo modprobe i2c-dev`"
        for one in at.devices("i2c")
    }
    found |= {
        str(getattr(one.link_settings, "port", "")): "enable the bus: on a Raspberry Pi dtparam=spi=on in "
        "/boot/firmware/config.txt, then restart the machine"
        for one in at.devices("spi")
    }
    return list(found.items())


def i2c_transfers(at: Surroundings) -> Findings:
    """Judge transfers on I2C by device."""
    for device in at.devices("i2c"):
        bus = getattr(device.link_settings, "bus", 1)
        controller = at.text(f"/sys/class/i2c-adapter/i2c-{bus}/name") or at.text(
            f"/sys/bus/i2c/devices/i2c-{bus}/name"
        )
        stretching = STRETCHING if BROADCOM in (controller or "") else ""
        address = getattr(device.link_settings, "address", "auto")
        where = "every address" if address == "auto" else f"address {address:#04x}"
        absent = (
            f"`sudo i2cdetect -y {bus}` should show 18; no answer at {where}: SDA and SCL swapped, no pull-ups to "
            "3.3 V, no power, an address that another device on the bus has"
        )
        yield from _judge(at, device, absent, stretching or "shorter wires, pull-ups of 2 to 5 kΩ, a lower bus clock")


def spi_transfers(at: Surroundings) -> Findings:
    """Judge transfers on SPI by device."""
    for device in at.devices("spi"):
        mode = getattr(device.link_settings, "mode", "auto")
        speed_hz = getattr(device.link_settings, "speed_hz", 0)
        has = "mode 0 or 3" if mode == "auto" else f"mode {mode} by the configuration: try `mode: auto`"
        one = at.status_of(device.name)
        wrong = _spi_cause(one.problem if one is not None else "", has)
        yield from _judge(at, device, wrong, f"shorter wires, a slower clock than {speed_hz} Hz (`speed_hz`)")


def _spi_cause(problem: str, has: str) -> str:
    """What to do about a device on SPI that gives nothing usable, by the daemon's problem; `has`: its mode."""
    if "cannot do mode" in problem:
        return "this controller does not have the mode: `mode: auto`, or another controller (spi-gpio has all)"
    if "cannot be used: Invalid argument" in problem:
        return (
            "the controller refuses words of 16 and of 8 bits, or this clock: a lower `speed_hz`; else another "
            "controller (spi-gpio), imud needs words of 8 bits at least"
        )
    for found in READ_ID.finditer(problem.replace("; ", "\n")):
        read = bytes.fromhex(found[1])
        if any(read == _swapped(product) for product in _ids()):
            return (
                "word size: both bytes of each word are exchanged; the controller's driver has words of 16 bits wrong"
            )
        if any(_is_shifted(read, product) for product in _ids()):
            return f"SPI mode: the answer is shifted by one bit; imud has {has}; else a slower clock (`speed_hz`)"
    return (
        "all bytes 00: MISO or power; all ff: chip select. Answers that are shifted by bits: mode or word size; "
        f"imud needs words of 8 bits from the controller, and has {has}"
    )


def _ids() -> Iterator[bytes]:
    return (product_id_of(product) for product in PRODUCTS.values())


def _swapped(data: bytes) -> bytes:
    """The bytes with each pair exchanged."""
    return bytes(data[place ^ 1] for place in range(len(data)))


def _is_shifted(read: bytes, wanted: bytes) -> bool:
    """Whether each word is the wanted one, shifted by a bit to either side, whatever came in at its end."""
    pairs = list(zip(_words(read), _words(wanted), strict=True))
    early = all(got >> 1 == want & (1 << WORD_BITS - 1) - 1 for got, want in pairs)
    late = all(got & (1 << WORD_BITS - 1) - 1 == want >> 1 for got, want in pairs)
    return early or late


def _words(data: bytes) -> list[int]:
    return [int.from_bytes(data[place : place + 2], "big") for place in range(0, len(data), 2)]


def _judge(at: Surroundings, device: DeviceConfig, silent: str, failing: str) -> Findings:
    """Judge one device: advice where nothing usable comes, and where some transfers fail."""
    if at.status is None:
        yield not_checked(
            f"{device.name}: the daemon does not answer, so its transfers are not known",
            "start the daemon and look again",
        )
        return
    one = at.status_of(device.name)
    if one is None:
        yield not_checked(f"{device.name}: the daemon does not have this device", "`sudo systemctl reload imud`")
    elif one.state in (DeviceState.SEARCHING, DeviceState.SILENT, DeviceState.FAILED):
        yield error(f"{one.name}: no samples on {one.link}: {one.problem or 'no answer'}", silent)
    elif one.polling is not None and one.state is DeviceState.RUNNING:
        yield _transfers(one, failing)


def _transfers(one: DeviceStatus, failing: str) -> DoctorFinding:
    polls = one.polling
    if polls is None or not polls.polls:
        return not_checked(f"{one.name}: it was not read yet", "look again in a minute")
    if polls.vanished or polls.failed > FAILED_SHARE * polls.polls:
        return warning(
            f"{one.name}: {polls.failed} of {polls.polls} transfers failed, it vanished {polls.vanished} times", failing
        )
    if one.ledger["frames_bad_crc"] > FAILED_SHARE * polls.polls:
        return warning(f"{one.name}: {one.ledger['frames_bad_crc']} of {polls.polls} answers were damaged", failing)
    if polls.stale > STALE_SHARE * polls.polls:
        return note(f"{one.name}: {polls.stale} of {polls.polls} reads had nothing new", "a lower `rate_hz` saves CPU")
    return ok(f"{one.name}: {polls.polls} transfers, {polls.failed} failed")
