"""`imud run`: run the daemon in the foreground. `imud check`: check a configuration file."""

import argparse
import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from imud import config
from imud.cli.arguments import CliCommand
from imud.cli.output import complain
from imud.config import host_values
from imud.config.host_values import Host
from imud.config.model import Config, DeviceConfig
from imud.config.yaml import FILE_BYTES_MAX, path_text, read_yaml
from imud.contracts.lines import DeviceLines
from imud.contracts.setting import declared_values
from imud.daemon import Daemon
from imud.drivers import DRIVERS
from imud.fleet.settings import EVERY
from imud.host import event_loop
from imud.host.log import STDERR, is_journal, log_to
from imud.host.process_end import STOP_LIMIT_S, EndDeadline
from imud.model.errors import ConfigError, ImudError, ServerError
from imud.model.options import unknown_name
from imud.publishers.rules.settings import RulesOptions
from imud.publishers.shm import ShmOptions, directory_problem

log = logging.getLogger(__name__)

EXIT_INTERNAL: Final = 1  # Exit status after an internal error. The log contains the error.
# Exit status if a required output cannot start, for example because another imud uses the socket (EX_TEMPFAIL)
EXIT_OUTPUT: Final = 75
# Exit status for an invalid configuration. A restart does not help (EX_CONFIG, sysexits.h).
EXIT_CONFIGURATION: Final = 78
DEFAULT_FILE = Path("/etc/imud.yaml")


def run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_FILE, metavar="FILE",
        help="configuration file (default: %(default)s)",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Run the daemon until SIGTERM or SIGINT. docs/operate.md lists the exit statuses."""
    try:
        settings = config.load(args.config, missing="name the file with --config")
    except ConfigError as error:
        refuse(error)
        return EXIT_CONFIGURATION
    with log_to(STDERR, settings.log_level):
        deadline = EndDeadline(STOP_LIMIT_S)
        try:
            event_loop.run(serve(settings, args.config, deadline))
        except ServerError as error:
            log.critical("%s", error)
            return EXIT_OUTPUT
        except ImudError:
            raise
        except (Exception, SystemExit):  # top level of the daemon: log the error and set the exit status
            log.critical("imud stops because of an internal error", exc_info=True)
            return EXIT_INTERNAL
        finally:
            deadline.cancel()
    return 0


def refuse(error: ConfigError) -> None:
    """Report the problems of the configuration: to the journal with a priority, otherwise to standard error."""
    if not is_journal(STDERR):
        complain(str(error))
        return
    with log_to(STDERR, "info"):
        # one journal entry per problem
        for problem in str(error).splitlines():
            log.critical("%s", problem)


def check_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="configuration file, or - for standard input")


def check(args: argparse.Namespace) -> int:
    """Print one line if the file is valid, and notes. Return 1 if a driver or output of another package has a problem,
    otherwise 0. Raises ConfigError with line and column if the file is invalid or does not fit the host."""
    is_standard_input = args.file == "-"
    content = standard_input() if is_standard_input else config.content_of(args.file)
    filename = "standard input" if is_standard_input else args.file
    settings = config.parse(content, filename)
    errors, host_notes = host_problems(settings, content, filename)
    if errors:
        raise ConfigError("\n".join((*errors, *host_notes)))
    names = ", ".join(device.name for device in settings.devices) or "none"
    print(f"{args.file}: valid; devices: {names}")
    for device in settings.devices:
        for note in (*limits_of(device), *absent_capture(device)):
            print(f"{args.file}:{device.line}: note: {device.name}: {note}")
    for note in (*unknown_devices(settings), *rules_without_values(settings), *missing_directories(settings)):
        print(f"{args.file}: note: {note}")
    for note in host_notes:
        print(note)
    for problem in settings.ignored:
        complain(problem)
    return 1 if settings.ignored else 0


def host_problems(settings: Config, content: bytes, filename: str) -> tuple[list[str], list[str]]:
    """Return the values of a configuration that do not fit this host: errors and notes, each with its line."""
    tree = read_yaml(content)
    errors: list[str] = []
    notes: list[str] = []
    for finding in host_values.findings(settings, Host(time.time())):
        mark = tree.mark(finding.path)
        place = f"{filename}:{mark.line}:{mark.column}:"
        text = f"{path_text(finding.path)}: {finding.message}"
        if finding.is_error:
            errors.append(f"{place} {text}")
        else:
            notes.append(f"{place} note: {text}")
    return errors, notes


def unknown_devices(settings: Config) -> Iterator[str]:
    """Yield a note for each unknown device in the configuration of an output."""
    known = [*(device.name for device in settings.devices), *settings.disabled]
    for output, part in settings.publishers.items():
        for key in ("device", "devices"):
            given = getattr(part, key, None)
            for name in [given] if isinstance(given, str) else given or ():
                if name not in (*known, EVERY):
                    yield f"{output}.{key}: {unknown_name('a device', name, known)}"


def rules_without_values(settings: Config) -> Iterator[str]:
    """Yield a note for each rule that needs a field which the driver of a device never sends."""
    rules = settings.publishers.get("rules")
    for name, rule in rules.rules.items() if isinstance(rules, RulesOptions) else ():
        for device in settings.devices:
            driver = DRIVERS.get(device.driver)
            is_named = rule.devices is None or device.name in rule.devices
            if driver is not None and is_named and rule.field in driver.never_sends:
                yield f"rules.rules.{name}: {device.name} never sends {rule.field}; the rule has no effect for it"


def missing_directories(settings: Config) -> Iterator[str]:
    """Yield a note if `imud run` of this user cannot create shared memory."""
    shm = settings.publishers.get("shm")
    if isinstance(shm, ShmOptions) and shm.enabled and (problem := directory_problem(shm.directory, os.environ)):
        yield f"shm: {problem}; ignore this note if another user runs the daemon"


def limits_of(device: DeviceConfig) -> Sequence[str]:
    """Return a sentence for each configured function that the device does not support."""
    if device.driver not in DRIVERS:
        return ()
    return DRIVERS[device.driver].limits(
        declared_values(device.declared), device.lines or DeviceLines(), device.rmc is not None
    )


def absent_capture(device: DeviceConfig) -> Sequence[str]:
    """Return a note if the capture of a replay does not exist."""
    # no note for a missing port: ports often appear later
    path = getattr(device.link_settings, "path", "") if device.link == "replay" else ""
    return (f"{path} does not exist; imud waits for the file",) if path and not Path(path).exists() else ()


def standard_input() -> bytes:
    return sys.stdin.buffer.read(FILE_BYTES_MAX + 1)  # one more byte: the reader then reports a file that is too long


async def serve(settings: Config, file: Path, deadline: EndDeadline) -> None:
    """Run the daemon with its signal handlers. `deadline` limits the time of its stop."""

    def on_stopping(error: BaseException | None) -> None:
        deadline.status = 0 if error is None else EXIT_INTERNAL
        deadline.start()

    daemon = Daemon(settings, file=file, state_dir=state_dir(settings))
    daemon.install_signals()
    await daemon.run(on_stopping)


def state_dir(settings: Config) -> Path:
    """Return the state directory of the service manager if it is set, otherwise the configured directory."""
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]  # systemd separates several directories with ":"
    return Path(given or settings.state_dir)


RUN = CliCommand(run_arguments, run)
CHECK = CliCommand(check_arguments, check)
