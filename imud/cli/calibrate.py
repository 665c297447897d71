"""`imud calibrate`: list the calibrations of a device, or guide the user through one calibration."""

import argparse
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Final, TextIO

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.output import local_time, table
from imud.client.connection import Client, decoded
from imud.contracts.command import CalibrationInfo, CalibrationResult, Handling, Kept
from imud.contracts.setting import SAVE_SENT
from imud.host.log import printable_json
from imud.model.errors import BadArgument
from imud.model.event import Event, EventKind
from imud.model.units import RAD_PER_DEG, T_PER_UT

HEAD: Final = ("CALIBRATION", "HANDLING", "RESULT LASTS", "LAST", "EFFECT")
LIMIT_S: Final = 600.0  # Time limit of the request, s. The daemon stops every calibration earlier.
LOOK_S: Final = 0.5  # Maximum wait for the next event, s. After that, imud checks for the reply.
BAR: Final = 30  # length of the progress bar, characters
CLEAR_LINE: Final = "\r\x1b[2K"


def calibrate_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument("device", metavar="DEVICE", help="name of the device")
    parser.add_argument("kind", nargs="?", metavar="KIND", help="calibration to run (default: list all calibrations)")
    parser.add_argument("--save", action="store_true", help="save the result in the device after verification")
    parser.add_argument("--stop", action="store_true", help="stop the running calibration of the device")
    parser.add_argument("--yes", action="store_true", help="start without a question, for scripts")
    parser.add_argument("--json", action="store_true", help="print the events and the result as JSON lines")


def calibrate(args: argparse.Namespace) -> int:
    """Run a calibration. Return 0 if imud verified the result, otherwise 1. Requires the right to control devices."""
    if args.stop and args.kind is not None:
        raise BadArgument(f"expected --stop without a calibration, got {args.kind!r}")
    with Client(args.socket) as watching:
        if args.stop:
            reply = watching.call("stop_calibration", device=args.device)
            stopped = decoded(reply, dict[str, bool], "stop_calibration")["stopped"]
            print("stopped; the device can still finish it" if stopped else f"{args.device} has no running calibration")
            return 0 if stopped else 1
        found = decoded(watching.call("calibrations", device=args.device), list[CalibrationInfo], "calibrations")
        if args.kind is None:
            print(table(HEAD, [(one.kind, one.handling, one.kept, _last(one), one.help) for one in found]))
            return 0
        known = {one.kind: one for one in found}
        if args.kind not in known:
            raise BadArgument(f"unknown calibration {args.kind!r}; {args.device} has: {', '.join(known) or 'none'}")
        if not args.json:
            _instruct(known[args.kind])
        if not args.yes and not _agreed(known[args.kind]):
            print("imud changed nothing")
            return 1
        result = _follow(args, watching)
    print(printable_json(result) if args.json else _account(result, asked_to_save=args.save))
    return 0 if result.verified else 1


def _last(calibration: CalibrationInfo) -> str:
    """Format the result of the last calibration."""
    last = calibration.last
    if last is None:
        return "not done yet"
    saved = "save not verified" if calibration.kept is Kept.BY_SAVE else "saved"
    result = "NOT verified" if not last.verified else f"verified, {saved}" if last.saved else "verified"
    return f"{local_time(last.utc_ns):%Y-%m-%d}, {result}"


def _instruct(calibration: CalibrationInfo) -> None:
    print(f"{calibration.kind}: {calibration.help} (manual, section {calibration.section})")
    for number, sentence in enumerate(calibration.instructions, start=1):
        print(f"  {number}. {sentence}")


def _agreed(calibration: CalibrationInfo) -> bool:
    """Ask the user to start. Raises BadArgument if standard input is not a terminal."""
    if not sys.stdin.isatty():
        raise BadArgument("cannot ask for confirmation without a terminal; confirm with --yes")
    request = (
        "Start to turn the device, then press Enter" if calibration.handling is not Handling.REST else "Press Enter"
    )
    return input(f"{request} to start the calibration, or type n to cancel: ").strip().lower() in ("", "y", "yes")


def _follow(args: argparse.Namespace, watching: Client) -> CalibrationResult:
    """Run the calibration. Print the events of the device until the reply arrives."""
    events = watching.events([args.device], timeout_s=LOOK_S)
    # a second connection: the request blocks its connection until the calibration ends
    with Client(args.socket, timeout_s=LIMIT_S) as asking, ThreadPoolExecutor(1) as pool:
        reply: Future[object] = pool.submit(
            asking.call, "calibrate", device=args.device, kind=args.kind, save=args.save
        )
        try:
            while not reply.done():
                with suppress(TimeoutError):
                    _show(next(events), sys.stdout, as_json=args.json)
        finally:
            if not reply.done():  # Ctrl-C, or the reader of standard output closed the pipe
                watching.call("stop_calibration", device=args.device)
            if not args.json and sys.stdout.isatty():
                sys.stdout.write("\n")
        return decoded(reply.result(), CalibrationResult, "calibrate")


def _show(event: Event, out: TextIO, *, as_json: bool) -> None:
    if event.kind is not EventKind.CALIBRATION:
        return
    if as_json:
        print(printable_json(event), file=out, flush=True)
    elif out.isatty():
        out.write(CLEAR_LINE + progress_line(event))
        out.flush()
    elif event.detail.get("phase") != "turn":  # several events per second: only for the progress bar
        print(event.message, file=out, flush=True)


def progress_line(event: Event) -> str:
    """Format the progress of the rotation as a bar with the measured field. For other events, return the message."""
    progress, field_t, residual = (event.detail.get(name) for name in ("progress", "field_t", "residual"))
    if not isinstance(progress, float):
        return event.message
    # progress is 0 to 1
    filled = int(progress * BAR)
    words = [f"[{'#' * filled}{'.' * (BAR - filled)}] {progress:4.0%}"]
    if isinstance(field_t, float) and isinstance(residual, float):
        words.append(f"field {field_t / T_PER_UT:.1f} µT, residual {residual:.1%}")
    if device := event.detail.get("device"):
        words.append(str(device))
    return "  ".join(words)


def _account(result: CalibrationResult, *, asked_to_save: bool) -> str:
    """Format the result as text."""
    lines = ["verified" if result.verified else f"NOT verified: {result.problem}"]
    if result.device:
        lines.append(f"  device reports: {result.device}")
    for check in result.checks:
        mark = "passed" if check.passed else "NOT passed"
        lines.append(
            f"  {check.name}: {_value(check.value, check.unit)}, limit {_value(check.limit, check.unit)}: {mark}"
        )
    if result.saved:
        lines.append(f"  {SAVE_SENT if result.kept is Kept.BY_SAVE else result.kept}")
    else:
        hint = "" if asked_to_save or not result.verified else "; save it with --save"
        lines.append(f"  not saved: lasts {result.kept}{hint if result.kept is Kept.BY_SAVE else ''}")
    return "\n".join(lines)


def _value(value: float | None, unit: str) -> str:
    """Format a value in everyday units."""
    if value is None:
        return "not reported"
    match unit:
        case "rad":
            return f"{value / RAD_PER_DEG:.3g}°"
        case "rad/s":
            return f"{value / RAD_PER_DEG:.3g} °/s"
        case "T":
            return f"{value / T_PER_UT:.3g} µT"
        # an empty unit is a ratio
        case "":
            return f"{value:.1%}"
    return f"{value:.3g} {unit}"


CALIBRATE = CliCommand(calibrate_arguments, calibrate)
