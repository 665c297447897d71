"""`imud doctor`: run all checks, print what was found; the exit status says how bad it is.

Nothing is changed and no port is opened. It runs with the daemon up or down, as any user; what a user may not see is
listed as not checked.
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Final

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.doctor import access, buses, can, host, kernel_log, outputs, serial_ports, service, traffic
from imud.cli.doctor.finding import DoctorCheck
from imud.cli.doctor.report import as_json, examine, exit_status, page
from imud.cli.doctor.surroundings import Surroundings, ask_daemon
from imud.cli.run import DEFAULT_FILE

CHECKS: Final = (
    DoctorCheck("configuration", service.configuration),
    DoctorCheck("service", service.service),
    DoctorCheck("socket", service.socket),
    DoctorCheck("stale configuration", service.stale_configuration),
    DoctorCheck("devices", service.device_states),
    DoctorCheck("ports", serial_ports.ports_present),
    DoctorCheck("rights", access.rights),
    DoctorCheck("rules of the unit", access.unit_rules),
    DoctorCheck("ports taken", serial_ports.ports_taken),
    DoctorCheck("ModemManager", serial_ports.modem_manager),
    DoctorCheck("latency timer", serial_ports.latency_timer),
    DoctorCheck("serial data", traffic.heard),
    DoctorCheck("RS-485", traffic.half_duplex),
    DoctorCheck("restarts", traffic.restarts),
    DoctorCheck("CAN interfaces", can.can_up),
    DoctorCheck("CAN state", can.can_state),
    DoctorCheck("CAN bit rate", can.can_bitrate),
    DoctorCheck("bus nodes", buses.bus_nodes),
    DoctorCheck("I2C", buses.i2c_transfers),
    DoctorCheck("SPI", buses.spi_transfers),
    DoctorCheck("lines", traffic.lines),
    DoctorCheck("clock", host.host_clock),
    DoctorCheck("storage", host.storage),
    DoctorCheck("power", host.power),
    DoctorCheck("processor", host.processor),
    DoctorCheck("kernel log", kernel_log.kernel_log),
    DoctorCheck("shared memory", outputs.shared_memory),
    DoctorCheck("Prometheus", outputs.prometheus),
)
"""In the order in which they are explained by one another; docs/doctor.md has them all."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud doctor`."""
    add_socket(parser)
    parser.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_FILE, metavar="FILE", help="configuration (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="for programs: every check with its findings")


def run(args: argparse.Namespace) -> int:
    """Print the findings; 0 for nothing wrong, 1 for warnings, 2 for errors."""
    at = Surroundings(args.config.absolute(), partial(ask_daemon, args.socket))
    examined = examine(CHECKS, at)
    sys.stdout.write((as_json(examined).decode() if args.json else page(examined)) + "\n")
    return exit_status(examined)


DOCTOR = CliCommand(add_arguments, run)
