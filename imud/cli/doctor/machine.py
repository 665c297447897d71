"""Checks of the host: clock, storage, processor load, kernel log, and the power supply of a Raspberry Pi."""

import re
from pathlib import Path
from typing import Final, NamedTuple

from imud.cli.doctor.surroundings import DoctorFinding, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.contracts.status import DeviceStatus
from imud.model.errors import reason_of
from imud.model.units import NS_PER_MS

CLOCK_ERROR_NS: Final = 100 * NS_PER_MS  # maximum one-sigma error of a clock with NTP over the Internet, ns
SYNC_SLOW_S: Final = 0.2
# Time of a synchronised write that is an error, s. A good SD card needs some 10 ms, a worn card up to seconds.
SYNC_BAD_S: Final = 1.0
SYNCS: Final = 3
LOAD_PER_CPU: Final = 1.5
# Maximum share of a minute in which a task waited for a processor, percent (/proc/pressure/cpu)
PRESSURE_PERCENT: Final = 20.0
LOST_SHARE: Final = 1e-4
LATE_SHARE: Final = 0.05

# State of the firmware in Raspberry Pi OS up to the Pi 4. On other systems, imud calls vcgencmd.
THROTTLED: Final = "/sys/devices/platform/soc/soc:firmware/get_throttled"
UNDER_VOLTAGE, CAPPED, SLOWED, HOT = 0x1, 0x2, 0x4, 0x8
SINCE_BOOT: Final = 16  # Shift of the bits with the state since boot. The lower bits contain the current state.
SUPPLY: Final = (
    "use the official supply (5.1 V) and a short, thick cable; move USB devices to a hub with its own supply"
)
COOLING: Final = "add a heat sink, a fan or a larger case, or reduce the load"


def host_clock(at: Surroundings) -> Findings:
    """Check that a time service synchronises the clock of the host."""
    clock = at.kernel_clock()
    if not clock.synchronised:
        yield warning(
            "the clock of this host is not synchronised (adjtimex): `utc_ns` of samples can be wrong, `t_ns` is "
            "correct",
            "install and start chrony; check its servers with `timedatectl` and `chronyc tracking`",
        )
    elif clock.error_ns > CLOCK_ERROR_NS:
        yield note(
            f"the error of the host clock can be {clock.error_ns / NS_PER_MS:.0f} ms",
            "normal for some minutes after boot; chrony reports a smaller error than systemd-timesyncd",
        )
    else:
        yield ok(f"the clock of this host is synchronised, error {clock.error_ns / NS_PER_MS:.1f} ms")


def storage(at: Surroundings) -> Findings:
    """Measure the time of a synchronised write to the state directory."""
    folder = at.config.state_dir if at.config is not None else "/var/lib/imud"
    place = at.at(folder)
    if not place.exists():
        yield not_checked(
            f"{folder} does not exist yet, so imud did not measure the storage", "the service creates it at its start"
        )
        return
    try:
        # the longest time: a slow card is slow only sometimes
        worst_s = max(at.sync_s(place) for _ in range(SYNCS))
    except PermissionError:
        yield not_checked(
            f"this user cannot write to {folder}, so imud did not measure the storage", "run `sudo imud doctor`"
        )
        return
    except OSError as problem:
        yield error(
            f"cannot write to {folder}: {reason_of(problem)}", "set state_dir to a directory that imud can write"
        )
        return
    medium = _medium(at, Path(folder))
    seen = f"writing 4 KiB to {folder} ({medium}) took up to {worst_s * 1000:.0f} ms ({SYNCS} writes)"
    advice = "is the SD card worn (`sudo dmesg | grep mmc`)? Use a card of class A1 or an SSD; keep logs in memory"
    if worst_s >= SYNC_BAD_S:
        yield error(seen, advice)
    elif worst_s >= SYNC_SLOW_S:
        yield warning(seen, advice)
    else:
        yield ok(seen)


