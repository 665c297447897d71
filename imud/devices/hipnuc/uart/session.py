"""Request scripts of a HiPNUC module on a UART: identity, settings, single commands, restart, another baud rate.

There are two accounts of when SERIALCONFIG and FRESET change the rate of the line: at once (manual, section 2.1; older
firmware even before its answer leaves), or after SAVECONFIG and REBOOT (section 2.2.5). What is heard decides: after
either command the module is looked for at the old rate and at the new one, and the line stays where it answered.
"""

from collections.abc import Mapping, Sequence
from typing import Final

from imud.contracts.driver import Identity
from imud.contracts.session import Outcome, Rejection, Reply, Request, RequestScript, Silence, pause
from imud.devices.hipnuc.uart import commands
from imud.devices.hipnuc.uart.commands import BAUD_RATES, BaudRate, OutputMessage, OutputRate, Query, ask
from imud.devices.hipnuc.uart.replies import ComConfig, lines_of, parse_comconfig, parse_report, parse_version
from imud.errors import NoReply, Rejected
from imud.units import NS_PER_S

BOOT_NS: Final = NS_PER_S
"""From REBOOT until it answers; the manual gives no time."""
BOOT_TRIES: Final = 5
LOOK_TRIES: Final = 2
"""Bytes sent at another rate may stand in the module's line buffer and spoil the first question."""
FACTORY_BAUD: Final = BAUD_RATES[0]
WAKE_HZ: Final = 100
"""Output rate as delivered (section 3.2)."""


def identify() -> RequestScript[Identity]:
    """Ask for product, serial number and firmware (LOG VERSION).

    `details` has every value by the device's own name; `firmware` is "1.5.6" for APP_VER=156. A reply without a product
    has lost bytes, as the first one after a plug can. Raises NoReply, Rejected.
    """
    outcome = yield ask(Query.VERSION)
    lines = _lines(outcome, Query.VERSION)
    version = parse_version(lines)
    if not version.product:
        raise NoReply(f"LOG VERSION: expected PNAME=... and other lines, got {' / '.join(lines)}; bytes were lost")
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


# --- output -----------------------------------------------------------------------------------------------------------


def ask_outputs() -> RequestScript[ComConfig | None]:
    """Ask which messages are sent and when (LOG COMCONFIG); None where the module does not tell that."""
    outcome = yield ask(Query.COMCONFIG)
    if not isinstance(outcome, Reply):
        return None
    config = parse_comconfig(outcome.lines)
    return config if config.periods_s or config.on_mark else None


def rates_hz(config: ComConfig | None) -> dict[OutputMessage, float]:
    """Output rates of the messages that have one; messages on mark are sent when they are asked for."""
    periods_s = config.periods_s if config is not None else {}
    return {OutputMessage(name): 1 / period_s for name, period_s in periods_s.items() if period_s > 0}


def set_output(message: OutputMessage, rate_hz: OutputRate, baud: int) -> RequestScript[None]:
    """Send a message at a rate, or not at all (0). Raises BadArgument where the line does not carry all messages."""
    if rate_hz and baud in BAUD_RATES:
        commands.require_room({message: rate_hz}, baud)
        present = rates_hz((yield from ask_outputs()))
        commands.require_room({**present, message: rate_hz}, baud)
    yield from send(commands.log_ontime(message, rate_hz))


def wake() -> RequestScript[bool | None]:
    """Let frames out (LOG ENABLE) where a message has a rate by the module's own settings.

    Returns whether it acknowledged; None where nothing was changed, because no message has a rate or one is on mark: a
    module that is set so is meant to be silent. Raises NoReply, Rejected.
    """
    config = yield from ask_outputs()
    if config is None or config.on_mark or not rates_hz(config):
        return None
    yield from send(commands.log_enable())
    return True


def why_silent(settings: Mapping[str, str]) -> str:
    """Say why it answers and sends no samples, from its settings (`read_settings`)."""
    config = parse_comconfig(lines_of(settings))
    if rates := rates_hz(config):
        message, rate_hz = max(rates.items(), key=lambda item: item[1])
        return f"its output is off (LOG DISABLE), though {message} has {rate_hz:g} Hz"
    if config.on_mark:
        return f"{' and '.join(sorted(config.on_mark))} on mark, one for each pulse on SIN"
    return "no message has a rate" if config.periods_s else "its output is off, or on mark"


def wake_by_force(baud: int) -> RequestScript[str]:
    """Let frames out and, where no message has a rate, send HI91; return what was done. Not saved.

    HI91 is sent with 100 Hz or what the line carries. Raises NoReply, Rejected.
    """
    yield from send(commands.log_enable())
    config = yield from ask_outputs()
    if config is None:
        return "LOG ENABLE; it does not tell the rates of its messages: where no sample comes, set one with output"
    if rates_hz(config):
        return "LOG ENABLE"
    rate_hz: OutputRate = 10 if baud == min(BAUD_RATES) else WAKE_HZ
    yield from send(commands.log_ontime(OutputMessage.HI91, rate_hz))
    return f"LOG ENABLE; HI91 at {rate_hz} Hz, which is not saved"


