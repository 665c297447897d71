"""Table: all metrics of imud except the process's own, in the order they are shown. `docs/metrics.md` lists them.

Base units, `_total` for counters, labels of bounded sets only. Counters of one scrape come from one moment of the
event loop, so sums over them are exact: the ledger closes in every scrape. Values of clients are summed over all:
a label per client would make a new time series for every connection.
"""

import platform
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final

import imud
from imud.contracts.setting import SettingsState, SettingsStatus
from imud.contracts.status import (
    LATENCY_BOUNDS_NS,
    ClockStatus,
    DeviceState,
    DeviceStatus,
    FlightStatus,
    LinesStatus,
    MqttStatus,
    OutputStatus,
    RecorderStatus,
    UtcStatus,
)
from imud.model.ledger import bytes_open, frames_open
from imud.model.sample import Sync, Vector3
from imud.publishers.metrics.metric import (
    ACCELERATION,
    BYTES,
    CELSIUS,
    HERTZ,
    NO_UNIT,
    RADIANS,
    RATIO,
    SECONDS,
    DevicePart,
    Family,
    Histogram,
    Lines,
    MetricType,
    Reader,
    Snapshot,
    Unit,
    daemon,
    each,
    status_part,
)
from imud.publishers.metrics.rings import MotionValues

DEVICE_INFO_LABELS: Final = ("device", "driver", "link", "product", "serial_number", "firmware")
CLIENT_ENCODINGS: Final = ("json", "binary", "none")


def _counter(name: str, help_: str, reader: Reader, unit: Unit = NO_UNIT) -> Family:
    return Family(name, MetricType.COUNTER, unit, help_, reader)


def _gauge(name: str, help_: str, reader: Reader, unit: Unit = NO_UNIT) -> Family:
    return Family(name, MetricType.GAUGE, unit, help_, reader)


def _info(name: str, help_: str, reader: Reader) -> Family:
    return Family(name, MetricType.INFO, NO_UNIT, help_, reader)


# --- how values are read ----------------------------------------------------------------------------------------------


def _edged(device: DeviceStatus) -> ClockStatus | None:
    """The clock of a device with lines."""
    return device.clock if device.lines is not None else None


def _with_alarm(device: DeviceStatus) -> LinesStatus | None:
    return device.lines if device.lines is not None and "alarm" in device.lines.edges else None


def _with_sin(device: DeviceStatus) -> LinesStatus | None:
    """The lines of a device whose SIN imud drives."""
    return device.lines if device.lines is not None and device.lines.sin else None


def _triggered(device: DeviceStatus) -> ClockStatus | None:
    return device.clock if _with_sin(device) is not None else None


def _fed(device: DeviceStatus) -> UtcStatus | None:
    """UTC of a device that sentences are sent to."""
    return device.utc if device.utc is not None and device.utc.source else None


def _declared(device: DeviceStatus) -> SettingsStatus | None:
    """Settings of a device for which some are declared."""
    found = device.declared
    return found if found is not None and found.state is not SettingsState.UNDECLARED else None


def _compared(device: DeviceStatus) -> SettingsStatus | None:
    """The same once the device has reported them."""
    found = _declared(device)
    return found if found is not None and found.state is not SettingsState.UNKNOWN else None


DEVICE: Final = status_part(lambda device: device)
CLOCK: Final = status_part(lambda device: device.clock)
FRAME: Final = status_part(lambda device: device.frame)
LEDGER: Final = status_part(lambda device: device.ledger)
KERNEL: Final = status_part(lambda device: device.kernel)
POLLING: Final = status_part(lambda device: device.polling)
SERIAL_LINE: Final = status_part(lambda device: device.serial_line)
EDGES: Final = status_part(_edged)
TRIGGERS: Final = status_part(_triggered)
LINES: Final = status_part(lambda device: device.lines)
ALARM: Final = status_part(_with_alarm)
SIN: Final = status_part(_with_sin)
UTC: Final = status_part(lambda device: device.utc)
SENTENCES: Final = status_part(_fed)
SETTINGS: Final = status_part(lambda device: device.declared)
DECLARED: Final = status_part(_declared)
COMPARED: Final = status_part(_compared)
RING: Final = DevicePart(lambda snapshot: snapshot.views.items())
MOTION: Final = DevicePart(lambda snapshot: ((name, view.motion) for name, view in snapshot.views.items()))
ANGLES: Final = ("roll", "pitch", "yaw")
AXES: Final = ("x", "y", "z")


