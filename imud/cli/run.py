"""`imud run`: the daemon in the foreground, as the service manager starts it; `imud check`: its configuration alone."""

import argparse
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from imud import config
from imud.cli.arguments import CliCommand
from imud.cli.output import complain
from imud.config.model import Config, DeviceConfig
from imud.config.yaml import FILE_BYTES_MAX
from imud.contracts.lines import DeviceLines
from imud.contracts.setting import declared_values
from imud.daemon import Daemon
from imud.drivers import DRIVERS
from imud.fleet.settings import EVERY
from imud.host import event_loop
from imud.host.log import STDERR, is_journal, log_to
from imud.model.errors import ConfigError, ImudError, ServerError
from imud.model.options import unknown_name

log = logging.getLogger(__name__)

EXIT_INTERNAL: Final = 1
"""An internal error, which is in the log."""
EXIT_OUTPUT: Final = 75
"""An output that is required cannot start, for example the socket that another imud has (EX_TEMPFAIL, sysexits.h)."""
EXIT_CONFIGURATION: Final = 78
"""The configuration cannot be used; starting again changes nothing (EX_CONFIG)."""
DEFAULT_FILE = Path("/etc/imud.yaml")


def run_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud run`."""
    parser.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_FILE, metavar="FILE", help="configuration (default: %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Run until SIGTERM or SIGINT. The exit statuses are those of docs/operate.md."""
    try:
        settings = config.load(args.config, missing="give the file with --config")
    except ConfigError as error:
        refuse(error)
        return EXIT_CONFIGURATION
    with log_to(STDERR, settings.log_level):
        try:
            event_loop.run(serve(settings, args.config))
        except ServerError as error:
            log.critical("%s", error)
            return EXIT_OUTPUT
        except ImudError:
            raise
        except Exception:  # the top level of the daemon: the log has it, and the exit status says it
            log.critical("imud ends because of an internal error", exc_info=True)
            return EXIT_INTERNAL
    return 0


def refuse(error: ConfigError) -> None:
    """Say what is wrong with the configuration: with its priority to the journal, else as `imud check` does."""
    if not is_journal(STDERR):
        complain(str(error))
        return
    with log_to(STDERR, "info"):
        for problem in str(error).splitlines():
            log.critical("%s", problem)


def check_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud check`."""
    parser.add_argument("file", metavar="FILE", help="configuration file, or - for standard input")


def check(args: argparse.Namespace) -> int:
    """Print one line when the file is good, and notes; the error with line and column goes to standard error."""
    settings = config.parse(standard_input(), "standard input") if args.file == "-" else config.load(args.file)
    names = ", ".join(device.name for device in settings.devices) or "none"
    print(f"{args.file}: good; devices: {names}")
    for device in settings.devices:
        for note in (*limits_of(device), *absent_capture(device)):
            print(f"{args.file}:{device.line}: note: {device.name}: {note}")
    for note in unknown_devices(settings):
        print(f"{args.file}: note: {note}")
    return 0


def unknown_devices(settings: Config) -> Iterator[str]:
    """Name the devices that outputs are configured for and that the configuration does not have."""
    known = [*(device.name for device in settings.devices), *settings.disabled]
    for output, part in settings.publishers.items():
        for key in ("device", "devices"):
            given = getattr(part, key, None)
            for name in [given] if isinstance(given, str) else given or ():
                if name not in (*known, EVERY):
                    yield f"{output}.{key}: {unknown_name('a device', name, known)}"


def limits_of(device: DeviceConfig) -> Sequence[str]:
    """What the device cannot do of all that its configuration has, a sentence each."""
    if device.driver not in DRIVERS:
        return ()
    return DRIVERS[device.driver].limits(
        declared_values(device.declared), device.lines or DeviceLines(), device.rmc is not None
    )


def absent_capture(device: DeviceConfig) -> Sequence[str]:
    """Say that the recording of a replay is not there, which a port may be for a while and a file seldom is."""
    path = getattr(device.link_settings, "path", "") if device.link == "replay" else ""
    return (f"{path} is not there: imud waits for it",) if path and not Path(path).exists() else ()


def standard_input() -> bytes:
    """Return standard input, no more of it than a configuration may have."""
    return sys.stdin.buffer.read(FILE_BYTES_MAX + 1)


async def serve(settings: Config, file: Path) -> None:
    """Run the daemon with its signals installed."""
    daemon = Daemon(settings, file=file, state_dir=state_dir(settings))
    daemon.install_signals()
    await daemon.run()


def state_dir(settings: Config) -> Path:
    """Choose the service manager's state directory if it gave one, else the configured one."""
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(given or settings.state_dir)


RUN = CliCommand(run_arguments, run)
CHECK = CliCommand(check_arguments, check)
