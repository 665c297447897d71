"""`imud firmware`: write a firmware file to a device of the running daemon, and verify the version."""

import argparse
import os
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import Final, TextIO
from zlib import crc32

from intelhex import IntelHex, IntelHexError

from imud.cli.arguments import CliCommand, add_socket
from imud.client.connection import Client, decoded
from imud.contracts.firmware import IMAGE_BYTES_MAX, TOTAL_S, FirmwareImage, FirmwareResult
from imud.host.files import read_regular
from imud.host.log import printable_json
from imud.model.errors import BadArgument, reason_of
from imud.model.event import Event, EventKind

FILE_BYTES_MAX: Final = 8 << 20  # Maximum length of a file. 1 MiB in lines with one byte each has 7 MiB.
LIMIT_S: Final = TOTAL_S + 120.0  # Time limit of the request, s. The daemon ends every update earlier.
LOOK_S: Final = 0.5  # Maximum wait for the next event, s. After that, imud checks for the reply.
BAR: Final = 30  # length of the progress bar, characters
CLEAR_LINE: Final = "\r\x1b[2K"
KIND, DATA, END_OF_FILE = slice(7, 9), "00", "01"  # place of the kind in a record, and two kinds
FRAME_DIGITS: Final = 11  # number of characters of a record without data


def firmware_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument("device", metavar="DEVICE", help="name of the device")
    parser.add_argument("file", metavar="FILE", type=Path, help="firmware of the vendor, an Intel HEX file")
    parser.add_argument("--product", metavar="NAME", help="product of the firmware, if the file does not name it")
    parser.add_argument("--version", metavar="VERSION", help="version of the firmware, for example 1.7.0, to verify it")
    parser.add_argument("--yes", action="store_true", help="start without a question, for scripts")
    parser.add_argument("--json", action="store_true", help="print the events and the result as JSON lines")


def firmware(args: argparse.Namespace) -> int:
    """Update a device. Return 0 if imud verified the version, otherwise 1. Requires the right to control devices."""
    image = read_image(args.file)
    named = ", ".join(image.products()) or "no product"
    if not args.json:
        print(
            f"{args.file}: {len(image.data)} bytes at {image.address:#010x} … {image.end - 1:#010x}; it names {named}\n"
            f"{args.device} sends no samples during the update. Do not remove its power or its cable."
        )
    if not args.yes and not _agreed():
        print("imud changed nothing")
        return 1
    with Client(args.socket) as watching:
        result = _follow(args, image, watching)
    print(printable_json(result) if args.json else _account(result))
    return 0 if result.verified else 1


def read_image(path: Path) -> FirmwareImage:
    """Read an Intel HEX file. Gaps contain 0xFF, as erased flash memory.

    Raises BadArgument for another, damaged or truncated file.
    """
    try:
        content = read_regular(path, FILE_BYTES_MAX + 1)
    except OSError as error:
        raise BadArgument(f"cannot read {path}: {reason_of(error)}") from None
    return parse_image(content, path)


def parse_image(content: bytes, path: Path) -> FirmwareImage:
    """Decode an Intel HEX file. `path` is for messages. Raises BadArgument as `read_image`."""
    if len(content) > FILE_BYTES_MAX:
        raise BadArgument(f"{path}: expected at most {FILE_BYTES_MAX} bytes, got a longer file")
    lines = content.decode("latin-1").split("\n")
    records = [line.strip() for line in lines if line.strip()]
    if not records or not records[0].startswith(":"):
        raise BadArgument(
            f"{path}: expected an Intel HEX file, got another file: its first line does not start with `:`"
        )
    *before, last_kind = (record[KIND] for record in records)
    if last_kind != END_OF_FILE or END_OF_FILE in before:
        raise BadArgument(f"{path}: expected one end record `:00000001FF` at the end, got a truncated or joined file")
    count = sum(len(record) - FRAME_DIGITS for record in records if record[KIND] == DATA) // 2
    if count > IMAGE_BYTES_MAX:
        raise BadArgument(f"{path}: expected at most {IMAGE_BYTES_MAX} bytes of data, got {count}")
    hexadecimal = IntelHex()
    try:
        hexadecimal.loadhex(StringIO("\n".join(records)))
    except IntelHexError as error:
        raise BadArgument(f"{path}: {str(error)[:200]}; get the file again") from None
    first, last = hexadecimal.minaddr(), hexadecimal.maxaddr()
    if first is None or last is None:
        raise BadArgument(f"{path}: expected data, got a file without data")
    if last - first >= IMAGE_BYTES_MAX:
        raise BadArgument(
            f"{path}: expected addresses within {IMAGE_BYTES_MAX} bytes, got {first:#010x} … {last:#010x}"
        )
    return FirmwareImage(first, hexadecimal.tobinstr(start=first, end=last))


def _agreed() -> bool:
    """Ask the user to start. Raises BadArgument if standard input is not a terminal."""
    if not sys.stdin.isatty():
        raise BadArgument("cannot ask for confirmation without a terminal; confirm with --yes")
    return input("Start the update? [y/N] ").strip().lower() in ("y", "yes")


def _follow(args: argparse.Namespace, image: FirmwareImage, watching: Client) -> FirmwareResult:
    """Send the image and run the update. Print the events of the device until the reply arrives."""
    events = watching.events([args.device], timeout_s=LOOK_S)
    # a second connection: the request blocks its connection until the update ends
    with Client(args.socket, timeout_s=LIMIT_S) as asking, ThreadPoolExecutor(1) as pool:
        asking.call("firmware.open", size_bytes=len(image.data))
        fd = asking.descriptor("firmware.open")
        try:
            done = 0
            while done < len(image.data):
                done += os.pwrite(fd, image.data[done:], done)
        finally:
            os.close(fd)
        reply: Future[object] = pool.submit(
            asking.call, "firmware.update", device=args.device, address=image.address, crc32=crc32(image.data),
            product=args.product, version=args.version,
        )  # fmt: skip
        try:
            while not reply.done():
                with suppress(TimeoutError):
                    _show(next(events), sys.stdout, as_json=args.json)
        except KeyboardInterrupt:
            print("\nthe update continues in the daemon; watch it with `imud events`", file=sys.stderr)
            asking.close()
            raise
        finally:
            if not args.json and sys.stdout.isatty():
                sys.stdout.write("\n")
        return decoded(reply.result(), FirmwareResult, "firmware.update")


def _show(event: Event, out: TextIO, *, as_json: bool) -> None:
    if event.kind is not EventKind.FIRMWARE:
        return
    progress = event.detail.get("progress")
    if as_json:
        print(printable_json(event), file=out, flush=True)
    elif out.isatty() and isinstance(progress, float) and event.detail.get("phase") != "end":
        filled = int(progress * BAR)
        out.write(f"{CLEAR_LINE}[{'#' * filled}{'.' * (BAR - filled)}] {progress:4.0%}  {event.message}")
        out.flush()
    else:
        print(event.message, file=out, flush=True)


def _account(result: FirmwareResult) -> str:
    """Format the result as text."""
    words = "verified" if result.verified else "NOT verified"
    return f"{words}: {result.evidence}\n  {result.size_bytes} bytes in {result.duration_s:.1f} s"


FIRMWARE = CliCommand(firmware_arguments, firmware)
