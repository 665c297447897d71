"""Diagnoses of devices: state, losses and error of the time stamps, with a level as diagnostic_msgs has it.

    LiveDiagnosis      of the daemon's status, once a second
    RecordedDiagnosis  of what a recording has: events, ledgers and samples, once in a second of the recording

| level | live | recorded |
|---|---|---|
| OK | running, or a replay at its end | samples come |
| WARN | searching; or running with something to look at: lost samples, a low rate, axes, lines | lost samples |
| ERROR | missing or failed | after an event `down` with one of these states |
| STALE | silent, or the daemon cannot be read | silent by such an event; no sample for STALE_S while others send |
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from imud.bridges.channel import Diagnoses, Diagnosis, DiagnosisLevel, LossCounts, StampedEvent
from imud.contracts.status import DeviceState, DeviceStatus
from imud.event import Event, EventKind
from imud.ledger import LOST_FIELDS
from imud.sample import Sample
from imud.units import NS_PER_S

PERIOD_NS: Final = NS_PER_S
"""Time between two diagnoses in a file: that of diagnostic_updater."""
LOSS_SHOWN_NS: Final = 10 * NS_PER_S
"""How long a loss is a warning: a person who looks away for a moment still sees it."""
STALE_S: Final = 5
"""Without samples for so long, while others send, a recorded device is stale: as long as viewers wait for diagnoses."""
RATE_LEAST: Final = 0.95
"""Of the expected rate; the alert ImudRateLow has the same bound."""


LEVEL_OF: Final = {
    DeviceState.RUNNING: DiagnosisLevel.OK,
    DeviceState.FINISHED: DiagnosisLevel.OK,
    DeviceState.SEARCHING: DiagnosisLevel.WARN,
    DeviceState.MISSING: DiagnosisLevel.ERROR,
    DeviceState.FAILED: DiagnosisLevel.ERROR,
    DeviceState.SILENT: DiagnosisLevel.STALE,
}


class LiveDiagnosis:
    """Diagnoses of a running daemon's devices. Synchronization: one thread."""

    def __init__(self) -> None:
        self._losses: dict[str, _LossWarning] = {}
        self._newest: dict[str, Diagnosis] = {}

    def of(self, statuses: Iterable[DeviceStatus], utc_ns: int) -> Diagnoses:
        """Return the diagnoses of devices by their status."""
        self._newest = {status.name: self._one(status, utc_ns) for status in statuses}
        return Diagnoses(utc_ns, tuple(self._newest.values()))

    def stale(self, reason: str, utc_ns: int) -> Diagnoses:
        """Return the newest diagnoses as stale: nothing is known of the devices now, for this reason."""
        stale = (one._replace(level=DiagnosisLevel.STALE, message=reason) for one in self._newest.values())
        return Diagnoses(utc_ns, tuple(stale))

    def _one(self, status: DeviceStatus, utc_ns: int) -> Diagnosis:
        level, words = LEVEL_OF[status.state], [f"{status.state}: {status.problem}".removesuffix(": ")]
        counts = [status.ledger.get(name, 0) for name in LOST_FIELDS]
        losing = self._losses.setdefault(status.name, _LossWarning()).is_on(counts, utc_ns)
        warnings = list(_warnings(status, losing=losing))
        if level is DiagnosisLevel.OK and warnings:
            level = DiagnosisLevel.WARN
        hardware = status.identity.get("serial_number") or status.identity.get("product", "")
        return Diagnosis(status.name, level, "; ".join(words + warnings), hardware, _values(status))


class RecordedDiagnosis:
    """Diagnoses of the devices of a recording, in its order. Synchronization: one thread.

    Each device counts seconds by its own samples: devices of replays have times that have nothing to do with those of
    others.
    """

    def __init__(self) -> None:
        self._devices: dict[str, _RecordedDevice] = {}

    def samples(self, device: str, samples: Sequence[Sample]) -> Diagnoses | None:
        """Take samples of a device, at least one; return the diagnoses where they are due."""
        newest = samples[-1]
        known = self._device(device)
        known.samples(newest, len(samples))
        if not known.is_due:
            return None
        for one in self._devices.values():
            one.pass_second()
        return self._all(newest.utc_ns)

    def losses(self, losses: LossCounts) -> None:
        """Take what was lost since the daemon's start."""
        self._device(losses.device).losses(losses)

    def event(self, stamped: StampedEvent) -> Diagnoses | None:
        """Take an event; return the diagnoses where a device came or went."""
        event = stamped.event
        if event.kind not in (EventKind.UP, EventKind.DOWN) or not event.device:
            return None
        self._device(event.device).change(event)
        return self._all(stamped.utc_ns)

    def _device(self, name: str) -> "_RecordedDevice":
        return self._devices.setdefault(name, _RecordedDevice(name))

    def _all(self, utc_ns: int) -> Diagnoses:
        return Diagnoses(utc_ns, tuple(device.diagnosis() for device in self._devices.values()))


