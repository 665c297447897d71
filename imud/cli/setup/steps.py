"""The course of `imud setup`: free the ports, look, propose, change, wait for samples; and all of it taken back.

Two rounds of changes, each announced and agreed before it is made: first what stands between imud and a port (a
console, a CAN interface that is down), since what is behind it can only be seen afterwards; then configuration,
adapters, group and service.
"""

import os
import sys
import textwrap
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final

import msgspec

from imud.cli.doctor.surroundings import Surroundings
from imud.cli.output import COLUMNS, paragraph, shortened, table
from imud.cli.setup.changes import FILE, Change, Journal, describe, describe_undo, locked
from imud.cli.setup.hardware import (
    BITRATE_DEFAULT,
    BITRATE_MAX,
    Attached,
    Finders,
    PortNow,
    Wanted,
    free_console,
    look,
    ports_now,
    raise_can,
    state,
)
from imud.cli.setup.plan import (
    CONTROLLERS,
    EXAMPLE_NODE,
    SYSTEMD,
    UNIT,
    Wishes,
    example_is_untouched,
    members,
    plan,
    present_names,
    proposed_names,
    real_path,
    service_reads,
)
from imud.config.devices import DEVICE_NAME
from imud.contracts.status import DeviceState, DeviceStatus
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable
from imud.links.netlink import absence, can_interfaces
from imud.model.errors import BadArgument, ConfigError, ImudError
from imud.model.units import NS_PER_MS

FOUND_HEAD: Final = ("PORT", "DRIVER", "RATE", "ADAPTER", "CONFIGURED")
TITLE_WIDTH: Final = 16
CONFIGURED_WIDTH: Final = 10
ANSWERS_MAX: Final = 10
"""Wrong answers to one question after which it is given up."""


