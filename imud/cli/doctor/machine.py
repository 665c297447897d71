"""Checks of the machine: its clock, storage, processor, and the power supply of a Raspberry Pi."""

import re
from pathlib import Path
from typing import Final, NamedTuple

from imud.cli.doctor.surroundings import DoctorFinding, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.contracts.status import DeviceStatus
from imud.model.units import NS_PER_MS

CLOCK_ERROR_NS: Final = 100 * NS_PER_MS
"""One-sigma error of a clock that is kept by NTP over the Internet, at its worst."""
SYNC_SLOW_S: Final = 0.2
SYNC_BAD_S: Final = 1.0
"""A good SD card takes some 10 ms for a synchronised block, a worn one up to seconds."""
SYNCS: Final = 3
LOAD_PER_CPU: Final = 1.5
PRESSURE_PERCENT: Final = 20.0
"""Share of a minute in which something waited for a processor (/proc/pressure/cpu)."""
LOST_SHARE: Final = 1e-4
LATE_SHARE: Final = 0.05

THROTTLED: Final = "/sys/devices/platform/soc/soc:firmware/get_throttled"
"""Raspberry Pi OS up to the Pi 4; elsewhere vcgencmd is asked."""
UNDER_VOLTAGE, CAPPED, SLOWED, HOT = 0x1, 0x2, 0x4, 0x8
SINCE_BOOT: Final = 16
"""Bits of the firmware's word: what is so now; the same shifted by SINCE_BOOT for what has been since boot."""
SUPPLY: Final = (
    "use the official supply (5.1 V) and a short, thick cable; move USB devices to a hub with its own supply"
)
COOLING: Final = "cool it: a heat sink, a fan, a larger case; less load"


def host_clock(at: Surroundings) -> Findings:
    """Look whether a daemon keeps the clock of this machine."""
    clock = at.kernel_clock()
    if not clock.synchronised:
        yield warning(
            "the clock of this machine is not synchronised (adjtimex): `utc_ns` of samples may be wrong, "
            "`t_ns` is not concerned",
            "`timedatectl`, `chronyc tracking`: install and start chrony, and look at its servers",
        )
    elif clock.error_ns > CLOCK_ERROR_NS:
        yield note(
            f"the clock of this machine may be wrong by {clock.error_ns / NS_PER_MS:.0f} ms",
            "normal for some minutes after boot; chrony reports a smaller bound than systemd-timesyncd",
        )
    else:
        yield ok(f"the clock of this machine is synchronised, error {clock.error_ns / NS_PER_MS:.1f} ms")


def storage(at: Surroundings) -> Findings:
    """Measure the time that a small file takes to reach the medium of the state directory."""
    folder = at.config.state_dir if at.config is not None else "/var/lib/imud"
    place = at.at(folder)
    if not place.is_dir():
        yield not_checked(
            f"{folder} is not there yet, so its medium was not measured", "the service makes it at its start"
        )
        return
    try:
        worst_s = max(at.sync_s(place) for _ in range(SYNCS))
    except PermissionError:
        yield not_checked(
            f"{folder} may not be written by this user, so its medium was not measured", "run `sudo imud doctor`"
        )
        return
    medium = _medium(at, Path(folder))
    seen = f"writing 4 KiB to {folder} ({medium}) took {worst_s * 1000:.0f} ms at worst of {SYNCS}"
    advice = "a worn or slow SD card? `sudo dmesg | grep mmc`; a card of class A1, or an SSD; logs in memory"
    if worst_s >= SYNC_BAD_S:
        yield error(seen, advice)
    elif worst_s >= SYNC_SLOW_S:
        yield warning(seen, advice)
    else:
        yield ok(seen)


def _medium(at: Surroundings, folder: Path) -> str:
    """Return the block device or file system that a folder is on, by /proc/mounts."""
    mounts = [line.split() for line in (at.text("/proc/mounts") or "").splitlines()]
    fitting = [mount for mount in mounts if len(mount) > 2 and folder.is_relative_to(mount[1])]
    return max(fitting, key=lambda mount: len(mount[1]))[0] if fitting else "medium not known"


