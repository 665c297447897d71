"""`imud export`: samples, losses and events of a recording or a capture as CSV or MCAP."""

import argparse
import os
import stat
import sys
from contextlib import closing, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self

from imud import __version__
from imud.attitude.conventions import Convention
from imud.bridges.json import JsonDialect
from imud.bridges.ros2 import Ros2Dialect
from imud.cli.arguments import (
    CliCommand,
    add_noise,
    add_option,
    chosen_fields,
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
    Sink,
    export_capture,
    export_recording,
    recorded_noise,
    times_of,
)
from imud.cli.output import complain
from imud.cli.replay import looks_like_recording
from imud.contracts.status import Deviations
from imud.drivers import DRIVERS
from imud.host.files import WRITE_FLAGS, open_regular
from imud.host.log import STDERR, log_to
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.recording.capture_player import NAME, KnownTimes

MODE: Final = 0o666
"""Of a new file, from which the umask takes its bits."""


class ExportFile:
    """The output of one export. As a context: what is written until an error is removed, unless it went to a pipe.

    A file grows under another name in the same folder, and gets its own when it is whole: a program that waits for it
    never sees half of it, and a killed export leaves nothing that could be taken for one.
    """

    def __init__(self, path: Path | None, *, source: Path, force: bool, binary: bool) -> None:
        """None is standard output. Raises BadArgument where the file must not be written, or a terminal gets bytes."""
        self.written_bytes = 0
        self.name = "standard output" if path is None else str(path)
        """For people."""
        self._path: Path | None = None
        """The file to be; None where it is written in place."""
        self._part: Path | None = None
        self._file = self._open(path, source, force, binary)

    def write(self, data: bytes) -> None:
        """Append bytes. Raises ImudError where the disk is full or fails, BrokenPipeError where nobody reads."""
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
                raise BadArgument("-o: expected a file, or a pipe on standard output; MCAP is not for terminals")
            return sys.stdout.buffer
        try:
            there = path.stat()
        except FileNotFoundError:
            there = None
        except OSError as error:
            raise self._failure(error) from error
        if there is not None and stat.S_ISREG(there.st_mode):
            if path.samefile(source):
                raise BadArgument(f"-o {path}: expected another file than the one that is exported")
            if not force:
                raise BadArgument(f"-o {path}: expected no file of this name, there is one; --force replaces it")
        try:
            if there is not None and not stat.S_ISREG(there.st_mode):
                return path.open("wb", buffering=0)  # a FIFO or a device
            self._path = path
            self._part = path.with_name(f".{path.name}.{os.getpid()}.part")
            return open(os.open(self._part, WRITE_FLAGS, MODE), "wb", buffering=0)
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
        return ImudError(f"{self.name}: {reason_of(error)}; nothing is left of this export")


