"""Checks of CAN interfaces: there, up, state of the controller, error counters, bit rate.

`ip -json -details -statistics link show NAME` has all of it: `linkinfo.info_data` is what the driver reports (state,
berr_counter, bittiming, restart_ms), `info_xstats` counts its changes of state.
"""

import json
from typing import Any, Final

from imud.cli.doctor.finding import Findings, error, note, ok, warning
from imud.cli.doctor.surroundings import Surroundings
from imud.contracts.status import DeviceState, DeviceStatus
from imud.links.can.link import NATIVE
from imud.links.can.netlink import absence, can_interfaces

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