def _ledger(field: str) -> Reader:
    return LEDGER.one(lambda ledger: ledger[field])


def _ledger_by(label: str, **fields: str) -> Reader:
    """Fields of the ledger by the label's value: `crc="lost_crc"`."""
    return LEDGER.by(label, lambda ledger: {value: ledger[field] for value, field in fields.items()})


def _vector(label: str, names: tuple[str, ...], read: Callable[[MotionValues], Vector3 | None]) -> Reader:
    """Three values of the motion by the label's value; absent where there are none."""
    return MOTION.by(label, lambda motion: dict(zip(names, read(motion) or (), strict=False)))


def _line_problems(lines: LinesStatus) -> Mapping[str, float]:
    names = dict.fromkeys((*lines.edges, *(("sin",) if lines.sin else ()), *lines.problems))
    return {name: name in lines.problems for name in names}


def _device_info(snapshot: Snapshot) -> Lines:
    for device in snapshot.devices:
        identity = (device.identity.get(key, "") for key in ("product", "serial_number", "firmware"))
        yield (device.name, device.driver, device.link, *identity), 1


def _clients_by_encoding(snapshot: Snapshot) -> Lines:
    encodings = Counter(client.encoding or "none" for client in snapshot.clients)
    return (((encoding,), encodings[encoding]) for encoding in CLIENT_ENCODINGS)


# --- the daemon and its devices ---------------------------------------------------------------------------------------

DAEMON_FAMILIES: Final = (
    _info(
        "imud_build_info", "What runs here; always 1.",
        Reader(("version", "python"), lambda _snapshot: (((imud.__version__, platform.python_version()), 1),)),
    ),
    _gauge(
        "imud_heartbeat_age_seconds",
        "Time since the daemon's ten-times-a-second tick; grows when the event loop is stuck.",
        daemon(lambda snapshot: snapshot.heartbeat_age_ns), SECONDS,
    ),
    _counter(
        "imud_log_messages_dropped_total", "Messages missing in the log because it was not read in time.",
        daemon(lambda snapshot: snapshot.log_messages_dropped),
    ),
    _info("imud_device_info", "What the device is; always 1.", Reader(DEVICE_INFO_LABELS, _device_info)),
)  # fmt: skip

# --- every device -----------------------------------------------------------------------------------------------------

