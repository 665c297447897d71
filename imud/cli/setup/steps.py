"""Steps of `imud setup`: make ports usable, search for devices, propose changes, make them, wait for samples; undo.

There are two rounds of changes. imud prints the changes of a round and asks the user before it makes them. The first
round removes consoles and brings CAN interfaces up, because imud can search these ports only after that. The second
round changes the configuration, the udev rules of adapters, the group and the service.
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
from imud.config.reading import DEVICE_NAME
from imud.contracts.status import DeviceState, DeviceStatus
from imud.host.log import MESSAGE_CHARACTERS_MAX, printable, printable_json
from imud.host.netlink import absence, can_interfaces
from imud.model.errors import BadArgument, ConfigError, ImudError
from imud.model.units import NS_PER_MS

FOUND_HEAD: Final = ("PORT", "DRIVER", "RATE", "ADAPTER", "CONFIGURED")
TITLE_WIDTH: Final = 16
CONFIGURED_WIDTH: Final = 10
ANSWERS_MAX: Final = 10  # maximum number of invalid answers to one question


class Conversation:
    """Dialogue with the user on the terminal. Synchronization: one thread."""

    def __init__(self, *, ask: bool, silent: bool = False) -> None:
        """`ask`: if False, every question gets its default answer. `silent`: print nothing."""
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
        """Print lines without wrapping: tables, lines of files."""
        for line in lines if not self._silent else ():
            print(printable(line, MESSAGE_CHARACTERS_MAX))

    def agreed(self, question: str, *, default: bool) -> bool:
        """Ask a yes-no question. Raises BadArgument if standard input is not a terminal."""
        if not self.asks:
            return default
        word = self.answer(f"{question} [{'Y/n' if default else 'y/N'}]", "y" if default else "n")
        return word.lower() in ("y", "yes")

    def answer(self, question: str, default: str) -> str:
        """Ask for a word; an empty answer is the default. Raises BadArgument if standard input is not a terminal."""
        if not self.asks:
            return default
        if not sys.stdin.isatty():
            raise BadArgument("cannot ask questions without a terminal; use --yes or --dry-run")
        try:
            return input(f"{question} ").strip() or default
        except KeyboardInterrupt:
            self.show(["", "imud setup made no further changes."])
            raise
        except EOFError:
            self.show([""])
            raise BadArgument("expected an answer, got the end of the input; imud made no further changes") from None


def attached_table(found: Sequence[Attached]) -> list[str]:
    """Format the table of ports and devices, and the problems below it."""
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
LOOK_S: Final = 0.5  # time between two status requests, s
SETTLE_S: Final = 4.0  # time until the rate, a mean over seconds, and the identity of a device are known, s


def wait_for_samples(
    ask: Callable[[], list[DeviceStatus]],
    names: Collection[str],
    limit_s: float,
    now_s: Callable[[], float],
    sleep: Callable[[float], None],
) -> list[DeviceStatus]:
    """Wait until these devices run, and SETTLE_S more, but at most `limit_s`. Return their status.

    Raises ImudError if the daemon does not reply within `limit_s`.
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
        # a device that stops again restarts the wait
        settled_s = min(settled_s, now + SETTLE_S) if runs else end_s
        if now >= min(end_s, settled_s):
            if problem is not None:
                raise ImudError(f"the daemon does not reply: {problem}; find the reason with `sudo imud doctor`")
            return found
        sleep(LOOK_S)


def samples_table(found: Sequence[DeviceStatus]) -> str:
    """Format state, rate, product and time stamp error of each device."""
    return table(SAMPLES_HEAD, [_row(one) for one in found])


def reasons(found: Sequence[DeviceStatus], names: Sequence[str]) -> list[str]:
    """Return the reason for each device without samples; empty if all devices send samples."""
    known = {one.name: one for one in found}
    return [_reason(name, known.get(name)) for name in names if name not in known or not _runs(known[name])]


