"""Checks of the samples of one device: the attitude against gravity at rest, and the status bits.

The check of the attitude uses one sample per second, and pauses after a rest without contradiction. Each kind of
contradiction between attitude and gravity raises one event per path. The status shows the contradiction until a later
rest without contradiction.
"""

from collections.abc import Mapping
from typing import Final

from imud.attitude.conventions import EULER_WORDS, HOST_NAVIGATION_WORDS, AttitudeSource, Convention, Heading
from imud.attitude.gravity import Contradiction, GravityCheck
from imud.attitude.published import PublishedAxes
from imud.config.model import DeviceConfig
from imud.contracts.driver import Driver, StatusBit, status_bits_of
from imud.contracts.status import FrameProblem, FrameStatus
from imud.device.health import DeviceEvents
from imud.device.settings import DeviceSettings
from imud.model.event import EventKind
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.path import SamplePath

# Minimum time between two checked samples, ns. A window of `GravityCheck` needs five samples in 5 s.
CHECK_NS: Final = NS_PER_S - 50 * NS_PER_MS
AGAIN_NS: Final = 60 * NS_PER_S  # time between two windows at rest without contradiction, ns
AS_DEVICE = "device"  # name of the convention if none is configured


class AttitudeWatch:
    """Check of the published attitude of one device. Synchronization: the loop's thread only."""

    def __init__(self, config: DeviceConfig, events: DeviceEvents) -> None:
        self._config = config
        self._events = events
        self._frame: PublishedAxes | None = None
        self._path: SamplePath | None = None
        self._check: GravityCheck | None = None
        self._raised: set[Contradiction] = set()
        self._due_ns = 0

    def tick(self, now_ns: int, path: SamplePath) -> None:
        """Check the newest sample. Raise an event for the first contradiction of each kind."""
        if path is not self._path or path.frame is not self._frame:
            self._path, self._frame, self._check = path, path.frame, self._new_check(path)
            self._raised.clear()
            self._due_ns = 0
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + CHECK_NS
        check, sample = self._check, path.newest
        if check is None or sample is None or not check.add(sample):
            return
        finding = check.finding
        if finding is None:
            self._due_ns = now_ns + AGAIN_NS
            return
        if finding.kind not in self._raised:
            self._raised.add(finding.kind)
            self._events.raise_event(
                now_ns,
                EventKind.ATTITUDE,
                finding.message,
                contradiction=str(finding.kind),
                angle_deg=round(finding.angle_deg, 1),
            )

    def status(self, driver: Driver | None, path: SamplePath | None, settings: DeviceSettings) -> FrameStatus | None:
        """Return axes and angles of the published samples; None before imud has found the device."""
        if driver is None or path is None:
            return None
        frame, config, sent = path.frame, self._config, driver.sent_axes(settings.shown)
        kind, problem = self.problem(driver, settings, sent.problem)
        is_host = config.attitude is AttitudeSource.HOST
        words = (
            frame.words(EULER_WORDS[Convention.ENU_FLU], HOST_NAVIGATION_WORDS)
            if is_host else frame.words(sent.euler_convention, sent.navigation_frame)
        )  # fmt: skip
        return FrameStatus(
            frame=words.frame,
            convention=AS_DEVICE if frame.convention is None else str(frame.convention),
            euler_convention=words.euler_convention,
            navigation_frame=words.navigation_frame,
            heading=Heading.RELATIVE if is_host else frame.heading(driver.heading(config.options, settings.values)),
            attitude=config.attitude,
            declination_deg=frame.declination_deg,
            conventions={str(one): frame.words_of(one) for one in Convention},
            problem=problem,
            problem_kind=kind,
        )

    def _new_check(self, path: SamplePath) -> GravityCheck:
        frame, configured = path.frame, self._config.frame
        is_level = configured is not None and configured.level_at_rest
        return GravityCheck(frame.device, frame.mounting if is_level else None)

    def problem(self, driver: Driver | None, settings: DeviceSettings, axes: str) -> tuple[FrameProblem | None, str]:
        """Return the kind of the present contradiction and its text. `axes`: the problem of the driver."""
        finding = self._check.finding if self._check is not None else None
        if driver is None:
            return None, ""
        if finding is not None:
            return FrameProblem.GRAVITY, finding.message
        config = self._config
        if config.declination_deg is not None and (heading := driver.heading(config.options, settings.values)) in (
            Heading.RELATIVE,
            Heading.TRUE,
        ):
            why = (
                "yaw is measured from the direction at power-on"
                if heading is Heading.RELATIVE
                else "yaw is true already"
            )
            return FrameProblem.DECLINATION, f"declination_deg is configured, but {why}"
        return (FrameProblem.AXES, axes) if axes else (None, "")


CLEAR_NS: Final = NS_PER_S  # time without a status bit after which the bit is cleared, ns
INTERVAL_NS: Final = NS_PER_S  # minimum interval of events, ns


class StatusWatch:
    """Check of the notable status bits of one device. Synchronization: the loop's thread only."""

    def __init__(self, events: DeviceEvents, attitude: AttitudeSource = AttitudeSource.DEVICE) -> None:
        self._events = events
        self._attitude = attitude
        self._path: SamplePath | None = None
        self._bits: Mapping[int, StatusBit] = {}
        self._set = 0  # bits that imud has reported as set, as a mask
        self._seen_ns: dict[int, int] = {}  # CLOCK_MONOTONIC of the newest sample with each bit
        self._due_ns = 0

    def tick(self, now_ns: int, driver: Driver | None, path: SamplePath | None) -> None:
        """Check the samples since the last call. Raise an event for changed bits."""
        if driver is None or path is None:
            return
        if path is not self._path:
            self._begin(driver, path)
        if not self._bits:
            return
        seen = path.take_status()
        if not seen and not self._set and not self._seen_ns:
            return
        for number in self._bits:
            if seen >> number & 1:
                self._seen_ns[number] = now_ns
        if now_ns >= self._due_ns:
            self._report(now_ns, is_silent=now_ns - path.last_sample_ns > CLEAR_NS)

    def _begin(self, driver: Driver, path: SamplePath) -> None:
        """Watch the status bits of a new path."""
        self._path = path
        known = status_bits_of(driver, self._attitude)
        self._bits = {number: bit for number, bit in known.items() if bit.notable}
        path.watch_status(sum(1 << number for number in self._bits))
        self._set = 0
        self._seen_ns.clear()

    def _report(self, now_ns: int, *, is_silent: bool) -> None:
        """Raise one event for all changed bits. Without samples the bits keep their state."""
        risen = [n for n in self._bits if not self._set >> n & 1 and n in self._seen_ns]
        fallen = [n for n in self._bits if self._set >> n & 1 and now_ns - self._seen_ns[n] > CLEAR_NS]
        if is_silent or not (risen or fallen):
            return
        for number in fallen:
            del self._seen_ns[number]
        self._set ^= sum(1 << number for number in (*risen, *fallen))
        self._due_ns = now_ns + INTERVAL_NS
        words = [self._bits[n].name for n in risen] + [f"cleared: {self._bits[n].name}" for n in fallen]
        detail = {self._bits[n].name: n in risen for n in (*risen, *fallen)}
        self._events.raise_event(now_ns, EventKind.ALARM, f"status: {', '.join(words)}", **detail)
