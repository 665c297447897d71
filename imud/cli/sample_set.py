"""Samples for an analysis, from a recording, a capture or a running daemon, with their source and the lost samples."""

import argparse
import sys
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from math import nan
from time import monotonic
from typing import Final

import numpy as np

from imud import config
from imud.analysis.series import FloatArray, Readings
from imud.cli.arguments import connect, statuses
from imud.cli.replay import (
    BAUD,
    DRIVER,
    check,
    configuration,
    has_times,
    looks_like_recording,
    others_of,
    problem_of,
    serve,
)
from imud.contracts.driver import CanDriver, DataSheet
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.daemon import Daemon
from imud.drivers import DRIVERS
from imud.formats.recording import RecordingReader
from imud.formats.records import Kind
from imud.host import event_loop
from imud.host.files import open_regular
from imud.host.log import STDERR, log_to
from imud.model.errors import BadArgument, ImudError
from imud.model.event import Event
from imud.model.ledger import LOST_FIELDS
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.recording.player import PlayedDevice, Player

# Maximum number of samples: 14 hours at 400 Hz. They use 1.3 GB, and the analysis uses the same amount again.
SAMPLES_MOST: Final = 20_000_000
SILENCE_S: Final = 5.0  # time without a sample after which imud reports a silent device, s
# Accepted latency of live samples, ms. The daemon then sends batches, which cost less CPU time.
LATENCY_MS: Final = 200.0
NOTE_S: Final = 1.0  # time between two progress updates, s
_NONE3: Final = (nan, nan, nan)


@dataclass(slots=True)
class SampleSet:
    """Samples of one device and their source."""

    source: str  # name of the file, or the socket of the daemon
    device: str = ""
    driver: str = ""
    link: str = ""
    identity: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    begun_utc_ns: int | None = None  # UTC of the first sample, ns; None if the capture contains no times
    readings: Readings | None = None
    lost: dict[str, int] = field(default_factory=dict)  # number of lost samples by cause, without causes of 0 samples
    stamps: str = ""  # sources and errors of the time stamps, as text
    notes: list[str] = field(default_factory=list)  # additional notes for the report

    @property
    def sheet(self) -> DataSheet:
        """Values of the vendor's manual."""
        return DRIVERS[self.driver].data_sheet if self.driver in DRIVERS else DataSheet()