DEVICE_FAMILIES: Final = (
    _gauge("imud_device_up", "1 while samples flow, else 0.", DEVICE.one(lambda d: d.state is DeviceState.RUNNING)),
    _gauge(
        "imud_device_state", "1 for the state the device is in, 0 for the others.",
        DEVICE.by("state", lambda d: {state.value: d.state is state for state in DeviceState}),
    ),
    _counter("imud_device_connects_total", "Times the link was opened.", DEVICE.one(lambda d: d.connects)),
    _counter("imud_bytes_in_total", "Bytes that the link delivered.", _ledger("bytes_in")),
    _counter(
        "imud_bytes_total", "Bytes by what became of them.",
        _ledger_by("fate", good_frames="bytes_in_good_frames", bad_frames="bytes_in_bad_frames",
                   skipped="bytes_skipped"), BYTES,
    ),
    _gauge("imud_bytes_pending", "Bytes that may still become a frame.", _ledger("bytes_pending")),
    _counter("imud_frames_good_total", "Frames whose check value was right.", _ledger("frames_good")),
    _counter(
        "imud_frames_total", "Good frames by what became of them.",
        _ledger_by("fate", samples="frames_in_samples", replies="frames_in_replies", ignored="frames_ignored"),
    ),
    _gauge("imud_frames_pending", "Good frames that wait for the rest of their sample.", _ledger("frames_pending")),
    _counter(
        "imud_frames_bad_total", "Damaged frames by reason; not_finite ones are used without those values.",
        _ledger_by("reason", crc="frames_bad_crc", length="frames_bad_length", content="frames_bad_content",
                   not_finite="frames_not_finite"),
    ),
    _counter("imud_unknown_tags_total", "Sub-packets of good frames with an unknown tag.", _ledger("unknown_tags")),
    _gauge(
        "imud_ledger_unaccounted_bytes", "Bytes delivered less bytes accounted for; 0 unless imud has a bug.",
        LEDGER.one(bytes_open), BYTES,
    ),
    _gauge(
        "imud_ledger_unaccounted_frames", "Good frames less frames accounted for; 0 unless imud has a bug.",
        LEDGER.one(frames_open),
    ),
    _counter("imud_samples_total", "Samples made.", _ledger("samples")),
    _counter(
        "imud_samples_lost_total", "Samples lost by cause.",
        _ledger_by("cause", gap_device="lost_gap_device", crc="lost_crc", overrun="lost_overrun", queue="lost_queue"),
    ),
    _counter(
        "imud_gaps_unknown_total", "Gaps between samples whose size is not known within one sample.",
        _ledger("lost_unknown"),
    ),
    _counter(
        "imud_replies_stray_total", "Lines of text from the device that answered no request in time.",
        _ledger_by("kind", late="replies_late", unsolicited="replies_unsolicited"),
    ),
    _gauge(
        "imud_sample_rate_hertz", "Samples per second over the last seconds.", DEVICE.one(lambda d: d.rate_hz), HERTZ
    ),
    _gauge(
        "imud_sample_rate_expected_hertz", "Rate by the device's own time stamps; absent while unknown.",
        DEVICE.one(lambda d: d.expected_rate_hz or None), HERTZ,
    ),
    _gauge(
        "imud_sample_hold_seconds", "How long data waits at present to be processed together; 0: it does not wait.",
        DEVICE.one(lambda device: device.hold_ns), SECONDS,
    ),
    _gauge(
        "imud_sample_hold_wanted_seconds", "How long the strictest consumer of the samples would let them wait.",
        DEVICE.one(lambda device: device.hold_wanted_ns), SECONDS,
    ),
    _gauge(
        "imud_clock_sync", "1 for the present source of time stamps, 0 for the others.",
        CLOCK.by("sync", lambda clock: {sync.value: clock.sync is sync for sync in Sync}),
    ),
    _gauge(
        "imud_clock_offset_seconds", "Host CLOCK_MONOTONIC minus device time, at the newest sample.",
        CLOCK.one(lambda clock: clock.offset_ns), SECONDS,
    ),
    _gauge(
        "imud_clock_skew_ratio", "How much faster than the unsteered host the device's clock runs; 4e-05: 40 ppm.",
        CLOCK.one(lambda clock: clock.skew_ppm), RATIO,
    ),
    _gauge(
        "imud_clock_steering_ratio", "How much faster than unsteered CLOCK_MONOTONIC runs; 0.0005: a slew of 500 ppm.",
        CLOCK.one(lambda clock: clock.steering_ppm), RATIO,
    ),
    _gauge(
        "imud_clock_residual_seconds", "One-sigma spread of arrival times around the fitted clock.",
        CLOCK.one(lambda clock: clock.residual_ns), SECONDS,
    ),
    _gauge(
        "imud_clock_error_seconds", "One-sigma error of the newest time stamp.",
        CLOCK.one(lambda clock: clock.t_err_ns), SECONDS,
    ),
    _counter("imud_clock_resets_total", "Times the device's clock started anew.", CLOCK.one(lambda c: c.resets)),
    _gauge(
        "imud_temperature_celsius", "Temperature that the device sends.", DEVICE.one(lambda d: d.temperature_c), CELSIUS
    ),
    _gauge(
        "imud_frame_problem", "1 while gravity or heading contradicts the attitude or the configuration, else 0.",
        FRAME.one(lambda frame: bool(frame.problem)),
    ),
    _gauge("imud_status_bits", "Status word of the newest sample.", DEVICE.one(lambda d: d.status_bits)),
    _counter(
        "imud_kernel_errors_total", "Errors of the port that the kernel counted since the link was opened.",
        KERNEL.by("kind", lambda kernel: {
            "overrun": kernel.overrun, "framing": kernel.framing, "parity": kernel.parity, "break": kernel.break_,
            "error_passive": kernel.error_passive, "bus_off": kernel.bus_off,
        }),
    ),
)  # fmt: skip

# --- metrics of some devices ------------------------------------------------------------------------------------------