class Conversation:
    """Standard output and the terminal. Synchronization: one thread."""

    def __init__(self, *, ask: bool, silent: bool = False) -> None:
        """Without `ask` every question has its default answer."""
        self.asks = ask
        self._silent = silent

    def say(self, text: str = "", indent: str = "") -> None:
        """Print a paragraph."""
        if not self._silent:
            words = printable(text, MESSAGE_CHARACTERS_MAX)
            print(
                textwrap.fill(words, COLUMNS, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
            )

    def show(self, lines: Sequence[str]) -> None:
        """Print lines as they are: tables, lines of files."""
        for line in lines if not self._silent else ():
            print(printable(line, MESSAGE_CHARACTERS_MAX))

    def agreed(self, question: str, *, default: bool) -> bool:
        """Ask for yes or no. Raises BadArgument where there is no terminal to ask on."""
        if not self.asks:
            return default
        word = self.answer(f"{question} [{'Y/n' if default else 'y/N'}]", "y" if default else "n")
        return word.lower() in ("y", "yes")

    def answer(self, question: str, default: str) -> str:
        """Ask for a word; an empty answer is the default. Raises BadArgument where there is no terminal to ask on."""
        if not self.asks:
            return default
        if not sys.stdin.isatty():
            raise BadArgument("expected a terminal to ask on, or --yes")
        try:
            return input(f"{question} ").strip() or default
        except KeyboardInterrupt:
            self.show(["", "Nothing more was changed."])
            raise
        except EOFError:
            self.show([""])
            raise BadArgument("expected an answer, got the end of the input: nothing more was changed") from None


def attached_table(found: Sequence[Attached]) -> list[str]:
    """Format what is attached, and below it why nothing was found on a port."""
    rows = [
        (
            one.node,
            f"{one.driver} {one.device}".strip() or "-",
            one.baud or "-",
            shortened(one.title, TITLE_WIDTH) or "-",
            shortened(one.configured, CONFIGURED_WIDTH) or "-",
        )
        for one in found
    ]
    lines = table(FOUND_HEAD, rows).splitlines()
    for one in found:
        if one.problem:
            lines += paragraph("  ", f"{one.node}: {one.problem}")
    return lines


SAMPLES_HEAD: Final = ("DEVICE", "STATE", "RATE HZ", "PRODUCT", "CLOCK ERROR")
NAME_WIDTH: Final = 24
PRODUCT_WIDTH: Final = 20
LOOK_S: Final = 0.5
"""Time between two looks."""
SETTLE_S: Final = 4.0
"""Time for the rate, a mean over seconds, and for the answer of the device to what it is."""


def wait_for_samples(
    ask: Callable[[], list[DeviceStatus]],
    names: Collection[str],
    limit_s: float,
    now_s: Callable[[], float],
    sleep: Callable[[float], None],
) -> list[DeviceStatus]:
    """Wait until all devices of these names run, and SETTLE_S more; return their status, at `limit_s` whatever it is.

    Raises ImudError where the daemon does not answer until then.
    """
    end_s = now_s() + limit_s
    settled_s = end_s
    while True:
        try:
            found = [one for one in ask() if one.name in names]
            problem: Exception | None = None
        except (ImudError, TimeoutError, msgspec.ValidationError) as error:
            found, problem = [], error
        now = now_s()
        runs = len(found) == len(names) and all(_runs(one) for one in found)
        settled_s = min(settled_s, now + SETTLE_S) if runs else end_s
        if now >= min(end_s, settled_s):
            if problem is not None:
                raise ImudError(f"the daemon does not answer: {problem}; `sudo imud doctor` says more")
            return found
        sleep(LOOK_S)


def samples_table(found: Sequence[DeviceStatus]) -> str:
    """Format rate, product and error of each device."""
    return table(SAMPLES_HEAD, [_row(one) for one in found])


def reasons(found: Sequence[DeviceStatus], names: Sequence[str]) -> list[str]:
    """Say for each device of these names why it gives no samples; empty when all do."""
    known = {one.name: one for one in found}
    return [_reason(name, known.get(name)) for name in names if name not in known or not _runs(known[name])]


def _reason(name: str, one: DeviceStatus | None) -> str:
    return (
        f"{name}: the daemon does not have it: `systemctl status imud`"
        if one is None
        else (f"{name}: {one.problem or one.state}")
    )


def _runs(one: DeviceStatus) -> bool:
    return one.state is DeviceState.RUNNING


def _row(one: DeviceStatus) -> tuple[object, ...]:
    error = f"{one.clock.t_err_ns / NS_PER_MS:.3f} ms" if _runs(one) else "-"
    product = shortened(one.identity.get("product", "-"), PRODUCT_WIDTH)
    return shortened(one.name, NAME_WIDTH), one.state, one.rate_hz, product, error


DONE, NOT_DONE = 0, 1
CAN_UP_S: Final = 5.0
"""Time that systemd-networkd gets to bring an interface up."""
CAN_LOOK_S: Final = 0.2
NEXT: Final = (
    "No sensor was found. Next steps:",
    "  - Is it powered, are TX and RX crossed, is ground connected? Then run this again.",
    "  - `imud probe --active PORT` also asks, and so finds modules that are silent.",
    "  - On RS-485: `sudo imud setup --rs485 PORT`. On I2C: `--i2c 1`. On SPI:",
    "    `--spi /dev/spidev0.0`. A CAN interface that is down: `--can can0=500000`.",
    "  - `sudo imud doctor` looks for what is wrong with this machine.",
)


class SetupSteps:
    """One run. Synchronization: one thread."""

    def __init__(
        self,
        look_around: Callable[[], Surroundings],
        talk: Conversation,
        finders: Finders,
        now_s: Callable[[], float],
        sleep: Callable[[float], None],
        *,
        dry_run: bool,
        user: str,
        date: str,
    ) -> None:
        """`look_around` gives the machine as it is now; `user` ran sudo, `date` is in the name of a backup."""
        self._look_around = look_around
        self._talk = talk
        self._finders = finders
        self._now_s, self._sleep = now_s, sleep
        self._dry_run = dry_run
        self._user, self._date = user, date
        self._announced: list[str] = []
        self._notes: list[str] = []
        self._found: list[Attached] = []
        self._status: list[DeviceStatus] = []
        self._changed = False
        self._freed: list[str] = []
        """Nodes of ports that have a sensor in place of a console, as the user says."""

    # --- forwards -----------------------------------------------------------------------------------------------------

    def set_up(
        self, wanted: Wanted, can: Sequence[tuple[str, int]], *, control: bool = False, wait_s: float = 30.0
    ) -> int:
        """Set up; DONE when samples come. Raises ImudError, OSError."""
        at = self._look_around()
        self._check_configuration(at)
        if wanted.places:
            wanted = wanted._replace(places=(*wanted.places, *(name for name, _ in can)))
        if not self._round(*self._ways(at, wanted, can)):
            return NOT_DONE
        at = self._look_around()
        self._await_can([name for name, _ in can])
        self._talk.say("Looking for sensors …")
        example = (EXAMPLE_NODE,) if example_is_untouched(at) else ()
        self._found = look(at, wanted, self._finders, example=example, freed=self._freed)
        self._talk.show(attached_table(self._found) if self._found else ["no serial port and no CAN interface"])
        names = self._chosen(at)
        present = present_names(at)
        if not names and not present:
            self._talk.show(["", *NEXT])
            return NOT_DONE
        made = plan(at, Wishes(names, self._user, control or self._may_control(at), self._date))
        if not self._round(made.changes, made.notes):
            return NOT_DONE
        if self._dry_run:
            return DONE
        return self._samples(wait_s)

    def _check_configuration(self, at: Surroundings) -> None:
        if at.config is None and at.at(real_path(at, str(at.config_file))).exists():
            raise ConfigError(f"{at.config_problem}\ncorrect it, or move it away; nothing was changed")

    def _ways(self, at: Surroundings, wanted: Wanted, can: Sequence[tuple[str, int]]) -> tuple[list[Change], list[str]]:
        """What has to be freed before anything can be heard."""
        changes: list[Change] = []
        notes: list[str] = []
        for port in self._consoles(at, wanted):
            if port.node == own_terminal():
                raise ImudError(f"{port.node} is the terminal that this runs on: use another one, for example ssh")
            self._freed.append(port.node)
            more, words = free_console(at, port.node)
            changes += more
            notes += words
        given = dict(can)
        for name in can_interfaces(at.at("/sys"), down=True) if not wanted.places else ():
            if self._talk.asks and name not in given and absence(name, at.at("/sys")):
                question = f"The CAN interface {name} is down. Bring it up, now and at every start?"
                if self._talk.agreed(question, default=False):
                    given[name] = 0
        for name, bitrate in given.items():
            more, words = raise_can(at, name, bitrate or self._bitrate(name))
            changes += more
            notes += words
        return changes, notes

    def _consoles(self, at: Surroundings, wanted: Wanted) -> list[PortNow]:
        """Ports with a console or a login that a sensor is wired to, as the user says."""
        named = {real_path(at, place) for place in (*wanted.places, *wanted.active) if place.startswith("/")}
        found = []
        for port in ports_now(at):
            if not (port.console or "getty" in port.holders):
                continue
            question = f"{port.node} has a console. Is a sensor wired to it, so that the console may go?"
            if port.node in named or (not named and self._talk.asks and self._talk.agreed(question, default=False)):
                found.append(port)
        return found

    def _bitrate(self, name: str) -> int:
        for _ in range(ANSWERS_MAX):
            word = self._talk.answer(f"Bit rate of the bus at {name}, bit/s? [{BITRATE_DEFAULT}]", str(BITRATE_DEFAULT))
            if word.isdecimal() and 0 < int(word) <= BITRATE_MAX:
                return int(word)
            self._talk.say(f"{word}: expected a whole number from 1 to {BITRATE_MAX}")
        raise ImudError(f"expected a bit rate for {name}")

    def _await_can(self, names: Sequence[str]) -> None:
        end_s = self._now_s() + CAN_UP_S
        sys_folder = self._look_around().at("/sys")
        while self._changed and any(absence(name, sys_folder) for name in names) and self._now_s() < end_s:
            self._sleep(CAN_LOOK_S)

    def _chosen(self, at: Surroundings) -> dict[str, Attached]:
        """The devices to add, by the names that the user gives them."""
        new = [one for one in self._found if one.driver and one.keys and not one.configured]
        taken = present_names(at)
        chosen: dict[str, Attached] = {}
        for one in new:
            (proposed,) = proposed_names([one], [*taken, *chosen])
            for _ in range(ANSWERS_MAX):
                question = f"Name of {one.driver} {one.device} on {one.node}? (`-` leaves it out) [{proposed}]"
                name = self._talk.answer(" ".join(question.split()), proposed)
                if name == "-":
                    break
                if DEVICE_NAME.fullmatch(name) and name not in (*taken, *chosen):
                    chosen[name] = one
                    break
                self._talk.say(f"{name}: expected a new name of a-z, 0-9, _ and -, at most 32 characters")
            else:
                self._talk.say(f"{one.node} is left out: {ANSWERS_MAX} answers were no new name")
        return chosen

    def _may_control(self, at: Surroundings) -> bool:
        if not self._user or not self._talk.asks:
            return False
        if self._user in members(at).get(CONTROLLERS, [self._user]):
            return False
        return self._talk.agreed(f"May {self._user} also change settings of modules (`imud command`)?", default=False)

    # --- one round of changes -----------------------------------------------------------------------------------------

    def _round(self, changes: Sequence[Change], notes: Sequence[str]) -> bool:
        """Tell, ask, make; False where the changes were not made. Raises ImudError, OSError."""
        at = self._look_around()
        if changes:
            self._talk.show(["", "Changes:"])
        for number, change in enumerate(changes, start=1):
            first, *more = describe(at, change)
            self._announced.append(first)
            self._talk.say(f"  {number}. {first}", indent="     ")
            self._talk.show([f"     {line}" for line in more])
        for note in notes:
            self._notes.append(note)
            self._talk.say(f"note: {note}", indent="      ")
        if not changes or self._dry_run:
            return True
        if at.uid != 0:
            self._talk.show(["", "Nothing was changed: only root may. `sudo imud setup` makes the changes above."])
            return False
        if not self._talk.agreed("Make these changes?", default=True):
            self._talk.say("nothing was changed")
            return False
        with locked(at):
            journal = Journal(at, self._talk.say)
            before = len(journal.records)
            try:
                notes = journal.carry_out(changes)
            except (ImudError, OSError, KeyboardInterrupt):
                done = sum(record.done for record in journal.records[before:])
                self._talk.say(f"{done} of {len(changes)} changes were made; `sudo imud setup --undo` takes them back")
                raise
        self._changed = True
        for note in notes:
            self._talk.say(f"note: {note}", indent="      ")
        self._talk.say(f"done; recorded in {FILE}, `sudo imud setup --undo` takes it back")
        return True

    def _samples(self, wait_s: float) -> int:
        """Wait for samples and show them."""
        at = self._look_around()
        if not self._announced:
            self._talk.say("Nothing to change.")
        names = [device.name for device in at.config.devices] if at.config else []
        if not at.at(SYSTEMD).exists() or not service_reads(at) or state(at, UNIT, "is-active") != "active":
            return DONE
        self._talk.say("Waiting for samples …")
        self._status = wait_for_samples(
            lambda: self._look_around().status_now(), names, wait_s, self._now_s, self._sleep
        )
        self._talk.show(samples_table(self._status).splitlines())
        silent = reasons(self._status, names)
        for reason in silent:
            self._talk.say(reason, indent="  ")
        if silent:
            self._talk.say("`sudo imud doctor` says what to do next")
            return NOT_DONE
        self._talk.say("Samples come. `imud watch` prints them, `imud status` says how they are.")
        return DONE

    def as_json(self) -> bytes:
        """All that was found and done, for programs."""
        found: dict[str, Any] = {
            "found": self._found, "changes": self._announced, "made": self._changed, "notes": self._notes,
            "devices": self._status,
        }  # fmt: skip
        return msgspec.json.encode(found)

    # --- backwards ----------------------------------------------------------------------------------------------------

    def undo(self) -> int:
        """Take back all changes; DONE when none is left. Raises ImudError, OSError."""
        at = self._look_around()
        if at.uid != 0:
            raise ImudError("only root may take changes back: `sudo imud setup --undo`")
        with locked(at):
            journal = Journal(at, self._talk.say)
            if not journal.records:
                self._talk.say("nothing to take back: imud setup has changed nothing here")
                return DONE
            self._talk.show(["Will be taken back, the newest first:"])
            for record in reversed(journal.records):
                self._talk.show([f"  - {line}" for line in describe_undo(record)])
            if self._dry_run:
                return DONE
            if not self._talk.agreed("Take these changes back?", default=True):
                self._talk.say("nothing was changed")
                return NOT_DONE
            refused = journal.take_back()
        for reason in refused:
            self._talk.say(f"not taken back: {reason}", indent="  ")
        if refused:
            self._talk.say("The rest was taken back. Run `sudo imud setup --undo` again when that is settled.")
            return NOT_DONE
        self._talk.say("Everything is as it was before `imud setup`.")
        return DONE


def own_terminal() -> str:
    """The node of the terminal that this program runs on; empty without one."""
    try:
        return os.ttyname(sys.stdin.fileno())
    except (OSError, ValueError):
        return ""
