"""`imud status`: state, rate, clock, losses and ledger of each device."""

import argparse
from collections.abc import Mapping, Sequence
from time import monotonic_ns

import msgspec

from imud.bridges.status import rows
from imud.cli.arguments import CliCommand, add_socket, connect
from imud.cli.output import paragraph
from imud.client.connection import decoded
from imud.contracts.status import CKernelStatus, DeviceStatus, MqttStatus
from imud.host.log import printable_json
from imud.model.errors import BadArgument
from imud.model.options import unknown_name


class _Reply(msgspec.Struct):
    """Printed members of the status."""

    devices: list[DeviceStatus]
    mqtt: list[MqttStatus] = []
    outputs: dict[str, str] = {}
    c_kernel: CKernelStatus | None = None  # None from a daemon of an older version


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to print (default: all)")
    parser.add_argument("--json", action="store_true", help="print the complete status, as the socket sends it")


def run(args: argparse.Namespace) -> int:
    """Print one block per device. Return 1 if the condition of a device is not ok, otherwise 0."""
    with connect(args) as client:
        answer = client.status()
    if args.device:
        known = [str(one["name"]) for one in answer["devices"]]
        if unknown := [name for name in args.device if name not in known]:
            raise BadArgument(unknown_name("a device", unknown[0], known))
        answer = {**answer, "devices": [one for one in answer["devices"] if one["name"] in args.device]}
    reply = decoded(answer, _Reply)
    if args.json:
        print(printable_json(answer))
    else:
        print(page(reply.devices, reply.mqtt, reply.outputs, reply.c_kernel))
    return 1 if any(device.has_problem for device in reply.devices) else 0


def page(
    devices: Sequence[DeviceStatus],
    mqtts: Sequence[MqttStatus] = (),
    outputs: Mapping[str, str] = {},
    c_kernel: CKernelStatus | None = None,
) -> str:
    """Format the blocks of all devices, the problems of the outputs, and the use of the C kernel."""
    parts = [block(device) for device in devices]
    for mqtt in mqtts:
        problems = [one for one in (mqtt.problem, mqtt.spool_problem, mqtt.limit) if one]
        problems += [f"the broker refuses messages of {topic}: {reason}" for topic, reason in mqtt.refused.items()]
        parts += ["\n".join(paragraph("mqtt: ", problem)) for problem in problems]
    parts += ["\n".join(paragraph(f"{name}: ", problem)) for name, problem in outputs.items()]
    if c_kernel is not None:
        use = "active" if c_kernel.active else f"not active: {c_kernel.problem}"
        parts.append("\n".join(paragraph("C kernel: ", use)))
    return "\n\n".join(parts)


def block(status: DeviceStatus, without_times: str = "", *, virtual: bool = False) -> str:
    """Format the block of one device in 80 columns.

    `without_times`: the reason why times are unknown; the block then contains no rate, clock or latency. `virtual`: a
    replay at maximum speed; the block then contains no measured rate and no latency.
    """
    found = dict(rows(status))
    if virtual:
        found["rate"] = f"{status.expected_rate_hz:.1f} Hz by the device's clock"
        del found["latency"]
    if not status.ledger["samples"]:
        without_times = without_times or "no sample yet"
    if without_times:
        timeless = {name: text for name, text in found.items() if name not in ("rate", "clock", "latency")}
        found = {"times": without_times, **timeless}
    lines = paragraph(f"{status.name}: ", status.word)
    if status.work is not None:
        lines += paragraph("  ", status.work.words(monotonic_ns()))
    for reason in status.reasons:
        lines += paragraph("  ", f"{reason.message} {reason.next}".rstrip())
    if status.problem and status.condition is None:
        lines += paragraph("  ", status.problem)
    for name, text in found.items():
        lines += paragraph(f"  {name:<10}", text)
    return "\n".join(lines)


STATUS = CliCommand(add_arguments, run)
