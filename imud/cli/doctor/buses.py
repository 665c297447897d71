"""Checks of I2C, SPI and CAN: device nodes, failed transfers, addresses, SPI modes, CAN states, bit rates."""

import json
import re
from collections.abc import Iterator
from typing import Any, Final

from imud.cli.doctor.surroundings import DoctorFinding, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.config.model import DeviceConfig
from imud.contracts.status import DeviceState, DeviceStatus
from imud.drivers.imu61x.common import PRODUCTS, product_id_of
from imud.host.netlink import absence, can_interfaces
from imud.links.socketcan import NATIVE

FAILED_SHARE: Final = 0.001
STALE_SHARE: Final = 0.5
BROADCOM: Final = "bcm2835"  # name part of a Raspberry Pi 1 to 4 I2C controller, which has a defect in clock stretching
# Pattern of the eight bytes that the daemon read instead of a product id, in the problem of a device
READ_ID: Final = re.compile(r"PROD_ID: .* got ((?:[0-9a-f]{2} ){7}[0-9a-f]{2})")
WORD_BITS: Final = 16
STRETCHING: Final = (
    "this I2C controller has a defect in clock stretching: use a lower bus clock (dtparam=i2c_arm_baudrate=50000) or a "
    "software bus (dtoverlay=i2c-gpio)"
)


def bus_nodes(at: Surroundings) -> Findings:
    """Check that each configured I2C and SPI node exists."""
    for path, enable in _nodes(at):
        if at.at(path).exists():
            yield ok(f"{path} exists")
            continue
        folder, begin = ("/dev", "i2c-" if "i2c" in path else "spidev")
        there = ", ".join(sorted(f"/dev/{node.name}" for node in at.at(folder).glob(f"{begin}*"))) or "none"
        yield error(f"{path} does not exist; existing nodes of this kind: {there}", enable)


def _nodes(at: Surroundings) -> list[tuple[str, str]]:
    """Return the path of each configured node, and the advice to enable it."""
    found = {
        f"/dev/i2c-{getattr(one.link_settings, 'bus', 1)}": "enable the bus: on a Raspberry Pi dtparam=i2c_arm=on in "
        "/boot/firmware/config.txt; elsewhere `sudo modprobe i2c-dev`"
        for one in at.devices("i2c")
    }
    found |= {
        str(getattr(one.link_settings, "port", "")): "enable the bus: on a Raspberry Pi dtparam=spi=on in "
        "/boot/firmware/config.txt, then restart the host"
        for one in at.devices("spi")
    }
    return list(found.items())


def i2c_transfers(at: Surroundings) -> Findings:
    """Check the transfers of each I2C device."""
    for device in at.devices("i2c"):
        bus = getattr(device.link_settings, "bus", 1)
        controller = at.text(f"/sys/class/i2c-adapter/i2c-{bus}/name") or at.text(
            f"/sys/bus/i2c/devices/i2c-{bus}/name"
        )
        stretching = STRETCHING if BROADCOM in (controller or "") else ""
        address = getattr(device.link_settings, "address", "auto")
        where = "any address" if address == "auto" else f"address {address:#04x}"
        absent = (
            f"`sudo i2cdetect -y {bus}` should show 18. If no device replies at {where}: check the power, SDA and SCL "
            "(swapped?), the pull-ups to 3.3 V, and whether two devices have the same address"
        )
        yield from _judge(
            at, device, absent, stretching or "use shorter wires, pull-ups of 2 to 5 kΩ, a lower bus clock"
        )


def spi_transfers(at: Surroundings) -> Findings:
    """Check the transfers of each SPI device."""
    for device in at.devices("spi"):
        mode = getattr(device.link_settings, "mode", "auto")
        speed_hz = getattr(device.link_settings, "speed_hz", 0)
        has = "mode 0 or 3" if mode == "auto" else f"the configured mode {mode} (try `mode: auto`)"
        one = at.status_of(device.name)
        wrong = _spi_cause(one.problem if one is not None else "", has)
        yield from _judge(at, device, wrong, f"use shorter wires, or a lower clock than {speed_hz} Hz (`speed_hz`)")


def _spi_cause(problem: str, has: str) -> str:
    """Return the advice for an SPI device without valid replies. `problem`: of the daemon; `has`: the SPI mode."""
    if "rejects SPI mode" in problem:
        return "the controller does not support this mode: set `mode: auto`, or use spi-gpio, which supports all modes"
    if problem.startswith("cannot use ") and "Invalid argument" in problem:
        return (
            "the controller refuses words of 16 and 8 bits, or the clock: set a lower `speed_hz`; otherwise use "
            "another controller, for example spi-gpio"
        )
    for found in READ_ID.finditer(problem.replace("; ", "\n")):
        read = bytes.fromhex(found[1])
        if any(read == _swapped(product) for product in _ids()):
            return (
                "word size: the two bytes of each word are swapped; the driver of the controller has a defect with "
                "words of 16 bits"
            )
        if any(_is_shifted(read, product) for product in _ids()):
            return f"SPI mode: the reply is shifted by one bit; imud uses {has}; otherwise set a lower `speed_hz`"
    return (
        "if all bytes are 00: check MISO and power; if all bytes are ff: check chip select; if the bits are shifted: "
        f"check mode and word size. imud uses {has} and needs words of 8 bits"
    )


