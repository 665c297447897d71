"""Request scripts of a HiPNUC module on a UART: identity, settings, single commands, restart, another baud rate."""

from collections.abc import Mapping
from typing import Final

from imud.contracts.driver import Identity
from imud.contracts.session import Outcome, Rejection, Request, RequestScript, Silence, pause
from imud.devices.hipnuc.uart import commands
from imud.devices.hipnuc.uart.commands import BaudRate, Query, ask
from imud.devices.hipnuc.uart.replies import parse_report, parse_version
from imud.errors import NoReply, Rejected
from imud.units import NS_PER_S

BOOT_NS: Final = NS_PER_S
"""From REBOOT until it answers; the manual gives no time."""
BOOT_TRIES: Final = 5


def identify() -> RequestScript[Identity]:
    """Ask for product, serial number and firmware (LOG VERSION).

    `details` has every value by the device's own name; `firmware` is "1.5.6" for APP_VER=156. Raises NoReply, Rejected.
    """
    outcome = yield ask(Query.VERSION)
    version = parse_version(_lines(outcome, Query.VERSION))
    firmware = "" if version.app_ver is None else ".".join(str(version.app_ver))
    return Identity(version.product, version.uuid, firmware, version.report.values)


def read_settings() -> RequestScript[Mapping[str, str]]:
    """Ask for all settings (LOG USRCONFIG, COMCONFIG, MAGCONFIG) in one mapping, by the device's own names.

    A line without a name is filed as "COMCONFIG 1", "COMCONFIG 2" and so on. A module without magnetometer may not know
    MAGCONFIG: no answer to that one is no error (a guess, no such module was seen). Raises NoReply, Rejected.
    """
    settings: dict[str, str] = {}
    for query in (Query.USRCONFIG, Query.COMCONFIG, Query.MAGCONFIG):
        outcome = yield ask(query)
        if query is Query.MAGCONFIG and isinstance(outcome, Silence | Rejection):
            break
        report = parse_report(_lines(outcome, query))
        settings.update(report.values)
        settings.update({f"{query} {number}": line for number, line in enumerate(report.other, 1)})
    return settings


def _lines(outcome: Outcome, query: Query) -> tuple[str, ...]:
    """Lines of a good reply. Raises NoReply or Rejected for another outcome."""
    if isinstance(outcome, Silence):
        heard = f"got {len(outcome.lines)} lines and no end" if outcome.lines else "got nothing"
        raise NoReply(
            f"LOG {query}: expected lines up to OK, {heard}; "
            "is the host's transmit line connected, and the baud rate right?"
        )
    if isinstance(outcome, Rejection):
        raise Rejected(f"LOG {query}: the module refused: {' / '.join(outcome.lines)}")
    return outcome.lines


def send(request: Request) -> RequestScript[None]:
    """Send one command. Raises NoReply (also for a command unknown to this firmware) and Rejected."""
    outcome = yield request
    if isinstance(outcome, Silence):
        raise NoReply(f"{request.name}: expected OK, got nothing; is the host's transmit line connected?")
    if isinstance(outcome, Rejection):
        raise Rejected(f"{request.name}: the module refused: {' / '.join(outcome.lines)}")


def restart() -> RequestScript[Identity]:
    """Restart and wait until it answers. What was not saved is lost. Raises NoReply."""
    yield commands.reboot()
    return (yield from _identify_after_boot(0))


def change_baud(baud: BaudRate, present_baud: int) -> RequestScript[int]:
    """Set the baud rate, save, restart, and follow; return the rate. Saves all other settings too.

    Raises NoReply, and Rejected where it answers at the old rate only; the line is then left there.
    """
    yield from send(commands.serial_config(baud))
    yield from send(commands.save_config())
    yield commands.reboot()
    try:
        yield from _identify_after_boot(baud)
    except NoReply:
        yield pause(0, baud=present_baud)
        yield from _identify_after_boot(present_baud)
        raise Rejected(f"SERIALCONFIG {baud}: the module stays at {present_baud} baud") from None
    return baud


def _identify_after_boot(baud: int) -> RequestScript[Identity]:
    """Ask until it answers after a restart, at `baud` unless that is 0."""
    yield pause(BOOT_NS, baud=baud)
    for _ in range(BOOT_TRIES - 1):
        try:
            return (yield from identify())
        except NoReply:
            continue
    return (yield from identify())