POLLING_FAMILIES: Final = (
    _counter("imud_polls_total", "Deadlines at which the device was read.", POLLING.one(lambda p: p.polls)),
    _counter(
        "imud_polls_late_total", "Of these, begun more than a quarter of the period after the deadline.",
        POLLING.one(lambda p: p.late),
    ),
    _counter("imud_polls_missed_total", "Deadlines that passed without a read.", POLLING.one(lambda p: p.missed)),
    _counter("imud_polls_stale_total", "Reads that gave nothing new.", POLLING.one(lambda p: p.stale)),
    _counter(
        "imud_poll_delay_seconds_total", "Time from deadline to read, summed over all polls.",
        POLLING.one(lambda p: p.late_sum_ns), SECONDS,
    ),
    _gauge(
        "imud_poll_delay_worst_seconds", "Longest time from deadline to read since start.",
        POLLING.one(lambda p: p.late_worst_ns), SECONDS,
    ),
    _counter("imud_transfers_failed_total", "Transfers of polls that failed.", POLLING.one(lambda p: p.failed)),
    _counter(
        "imud_device_vanished_total", "Times a polled device had to be identified again.",
        POLLING.one(lambda p: p.vanished),
    ),
    _counter(
        "imud_serial_line_timeouts_total", "Requests on the device's line that got no reply.",
        SERIAL_LINE.one(lambda line: line.timeouts),
    ),
    _counter(
        "imud_serial_line_late_bytes_total", "Bytes on the device's line that came when nothing was asked.",
        SERIAL_LINE.one(lambda line: line.late_bytes), BYTES,
    ),
    _counter(
        "imud_serial_line_strange_bytes_total", "Bytes on the device's line before a reply, or instead of it.",
        SERIAL_LINE.one(lambda line: line.strange_bytes), BYTES,
    ),
    _counter(
        "imud_serial_line_echoes_total", "Requests on the device's line that came back as an echo.",
        SERIAL_LINE.one(lambda line: line.echoes),
    ),
)  # fmt: skip

TIME_FAMILIES: Final = (
    _gauge(
        "imud_clock_hold_seconds", "How long the link's adapter may hold bytes back; 0 for none.",
        CLOCK.one(lambda clock: clock.hold_ns), SECONDS,
    ),
    _counter(
        "imud_clock_edges_total", "Pulses on SOUT, or triggers given on SIN, that reached the clock.",
        EDGES.one(lambda clock: clock.edges),
    ),
    _counter(
        "imud_clock_edges_unpaired_total", "Pulses on SOUT that belong to no sample.",
        EDGES.one(lambda clock: clock.edges_unpaired),
    ),
    _counter(
        "imud_clock_samples_unpaired_total",
        "Samples whose own pulse or trigger was not seen, though others were.",
        EDGES.one(lambda clock: clock.samples_unpaired),
    ),
    _counter(
        "imud_triggers_unanswered_total", "Triggers on SIN that no sample answered.",
        TRIGGERS.one(lambda clock: clock.triggers_missed),
    ),
    _gauge(
        "imud_clock_reference_error_seconds", "One-sigma error of what the host knows of UTC; absent while nothing.",
        CLOCK.one(lambda clock: clock.reference_error_ns or None), SECONDS,
    ),
    _gauge(
        "imud_utc_problem", "1 while something is wrong with the source of UTC or the feed of chronyd.",
        UTC.one(lambda utc: bool(utc.problem)),
    ),
    _counter(
        "imud_utc_sentences_total", "RMC sentences that the source gave.", SENTENCES.one(lambda utc: utc.sentences)
    ),
    _counter(
        "imud_utc_sentences_sent_total", "Of these, sent to the device.", SENTENCES.one(lambda utc: utc.sent)
    ),
    _counter(
        "imud_utc_sentences_refused_total", "Of these, not sent, by cause.",
        SENTENCES.by("cause", lambda utc: utc.refused),
    ),
    _counter("imud_pps_pulses_total", "Pulses per second that counted.", UTC.one(lambda utc: utc.pulses)),
    _counter(
        "imud_pps_pulses_ignored_total", "Pulses that were in step with none.",
        UTC.one(lambda utc: utc.pulses_ignored),
    ),
    _counter(
        "imud_chrony_samples_total", "Samples for chronyd: sent to it, or refused by it.",
        UTC.by("fate", lambda utc: {"sent": utc.chrony_sent, "refused": utc.chrony_refused}),
    ),
)  # fmt: skip