def _reason(name: str, one: DeviceStatus | None) -> str:
    return (
        f"{name}: the daemon does not use this device: check `systemctl status imud`"
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
CAN_UP_S: Final = 5.0  # time limit for systemd-networkd to bring an interface up, s
CAN_LOOK_S: Final = 0.2
NEXT: Final = (
    "imud found no device. Next steps:",
    "  - Check power, ground, and TX to RX in both directions. Run imud setup again.",
    "  - `imud probe --active PORT` sends requests, which finds silent devices.",
    "  - On RS-485: `sudo imud setup --rs485 PORT`. On I2C: `--i2c 1`. On SPI:",
    "    `--spi /dev/spidev0.0`. A CAN interface that is down: `--can can0=500000`.",
    "  - `sudo imud doctor` finds problems of this host.",
)


class SetupSteps:
    """One run of `imud setup`. Synchronization: one thread."""

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
        """`look_around` returns the current state of the host. `user`: user of sudo. `date`: suffix of backups."""
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
        self._freed: list[str] = []  # nodes of ports from which this run removes the console
        self._raised: list[str] = []  # CAN interfaces that this run brings up

    # --- set up -------------------------------------------------------------------------------------------------------

    def set_up(
        self, wanted: Wanted, can: Sequence[tuple[str, int]], *, control: bool = False, wait_s: float = 30.0
    ) -> int:
        """Set up the host. Return DONE if all devices send samples, otherwise NOT_DONE. Raises ImudError, OSError."""
        at = self._look_around()
        self._check_configuration(at)
        if wanted.places:
            wanted = wanted._replace(places=(*wanted.places, *(name for name, _ in can)))
        if not self._round(*self._ways(at, wanted, can)):
            return NOT_DONE
        at = self._look_around()
        self._await_can()
        self._talk.say("Searching for devices …")
        example = (EXAMPLE_NODE,) if example_is_untouched(at) else ()
        self._found = look(at, wanted, self._finders, example=example, freed=self._freed)
        self._talk.show(attached_table(self._found) if self._found else ["found no serial port and no CAN interface"])
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
            raise ConfigError(f"{at.config_problem}\ncorrect or rename the file; imud changed nothing")

    def _ways(self, at: Surroundings, wanted: Wanted, can: Sequence[tuple[str, int]]) -> tuple[list[Change], list[str]]:
        """Return the changes that make ports and interfaces usable, and notes."""
        changes: list[Change] = []
        notes: list[str] = []
        for port in self._consoles(at, wanted):
            # removing this console would end the dialogue
            if port.node == own_terminal():
                raise ImudError(f"imud setup runs on the terminal {port.node}; use another terminal, for example ssh")
            self._freed.append(port.node)
            more, words = free_console(at, port.node)
            changes += more
            notes += words
        given = dict(can)
        for name in can_interfaces(at.at("/sys"), down=True) if not wanted.places else ():
            if self._talk.asks and name not in given and absence(name, at.at("/sys")):
                question = f"The CAN interface {name} is down. Bring it up now and at every boot?"
                if self._talk.agreed(question, default=False):
                    given[name] = 0
        self._raised = list(given)
        for name, bitrate in given.items():
            more, words = raise_can(at, name, bitrate or self._bitrate(name))
            changes += more
            notes += words
        return changes, notes

    def _consoles(self, at: Surroundings, wanted: Wanted) -> list[PortNow]:
        """Return the ports with a console or a login to which a device is connected, according to the user."""
        named = {real_path(at, place) for place in (*wanted.places, *wanted.active) if place.startswith("/")}
        found = []
        for port in ports_now(at):
            if not (port.console or "getty" in port.holders):
                continue
            question = f"{port.node} has a console. Is a device connected, so that imud can remove the console?"
            if port.node in named or (not named and self._talk.asks and self._talk.agreed(question, default=False)):
                found.append(port)
        return found

    def _bitrate(self, name: str) -> int:
        for _ in range(ANSWERS_MAX):
            word = self._talk.answer(f"Bit rate of the bus at {name}, bit/s? [{BITRATE_DEFAULT}]", str(BITRATE_DEFAULT))
            if word.isdecimal() and 0 < int(word) <= BITRATE_MAX:
                return int(word)
            self._talk.say(f"{word}: expected a whole number from 1 to {BITRATE_MAX}")
        raise ImudError(f"expected a bit rate for {name}, got {ANSWERS_MAX} invalid answers; use --can {name}=BITRATE")

    def _await_can(self) -> None:
        end_s = self._now_s() + CAN_UP_S
        sys_folder = self._look_around().at("/sys")
        # networkd needs some time
        while self._changed and any(absence(name, sys_folder) for name in self._raised) and self._now_s() < end_s:
            self._sleep(CAN_LOOK_S)

    def _chosen(self, at: Surroundings) -> dict[str, Attached]:
        """Ask for the names of new devices. Return the devices to add, by name."""
        new = [one for one in self._found if one.driver and one.keys and not one.configured]
        taken = present_names(at)
        chosen: dict[str, Attached] = {}
        for one in new:
            (proposed,) = proposed_names([one], [*taken, *chosen])
            for _ in range(ANSWERS_MAX):
                question = f"Name of {one.driver} {one.device} on {one.node}? (`-`: do not add) [{proposed}]"
                name = self._talk.answer(" ".join(question.split()), proposed)
                if name == "-":
                    break
                if DEVICE_NAME.fullmatch(name) and name not in (*taken, *chosen):
                    chosen[name] = one
                    break
                self._talk.say(f"{name}: expected an unused name of a-z, 0-9, _ and -, at most 32 characters")
            else:
                self._talk.say(f"imud does not add {one.node} after {ANSWERS_MAX} invalid answers")
        return chosen

    def _may_control(self, at: Surroundings) -> bool:
        if not self._user or not self._talk.asks:
            return False
        if self._user in members(at).get(CONTROLLERS, [self._user]):
            return False
        return self._talk.agreed(f"Allow {self._user} to change device settings (`imud settings`)?", default=False)

    # --- one round of changes -----------------------------------------------------------------------------------------

    def _round(self, changes: Sequence[Change], notes: Sequence[str]) -> bool:
        """Print the changes, ask the user, make the changes. Return False if imud did not make the changes.

        Raises ImudError, OSError.
        """
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
            self._talk.show(["", "imud changed nothing: only root can. Make the changes with `sudo imud setup`."])
            return False
        if not self._talk.agreed("Make these changes?", default=True):
            self._talk.say("imud changed nothing")
            return False
        with locked(at):
            journal = Journal(at, self._talk.say)
            before = len(journal.records)
            try:
                notes = journal.carry_out(changes)
            except (ImudError, OSError, KeyboardInterrupt):
                done = sum(record.done for record in journal.records[before:])
                self._talk.say(f"imud made {done} of {len(changes)} changes; undo: `sudo imud setup --undo`")
                raise
        self._changed = True
        for note in notes:
            self._talk.say(f"note: {note}", indent="      ")
        self._talk.say(f"done; recorded in {FILE}; undo: `sudo imud setup --undo`")
        return True

    def _samples(self, wait_s: float) -> int:
        """Wait for samples. Print the state of the devices. Return the exit status."""
        at = self._look_around()
        if not self._announced:
            self._talk.say("No changes needed.")
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
            self._talk.say("Find the reason and the next step with `sudo imud doctor`.")
            return NOT_DONE
        self._talk.say("All devices send samples. `imud watch` prints them, `imud status` prints their state.")
        return DONE

    def as_json(self) -> str:
        """Return the found devices, the changes and the device states as JSON."""
        found: dict[str, Any] = {
            "found": self._found, "changes": self._announced, "made": self._changed, "notes": self._notes,
            "devices": self._status,
        }  # fmt: skip
        return printable_json(found)

    # --- undo ---------------------------------------------------------------------------------------------------------

    def undo(self) -> int:
        """Undo all changes. Return DONE if no change is left. Raises ImudError, OSError."""
        at = self._look_around()
        if at.uid != 0:
            raise ImudError("only root can undo changes; use `sudo imud setup --undo`")
        with locked(at):
            journal = Journal(at, self._talk.say)
            if not journal.records:
                self._talk.say("there are no changes to undo")
                return DONE
            self._talk.show(["Undo, newest change first:"])
            for record in reversed(journal.records):
                self._talk.show([f"  - {line}" for line in describe_undo(record)])
            if self._dry_run:
                return DONE
            if not self._talk.agreed("Undo these changes?", default=True):
                self._talk.say("imud changed nothing")
                return NOT_DONE
            refused = journal.take_back()
        for reason in refused:
            self._talk.say(f"not undone: {reason}", indent="  ")
        if refused:
            self._talk.say("imud undid the other changes. Solve the problems, then run `sudo imud setup --undo` again.")
            return NOT_DONE
        self._talk.say("imud undid all changes of `imud setup`.")
        return DONE


def own_terminal() -> str:
    """Return the node of the terminal of this program; empty without a terminal."""
    try:
        return os.ttyname(sys.stdin.fileno())
    except (OSError, ValueError):
        return ""