class _LossWarning:
    """Whether losses have grown within LOSS_SHOWN_NS. What was lost before the first look is no news."""

    def __init__(self) -> None:
        self._lost: int | None = None
        self._until_ns = 0

    def is_on(self, counts: Sequence[int], now_ns: int) -> bool:
        lost = sum(counts)
        if self._lost is not None and lost > self._lost:
            self._until_ns = now_ns + LOSS_SHOWN_NS
        self._lost = lost
        return now_ns < self._until_ns


class _RecordedDevice:
    """What the recording has said of a device so far."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._gone: tuple[DiagnosisLevel, str] | None = None
        """How and why it is gone; None while it is there."""
        self._newest: Sample | None = None
        self._begin: Sample | None = None
        """The newest sample at the begin of the present second."""
        self._count = 0
        """Samples since then."""
        self._rate_hz: float | None = None
        self._idle_s = 0
        """Seconds of the recording without a sample."""
        self._counts = dict.fromkeys(LOST_FIELDS, 0)
        self._warning = _LossWarning()
        self._losing = False

    def samples(self, newest: Sample, count: int) -> None:
        self._newest, self._count = newest, self._count + count
        self._losing = self._warning.is_on(list(self._counts.values()), newest.t_ns)

    def losses(self, losses: LossCounts) -> None:
        self._counts = dict(zip(LOST_FIELDS, losses.counts, strict=True))
        self._losing = self._warning.is_on(losses.counts, losses.t_ns)

    def change(self, event: Event) -> None:
        """Take the event that it came or went."""
        state = str(event.detail.get("state", event.kind))
        level = LEVEL_OF[DeviceState(state)] if state in list(DeviceState) else DiagnosisLevel.ERROR
        self._gone = (level, f"{state}: {event.message}") if event.kind == EventKind.DOWN else None
        self._idle_s = 0

    @property
    def is_due(self) -> bool:
        """Whether a second has passed by its samples, forward or by a jump back."""
        newest, begin = self._newest, self._begin
        return newest is not None and (begin is None or not 0 <= newest.t_ns - begin.t_ns < PERIOD_NS)

    def pass_second(self) -> None:
        """Begin the next second."""
        newest, begin = self._newest, self._begin
        self._idle_s = 0 if self._count else self._idle_s + 1
        if newest is not None and begin is not None and newest.t_ns > begin.t_ns:
            self._rate_hz = self._count * NS_PER_S / (newest.t_ns - begin.t_ns)
        elif self._idle_s:
            self._rate_hz = 0.0
        self._begin, self._count = newest, 0

    def diagnosis(self) -> Diagnosis:
        level, message = self._judged()
        return Diagnosis(self.name, level, message, "", self._values())

    def _judged(self) -> tuple[DiagnosisLevel, str]:
        if self._gone is not None:
            return self._gone
        if self._idle_s >= STALE_S:
            return DiagnosisLevel.STALE, f"no sample for {self._idle_s} s"
        if self._newest is None:
            return DiagnosisLevel.OK, "no sample yet"
        return (DiagnosisLevel.WARN, f"running; {_LOSING}") if self._losing else (DiagnosisLevel.OK, "running")

    def _values(self) -> dict[str, str]:
        values = {name: str(count) for name, count in self._counts.items()}
        if self._newest is not None:
            newest = self._newest
            values |= {"samples": str(newest.seq), "sync": str(newest.sync), "t_err_ns": str(newest.t_err_ns)}
        if self._rate_hz is not None:
            values["rate_hz"] = _number(self._rate_hz)
        return values


_LOSING: Final = f"samples were lost within the last {LOSS_SHOWN_NS // NS_PER_S} s"


def _warnings(status: DeviceStatus, *, losing: bool) -> Iterator[str]:
    """What is to be looked at although the device runs."""
    if losing:
        yield _LOSING
    if status.state is DeviceState.RUNNING and status.rate_hz < RATE_LEAST * status.expected_rate_hz:
        yield f"{status.rate_hz:.1f} Hz come of {status.expected_rate_hz:.1f} Hz"
    if status.frame is not None and status.frame.problem:
        yield status.frame.problem
    if status.lines is not None:
        yield from (f"{line}: {problem}" for line, problem in status.lines.problems.items() if problem)
        if status.lines.alarm:
            yield "the ALARM line is active"


def _values(status: DeviceStatus) -> dict[str, str]:
    clock = status.clock
    numbers = {
        "rate_hz": status.rate_hz, "expected_rate_hz": status.expected_rate_hz,
        "samples": status.ledger.get("samples", 0), **{name: status.ledger.get(name, 0) for name in LOST_FIELDS},
        "t_err_ns": clock.t_err_ns, "skew_ppm": clock.skew_ppm, "residual_ns": clock.residual_ns,
        "reference_error_ns": clock.reference_error_ns, "resets": clock.resets, "connects": status.connects,
        "frames_bad_crc": status.ledger.get("frames_bad_crc", 0),
    }  # fmt: skip
    words = {"state": str(status.state), "driver": status.driver, "link": status.link, "sync": str(clock.sync)}
    values = words | {name: _number(value) for name, value in numbers.items()}
    if status.status_words:
        values["status"] = ", ".join(status.status_words)
    return values


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.6g}"