LINE_FAMILIES: Final = (
    _gauge(
        "imud_line_problem", "1 while a line cannot be used, or its level cannot be right.",
        LINES.by("line", _line_problems),
    ),
    _counter("imud_line_edges_total", "Edges seen on a line.", LINES.by("line", lambda lines: lines.edges)),
    _counter(
        "imud_line_edges_lost_total", "Edges that the kernel dropped because they were not read in time.",
        LINES.by("line", lambda lines: lines.edges_lost),
    ),
    _gauge(
        "imud_alarm_active", "1 while the ALARM line is active; absent while its level is not known.",
        LINES.one(lambda lines: lines.alarm),
    ),
    _counter("imud_alarms_total", "Times the ALARM line became active.", ALARM.one(lambda lines: lines.alarms)),
    _counter("imud_triggers_total", "Triggers made on SIN.", SIN.one(lambda lines: lines.triggers)),
    _counter(
        "imud_triggers_missed_total", "Deadlines for which no trigger was made, the host being busy.",
        SIN.one(lambda lines: lines.triggers_missed),
    ),
    _counter(
        "imud_trigger_delay_seconds_total", "Time from deadline to trigger, summed over all.",
        SIN.one(lambda lines: lines.trigger_late_sum_ns), SECONDS,
    ),
    _gauge(
        "imud_trigger_delay_worst_seconds", "Longest time from deadline to trigger since start.",
        SIN.one(lambda lines: lines.trigger_late_worst_ns), SECONDS,
    ),
)  # fmt: skip

SETTINGS_FAMILIES: Final = (
    _gauge(
        "imud_settings_differ", "Settings of the device that are not as declared; absent while that is not known.",
        COMPARED.one(lambda settings: len(settings.differences)),
    ),
    _gauge(
        "imud_settings_problem", "1 while declared settings cannot be read, set or saved.",
        DECLARED.one(lambda settings: bool(settings.problem)),
    ),
    _counter(
        "imud_settings_repairs_total", "Times that imud has set the device by itself.",
        DECLARED.one(lambda settings: settings.repairs),
    ),
    _counter(
        "imud_settings_flash_writes_total", "Writes to the flash of this module by imud, earlier runs included.",
        SETTINGS.one(lambda settings: settings.flash_writes),
    ),
    _gauge(
        "imud_settings_flash_writes_day", "Of these, those of the last 24 hours, which are limited.",
        SETTINGS.one(lambda settings: settings.flash_writes_day),
    ),
)  # fmt: skip

# --- from shared memory -----------------------------------------------------------------------------------------------

RING_FAMILIES: Final = (
    _gauge(
        "imud_ring_written", "1 while the device's ring in shared memory is there and written, else 0.",
        RING.one(lambda ring: ring.written),
    ),
    _gauge(
        "imud_attitude_radians", "Attitude of the newest sample.",
        _vector("angle", ANGLES, lambda motion: motion.attitude_rad), RADIANS,
    ),
    _gauge(
        "imud_acceleration_norm_meters_per_second_squared", "Length of the mean acceleration of the last second.",
        MOTION.one(lambda motion: motion.accel_norm_m_s2), ACCELERATION,
    ),
    _gauge(
        "imud_vibration_rms_meters_per_second_squared",
        "RMS of the acceleration's deviation from its mean of each second.",
        _vector("axis", AXES, lambda motion: motion.vibration_rms_m_s2), ACCELERATION,
    ),
    _gauge(
        "imud_vibration_peak_meters_per_second_squared",
        "Largest deviation of the acceleration from its mean of each second.",
        _vector("axis", AXES, lambda motion: motion.vibration_peak_m_s2), ACCELERATION,
    ),
    _gauge(
        "imud_motion_span_seconds", "Time from the oldest to the newest sample that vibration was computed over.",
        MOTION.one(lambda motion: motion.span_ns), SECONDS,
    ),
)  # fmt: skip

LATENCY: Final = Histogram(
    "imud_sample_latency_seconds",
    "Time from the measurement to its publication.",
    LATENCY_BOUNDS_NS,
    lambda device: (device.latency_buckets, device.latency_sum_ns),
)

# --- clients and events -----------------------------------------------------------------------------------------------