def power(at: Surroundings) -> Findings:
    """Read what the firmware of a Raspberry Pi says of voltage and temperature."""
    model = at.text("/proc/device-tree/model") or at.text("/sys/firmware/devicetree/base/model") or ""
    if "Raspberry Pi" not in model:
        return
    word = _throttled(at)
    if word is None:
        yield not_checked(
            "the firmware's word on voltage and throttling cannot be read",
            "`sudo vcgencmd get_throttled` (package raspi-utils or libraspberrypi-bin)",
        )
        return
    now, before = word & 0xF, word >> SINCE_BOOT & 0xF & ~word
    if now & UNDER_VOLTAGE:
        yield error("the supply voltage is too low now (below 4.63 V)", SUPPLY)
    if before & UNDER_VOLTAGE:
        yield warning("the supply voltage was too low since boot (below 4.63 V)", SUPPLY)
    if now & (CAPPED | SLOWED | HOT):
        yield warning("the processor is slowed down now, by heat or low voltage", COOLING)
    elif before & (CAPPED | SLOWED | HOT):
        yield note("the processor was slowed down since boot, by heat or low voltage", COOLING)
    if not word & 0xF000F:
        yield ok("voltage and temperature were good since boot")


def _throttled(at: Surroundings) -> int | None:
    """Return the firmware's word, from sysfs or from vcgencmd; None where neither has it."""
    texts = [text] if (text := at.text(THROTTLED)) else []
    if not texts:
        try:
            output = at.run(["vcgencmd", "get_throttled"])
        except OSError:
            return None
        texts = [output.text.partition("=")[2]] if output.status == 0 else []
    try:
        return int(texts[0], 16) if texts else None
    except ValueError:
        return None


def processor(at: Surroundings) -> Findings:
    """Judge the load of the processors, and what the daemon lost or did late by it."""
    cpus = max(len(list(at.at("/sys/devices/system/cpu").glob("cpu[0-9]*"))), 1)
    load = at.text("/proc/loadavg")
    if load is None:
        yield not_checked("/proc/loadavg cannot be read")
    else:
        minutes = float(load.split()[1])
        waited = _pressure(at.text("/proc/pressure/cpu") or "")
        seen = f"load of {minutes:.1f} over 5 minutes on {cpus} processors"
        seen += f", {waited:.0f} % of a minute spent waiting for one" if waited is not None else ""
        if minutes > LOAD_PER_CPU * cpus or (waited or 0.0) > PRESSURE_PERCENT:
            yield warning(seen, "`top`; nice other programs, lower rates or allow a latency; docs/latency.md")
        else:
            yield ok(seen)
    for one in at.status or ():
        yield from _late(one)


def _pressure(text: str) -> float | None:
    words = text.split()
    found = next((word for word in words if word.startswith("avg60=")), "")
    return float(found.partition("=")[2]) if found and words[0] == "some" else None


def _late(one: DeviceStatus) -> list[DoctorFinding]:
    """Samples that the daemon's queues gave up, and reads that were late."""
    samples, lost = one.ledger["samples"], one.ledger["lost_queue"]
    if lost > LOST_SHARE * max(samples, 1):
        return [
            warning(
                f"{one.name}: {lost} samples lost because this machine or its bus was busy",
                "too little CPU, or more devices on the bus than it can serve: a lower `rate_hz`",
            )
        ]
    polls = one.polling
    if polls is not None and polls.late > LATE_SHARE * max(polls.polls, 1):
        return [
            warning(
                f"{one.name}: {polls.late} of {polls.polls} reads were late, {polls.late_worst_ns / NS_PER_MS:.1f} ms "
                "at worst",
                "too little CPU, or a bus that is too slow: a lower `rate_hz`, a faster bus clock",
            )
        ]
    return []


LINES: Final = "5000"
"""Newest lines of the log that are looked at."""
COMMANDS: Final = (
    ("journalctl", "--dmesg", "--boot", "--quiet", "--no-pager", "--output=cat", f"--lines={LINES}"),
    ("dmesg", "--notime"),
    ("dmesg",),
)
"""Tried in this order; the journal is readable for the groups adm and systemd-journal."""
SHOWN_CHARACTERS: Final = 120