FORMATS: Final = ("csv", "mcap")
SCHEMAS: Final = ("json", "ros2")
DRIVER: Final = "hipnuc-uart"
BAUD: Final = 115200
MEGABYTE: Final = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud export`."""
    parser.add_argument(
        "file", type=Path, metavar="FILE",
        help="recording of imud; or a capture, raw or time-stamped; for CAN a log of candump -L",
    )  # fmt: skip
    parser.add_argument("--to", choices=FORMATS, required=True, help="format")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT", help="file to write, whole or not at all (default: standard output)"
    )
    parser.add_argument("--force", action="store_true", help="replace OUT if it is there")
    parser.add_argument(
        "--device", action="append", default=[], metavar="NAME", help="only this one; may be given several times"
    )
    parser.add_argument(
        "--fields", metavar="NAME,…",
        help="columns of CSV; channels of MCAP that say something of one of them (default: all; `imud schema` lists)",
    )  # fmt: skip
    parser.add_argument("--table", choices=TABLES, help="rows of CSV (default: samples)")
    parser.add_argument("--schema", choices=SCHEMAS, help="messages of MCAP (default: json)")
    parser.add_argument(
        "--convention", choices=[str(one) for one in Convention],
        help="axes and angles (default: of CSV as they were published, of MCAP enu-flu as of REP-103)",
    )  # fmt: skip
    add_noise(parser)
    parser.add_argument("--driver", choices=sorted(DRIVERS), help=f"of a capture (default: {DRIVER})")
    parser.add_argument("--baud", type=int, help=f"rate of a raw capture (default: {BAUD})")
    add_option(parser)


def run(args: argparse.Namespace) -> int:
    """Export; what came of it goes to standard error. 1 where `imud replay` of the same file says 1."""
    check(args)
    args.fields = None if args.fields is None else chosen_fields(args.fields)
    is_recording = _is_recording(args)
    with log_to(STDERR, "warning"), open_regular(args.file) as file:
        progress = Progress(args.file.stat().st_size)
        out = ExportFile(args.output, source=args.file, force=args.force, binary=args.to == "mcap")
        with closing(progress), out, closing(_sink(args, file, out, is_recording=is_recording)) as sink:
            convention = _convention(args)
            feed = ExportFeed(sink, file, progress, convention)
            done = _play(args, file, feed, is_recording=is_recording)
            sink.finish()
    size = f"{out.written_bytes / MEGABYTE:.1f} MB"
    complain(f"{done.report}\n\n{feed.samples_taken} samples to {out.name}, {size} in {progress.spent_s:.1f} s")
    return done.status if feed.samples_taken else 1


def check(args: argparse.Namespace) -> None:
    """Raises BadArgument for options that mean nothing together."""
    for option, to in (("table", "csv"), ("schema", "mcap")):
        if getattr(args, option) is not None and args.to != to:
            raise BadArgument(f"--{option}: expected with --to {to} only, got --to {args.to}")
    if args.noise and args.to != "mcap":
        raise BadArgument(f"--noise: expected with --to mcap only, got --to {args.to}")
    if args.fields is not None and args.table not in (None, "samples"):
        raise BadArgument(f"--fields: expected with samples only, got --table {args.table}")


def _is_recording(args: argparse.Namespace) -> bool:
    """Raises ImudError for a file that is not there, BadArgument for options of captures with a recording."""
    try:
        found = looks_like_recording(str(args.file))
    except OSError as error:
        raise ImudError(f"{args.file}: expected a recording or a capture: {reason_of(error)}") from error
    for option, default in (("option", []), ("driver", None), ("baud", None)):
        if found and getattr(args, option) != default:
            raise BadArgument(f"--{option}: expected none with a recording, which has that of the live run")
    if not found and args.device:
        raise BadArgument("--device: expected with a recording only; a capture is of one device")
    return found


def _convention(args: argparse.Namespace) -> Convention | None:
    if args.convention is not None:
        return Convention(args.convention)
    return Convention.ENU_FLU if args.to == "mcap" else None


def _sink(args: argparse.Namespace, file: BinaryIO, out: ExportFile, *, is_recording: bool) -> Sink:
    if args.to == "csv":
        times = None if is_recording else times_of(file, DRIVERS[args.driver or DRIVER])
        return CsvSink(out, args.table or "samples", args.fields, without_times=times is KnownTimes.NONE)
    try:
        from imud.bridges.mcap import McapFile
    except ModuleNotFoundError as error:
        library = (error.name or "a library").partition(".")[0]
        raise BadArgument(
            f"--to mcap: cannot import {library}; install the extra: pip install 'imud[export]'"
        ) from None
    dialect = Ros2Dialect() if args.schema == "ros2" else JsonDialect()
    convention = _convention(args)
    assert convention is not None
    words = {"imud": __version__, "source": args.file.name, "convention": str(convention)}
    if not is_recording:
        words["times"] = (times_of(file, DRIVERS[args.driver or DRIVER]) or KnownTimes.HOST).value
    noise = recorded_noise(file, str(args.file)) if is_recording else {}
    for device, given in noise_by_device(args.noise).items():
        name = device if is_recording else NAME  # whatever it was called where the report was made
        noise[name] = noise.get(name, Deviations()).updated(given)
    made = McapFile(out, dialect.profile, f"imud {__version__}", words)
    return McapSink(made, dialect, convention, args.fields, noise)


def _play(args: argparse.Namespace, file: BinaryIO, feed: ExportFeed, *, is_recording: bool) -> Exported:
    if is_recording:
        return export_recording(file, args.file, feed, args.device)
    driver = DRIVERS[args.driver or DRIVER]
    options = driver_settings(driver, given_options(driver, args.option))
    return export_capture(file, args.file, feed, driver, options, args.baud or BAUD)


EXPORT = CliCommand(add_arguments, run)