class Collector:
    """Collector of the samples of one device. The class is also a publisher for the daemon of a replay.

    The collector ignores samples in the first `skip_s`, and stops after `for_s` more.
    """

    def __init__(self, name: str = "", *, skip_s: float = 0.0, for_s: float | None = None) -> None:
        self.name = name  # name of the device; empty for the first device that sends a sample
        self.others: set[str] = set()  # names of ignored devices if the user did not choose a device
        self.done = False  # whether the collector received samples after the end of the requested time
        self.first: Sample | None = None
        self.newest: Sample | None = None
        self.syncs: Counter[str] = Counter()
        self.by_device_time = False  # whether the times are device times
        # Callback after the first collected batch and after the end of the requested time, to count lost samples
        self.look: Callable[[], None] = lambda: None
        self._chosen = bool(name)
        self._skip_ns, self._for_ns = round(skip_s * NS_PER_S), None if for_s is None else round(for_s * NS_PER_S)
        self._begin_ns: int | None = None
        self._errors_ns = 0
        self._times = array("q")
        self._gyro, self._accel, self._euler, self._temperature = array("d"), array("d"), array("d"), array("d")

    def __len__(self) -> int:
        return len(self._times)

    def add(self, sample: Sample) -> None:
        """Collect one sample. Raises BadArgument for more than SAMPLES_MOST samples."""
        if self.done:
            return
        if not self.name:
            self.name = sample.device
        if sample.device != self.name:
            if not self._chosen:
                self.others.add(sample.device)
            return
        t_ns = sample.t_dev_ns if self.by_device_time else sample.t_ns
        if t_ns is None:
            raise BadArgument("the capture contains neither arrival times nor device times; use a time-stamped capture")
        if self._begin_ns is None:
            self._begin_ns = t_ns + self._skip_ns
        if t_ns < self._begin_ns:
            return
        if self._for_ns is not None and t_ns - self._begin_ns > self._for_ns:
            self.done = True
            return
        if len(self._times) >= SAMPLES_MOST:
            raise BadArgument(f"expected at most {SAMPLES_MOST} samples; select a part with --skip and --for")
        self._keep(sample, t_ns)

    def _keep(self, sample: Sample, t_ns: int) -> None:
        self.first = self.first or sample
        self.newest = sample
        self.syncs[str(sample.sync)] += 1
        self._errors_ns += sample.t_err_ns
        self._times.append(t_ns)
        # NaN keeps the arrays at equal length
        self._gyro.extend(sample.gyro_rad_s or _NONE3)
        self._accel.extend(sample.accel_m_s2 or _NONE3)
        self._euler.extend(sample.euler_rad or _NONE3)
        self._temperature.append(nan if sample.temperature_c is None else sample.temperature_c)

    def drop_before(self, t_ns: int) -> None:
        """Remove the samples before a time."""
        count = int(np.searchsorted(np.frombuffer(self._times, dtype=np.int64), t_ns)) if self._times else 0
        del self._times[:count], self._temperature[:count]
        del self._gyro[: 3 * count], self._accel[: 3 * count], self._euler[: 3 * count]

    def readings(self) -> Readings:
        """Return the collected samples as arrays."""
        temperature = np.array(self._temperature)
        return Readings(
            np.array(self._times, dtype=np.int64), _sensor(self._gyro), _sensor(self._accel),
            temperature if np.isfinite(temperature).any() else None, _sensor(self._euler),
        )  # fmt: skip

    def stamps(self) -> str:
        """Describe the sources and the mean error of the time stamps."""
        if self.by_device_time:
            return (
                "device time, because the capture contains no arrival times; the error of the device's crystal is the "
                "error of the rate"
            )
        kinds = ", ".join(f"{100 * count / len(self):.3g} % {kind}" for kind, count in self.syncs.most_common())
        return f"{kinds}; mean time stamp error {self._errors_ns / max(len(self), 1) / 1000:.3g} µs"

    # --- methods of a publisher; most do nothing ----------------------------------------------------------------------

    def publish(self, batch: Batch) -> None:
        """Collect the samples of a batch."""
        before = self.first, self.done
        for sample in batch.samples:
            self.add(sample)
        if (self.first, self.done) != before:
            self.look()

    def start(self) -> None: ...

    def add_device(self, name: str, device_id: int) -> None: ...

    def remove_device(self, name: str) -> None: ...

    def event(self, event: Event) -> None: ...

    def tick(self, now_ns: int) -> None: ...

    def close(self) -> None: ...


class LossTally:
    """Counter of the lost samples of a device, by cause, between the first and the last `look`."""

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()  # number of lost samples by the names of the ledger
        self._newest: Mapping[str, int] | None = None

    @property
    def begun(self) -> bool:
        """Whether `look` was called."""
        return self._newest is not None

    def look(self, ledger: Mapping[str, int]) -> None:
        """Add the samples that were lost since the previous call."""
        before = self._newest if self._newest is not None else ledger
        if ledger.get("samples", 0) < before.get("samples", 0):  # the ledger restarted
            before = {}
        self.lost.update({name: ledger.get(name, 0) - before.get(name, 0) for name in LOST_FIELDS})
        self._newest = ledger

    def found(self) -> dict[str, int]:
        """Return the number of lost samples by cause, without causes of 0 samples."""
        return {name: count for name, count in self.lost.items() if count}


def _sensor(values: "array[float]") -> FloatArray | None:
    found = np.array(values).reshape(-1, 3)
    return found if np.isfinite(found).any() else None


# --- files ------------------------------------------------------------------------------------------------------------


