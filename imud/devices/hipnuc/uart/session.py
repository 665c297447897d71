"""Conversations with a HiPNUC module: who it is and how it is set. Both only ask."""

from collections.abc import Mapping

from imud.contracts.driver import Identity
from imud.contracts.session import Outcome, Rejection, RequestScript, Silence
from imud.devices.hipnuc.uart.commands import Query, ask
from imud.devices.hipnuc.uart.replies import parse_report, parse_version
from imud.errors import NoReply, Rejected


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
    """The lines of a good reply; raises NoReply or Rejected for another outcome."""
    if isinstance(outcome, Silence):
        heard = f"got {len(outcome.lines)} lines and no end" if outcome.lines else "got nothing"
        raise NoReply(
            f"LOG {query}: expected lines up to OK, {heard}; "
            "is the host's transmit line connected, and the baud rate right?"
        )
    if isinstance(outcome, Rejection):
        raise Rejected(f"LOG {query}: the module refused: {' / '.join(outcome.lines)}")
    return outcome.lines
