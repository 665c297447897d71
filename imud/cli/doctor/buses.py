"""Checks of I2C and SPI: the node, transfers that fail, the address, clock stretching, SPI mode and word size."""

import json
import re
from collections.abc import Iterator
from typing import Any, Final

from imud.cli.doctor.surroundings import DoctorFinding, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.config.model import DeviceConfig
from imud.contracts.status import DeviceState, DeviceStatus
from imud.drivers.imu61x.common import PRODUCTS, product_id_of
from imud.links.netlink import absence, can_interfaces
from imud.links.socketcan import NATIVE

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


BITRATES: Final = (125_000, 250_000, 500_000, 1_000_000)
"""Bit rates that modules of both families can be set to, bit/s."""
COUNTER_LIMIT: Final = 96
"""Error counter of a controller in the state warning (ISO 11898-1)."""
NO_ACKNOWLEDGEMENT: Final = 128
"""Where the transmit error counter stays when no other node acknowledges: then error-passive, never bus-off."""
LISTEN_S: Final = 2.0
"""A module sends once a second at its slowest: a bus without a frame for so long is silent."""
ABSENT: Final = (DeviceState.SEARCHING, DeviceState.SILENT)
BUS_ADVICE: Final = (
    "120 Ω at both ends (60 Ω between CAN_H and CAN_L without power)? CAN_H and CAN_L swapped? "
    "All nodes the same bit rate?"
)


def interfaces(at: Surroundings) -> list[str]:
    """Return the configured interfaces of the kernel, each once."""
    names = (
        device.link_settings.interface  # type: ignore[attr-defined]  # of socketcan, by `devices`
        for device in at.devices("socketcan")
        if getattr(device.link_settings, "backend", NATIVE) == NATIVE
    )
    return list(dict.fromkeys(names))


def can_up(at: Surroundings) -> Findings:
    """Look whether each configured interface exists and is up."""
    there = ", ".join(can_interfaces(at.at("/sys"), down=True)) or "none"
    for name in interfaces(at):
        if not (problem := absence(name, at.at("/sys"))):
            yield ok(f"{name} is up")
        elif at.at(f"/sys/class/net/{name}").exists():
            yield error(
                problem,
                f"`sudo ip link set {name} up type can bitrate 500000 restart-ms 100`; for every boot: docs/can.md",
            )
        else:
            yield error(
                f"{name} is not there; CAN interfaces of this machine: {there}",
                "is the adapter plugged in, its overlay enabled (dtoverlay=mcp2515-can0,…), its module loaded? "
                "`sudo dmesg | grep -i can`",
            )


def can_state(at: Surroundings) -> Findings:
    """Judge the state of each controller, and its error counters against its traffic."""
    for name in _up(at):
        data, frames = _details(at, name)
        if not data:
            yield ok(f"{name} is virtual: it has no controller")
            continue
        state = str(data.get("state", "unknown"))
        counters = data.get("berr_counter", {})
        tx, rx = int(counters.get("tx", 0)), int(counters.get("rx", 0))
        seen = f"{name} is {state}, error counters tx {tx}, rx {rx}, {frames} frames received"
        if state == "BUS-OFF":
            restart = "" if data.get("restart_ms") else f"{_restarting(name)} let it recover; "
            yield error(f"{seen}: it has left the bus", restart + BUS_ADVICE)
        elif (tx or rx) and not _runs(at, name) and _silent(at, name, frames):
            yield error(f"{seen}, none now", _without_traffic(tx, rx))
        elif state in ("ERROR-PASSIVE", "ERROR-WARNING") or max(tx, rx) >= COUNTER_LIMIT:
            yield warning(seen, BUS_ADVICE)
        else:
            yield ok(seen)
        offs = int(data.get("bus_off", 0))
        if offs and state != "BUS-OFF":
            yield warning(f"{name} was bus-off {offs} times", BUS_ADVICE)
        if not data.get("restart_ms"):
            yield note(f"{name} does not return from bus-off by itself", _restarting(name))


def _restarting(name: str) -> str:
    """The commands after which a controller returns from bus-off. The kernel refuses the second one while it is up."""
    return f"`sudo ip link set {name} down`, then `sudo ip link set {name} up type can restart-ms 100`"


def _without_traffic(tx: int, rx: int) -> str:
    """What errors without a single frame mean."""
    if tx >= NO_ACKNOWLEDGEMENT > rx:
        return f"no other node acknowledges: is the module powered and wired? {BUS_ADVICE}"
    return f"a missing terminator or a wrong bit rate. {BUS_ADVICE}"


def can_bitrate(at: Surroundings) -> Findings:
    """Judge the bit rate of each interface by what the modules can have and by what is heard."""
    for name in _up(at):
        data, frames = _details(at, name)
        bitrate = int(data.get("bittiming", {}).get("bitrate", 0))
        if not bitrate:
            continue
        down = [one.name for one in _devices(at, name) if one.state in ABSENT]
        change = f"`sudo ip link set {name} down`, then `sudo ip link set {name} up type can bitrate RATE`"
        if bitrate not in BITRATES:
            yield warning(
                f"{name} has {bitrate} bit/s, which no supported module has",
                f"one of {', '.join(map(str, BITRATES))}: {change}",
            )
        elif down and not _runs(at, name) and _silent(at, name, frames):
            others = ", ".join(str(rate) for rate in BITRATES if rate != bitrate)
            yield error(
                f"{', '.join(down)}: no frame comes at {bitrate} bit/s on {name}",
                f"try {others}: {change}; else power and wiring of the module",
            )
        else:
            yield ok(f"{name} has {bitrate} bit/s" + (f", {frames} frames received" if frames else ""))


def _devices(at: Surroundings, name: str) -> list[DeviceStatus]:
    """Status of the configured devices on an interface, as far as the daemon has it."""
    found = (
        at.status_of(one.name) for one in at.devices("socketcan") if getattr(one.link_settings, "interface", "") == name
    )
    return [status for status in found if status is not None]


def _runs(at: Surroundings, name: str) -> bool:
    return any(one.state is DeviceState.RUNNING for one in _devices(at, name))


def _silent(at: Surroundings, name: str, frames: int) -> bool:
    """Whether no frame comes within LISTEN_S. Those before, `frames`, may be from before the bit rate was changed."""
    if frames:
        at.pause(LISTEN_S)
    return not frames or _details(at, name)[1] == frames


def _up(at: Surroundings) -> list[str]:
    return [name for name in interfaces(at) if not absence(name, at.at("/sys"))]


def _details(at: Surroundings, name: str) -> tuple[dict[str, Any], int]:
    """What the driver reports, its counts of states among it, and the frames received; empty for a virtual interface.

    Raises OSError, ValueError.
    """
    output = at.run(["ip", "-json", "-details", "-statistics", "link", "show", name])
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
