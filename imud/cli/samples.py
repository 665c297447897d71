"""`imud watch`: print samples as they come; `imud schema`: what their fields mean, in which units and frames."""

import argparse
from collections.abc import Mapping, Sequence
from contextlib import suppress
from time import monotonic
from typing import Any, Final, Protocol

import msgspec

from imud.cli.arguments import CliCommand, add_socket, connect
from imud.cli.output import shortened, table
from imud.cli.streams import complain
from imud.contracts.status import DeviceState
from imud.devices import DRIVERS
from imud.frames.conventions import Convention
from imud.sample import SAMPLE_SCHEMA, Sample
from imud.units import NS_PER_MS, NS_PER_S, RAD_PER_DEG

NAME_WIDTH: Final = 10
ERROR_LARGE_MS: Final = 100.0
"""From here on, ms without decimals."""
LOOK_S: Final = 2.0
"""Time between two looks at the states of the watched devices."""
FIELD_HEAD: Final = ("FIELD", "TYPE", "UNIT", "FRAME", "MEANING")
DRIVER_HEAD: Final = ("DRIVER", "NAVIGATION FRAME", "EULER ANGLES")
STATUS_HEAD: Final = ("DRIVER", "STATUS BIT", "MEANING WHILE IT IS SET")


def watch_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud watch`."""
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to watch (default: all)")
    parser.add_argument(
        "--rate", type=float, default=None, metavar="HZ", help="at most this many samples a second each"
    )
    parser.add_argument(
        "--convention", choices=[str(one) for one in Convention], default=None,
        help="axes and angles of the samples (default: as configured)",
    )  # fmt: skip
    parser.add_argument(
        "--latency", type=float, default=None, metavar="MS",
        help="samples may be so late, which costs less CPU (default: a period of the rate, at most 20; without one, 0)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one JSON object per line, SI units")
    parser.add_argument("--count", type=int, default=None, metavar="N", help="stop after N samples")


def watch(args: argparse.Namespace) -> int:
    """Print until interrupted, until N samples came, or until the daemon ends."""
    show = as_json if args.json else as_text
    with connect(args) as client:
        samples = client.watch(
            args.device or None, rate_hz=args.rate, timeout_s=LOOK_S, convention=args.convention,
            latency_ms=args.latency,
        )  # fmt: skip
        states = DeviceNotes(client, args.device)
        shown = 0
        while args.count is None or shown < args.count:
            states.look(monotonic())
            with suppress(TimeoutError):  # silence: its reason is looked for
                print(show(next(samples)), flush=True)
                shown += 1
    return 0


class DeviceLister(Protocol):
    """What lists the devices of a daemon, as `imud.client.Client` does."""

    def devices(self) -> Sequence[Mapping[str, Any]]:
        """Each with its name, state and problem."""
        ...


class DeviceNotes:
    """Lines on standard error for devices that are watched and send no samples now, with the reason."""

    def __init__(self, client: DeviceLister, names: Sequence[str]) -> None:
        """No `names` are all devices."""
        self._client = client
        self._names = list(names)
        self._due_s = 0.0
        self._noted: dict[str, str] = {}

    def look(self, now_s: float) -> None:
        """Ask for the devices, once in LOOK_S at most, and note what has changed."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + LOOK_S
        found = {str(device["name"]): device for device in self._client.devices()}
        for name in self._names or sorted({*found, *self._noted}):
            words = _why_silent(found[name]) if name in found else "not in the configuration any more"
            if words != self._noted.get(name, ""):
                complain(f"imud watch: {name} is {words or 'running'}")
            self._noted[name] = words


def _why_silent(device: Mapping[str, Any]) -> str:
    """Describe state and problem of a device; empty for one that runs."""
    state, problem = device["state"], device["problem"]
    return "" if state == DeviceState.RUNNING else f"{state}: {problem}" if problem else str(state)


def as_json(sample: Sample) -> str:
    """Format a sample as the socket sends it."""
    return msgspec.json.encode(sample).decode()


def as_text(sample: Sample) -> str:
    """Format a sample as at most two lines of 80 columns: seconds, degrees, °/s; acceleration stays in m/s²."""
    name = shortened(sample.device, NAME_WIDTH)
    error_ms = sample.t_err_ns / NS_PER_MS
    error = f"{error_ms:6.3f}" if error_ms < ERROR_LARGE_MS else f"{error_ms:6.0f}"
    first = [f"{name:{NAME_WIDTH}} {sample.t_ns / NS_PER_S:14.6f} s ±{error} ms {sample.sync:10}"]
    if sample.euler_rad is not None:
        first.append("rpy " + " ".join(f"{a / RAD_PER_DEG:7.2f}" for a in sample.euler_rad) + " °")
    second = []
    if sample.gyro_rad_s is not None:
        second.append("gyro " + " ".join(f"{w / RAD_PER_DEG:8.2f}" for w in sample.gyro_rad_s) + " °/s")
    if sample.accel_m_s2 is not None:
        second.append("accel " + " ".join(f"{a:7.3f}" for a in sample.accel_m_s2) + " m/s²")
    lines = ["  ".join(first).rstrip(), *(["    " + "  ".join(second)] if second else [])]
    return "\n".join(lines)


def schema_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud schema`."""
    parser.add_argument("--json", action="store_true", help="one JSON object")


def schema(args: argparse.Namespace) -> int:
    """Print the fields and each driver's conventions. Needs no daemon."""
    bits = {name: {str(n): bit.name for n, bit in driver.status_bits.items()} for name, driver in DRIVERS.items()}
    conventions = {
        name: {
            "navigation_frame": driver.navigation_frame,
            "euler_convention": driver.euler_convention,
            "status_bits": bits[name],
        }
        for name, driver in DRIVERS.items()
    }
    if args.json:
        print(msgspec.json.encode({"fields": SAMPLE_SCHEMA, "drivers": conventions}).decode())
        return 0
    print(table(FIELD_HEAD, [(f.name, f.type, f.unit, f.frame, f.meaning) for f in SAMPLE_SCHEMA]))
    print()
    print(table(DRIVER_HEAD, [(name, c["navigation_frame"], c["euler_convention"]) for name, c in conventions.items()]))
    print()
    print(table(STATUS_HEAD, [(name, n, words) for name, named in bits.items() for n, words in named.items()]))
    return 0


WATCH = CliCommand(watch_arguments, watch)
SCHEMA = CliCommand(schema_arguments, schema)
