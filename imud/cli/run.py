"""`imud run`: the daemon in the foreground, as the service manager starts it; `imud check`: its configuration alone."""

import argparse
import asyncio
import logging
import os
from pathlib import Path

from imud import config
from imud.cli.arguments import CliCommand
from imud.config import Config
from imud.daemon import Daemon

DEFAULT_FILE = Path("/etc/imud.yaml")


def run_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud run`."""
    parser.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_FILE, metavar="FILE", help="configuration (default: %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Run until SIGTERM or SIGINT."""
    settings = config.load(args.config)
    start_log(settings.log_level)
    asyncio.run(serve(settings, args.config))
    return 0


def check_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud check`."""
    parser.add_argument("file", type=Path, metavar="FILE", help="configuration file")


def check(args: argparse.Namespace) -> int:
    """Print one line when the file is good; the error with line and column goes to standard error."""
    settings = config.load(args.file)
    names = ", ".join(device.name for device in settings.devices) or "none"
    print(f"{args.file}: good; devices: {names}")
    return 0


async def serve(settings: Config, file: Path) -> None:
    """Run the daemon with its signals installed."""
    daemon = Daemon(settings, file=file, state_dir=state_dir(settings))
    daemon.install_signals()
    await daemon.run()


def state_dir(settings: Config) -> Path:
    """Choose the service manager's state directory if it gave one, else the configured one."""
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(given or settings.state_dir)


def start_log(level: str) -> None:
    """Log to standard error, without the time under a service manager, whose journal adds it."""
    stamp = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    logging.basicConfig(level=level.upper(), format=stamp + "%(levelname)s %(message)s")


RUN = CliCommand(run_arguments, run)
CHECK = CliCommand(check_arguments, check)
