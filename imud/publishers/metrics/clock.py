"""Metrics of what dates samples besides their arrival: edges, triggers, UTC."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import ClockStatus, DeviceStatus, UtcStatus
from imud.publishers.metrics.family import DeviceReader, Family, one, part, part_labelled
from imud.units import NS_PER_S


def _edged(device: DeviceStatus) -> ClockStatus | None:
    """The clock of a device with lines."""
    return device.clock if device.lines is not None else None


def _triggered(device: DeviceStatus) -> ClockStatus | None:
    """The clock of a device whose SIN imud drives."""
    return device.clock if device.lines is not None and device.lines.sin else None


def _utc(read: Callable[[UtcStatus], float | None]) -> DeviceReader:
    return part(lambda device: device.utc, read)


def _fed(device: DeviceStatus) -> UtcStatus | None:
    """UTC of a device that is fed sentences."""
    return device.utc if device.utc is not None and device.utc.source else None


TIME_FAMILIES: Final = (
    Family(
        "imud_clock_hold_seconds", "How long the link's adapter may hold bytes back; 0 for none.", (),
        one(lambda d: d.clock.hold_ns / NS_PER_S),
    ),
    Family(
        "imud_clock_edges_total", "Pulses on SOUT, or triggers given on SIN, that the clock was told.", (),
        part(_edged, lambda clock: clock.edges),
    ),
    Family(
        "imud_clock_edges_unpaired_total", "Pulses on SOUT that belong to no sample.", (),
        part(_edged, lambda clock: clock.edges_unpaired),
    ),
    Family(
        "imud_clock_samples_unpaired_total", "Samples whose own pulse or trigger was not seen, though others were.", (),
        part(_edged, lambda clock: clock.samples_unpaired),
    ),
    Family(
        "imud_triggers_unanswered_total", "Triggers on SIN that no sample answered.", (),
        part(_triggered, lambda clock: clock.triggers_missed),
    ),
    Family(
        "imud_clock_reference_error_seconds", "One-sigma error of what the host knows of UTC; absent while nothing.",
        (), one(lambda d: d.clock.reference_error_ns / NS_PER_S or None),
    ),
    Family(
        "imud_utc_problem", "1 while something is wrong with the source of UTC or the feed of chronyd.", (),
        _utc(lambda utc: float(bool(utc.problem))),
    ),
    Family(
        "imud_utc_sentences_total", "RMC sentences that the source gave.", (), part(_fed, lambda utc: utc.sentences)
    ),
    Family(
        "imud_utc_sentences_sent_total", "Of these, sent to the device.", (), part(_fed, lambda utc: utc.sent)
    ),
    Family(
        "imud_utc_sentences_refused_total", "Of these, not sent, by cause.", ("cause",),
        part_labelled(_fed, lambda utc: (((cause,), count) for cause, count in utc.refused.items())),
    ),
    Family("imud_pps_pulses_total", "Pulses per second that counted.", (), _utc(lambda utc: utc.pulses)),
    Family(
        "imud_pps_pulses_ignored_total", "Pulses that were in step with none.", (), _utc(lambda utc: utc.pulses_ignored)
    ),
    Family(
        "imud_chrony_samples_total", "Samples for chronyd: given to it, or not taken.", ("fate",),
        part_labelled(
            lambda d: d.utc, lambda utc: ((("sent",), utc.chrony_sent), (("refused",), utc.chrony_refused))
        ),
    ),
)  # fmt: skip
