"""Checks of the kernel's log of this boot: trouble of USB, I2C, SD cards, CAN and the supply voltage."""

import re
from typing import Final, NamedTuple

from imud.cli.doctor.finding import Findings, not_checked, ok, warning
from imud.cli.doctor.surroundings import Surroundings

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