CLIENT_FAMILIES: Final = (
    _gauge(
        "imud_clients", "Clients by the encoding they watch in; none for those that do not watch.",
        Reader(("encoding",), _clients_by_encoding),
    ),
    _gauge(
        "imud_client_queue_samples", "Samples that wait for clients to read them, all clients together.",
        daemon(lambda snapshot: sum(client.queue_samples for client in snapshot.clients)),
    ),
    _gauge(
        "imud_client_queue_samples_max", "Samples that wait for the slowest client.",
        daemon(lambda snapshot: max((client.queue_samples for client in snapshot.clients), default=0)),
    ),
    _gauge(
        "imud_client_queue_bytes", "Bytes that wait for clients to read them, all clients together.",
        daemon(lambda snapshot: sum(client.queue_bytes for client in snapshot.clients)), BYTES,
    ),
    _counter(
        "imud_client_samples_sent_total", "Samples given to clients, as seen at scrapes.",
        daemon(lambda snapshot: snapshot.client_samples_sent),
    ),
    _counter(
        "imud_client_samples_dropped_total",
        "Samples dropped for clients that did not read fast enough, as seen at scrapes.",
        daemon(lambda snapshot: snapshot.client_samples_dropped),
    ),
    _counter(
        "imud_events_total", "Events by kind; device is empty for the daemon's own.",
        Reader(("device", "kind"), lambda snapshot: snapshot.events),
    ),
)  # fmt: skip

FAMILIES: Final[tuple[Family | Histogram, ...]] = (
    *DAEMON_FAMILIES,
    *DEVICE_FAMILIES,
    *POLLING_FAMILIES,
    *TIME_FAMILIES,
    *LINE_FAMILIES,
    *SETTINGS_FAMILIES,
    *RING_FAMILIES,
    LATENCY,
    *CLIENT_FAMILIES,
)
"""Every metric, in the order they are shown."""


def _mqtt(read: Callable[[MqttStatus], float]) -> Reader:
    """A value of the output."""
    return each(lambda snapshot: snapshot.mqtts, read)


def _dropped(snapshot: Snapshot) -> Lines:
    return [((cause,), count) for status in snapshot.mqtts for cause, count in status.dropped.items()]


def _counter_of(name: str, words: str, read: Callable[[MqttStatus], float]) -> Family:
    return Family(f"imud_mqtt_{name}_total", MetricType.COUNTER, NO_UNIT, words, _mqtt(read))


def _gauge_of(name: str, unit: Unit, words: str, read: Callable[[MqttStatus], float]) -> Family:
    return Family(f"imud_mqtt_{name}", MetricType.GAUGE, unit, words, _mqtt(read))


MQTT_FAMILIES: Final = (
    _gauge_of("connected", NO_UNIT, "1 while a broker is connected, else 0.", lambda status: bool(status.broker)),
    _gauge_of(
        "spooling", NO_UNIT, "1 while the spool can be written, 0 while the disk does not let it.",
        lambda status: not status.spool_problem,
    ),
    _counter_of("queued", "Samples and events given to the output.", lambda status: status.queued),
    _counter_of("spooled_messages", "Messages written to the spool.", lambda status: status.spooled),
    _counter_of("sent_messages", "Messages sent, those sent again included.", lambda status: status.sent),
    _counter_of("acknowledged_messages", "Messages that the broker has taken.", lambda status: status.acknowledged),
    _gauge_of("waiting_messages", NO_UNIT, "Messages in the spool.", lambda status: status.waiting),
    _gauge_of("spool_bytes", BYTES, "Room that the spool uses.", lambda status: status.spool_bytes),
    _counter_of(
        "thinned", "Samples of which only statistics are left, for want of room in the spool.",
        lambda status: status.thinned,
    ),
    Family(
        "imud_mqtt_dropped_total", MetricType.COUNTER, NO_UNIT, "Samples and events that were dropped, by cause.",
        Reader(("cause",), _dropped),
    ),
    _counter_of("reconnects", "Connections to a broker after the first.", lambda status: status.reconnects),
    _counter_of("commands", "Requests for actions that were carried out, or tried.", lambda status: status.commands),
    _counter_of("commands_refused", "Requests for actions that were refused.", lambda status: status.commands_refused),
)  # fmt: skip


def _output(read: Callable[[OutputStatus], float]) -> Reader:
    """A value of each way out."""

    def lines(snapshot: Snapshot) -> Lines:
        return [((status.name,), read(status)) for status in snapshot.outputs]

    return Reader(("output",), lines)