def _medium(at: Surroundings, folder: Path) -> str:
    """Return the block device or file system of a folder, from /proc/mounts."""
    mounts = [line.split() for line in (at.text("/proc/mounts") or "").splitlines()]
    fitting = [mount for mount in mounts if len(mount) > 2 and folder.is_relative_to(mount[1])]
    # the longest mount point is the file system of the folder
    return max(fitting, key=lambda mount: len(mount[1]))[0] if fitting else "unknown storage"


def power(at: Surroundings) -> Findings:
    """Check voltage and temperature as the firmware of a Raspberry Pi reports them."""
    model = at.text("/proc/device-tree/model") or at.text("/sys/firmware/devicetree/base/model") or ""
    if "Raspberry Pi" not in model:
        return
    word = _throttled(at)
    if word is None:
        yield not_checked(
            "imud cannot read the state of voltage and throttling from the firmware",
            "`sudo vcgencmd get_throttled` (package raspi-utils or libraspberrypi-bin)",
        )
        return
    # `before`: not at present, but at some time since boot
    now, before = word & 0xF, word >> SINCE_BOOT & 0xF & ~word
    if now & UNDER_VOLTAGE:
        yield error("the supply voltage is too low now (below 4.63 V)", SUPPLY)
    if before & UNDER_VOLTAGE:
        yield warning("the supply voltage was too low at some time since boot (below 4.63 V)", SUPPLY)
    if now & (CAPPED | SLOWED | HOT):
        yield warning("the firmware slows the processor down now, because of heat or low voltage", COOLING)
    elif before & (CAPPED | SLOWED | HOT):
        yield note(
            "the firmware slowed the processor down at some time since boot, because of heat or low voltage", COOLING
        )
    if not word & 0xF000F:
        yield ok("voltage and temperature were good since boot")


def _throttled(at: Surroundings) -> int | None:
    """Return the state bits of the firmware, from sysfs or vcgencmd; None if they are unknown."""
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
    """Check the load of the processors, and the dropped samples and late reads of each device."""
    cpus = max(len(list(at.at("/sys/devices/system/cpu").glob("cpu[0-9]*"))), 1)
    load = at.text("/proc/loadavg")
    if load is None:
        yield not_checked("cannot read /proc/loadavg")
    else:
        minutes = float(load.split()[1])
        waited = _pressure(at.text("/proc/pressure/cpu") or "")
        seen = f"load {minutes:.1f} over 5 minutes on {cpus} processors"
        seen += f", tasks waited for a processor in {waited:.0f} % of the last minute" if waited is not None else ""
        # kernels without CONFIG_PSI have no /proc/pressure
        if minutes > LOAD_PER_CPU * cpus or (waited or 0.0) > PRESSURE_PERCENT:
            yield warning(
                seen, "check with `top`; give other programs a nice value, reduce rates, or accept a latency "
                "(docs/latency.md)",
            )  # fmt: skip
        else:
            yield ok(seen)
    for one in at.status or ():
        yield from _late(one)


def _pressure(text: str) -> float | None:
    words = text.split()
    found = next((word for word in words if word.startswith("avg60=")), "")
    return float(found.partition("=")[2]) if found and words[0] == "some" else None


def _late(one: DeviceStatus) -> list[DoctorFinding]:
    """Return a finding for samples that full queues dropped, or for late reads."""
    samples, lost = one.ledger["samples"], one.ledger["lost_queue"]
    if lost > LOST_SHARE * max(samples, 1):
        return [
            warning(
                f"{one.name}: {lost} samples lost, because the host or the bus was busy",
                "the CPU is too slow, or the bus has too many devices: set a lower `rate_hz`",
            )
        ]
    polls = one.polling
    if polls is not None and polls.late > LATE_SHARE * max(polls.polls, 1):
        return [
            warning(
                f"{one.name}: {polls.late} of {polls.polls} reads were late, by up to "
                f"{polls.late_worst_ns / NS_PER_MS:.1f} ms",
                "the CPU or the bus is too slow: set a lower `rate_hz` or a faster bus clock",
            )
        ]
    return []


