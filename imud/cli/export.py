"""`imud export`: convert the samples, losses and events of a recording or a capture to CSV or MCAP."""

import argparse
import os
import re
import stat
import sys
from contextlib import closing, suppress
from fcntl import LOCK_EX, LOCK_NB, flock
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self

from imud import __version__
from imud.attitude.conventions import Convention
from imud.bridges.json import JsonDialect
from imud.bridges.ros2 import Ros2Dialect
from imud.cli.arguments import (
    CliCommand,
    add_driver,
    add_interface,
    add_noise,
    add_option,
    chosen_fields,
    chosen_interface,
    driver_settings,
    given_options,
    noise_by_device,
)
from imud.cli.export_sources import (
    TABLES,
    CsvSink,
    Exported,
    ExportFeed,
    McapSink,
    Progress,
    RecordedFacts,
    Sink,
    export_capture,
    export_recording,
    recorded_facts,
    times_of,
)
from imud.cli.output import complain
from imud.cli.replay import BAUD, DRIVER, looks_like_recording
from imud.contracts.driver import CanDriver
from imud.contracts.status import Deviations
from imud.drivers import DRIVERS
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.host.files import READ_FLAGS, WRITE_FLAGS, open_regular
from imud.host.installation import needs_extra
from imud.host.log import STDERR, log_to
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.recording.capture_player import NAME, KnownTimes
from imud.recording.player import RecordedClock

MODE: Final = 0o666  # mode of a new file before the umask


class ExportFile:
    """Output of one export. Used as a context, it removes an incomplete file after an error.

    imud writes a temporary file in the same folder, and renames the complete file. Other programs therefore never see
    an incomplete export.
    """

    def __init__(self, path: Path | None, *, source: Path, force: bool, binary: bool) -> None:
        """`path`: None for standard output. Raises BadArgument if the file exists, or for binary data to a terminal."""
        self.written_bytes = 0
        self.name = "standard output" if path is None else str(path)
        # Final path of the file; None if imud writes directly: to standard output, a FIFO or a device node
        self._path: Path | None = None
        self._part: Path | None = None
        self._file = self._open(path, source, force, binary)

    def write(self, data: bytes) -> None:
        """Append bytes. Raises ImudError if the disk fails, BrokenPipeError if the reader closed the pipe."""
        try:
            self._file.write(data)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise self._failure(error) from error
        self.written_bytes += len(data)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            try:
                self._finish()
            except BrokenPipeError:
                raise
            except OSError as problem:
                self._discard()
                raise self._failure(problem) from problem
        else:
            self._discard()

    def _open(self, path: Path | None, source: Path, force: bool, binary: bool) -> BinaryIO:
        if path is None:
            if binary and sys.stdout.isatty():
                raise BadArgument("cannot write MCAP to a terminal; name a file with -o, or use a pipe")
            return sys.stdout.buffer
        try:
            there = path.stat()
        except FileNotFoundError:
            there = None
        except OSError as error:
            raise self._failure(error) from error
        if there is not None and stat.S_ISREG(there.st_mode):
            if path.samefile(source):
                raise BadArgument(f"-o {path}: this is the input file; name another file")
            if not force:
                raise BadArgument(f"-o {path}: the file exists; replace it with --force")
        try:
            if there is not None and not stat.S_ISREG(there.st_mode):
                return path.open("wb", buffering=0)  # a FIFO or a device node cannot be renamed
            self._path = path
            _remove_stale_parts(path)
            self._part = path.with_name(f".{path.name}.{os.getpid()}.part")
            descriptor = os.open(self._part, WRITE_FLAGS, MODE)
            flock(descriptor, LOCK_EX | LOCK_NB)
            return open(descriptor, "wb", buffering=0)
        except OSError as error:
            raise self._failure(error) from error

    def _finish(self) -> None:
        self._file.flush()
        if self._path is None:
            if self._file is not sys.stdout.buffer:
                self._file.close()
            return
        assert self._part is not None
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self._part, self._path)

    def _discard(self) -> None:
        if self._file is not sys.stdout.buffer:
            with suppress(OSError):
                self._file.close()
        if self._part is not None:
            with suppress(OSError):
                self._part.unlink()

    def _failure(self, error: OSError) -> ImudError:
        return ImudError(f"cannot write {self.name}: {reason_of(error)}; imud removed the incomplete export")


def _remove_stale_parts(path: Path) -> None:
    """Remove the incomplete files of killed exports to `path`. A running export holds the lock of its file."""
    pattern = re.compile(rf"\.{re.escape(path.name)}\.\d+\.part")
    for part in path.parent.iterdir():
        if pattern.fullmatch(part.name) is None:
            continue
        with suppress(OSError):
            descriptor = os.open(part, READ_FLAGS | os.O_NOFOLLOW)
            try:
                flock(descriptor, LOCK_EX | LOCK_NB)
                part.unlink()
            finally:
                os.close(descriptor)


