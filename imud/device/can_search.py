"""Detection of the devices on a CAN bus, without I/O and without reads of the clock. The detection sends no frame.

`node_of` of each driver returns the possible sender of a frame. Each (driver, node) gets a trial codec with
`node_settings(node)`, which decodes all frames that pass its filters. The search accepts a device after LOCK_SAMPLES
measurements, and only if it has fewer damaged frames. A round lasts LISTEN_NS, so that it receives all devices of the
bus. With doubtful candidates it lasts up to PATIENCE_NS: a device at 1 Hz with several frames per sample needs some
periods.

The search is successful if exactly one accepted device is not used by another configured device. It chooses the device
of the last successful search immediately.

The search cannot find a device that only sends on request (CANopen TPDOs by SYNC, J1939). The user must configure it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from imud.contracts.codec import CodecEvent
from imud.contracts.driver import CanDriver
from imud.device.search import GaveUp, Listen, SearchRound
from imud.formats.can import CanFilter, CanFrame
from imud.formats.j1939 import pgn_name, split
from imud.host.clock import HostClock
from imud.model.errors import DriverFailed
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S

LOCK_SAMPLES: Final = 2  # minimum number of measurements of an accepted device
LISTEN_NS: Final = 1500 * NS_PER_MS
"""Minimum duration of a round, ns: one frame at 1 Hz, the lowest rate in the manuals."""
PATIENCE_NS: Final = 6 * NS_PER_S  # maximum duration of a round with doubtful candidates, ns
DEVICES_MAX: Final = 128  # maximum number of candidates. More candidates are noise or another protocol.
IDENTIFIERS_MAX: Final = 4096  # maximum number of stored identifiers
SHOWN_MAX: Final = 8  # maximum number of identifiers in a message

Identifier = tuple[int, bool]  # identifier of a frame, and whether it has 29 bits
Claimed = Callable[[int, bool], bool]  # test of an identifier: whether a configured device uses it


def none_claimed(_can_id: int, _extended: bool) -> bool:
    """Return False: no other device is configured."""
    return False


class CanDevice(NamedTuple):
    """A device on a bus with the number that its driver uses."""

    driver: CanDriver
    node: int

    @property
    def title(self) -> str:
        """Title, for example `imu61x-can base_id 101`."""
        return f"{self.driver.name} {self.driver.node_title(self.node)}"


@dataclass(frozen=True, slots=True)
class CanFound:
    """Result of a search: the device."""

    device: CanDevice


CanStep = Listen | CanFound | GaveUp


class CanSurvey:
    """Devices that send on a bus. Synchronization: one thread."""

    def __init__(self, drivers: Sequence[CanDriver]) -> None:
        self._drivers = tuple(drivers)
        self._trials: dict[tuple[str, int], _Trial] = {}
        # Candidates that receive a frame, by identifier. Each received identifier is a key.
        self._listeners: dict[Identifier, tuple[_Trial, ...]] = {}
        self.failures: dict[str, str] = {}  # problem of each driver of another package that failed

    def on_frames(self, frames: Sequence[CanFrame]) -> None:
        """Process frames in the order of arrival."""
        for frame in frames:
            try:
                self._on_frame(frame)
            except DriverFailed as error:
                self._remove_driver(error)

    def flush(self) -> None:
        """Process pending frames at the end of a round."""
        for trial in list(self._trials.values()):
            try:
                trial.count(trial.codec.flush())
            except DriverFailed as error:
                self._remove_driver(error)

    def _on_frame(self, frame: CanFrame) -> None:
        if frame.after_loss:
            for trial in self._trials.values():
                trial.codec.reset()
        self._look_for_devices(frame)
        for trial in self._listening(frame):
            trial.count(trial.codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns))

    def _remove_driver(self, error: DriverFailed) -> None:
        """Continue without a driver of another package that failed. The frame counts for no device."""
        self.failures[error.driver] = str(error)
        self._drivers = tuple(driver for driver in self._drivers if driver.name != error.driver)
        self._trials = {key: trial for key, trial in self._trials.items() if key[0] != error.driver}
        self._listeners.clear()

    def devices(self, claimed: Claimed = none_claimed) -> list[CanDevice]:
        """Return the accepted devices that no configured device uses, in the order of their first frames."""
        return [trial.device for trial in self._trials.values() if trial.accepted and not trial.has_any(claimed)]

    def doubtful(self, claimed: Claimed = none_claimed) -> list[CanDevice]:
        """Return candidates that are not accepted and have a frame that no accepted device sends."""
        known = {i for trial in self._trials.values() if trial.accepted for i in trial.identifiers}
        return [
            trial.device
            for trial in self._trials.values()
            if not trial.accepted and not trial.has_any(claimed) and not trial.identifiers <= known
        ]

    def others(self, claimed: Claimed = none_claimed) -> list[str]:
        """Return the names of the frames without candidate and without configured device."""
        free = (i for i, trials in self._listeners.items() if not trials and not claimed(*i))
        return [_frame_name(*identifier) for identifier in sorted(free)]

    def _look_for_devices(self, frame: CanFrame) -> None:
        for driver in self._drivers:
            node = driver.node_of(frame.can_id, frame.extended, frame.data)
            if node is None:
                continue
            trial = self._trials.get((driver.name, node))
            if trial is None:
                if len(self._trials) >= DEVICES_MAX:
                    continue
                trial = self._begin(CanDevice(driver, node))
            trial.identifiers.add((frame.can_id, frame.extended))

    def _begin(self, device: CanDevice) -> "_Trial":
        trial = self._trials[device.driver.name, device.node] = _Trial(device)
        for identifier, trials in self._listeners.items():
            if trial.hears(identifier):
                self._listeners[identifier] = (*trials, trial)
        return trial

    def _listening(self, frame: CanFrame) -> "tuple[_Trial, ...]":
        identifier = (frame.can_id, frame.extended)
        trials = self._listeners.get(identifier)
        if trials is None:
            trials = tuple(trial for trial in self._trials.values() if trial.hears(identifier))
            if len(self._listeners) < IDENTIFIERS_MAX:
                self._listeners[identifier] = trials
        return trials


class CanSearch:
    """Search on one bus. Synchronization: one thread. All times are CLOCK_MONOTONIC in ns."""

    def __init__(
        self,
        drivers: Sequence[CanDriver],
        where: str,
        *,
        claimed: Claimed = none_claimed,
        remembered: tuple[str, int] | None = None,
    ) -> None:
        """`where` is the name of the bus. `remembered` is (driver name, node) of the last successful search.

        The search calls `claimed` at each decision, because its result can change.
        """
        self.survey = CanSurvey(drivers)
        self._where = where
        self._claimed = claimed
        self._remembered = remembered
        self._begun_ns = self._until_ns = 0

    def start(self, now_ns: int) -> Listen:
        self._begun_ns = now_ns
        return self._listen(now_ns)

    def on_frames(self, frames: Sequence[CanFrame]) -> CanFound | None:
        """Process frames. Return None to continue."""
        self.survey.on_frames(frames)
        if self._remembered is None:
            return None
        for device in self.survey.devices(self._claimed):
            if (device.driver.name, device.node) == self._remembered:
                return CanFound(device)
        return None

    def on_time(self, now_ns: int) -> CanStep | None:
        if now_ns < self._until_ns:
            return None
        self.survey.flush()
        devices = self.survey.devices(self._claimed)
        if self.survey.doubtful(self._claimed) and now_ns - self._begun_ns < PATIENCE_NS:
            return self._listen(now_ns)
        return CanFound(devices[0]) if len(devices) == 1 else GaveUp(self.summary())

    def summary(self) -> str:
        """Return the reason for no result."""
        return "; ".join([self._result(), *self.survey.failures.values()])

    def _result(self) -> str:
        survey, where = self.survey, self._where
        if devices := survey.devices(self._claimed):
            return f"{len(devices)} devices send on {where}: {_listed(devices)}; configure driver and options"
        if doubtful := survey.doubtful(self._claimed):
            found = _listed(doubtful)
            return f"frames of {found} arrive on {where}, but no complete sample; configure driver and options"
        if others := survey.others(self._claimed):
            more = f" and {len(others) - SHOWN_MAX} more" if len(others) > SHOWN_MAX else ""
            names = ", ".join(others[:SHOWN_MAX])
            return f"frames of unknown types arrive on {where} ({names}{more}); configure driver and options"
        if survey.others() or survey.devices() or survey.doubtful():
            return f"only frames of other configured devices arrive on {where}; check the power supply of the device"
        return f"no frame arrives on {where}; check the bit rate, the termination and the power supply of the device"

    def _listen(self, now_ns: int) -> Listen:
        self._until_ns = now_ns + LISTEN_NS
        return Listen(self._until_ns)


class _Trial:
    """Candidate with its codec."""

    def __init__(self, device: CanDevice) -> None:
        settings = device.driver.node_settings(device.node)
        self.device = device
        self.ledger = Ledger()
        self.codec = device.driver.make_codec(self.ledger, settings)
        self.identifiers: set[Identifier] = set()  # identifiers of the frames that name the device
        self._filters = device.driver.filters(settings)
        self._samples = 0

    @property
    def accepted(self) -> bool:
        """Whether the candidate is a device."""
        return self._samples >= LOCK_SAMPLES and self._samples > self.ledger.frames_bad()

    def count(self, events: Sequence[CodecEvent]) -> None:
        """Count the measurements of the codec."""
        for event in events:
            self._samples += isinstance(event, Measurement)

    def hears(self, identifier: Identifier) -> bool:
        """Return whether the codec receives such frames."""
        return any(wanted.matches(*identifier) for wanted in self._filters)

    def has_any(self, claimed: Claimed) -> bool:
        """Return whether a configured device uses a frame of the candidate."""
        return any(claimed(*identifier) for identifier in self.identifiers)


def _frame_name(can_id: int, extended: bool) -> str:
    """Return the PGN and the source of a frame with 29 bits, and the identifier of a frame with 11 bits."""
    return f"{pgn_name(split(can_id).pgn)} from source {can_id & 0xFF}" if extended else f"0x{can_id:03X}"


def _listed(devices: Sequence[CanDevice]) -> str:
    return ", ".join(device.title for device in devices)


EVERYTHING: Final = (CanFilter(0, 0, False), CanFilter(0, 0, True))  # filters that pass every data frame


class CanRound(SearchRound[CanFound]):
    """Search round on a CAN bus."""

    def __init__(self, search: CanSearch, ledger: Ledger, host: HostClock) -> None:
        super().__init__(ledger, host)
        self._search = search

    def on_frames(self, frames: Sequence[CanFrame]) -> None:
        """Process all frames of the bus. The ledger counts their bytes as skipped."""
        self._count(sum(len(frame.data) for frame in frames))
        if not self._done.done():
            self._follow(self._search.on_frames(frames))

    def _first(self, now_ns: int) -> Listen:
        return self._search.start(now_ns)

    def _due(self, now_ns: int) -> CanStep | None:
        return self._search.on_time(now_ns)

    def _listen(self, step: Listen) -> None:
        """Do nothing: the filters of the link pass all frames."""