def _ids() -> Iterator[bytes]:
    return (product_id_of(product) for product in PRODUCTS.values())


def _swapped(data: bytes) -> bytes:
    """Return the bytes with the two bytes of each word swapped."""
    return bytes(data[place ^ 1] for place in range(len(data)))


def _is_shifted(read: bytes, wanted: bytes) -> bool:
    """Return whether each word is the wanted word shifted by one bit. The added bit can have any value."""
    pairs = list(zip(_words(read), _words(wanted), strict=True))
    # shifted left: the highest bit is lost
    early = all(got >> 1 == want & (1 << WORD_BITS - 1) - 1 for got, want in pairs)
    # shifted right: the lowest bit is lost
    late = all(got & (1 << WORD_BITS - 1) - 1 == want >> 1 for got, want in pairs)
    return early or late


def _words(data: bytes) -> list[int]:
    return [int.from_bytes(data[place : place + 2], "big") for place in range(0, len(data), 2)]


def _judge(at: Surroundings, device: DeviceConfig, silent: str, failing: str) -> Findings:
    """Check one device. `silent`: advice if no sample arrives; `failing`: advice if some transfers fail."""
    if at.status is None:
        yield not_checked(
            f"{device.name}: transfers unknown, because the daemon does not reply",
            "start the daemon, then run `imud doctor` again",
        )
        return
    one = at.status_of(device.name)
    if one is None:
        yield not_checked(f"{device.name}: the daemon does not use this device", "`sudo systemctl reload imud`")
    elif one.state in (DeviceState.SEARCHING, DeviceState.SILENT, DeviceState.FAILED):
        yield error(f"{one.name}: no samples on {one.link}: {one.problem or 'no reply'}", silent)
    elif one.polling is not None and one.state is DeviceState.RUNNING:
        yield _transfers(one, failing)


def _transfers(one: DeviceStatus, failing: str) -> DoctorFinding:
    polls = one.polling
    if polls is None or not polls.polls:
        return not_checked(f"{one.name}: the daemon has not read the device yet", "run `imud doctor` again in a minute")
    if polls.vanished or polls.failed > FAILED_SHARE * polls.polls:
        return warning(
            f"{one.name}: {polls.failed} of {polls.polls} transfers failed, the device vanished {polls.vanished} times",
            failing,
        )
    if one.ledger["frames_bad_crc"] > FAILED_SHARE * polls.polls:
        return warning(f"{one.name}: {one.ledger['frames_bad_crc']} of {polls.polls} replies were damaged", failing)
    if polls.stale > STALE_SHARE * polls.polls:
        return note(
            f"{one.name}: {polls.stale} of {polls.polls} reads returned no new sample",
            "a lower `rate_hz` saves CPU time",
        )
    return ok(f"{one.name}: {polls.polls} transfers, {polls.failed} failed")


BITRATES: Final = (125_000, 250_000, 500_000, 1_000_000)  # bit rates that the devices of both families support, bit/s
COUNTER_LIMIT: Final = 96  # minimum error counter of a controller in the state ERROR-WARNING (ISO 11898-1)
# Transmit error counter without acknowledgement by another node. The controller stays error-passive, never bus-off.
NO_ACKNOWLEDGEMENT: Final = 128
LISTEN_S: Final = 2.0  # Time without a frame after which a bus is silent, s. The lowest rate of a device is 1 Hz.
ABSENT: Final = (DeviceState.SEARCHING, DeviceState.SILENT)
BUS_ADVICE: Final = (
    "check: 120 Ω at both ends (60 Ω between CAN_H and CAN_L without power), CAN_H and CAN_L not swapped, the same bit "
    "rate on all nodes"
)


def interfaces(at: Surroundings) -> list[str]:
    """Return the configured SocketCAN interfaces without duplicates."""
    names = (
        device.link_settings.interface  # type: ignore[attr-defined]  # all are options of socketcan
        for device in at.devices("socketcan")
        if getattr(device.link_settings, "backend", NATIVE) == NATIVE
    )
    return list(dict.fromkeys(names))


def can_up(at: Surroundings) -> Findings:
    """Check that each configured interface exists and is up."""
    there = ", ".join(can_interfaces(at.at("/sys"), down=True)) or "none"
    for name in interfaces(at):
        if not (problem := absence(name, at.at("/sys"))):
            yield ok(f"{name} is up")
        elif at.at(f"/sys/class/net/{name}").exists():
            yield error(
                problem,
                f"`sudo ip link set {name} up type can bitrate 500000 restart-ms 100`; at every boot: docs/can.md",
            )
        else:
            yield error(
                f"{name} does not exist; CAN interfaces of this host: {there}",
                "is the adapter plugged in, the overlay enabled (dtoverlay=mcp2515-can0,…), the kernel module loaded? "
                "`sudo dmesg | grep -i can`",
            )