FORMATS: Final = ("csv", "mcap")
SCHEMAS: Final = ("json", "ros2")
MEGABYTE: Final = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", type=Path, metavar="FILE",
        help="recording of imud, raw or time-stamped capture, or for CAN a log of candump -L",
    )  # fmt: skip
    parser.add_argument("--to", choices=FORMATS, help="output format (default: from the name of OUT)")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="output file (default: standard output)")
    parser.add_argument("--force", action="store_true", help="replace OUT if it exists")
    parser.add_argument(
        "--device", action="append", default=[], metavar="NAME",
        help="export this device only; repeat for more devices (default: all devices)",
    )  # fmt: skip
    parser.add_argument(
        "--fields", metavar="NAME,…",
        help="columns of CSV, or MCAP channels that contain one of these fields (default: all; list: `imud schema`)",
    )  # fmt: skip
    parser.add_argument("--table", choices=TABLES, help="rows of CSV (default: samples)")
    parser.add_argument("--schema", choices=SCHEMAS, help="message format of MCAP (default: json)")
    parser.add_argument(
        "--convention", choices=[str(one) for one in Convention],
        help="convention of axes and angles (default: CSV as published, MCAP enu-flu as in REP-103)",
    )  # fmt: skip
    add_noise(parser)
    add_driver(parser, f"driver for a capture (default: {DRIVER})")
    parser.add_argument("--baud", type=int, help=f"baud rate of a raw capture (default: {BAUD})")
    add_option(parser)
    add_interface(parser)


def run(args: argparse.Namespace) -> int:
    """Export the file. Print the report to standard error. Return the exit status that `imud replay` would return."""
    check(args)
    args.fields = None if args.fields is None else chosen_fields(args.fields)
    is_recording = _is_recording(args)
    with log_to(STDERR, "warning"), open_regular(args.file) as file:
        progress = Progress(args.file.stat().st_size)
        out = ExportFile(args.output, source=args.file, force=args.force, binary=args.to == "mcap")
        with closing(progress), out:
            facts = recorded_facts(file, str(args.file)) if is_recording else RecordedFacts({}, RecordedClock())
            with closing(_sink(args, file, out, facts.noise, is_recording=is_recording)) as sink:
                feed = ExportFeed(sink, file, progress, _convention(args), facts.clock)
                done = _play(args, file, feed, is_recording=is_recording)
                sink.finish()
    size = f"{out.written_bytes / MEGABYTE:.1f} MB"
    complain(f"{done.report}\n\n{feed.samples_taken} samples to {out.name}, {size} in {progress.spent_s:.1f} s")
    return done.status if feed.samples_taken else 1


def check(args: argparse.Namespace) -> None:
    """Find the output format. Raise BadArgument if it is unknown, and for options that exclude each other."""
    if args.to is None:
        args.to = args.output.suffix.removeprefix(".").lower() if args.output is not None else ""
        if args.to not in FORMATS:
            wanted = " or ".join(f".{name}" for name in FORMATS)
            got = args.output or "standard output"
            raise BadArgument(f"expected --to, or an output file with the suffix {wanted}, got {got}")
    for option, to in (("table", "csv"), ("schema", "mcap")):
        if getattr(args, option) is not None and args.to != to:
            raise BadArgument(f"--{option} applies to --to {to} only, got --to {args.to}")
    if args.noise and args.to != "mcap":
        raise BadArgument(f"--noise applies to --to mcap only, got --to {args.to}")
    if args.fields is not None and args.table not in (None, "samples"):
        raise BadArgument(f"--fields applies to --table samples only, got --table {args.table}")


def _is_recording(args: argparse.Namespace) -> bool:
    """Return whether the file is a recording. Raises ImudError if it does not exist, BadArgument for wrong options."""
    try:
        found = looks_like_recording(str(args.file))
    except OSError as error:
        raise ImudError(f"{args.file}: expected a recording or a capture: {reason_of(error)}") from error
    for option, default in (("option", []), ("driver", None), ("baud", None), ("interface", None)):
        if found and getattr(args, option) != default:
            raise BadArgument(f"--{option} applies to captures only; a recording contains the value of the live run")
    if not found and args.device:
        raise BadArgument("--device applies to recordings only; a capture contains one device")
    return found


def _convention(args: argparse.Namespace) -> Convention | None:
    if args.convention is not None:
        return Convention(args.convention)
    return Convention.ENU_FLU if args.to == "mcap" else None


def _sink(
    args: argparse.Namespace, file: BinaryIO, out: ExportFile, noise: dict[str, Deviations], *, is_recording: bool
) -> Sink:
    if args.to == "csv":
        times = None if is_recording else times_of(file, DRIVERS[args.driver or DRIVER])
        return CsvSink(out, args.table or "samples", args.fields, without_times=times is KnownTimes.NONE)
    with needs_extra("export"):
        from imud.bridges.mcap import McapFile
    dialect = Ros2Dialect() if args.schema == "ros2" else JsonDialect()
    convention = _convention(args)
    assert convention is not None
    words = {"imud": __version__, "source": args.file.name, "convention": str(convention)}
    if not is_recording:
        words["times"] = (times_of(file, DRIVERS[args.driver or DRIVER]) or KnownTimes.HOST).value
    for device, given in noise_by_device(args.noise).items():
        name = device if is_recording else NAME  # a capture does not contain the name of its device
        noise[name] = noise.get(name, Deviations()).updated(given)
    made = McapFile(out, dialect.profile, f"imud {__version__}", words)
    return McapSink(made, dialect, convention, args.fields, noise)


def _play(args: argparse.Namespace, file: BinaryIO, feed: ExportFeed, *, is_recording: bool) -> Exported:
    if is_recording:
        return export_recording(file, args.file, feed, args.device)
    driver = DRIVERS[args.driver or DRIVER]
    options = driver_settings(driver, given_options(driver, args.option))
    interface = chosen_interface(driver, args.interface)
    reader = CandumpReader(file, interface) if isinstance(driver, CanDriver) else CaptureReader(file)
    return export_capture(reader, args.file, feed, driver, options, args.baud or BAUD)


EXPORT = CliCommand(add_arguments, run)