LINES: Final = "5000"  # number of the newest lines of the kernel log that imud reads
# Commands that read the kernel log, first choice first. The groups adm and systemd-journal can read the journal.
COMMANDS: Final = (
    ("journalctl", "--dmesg", "--boot", "--quiet", "--no-pager", "--output=cat", f"--lines={LINES}"),
    ("dmesg", "--notime"),
    ("dmesg",),
)
SHOWN_CHARACTERS: Final = 120


class Pattern(NamedTuple):
    """Pattern of log lines that show one kind of fault."""

    title: str
    expression: re.Pattern[str]
    advice: str
    least: int = 1  # Minimum number of lines for a warning. A user who unplugs a cable causes few lines.


USB_ADVICE: Final = "use a shorter cable without an extension, another port, or a hub with its own supply"
PATTERNS: Final = (
    Pattern("resets of USB devices",
            re.compile(r"usb .*: reset (low|full|high|super)[- ]?speed|cannot reset port|hub_ext_port_status failed"
                       r"|hub .*: (USB hub found.*reset|config failed)", re.IGNORECASE), USB_ADVICE),
    Pattern("too much current on USB", re.compile(r"over-?current", re.IGNORECASE),
            "a device needs more current than the port supplies: use a hub with its own supply"),
    Pattern("errors of USB transfers",
            re.compile(r"usb .*(device descriptor read|device not (accepting|responding)|unable to enumerate)"
                       r"|urb .* failed|disabled by hub \(EMI", re.IGNORECASE), USB_ADVICE),
    Pattern("disconnected serial adapters",
            re.compile(r"now disconnected from (ttyUSB|ttyACM)|USB ACM device.*disconnect", re.IGNORECASE),
            "is a plug loose, is the supply of the port too weak? " + USB_ADVICE, 3),
    Pattern("low voltage", re.compile(r"under-?voltage detected", re.IGNORECASE),
            "use a stronger supply and a thicker cable; low voltage also resets devices and adapters"),
    Pattern("errors of the SD card",
            re.compile(r"mmc\d.*(error|timeout|timed out|stuck)|mmcblk\d.*(I/O error|error -\d)|I/O error.*mmcblk"
                       r"|EXT4-fs error", re.IGNORECASE), "copy the content of the card, then replace the card"),
    Pattern("errors of I2C",
            re.compile(r"i2c.*(timed? ?out|arbitration lost|bus busy|SDA stuck|recover)", re.IGNORECASE),
            "a device holds SDA or SCL low, the pull-ups are missing, or clock stretching fails: docs/buses.md"),
    Pattern("errors of CAN controllers",
            re.compile(r"\bcan\d+: (bus-off|entered bus|.*controller.*not respond|.*failed to)", re.IGNORECASE),
            "check terminators, bit rate and wiring: docs/can.md"),
    Pattern("overruns of serial ports", re.compile(r"tty\w*\d+: .*(overrun|input overrun)", re.IGNORECASE),
            "reduce the load of this host or the rate, or use an adapter with a larger buffer"),
    Pattern("lack of memory", re.compile(r"out of memory: killed process|oom-kill", re.IGNORECASE),
            "stop programs or add memory; `journalctl --dmesg | grep -i oom`"),
)  # fmt: skip


def kernel_log(at: Surroundings) -> Findings:
    """Count the lines of the kernel log that explain faults of ports and buses."""
    lines, why = _lines(at)
    if lines is None:
        yield not_checked(f"cannot read the kernel log: {why}", "run `sudo imud doctor`, or join the group adm")
        return
    clean = True
    for pattern in PATTERNS:
        found = [line for line in lines if pattern.expression.search(line)]
        if len(found) >= pattern.least:
            clean = False
            yield warning(
                f"kernel log: {len(found)} lines about {pattern.title}, the last: "
                f"{found[-1].strip()[:SHOWN_CHARACTERS]}",
                pattern.advice,
            )
    if clean:
        yield ok(f"no fault of ports, buses, storage or voltage in {len(lines)} lines of the kernel log")


def _lines(at: Surroundings) -> tuple[list[str] | None, str]:
    """Return the newest lines of the log. If all commands fail, return None and the reason."""
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
        why = output.complaint or why or f"{command[0]} printed no line"
    return None, why