def can_state(at: Surroundings) -> Findings:
    """Check the state and the error counters of each controller."""
    for name in _up(at):
        data, frames = _details(at, name)
        if not data:
            yield ok(f"{name} is a virtual interface without a controller")
            continue
        state = str(data.get("state", "unknown"))
        counters = data.get("berr_counter", {})
        tx, rx = int(counters.get("tx", 0)), int(counters.get("rx", 0))
        seen = f"{name} is {state}, error counters tx {tx}, rx {rx}, {frames} frames received"
        if state == "BUS-OFF":
            restart = "" if data.get("restart_ms") else f"restart it: {_restarting(name)}; "
            yield error(f"{seen}: the controller left the bus", restart + BUS_ADVICE)
        # errors without traffic show a wrong bit rate or wrong wires
        elif (tx or rx) and not _runs(at, name) and _silent(at, name, frames):
            yield error(f"{seen}, no frame arrives now", _without_traffic(tx, rx))
        elif state in ("ERROR-PASSIVE", "ERROR-WARNING") or max(tx, rx) >= COUNTER_LIMIT:
            yield warning(seen, BUS_ADVICE)
        else:
            yield ok(seen)
        offs = int(data.get("bus_off", 0))
        # the controller restarted, but the cause can still exist
        if offs and state != "BUS-OFF":
            yield warning(f"{name} was bus-off {offs} times", BUS_ADVICE)
        if not data.get("restart_ms"):
            yield note(f"{name} does not restart after bus-off", _restarting(name))


def _restarting(name: str) -> str:
    """Return the commands that make a controller restart after bus-off."""
    # the kernel refuses the second command while the interface is up
    return f"`sudo ip link set {name} down`, then `sudo ip link set {name} up type can restart-ms 100`"


def _without_traffic(tx: int, rx: int) -> str:
    """Return the advice for errors without received frames."""
    if tx >= NO_ACKNOWLEDGEMENT > rx:
        return f"no other node acknowledges: does the device have power, is it connected? {BUS_ADVICE}"
    return f"a terminator is missing, or the bit rate is wrong; {BUS_ADVICE}"


def can_bitrate(at: Surroundings) -> Findings:
    """Check the bit rate of each interface: is it supported by devices, do frames arrive?"""
    for name in _up(at):
        data, frames = _details(at, name)
        bitrate = int(data.get("bittiming", {}).get("bitrate", 0))
        # a virtual interface has no bit rate
        if not bitrate:
            continue
        down = [one.name for one in _devices(at, name) if one.state in ABSENT]
        change = f"`sudo ip link set {name} down`, then `sudo ip link set {name} up type can bitrate RATE`"
        if bitrate not in BITRATES:
            yield warning(
                f"{name} has {bitrate} bit/s, which no supported device uses",
                f"set one of {', '.join(map(str, BITRATES))}: {change}",
            )
        elif down and not _runs(at, name) and _silent(at, name, frames):
            others = ", ".join(str(rate) for rate in BITRATES if rate != bitrate)
            yield error(
                f"{', '.join(down)}: no frame arrives at {bitrate} bit/s on {name}",
                f"try {others}: {change}; otherwise check power and wiring of the device",
            )
        else:
            yield ok(f"{name} has {bitrate} bit/s" + (f", {frames} frames received" if frames else ""))


def _devices(at: Surroundings, name: str) -> list[DeviceStatus]:
    """Return the known status of the configured devices on an interface."""
    found = (
        at.status_of(one.name) for one in at.devices("socketcan") if getattr(one.link_settings, "interface", "") == name
    )
    return [status for status in found if status is not None]


def _runs(at: Surroundings, name: str) -> bool:
    return any(one.state is DeviceState.RUNNING for one in _devices(at, name))


def _silent(at: Surroundings, name: str, frames: int) -> bool:
    """Return whether no frame arrives within LISTEN_S. `frames`: the number of frames received so far."""
    if frames:  # they can be from before a change of the bit rate
        at.pause(LISTEN_S)
    return not frames or _details(at, name)[1] == frames


def _up(at: Surroundings) -> list[str]:
    return [name for name in interfaces(at) if not absence(name, at.at("/sys"))]


def _details(at: Surroundings, name: str) -> tuple[dict[str, Any], int]:
    """Return the report of the CAN driver (empty for a virtual interface) and the number of received frames.

    Raises OSError, ValueError.
    """
    output = at.run(["ip", "-json", "-details", "-statistics", "link", "show", name])
    # for example, the interface disappeared
    if output.status:
        raise OSError(f"ip link show {name}: {output.complaint}")
    found = json.loads(output.text)
    if not isinstance(found, list) or not found or not isinstance(found[0], dict):
        raise ValueError(f"ip link show {name}: expected a list with one interface, got {output.text[:80]!r}")
    info = found[0].get("linkinfo") or {}
    statistics: dict[str, Any] = found[0].get("stats64") or found[0].get("stats") or {}
    frames = int((statistics.get("rx") or {}).get("packets", 0))
    data = info.get("info_data") or {}
    known = bool(data.get("state") or data.get("bittiming"))
    return ({**(info.get("info_xstats") or {}), **data} if known else {}), frames