OUTPUT_FAMILIES: Final = (
    Family(
        "imud_nmea0183_sentences_total", MetricType.COUNTER, NO_UNIT, "Sentences sent.",
        _output(lambda status: status.sent),
    ),
    Family(
        "imud_nmea0183_sentences_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Sentences that were not sent because the way out had no room or was away.",
        _output(lambda status: status.dropped),
    ),
    Family(
        "imud_nmea0183_readers", MetricType.GAUGE, NO_UNIT,
        "Clients of the TCP server; of a port or an address 1 while it takes what is sent, 0 while it does not.",
        _output(lambda status: status.readers),
    ),
)  # fmt: skip


def _recorder(read: Callable[[RecorderStatus], float]) -> Reader:
    """A value of the recorder."""
    return each(lambda snapshot: snapshot.recorders, read)


def _flight(read: Callable[[FlightStatus], float]) -> Reader:
    """A value of the flight recorder."""
    return each(lambda snapshot: snapshot.flights, read)


def _snapshots(snapshot: Snapshot) -> Lines:
    """Snapshots by what became of them."""
    return [
        ((result,), getattr(status, result))
        for status in snapshot.flights
        for result in ("saved", "failed", "left_out")
    ]


def _disk(snapshot: Snapshot) -> Lines:
    """Both recorders write to one directory; the one that always writes knows its present file, too."""
    always = [status.disk_bytes for status in snapshot.recorders]
    return [((), size) for size in always or [status.disk_bytes for status in snapshot.flights]]


RECORDINGS_FAMILIES: Final = (
    Family(
        "imud_recordings_bytes", MetricType.GAUGE, BYTES,
        "Size of all recordings in the directory of the recorder, snapshots included.", Reader((), _disk),
    ),
)  # fmt: skip

RECORDER_FAMILIES: Final = (
    Family(
        "imud_recorder_active", MetricType.GAUGE, NO_UNIT, "1 while imud records, 0 while the disk does not let it.",
        _recorder(lambda status: not status.problem),
    ),
    Family(
        "imud_recorder_written_bytes_total", MetricType.COUNTER, BYTES, "Bytes written to recordings.",
        _recorder(lambda status: status.written_bytes),
    ),
    Family(
        "imud_recorder_records_total", MetricType.COUNTER, NO_UNIT, "Records written to recordings.",
        _recorder(lambda status: status.records),
    ),
    Family(
        "imud_recorder_records_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Records that are missing in recordings because the disk was too slow.",
        _recorder(lambda status: status.records_dropped),
    ),
    Family(
        "imud_recorder_waiting_bytes", MetricType.GAUGE, BYTES, "Records that wait to be written.",
        _recorder(lambda status: status.waiting_bytes),
    ),
    Family(
        "imud_recorder_files_removed_total", MetricType.COUNTER, NO_UNIT,
        "Recordings that were removed to keep within the budget.",
        _recorder(lambda status: status.files_removed),
    ),
)  # fmt: skip

FLIGHT_FAMILIES: Final = (
    Family(
        "imud_flight_recorder_active", MetricType.GAUGE, NO_UNIT,
        "1 while the flight recorder keeps what devices deliver, 0 while there is no room for it.",
        _flight(lambda status: not status.problem),
    ),
    Family(
        "imud_flight_recorder_kept_seconds", MetricType.GAUGE, SECONDS, "Length of what the flight recorder has.",
        _flight(lambda status: status.kept_ns),
    ),
    Family(
        "imud_flight_recorder_kept_bytes", MetricType.GAUGE, BYTES, "Size of what the flight recorder has.",
        _flight(lambda status: status.kept_bytes),
    ),
    Family(
        "imud_flight_recorder_records_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Records that the flight recorder does not have because this machine was too slow.",
        _flight(lambda status: status.records_dropped),
    ),
    Family(
        "imud_flight_recorder_snapshots_total", MetricType.COUNTER, NO_UNIT,
        "Alerts whose snapshot was saved, could not be saved, or was one too many within an hour.",
        Reader(("result",), _snapshots),
    ),
    Family(
        "imud_flight_recorder_snapshots_sent_total", MetricType.COUNTER, NO_UNIT, "Snapshots that clients asked for.",
        _flight(lambda status: status.sent),
    ),
)  # fmt: skip