def take_file(args: argparse.Namespace) -> SampleSet:
    """Read the samples of a recording or a capture. Raises ImudError, also if there is no sample, and OSError."""
    with log_to(STDERR, "error"):
        sample_set = take_recording(args) if looks_like_recording(args.input) else take_capture(args)
    if sample_set.readings is None or not len(sample_set.readings.t_ns):
        after = f" of {args.device}" if args.device else ""
        after += f" after the first {args.skip:g} s (--skip)" if args.skip else ""
        raise ImudError(
            f"{args.input}: found no samples{after}; check a recording with `imud info`, a capture with `imud decode`"
        )
    return sample_set


def take_recording(args: argparse.Namespace) -> SampleSet:
    """Replay a recording. The time stamps are equal to the live run."""
    for option, default in (("driver", None), ("option", []), ("baud", None), ("interface", None)):
        if getattr(args, option) != default:
            raise BadArgument(f"--{option} applies to captures only; a recording contains the value of the live run")
    collector = Collector(args.device or "", skip_s=args.skip or 0.0, for_s=args.duration)
    sample_set, tally = SampleSet(args.input), LossTally()
    with open_regular(args.input) as file:
        player = Player(collector.publish)
        reader = RecordingReader(file, args.input)

        def look() -> None:
            if (device := played(player, collector.name)) is not None and collector.first is not None:
                tally.look(device.ledger.snapshot())

        collector.look = look
        for record in reader:
            if record.kind == Kind.PATH:  # the record can restart the ledger
                look()
            player.play((record,))
            if record.kind in (Kind.PATH, Kind.CHECK):
                look()
            # with several devices, `others` causes an error below
            if collector.done or collector.others:
                break
        if not collector.done:
            look()
    names = list(dict.fromkeys(device.described.name for device in player.all_devices))
    if collector.others:
        raise BadArgument(f"{args.input} contains several devices: {', '.join(names)}; select one with --device")
    if args.device and args.device not in names:
        there = ", ".join(names) or "none, because the block with the device names is damaged or missing"
        raise BadArgument(f"--device {args.device}: expected a device of the recording: {there}")
    _describe(sample_set, player, collector.name)
    sample_set.notes += list(reader.problems)
    if player.lost:
        sample_set.notes.append(f"the recorder dropped {player.lost} records")
    return _finished(sample_set, collector, tally.found())


def played(player: Player, name: str) -> PlayedDevice | None:
    """Return the newest device of this name; None before the player found it."""
    return next((device for device in reversed(player.all_devices) if device.described.name == name), None)


def _describe(sample_set: SampleSet, player: Player, name: str) -> None:
    """Copy the description of the device and notes about the replay."""
    if (device := played(player, name)) is None:
        return
    sample_set.driver = device.driver.name if device.driver is not None else device.described.driver
    sample_set.link, sample_set.identity = device.described.where, device.described.identity
    sample_set.settings = device.described.settings
    sample_set.notes += [f"clock: {why}" for why in device.fresh_starts[:1]]
    if device.different_checks:
        sample_set.notes.append(f"replay: {device.different_checks} of {device.checks} checks differ")


def take_capture(args: argparse.Namespace) -> SampleSet:
    """Replay a capture through the daemon."""
    replayed = argparse.Namespace(
        file=args.input, driver=args.driver or DRIVER, speed="maximum", baud=args.baud or BAUD, socket=None,
        option=args.option, interface=args.interface,
    )  # fmt: skip
    settings = config.parse(configuration(replayed), str(args.input))
    check(settings.devices[0])
    collector = Collector(skip_s=args.skip or 0.0, for_s=args.duration)
    collector.by_device_time = not has_times(replayed)
    daemon = Daemon(settings, extra={"collect": collector}, until_finished=True)
    tally = LossTally()
    collector.look = lambda: tally.look(daemon.status()[0].ledger)
    event_loop.run(serve(daemon))
    if not collector.done:
        collector.look()
    status = daemon.status()[0]
    sample_set = SampleSet(args.input, driver=status.driver, link=status.link, identity=status.identity)
    sample_set.settings = status.settings
    driver = DRIVERS[replayed.driver]
    others = others_of(replayed, driver) if isinstance(driver, CanDriver) else ""
    sample_set.notes += filter(None, (problem_of(replayed)[0], status.problem, others))
    finished = _finished(sample_set, collector, tally.found())
    finished.device, finished.begun_utc_ns = args.device or "capture", None
    return finished


