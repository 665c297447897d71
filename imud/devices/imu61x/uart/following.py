"""Request scripts of an IMU61x on a UART that could lose it: restart, baud rate, factory reset.

Manual "IMU61X Interface Protocol and Instructions", table 12: CMD 9, CMD 14 with parameter 3, CMD 15. What decides is
what the device shows, not what it acknowledges: a restart by its timer, which begins again; a baud rate by an answer at
it; a factory reset by the parameters that it reads back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from imud.contracts.driver import Identity
from imud.contracts.session import Reply, RequestScript, pause, with_undo
from imud.devices.imu61x.common.family import FILTER_DEFAULT, I2C_ADDRESSES
from imud.devices.imu61x.uart import commands
from imud.devices.imu61x.uart.commands import BAUD_RATES, BusMode, OutputMode
from imud.devices.imu61x.uart.contact import (
    CONTACT_TRIES,
    STREAM,
    in_contact,
    ordered,
    read,
    result_of,
    resume_streaming,
    sample,
    settled,
)
from imud.devices.imu61x.uart.replies import RESULT_DONE, Parameter
from imud.devices.imu61x.uart.session import identity_of
from imud.errors import BadArgument, NoReply, Rejected
from imud.units import NS_PER_S, NS_PER_US

LOOK_TRIES: Final = 3
"""A device in the middle of a false frame, made of bytes at another rate, or quiet after an answer, may miss two."""
BOOT_NS: Final = NS_PER_S
BOOT_TRIES: Final = 5
"""Number of searches after a restart; with their time-outs longer than the 3 s that section 2.2 names."""
US_PER_S: Final = NS_PER_S // NS_PER_US
TIMER_US: Final = 2**32
OLD_US: Final = 15 * US_PER_S
"""Least age of the timer before a restart: more than the time in which the device is searched for afterwards, so that
a timer that began again shows less."""

FACTORY: Final[Mapping[Parameter, int]] = {
    Parameter.BAUD: BAUD_RATES[0],
    Parameter.AHRS_RATE: 100,
    Parameter.BUS_MODE: BusMode.SPI.value,
    Parameter.I2C_ADDRESS: I2C_ADDRESSES[0],
    Parameter.FILTER: FILTER_DEFAULT,
}
"""The defaults that tables 1, 9 and 12 name."""
FACTORY_BAUD: Final = FACTORY[Parameter.BAUD]


@dataclass(frozen=True, slots=True)
class BaudChange:
    """Result of a successful change of the baud rate."""

    baud: int
    """The rate at which the device answered last; the line has it as well."""
    saved: bool
    """Whether the device acknowledged that it saved its parameters."""
    configuration: str = ""
    """What to change in the configuration; empty for nothing."""


def with_advice(script: RequestScript[BaudChange], fixed_baud: int) -> RequestScript[BaudChange]:
    """Make the same script; its answer says what to change where the configuration fixes the rate (0: it does not)."""
    change = yield from script
    if fixed_baud in (0, change.baud):
        return change
    words = f"change `uart.baud` from {fixed_baud} to {change.baud} or auto: imud uses it at its next start"
    return replace(change, configuration=words)


# --- restart ----------------------------------------------------------------------------------------------------------


def restart(*, done: int = RESULT_DONE) -> RequestScript[Identity]:
    """Restart (CMD 9) and wait until it answers again. Parameters that were not saved are lost.

    Raises NoReply where it does not come back or sends no AHRS frame, and Rejected where its timer went on.
    """
    before_us = yield from _old_timer()
    result = yield from in_contact(_restart)
    yield pause(BOOT_NS)
    identity, after_us = yield from _back()
    if after_us >= before_us:
        word = "no acknowledgement" if result is None else f"acknowledgement {result}"
        raise Rejected(
            f"restart: expected a timer that begins again, got {before_us / US_PER_S:.1f} s before and "
            f"{after_us / US_PER_S:.1f} s after it, and {word} ({done} is done)"
        )
    return identity


def _old_timer() -> RequestScript[int]:
    """The timer, µs, once it can be distinguished from one that has just begun, and does not turn over soon."""
    while True:
        timer_us = (yield from in_contact(sample)).dev_ticks
        assert timer_us is not None  # every AHRS frame has it
        if timer_us < OLD_US:
            yield pause((OLD_US - timer_us) * NS_PER_US)
        elif timer_us > TIMER_US - 2 * OLD_US:
            yield pause((TIMER_US - timer_us) * NS_PER_US)
        else:
            return timer_us


def _restart() -> RequestScript[int | None]:
    return result_of((yield commands.restart()))


def _back() -> RequestScript[tuple[Identity, int]]:
    """Wait for the device after a restart."""

    def ask() -> RequestScript[tuple[Identity, int]]:
        status = yield from settled(CONTACT_TRIES)
        return identity_of(status), (yield from sample()).dev_ticks or 0

    for _ in range(BOOT_TRIES - 1):
        try:
            return (yield from in_contact(ask))
        except NoReply:
            continue
    return (yield from in_contact(ask))


# --- baud rate --------------------------------------------------------------------------------------------------------


def change_baud(
    baud: int, present_baud: int, *, done: int = RESULT_DONE, save: bool = True
) -> RequestScript[BaudChange]:
    """Set the baud rate of device and line from `present_baud` to `baud`, and save it.

    Whether the device changes at once or at its next start is not documented, so it is searched at both rates. The
    rate is saved only after a reply at the new rate, or a report of it at the old one; without `save` in the second
    case only, where it comes into force in no other way. Leaves it streaming.
    Raises BadArgument for a rate that does not carry the output rate of the device, Rejected where it stays at the old
    rate (the line too) or refuses to save, and NoReply where it is not heard; if nothing was saved, it has the old rate
    again after power-on.
    """
    return with_undo(_change_baud(baud, present_baud, done, save), STREAM)


def _change_baud(baud: int, present_baud: int, done: int, save: bool) -> RequestScript[BaudChange]:
    request = commands.set_baud(baud)
    if (yield from _look((present_baud,))) is None:
        yield from resume_streaming()
        raise NoReply(_unheard(f"{request.name}: nothing was changed", (present_baud,)))
    rate_hz = yield from read(Parameter.AHRS_RATE)
    try:
        commands.require_fit(rate_hz, baud)
    except BadArgument as error:
        yield from resume_streaming()
        raise BadArgument(f"baud: {error}; lower the output rate first") from None
    yield request
    saved = False
    found = yield from _look((baud, present_baud))
    if found == (present_baud, baud) != (baud, baud):  # set, but in force at the next start only
        yield from resume_streaming()
        saved = yield from _save(done)
        yield from in_contact(_restart)
        yield pause(BOOT_NS)
        found = yield from _look((baud, present_baud), BOOT_TRIES)
    if found is None:
        yield from resume_streaming()  # at the present rate, where the search ended
        kept = "it may have been saved" if saved else "switch its power off and on: nothing was saved"
        raise NoReply(_unheard(f"{request.name}: {kept}", (baud, present_baud)))
    yield from resume_streaming()
    if found[0] != baud:
        raise Rejected(f"{request.name}: the device stays at {present_baud} baud")
    if save:
        saved = (yield from _save(done)) or saved
    return BaudChange(baud, saved)


# --- factory reset ----------------------------------------------------------------------------------------------------


def factory_reset(present_baud: int, *, done: int = RESULT_DONE) -> RequestScript[BaudChange]:
    """Restore and save the factory settings (CMD 15), follow the device to its baud rate, and read its parameters back.

    One that changes at its next start is restarted. Leaves it streaming, as delivered. Raises NoReply, and Rejected
    where a parameter reads otherwise than `FACTORY`.
    """
    return with_undo(_factory_reset(present_baud, done), STREAM)


def _factory_reset(present_baud: int, done: int) -> RequestScript[BaudChange]:
    bauds = (FACTORY_BAUD, present_baud)
    if (yield from _look((present_baud,))) is None:
        yield from resume_streaming()
        raise NoReply(_unheard("factory reset: nothing was changed", (present_baud,)))
    result = result_of((yield commands.factory_reset()))
    found = yield from _look(bauds)
    others = {} if found is None else (yield from _not_factory())
    refused = result is not None and result != done
    pending = found is not None and found[0] != FACTORY_BAUD == found[1]
    if found is not None and (pending or (others and not refused)):
        yield from resume_streaming()
        if pending:  # the parameters have the new values, which the restart must not lose
            yield from _save(done)
        yield from in_contact(_restart)
        yield pause(BOOT_NS)
        found = yield from _look(bauds, BOOT_TRIES)
        others = {} if found is None else (yield from _not_factory())
    yield from resume_streaming()
    if found is None:
        raise NoReply(_unheard("factory reset", bauds))
    if others:
        words = ", ".join(f"{parameter.name} {value:g}" for parameter, value in others.items())
        expected = ", ".join(f"{parameter.name} {FACTORY[parameter]}" for parameter in others)
        word = "none" if result is None else str(result)
        raise Rejected(
            f"factory reset: expected {expected}, read back {words}; acknowledgement {word} ({done} is done)"
        )
    return BaudChange(found[0], (yield from _save(done)))


def _not_factory() -> RequestScript[Mapping[Parameter, float]]:
    """The parameters that are not as delivered; one that the device does not have is left out."""
    others = {}
    for parameter, expected in FACTORY.items():
        try:
            value = yield from read(parameter)
        except NoReply:
            continue
        if value != expected:
            others[parameter] = value
    return others


# --- steps ------------------------------------------------------------------------------------------------------------


def _save(done: int) -> RequestScript[bool]:
    """Save; return whether the device acknowledged. Raises Rejected."""
    return (yield from in_contact(lambda: ordered(commands.save(), done), CONTACT_TRIES))


def _look(bauds: Sequence[int], tries: int = LOOK_TRIES) -> RequestScript[tuple[int, float] | None]:
    """Find the device, and enter command mode; return the rate it answers at and the rate it reports.

    The line is left at that rate, or at the last of `bauds` where it is not heard.
    """
    for baud in tuple(dict.fromkeys(bauds)) * tries:
        heard = yield commands.output_mode(OutputMode.COMMAND, baud=baud)
        try:
            return baud, (yield from read(Parameter.BAUD, CONTACT_TRIES if isinstance(heard, Reply) else 1))
        except NoReply:
            continue
    return None


def _unheard(what: str, bauds: Sequence[int]) -> str:
    rates = " and ".join(str(baud) for baud in dict.fromkeys(bauds))
    return f"{what}; expected an answer at {rates} baud, got none: is the host's transmit line connected?"