# --- restart and baud rate --------------------------------------------------------------------------------------------


def restart(present_baud: int = 0) -> RequestScript[Identity]:
    """Restart and wait until it answers. What was not saved is lost, also a baud rate. Raises NoReply."""
    yield commands.reboot()
    identity, _ = yield from _found_after_boot([present_baud])
    return identity


def change_baud(baud: BaudRate, present_baud: int) -> RequestScript[int]:
    """Set the baud rate, save, restart, and follow; return the rate. Saves all other settings too.

    The restart shows that the rate was saved, and puts in force what needs one.

    Raises BadArgument where the line would not carry the present output, NoReply, and Rejected where the module answers
    at the old rate only; the line is then left there.
    """
    commands.require_room(rates_hz((yield from ask_outputs())), baud)
    outcome = yield commands.serial_config(baud)
    answered = _is_answer(outcome, f"SERIALCONFIG {baud}")
    heard = yield from _find((present_baud, baud) if answered else (baud, present_baud))
    if heard == present_baud != baud and not answered:
        raise NoReply(f"SERIALCONFIG {baud}: expected OK, got nothing; the module stays at {present_baud} baud")
    yield from send(commands.save_config())
    yield commands.reboot()
    _, heard = yield from _found_after_boot((baud, present_baud))
    if heard != baud:
        raise Rejected(f"SERIALCONFIG {baud}: the module stays at {heard} baud")
    return heard


def reset_to_factory(present_baud: int) -> RequestScript[int]:
    """Restore the factory settings, restart so that they are in force, and follow; return the baud rate.

    Raises NoReply, Rejected.
    """
    outcome = yield commands.factory_reset()
    answered = _is_answer(outcome, "FRESET")
    heard = yield from _find((present_baud, FACTORY_BAUD) if answered else (FACTORY_BAUD, present_baud))
    if not answered and heard == present_baud:
        raise NoReply("FRESET: expected OK, got nothing; read the settings to see whether it was carried out")
    yield commands.reboot()
    _, heard = yield from _found_after_boot((FACTORY_BAUD, present_baud))
    return heard


def advice(baud: int, fixed_baud: int) -> str:
    """Say what to change in a configuration that fixes another baud rate; empty where nothing is to be changed."""
    if fixed_baud in (0, baud):
        return ""
    return f"change `baud: {fixed_baud}` in the configuration to {baud} or auto: imud uses it at its next start"


def _is_answer(outcome: Outcome, name: str) -> bool:
    """Whether the module answered well. Raises Rejected."""
    if isinstance(outcome, Rejection):
        raise Rejected(f"{name}: the module refused: {' / '.join(outcome.lines)}")
    return isinstance(outcome, Reply)


def _find(bauds: Sequence[int]) -> RequestScript[int]:
    """Return the first of some rates at which it answers; the line stays there. Raises NoReply, at the first one."""
    for baud in dict.fromkeys(bauds):
        yield pause(0, baud=baud)
        if (yield from _answers(LOOK_TRIES)) is not None:
            return baud
    yield pause(0, baud=bauds[0])
    rates = " or ".join(str(baud) for baud in dict.fromkeys(bauds))
    raise NoReply(f"LOG VERSION: expected an answer at {rates} baud, got nothing; `baud: auto` tries all rates")


def _found_after_boot(bauds: Sequence[int]) -> RequestScript[tuple[Identity, int]]:
    """Ask until it answers after a restart, at the likely rates first, then at all others. Raises NoReply.

    A rate that was in force without being saved is lost by a restart, and which was saved is not known.
    """
    yield pause(BOOT_NS)  # at the present rate: REBOOT may still be on its way out of the port
    likely = dict.fromkeys(bauds)
    others = [baud for baud in BAUD_RATES if baud not in likely] if bauds[0] else []
    for baud in (*likely, *others):
        yield pause(0, baud=baud)
        identity = yield from _answers(BOOT_TRIES if baud in likely else LOOK_TRIES)
        if identity is not None:
            return identity, baud
    yield pause(0, baud=bauds[0])
    raise NoReply("LOG VERSION: expected an answer after the restart, got nothing at any baud rate")


def _answers(tries: int) -> RequestScript[Identity | None]:
    """Ask for the identity some times; None for no answer."""
    for _ in range(tries):
        try:
            return (yield from identify())
        except (NoReply, Rejected):
            continue
    return None