def _finished(sample_set: SampleSet, collector: Collector, lost: dict[str, int]) -> SampleSet:
    sample_set.device, sample_set.lost = collector.name, lost
    sample_set.readings, sample_set.stamps = collector.readings(), collector.stamps() if len(collector) else ""
    sample_set.begun_utc_ns = collector.first.utc_ns if collector.first is not None else None
    return sample_set


# --- a running daemon -------------------------------------------------------------------------------------------------


def take_live(
    args: argparse.Namespace, note: Callable[[float, int], None] = lambda _passed_s, _count: None
) -> SampleSet:
    """Collect the samples of the device `args.input` for `args.duration`, or until Ctrl-C.

    If the device becomes silent, keep the samples and wait until the end of `args.duration`. Call `note` about once per
    second with the elapsed time and the number of samples. Raises BadArgument if no sample arrives at all.
    """
    with connect(args) as asking, connect(args) as listening:
        before = status_of(statuses(asking), args.input)
        collector = Collector(args.input, skip_s=args.skip or 0.0, for_s=args.duration)
        samples = listening.watch([args.input], timeout_s=SILENCE_S, latency_ms=LATENCY_MS)
        tally = LossTally()
        # without --skip, losses count from the start
        if not args.skip:
            tally.look(before.ledger)
        begun = noted = monotonic()
        with suppress(KeyboardInterrupt):
            for sample in heard(samples, args.input):
                if sample is None:
                    if args.duration is not None and monotonic() - begun >= args.duration + (args.skip or 0.0):
                        break
                    continue
                collector.add(sample)
                # with --skip, losses count from the first collected sample
                if not tally.begun and collector.first is not None:
                    tally.look(status_of(statuses(asking), args.input).ledger)
                now = monotonic()
                if now - noted >= NOTE_S:
                    noted = now
                    note(now - begun, len(collector))
                if collector.done:
                    break
        after = status_of(statuses(asking), args.input)
        sample_set = sample_set_of(after, args.socket)
        dropped = samples.dropped.get(args.input, 0)
    if tally.begun:
        tally.look(after.ledger)
    lost = tally.found()
    return _finished(sample_set, collector, lost | ({"dropped": dropped} if dropped else {}))


def heard(samples: Iterator[Sample], name: str) -> Iterator[Sample | None]:
    """Yield the samples, and None after each SILENCE_S without a sample. Raises BadArgument if no sample arrives."""
    silent = True
    while True:
        try:
            sample = next(samples)
        except TimeoutError:
            if silent:
                raise BadArgument(f"{name} sends no samples; find the reason with `imud status`") from None
            yield None
        except StopIteration:
            return
        else:
            silent = False
            yield sample


def status_of(found: Iterable[DeviceStatus], name: str) -> DeviceStatus:
    """Return the status of a device. Raises BadArgument if the device is unknown."""
    known = {status.name: status for status in found}
    if name not in known:
        raise BadArgument(f"{name}: expected a file, or a device of the daemon ({', '.join(known) or 'none'})")
    return known[name]


def sample_set_of(status: DeviceStatus, socket: str) -> SampleSet:
    """Return a SampleSet without samples for a live device."""
    return SampleSet(f"live from {socket}", status.name, status.driver, status.link, status.identity, status.settings)


def progress(passed_s: float, count: int) -> None:
    """Print the progress on a terminal. The next call replaces the line."""
    if sys.stderr.isatty():
        print(f"{passed_s:.0f} s, {count} samples", end="\r", file=sys.stderr, flush=True)