class Pattern(NamedTuple):
    """Lines of one kind of trouble."""

    title: str
    expression: re.Pattern[str]
    advice: str
    least: int = 1
    """So many lines are a fault; fewer may be a cable that was unplugged by hand."""


USB_ADVICE: Final = "a shorter cable without extension, another port, a hub with its own supply"
PATTERNS: Final = (
    Pattern("resets of USB devices",
            re.compile(r"usb .*: reset (low|full|high|super)[- ]?speed|cannot reset port|hub_ext_port_status failed"
                       r"|hub .*: (USB hub found.*reset|config failed)", re.IGNORECASE), USB_ADVICE),
    Pattern("too much current on USB", re.compile(r"over-?current", re.IGNORECASE),
            "a device takes more than the port gives: a hub with its own supply"),
    Pattern("errors of USB transfers",
            re.compile(r"usb .*(device descriptor read|device not (accepting|responding)|unable to enumerate)"
                       r"|urb .* failed|disabled by hub \(EMI", re.IGNORECASE), USB_ADVICE),
    Pattern("unplugged serial adapters",
            re.compile(r"now disconnected from (ttyUSB|ttyACM)|USB ACM device.*disconnect", re.IGNORECASE),
            "loose plug, or the supply of the port breaks down: " + USB_ADVICE, 3),
    Pattern("low voltage", re.compile(r"under-?voltage detected", re.IGNORECASE),
            "a stronger supply and a thicker cable: this also resets modules and adapters"),
    Pattern("trouble of the SD card",
            re.compile(r"mmc\d.*(error|timeout|timed out|stuck)|mmcblk\d.*(I/O error|error -\d)|I/O error.*mmcblk"
                       r"|EXT4-fs error", re.IGNORECASE), "replace the card; copy its content first"),
    Pattern("trouble of I2C",
            re.compile(r"i2c.*(timed? ?out|arbitration lost|bus busy|SDA stuck|recover)", re.IGNORECASE),
            "a line held low, no pull-ups, or clock stretching: docs/buses.md"),
    Pattern("trouble of CAN controllers",
            re.compile(r"\bcan\d+: (bus-off|entered bus|.*controller.*not respond|.*failed to)", re.IGNORECASE),
            "terminators, bit rate, wiring: docs/can.md"),
    Pattern("overruns of serial ports", re.compile(r"tty\w*\d+: .*(overrun|input overrun)", re.IGNORECASE),
            "less load on this machine, a lower rate, an adapter with a larger buffer"),
    Pattern("lack of memory", re.compile(r"out of memory: killed process|oom-kill", re.IGNORECASE),
            "fewer programs or more memory; `journalctl --dmesg | grep -i oom`"),
)  # fmt: skip


def kernel_log(at: Surroundings) -> Findings:
    """Count lines of the kernel's log that explain failures of ports and buses."""
    lines, why = _lines(at)
    if lines is None:
        yield not_checked(f"the kernel's log cannot be read: {why}", "run `sudo imud doctor`, or join the group adm")
        return
    clean = True
    for pattern in PATTERNS:
        found = [line for line in lines if pattern.expression.search(line)]
        if len(found) >= pattern.least:
            clean = False
            yield warning(
                f"kernel log: {len(found)} lines on {pattern.title}, the last: {found[-1].strip()[:SHOWN_CHARACTERS]}",
                pattern.advice,
            )
    if clean:
        yield ok(f"nothing on ports, buses, storage or voltage in {len(lines)} lines of the kernel's log")


def _lines(at: Surroundings) -> tuple[list[str] | None, str]:
    """The newest lines of the log; None and the reason where no command gives any."""
    why = ""
    for command in COMMANDS:
        try:
            output = at.run(command)
        except OSError as error:
            why = why or f"{command[0]}: {error.strerror or error}"
            continue
        lines = output.text.splitlines()
        if output.status == 0 and lines:
            return lines[-int(LINES) :], ""
        why = output.complaint or why or f"{command[0]} shows no line"
    return None, why
