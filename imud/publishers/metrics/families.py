"""Table of all metrics of imud except the metrics of the process, in the order of the output.

`docs/metrics.md` lists them.

Names use base units, and `_total` for counters. Labels have a bounded set of values. All counters of a scrape are from
the same turn of the event loop, so the ledger balances in each scrape. imud adds the values of all clients, because a
label per client would create a new time series for each connection.
"""

import platform
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final

import imud
from imud.contracts.condition import Condition
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
    RuleStatus,
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


# --- readers of values ------------------------------------------------------------------------------------------------


def _edged(device: DeviceStatus) -> ClockStatus | None:
    """Return the clock of a device with GPIO lines."""
    return device.clock if device.lines is not None else None


def _with_alarm(device: DeviceStatus) -> LinesStatus | None:
    return device.lines if device.lines is not None and "alarm" in device.lines.edges else None


def _with_sin(device: DeviceStatus) -> LinesStatus | None:
    return device.lines if device.lines is not None and device.lines.sin else None


def _triggered(device: DeviceStatus) -> ClockStatus | None:
    return device.clock if _with_sin(device) is not None else None


def _fed(device: DeviceStatus) -> UtcStatus | None:
    """Return the UTC state of a device that receives sentences."""
    return device.utc if device.utc is not None and device.utc.source else None


def _declared(device: DeviceStatus) -> SettingsStatus | None:
    found = device.declared
    return found if found is not None and found.state is not SettingsState.UNDECLARED else None


def _compared(device: DeviceStatus) -> SettingsStatus | None:
    """Return the settings of a device with declared settings after the device reported its settings."""
    found = _declared(device)
    return found if found is not None and found.state is not SettingsState.UNKNOWN else None


DEVICE: Final = status_part(lambda device: device)
CONDITION: Final = status_part(lambda device: device.condition)
CLOCK: Final = status_part(lambda device: device.clock)
FRAME: Final = status_part(lambda device: device.frame)
LEDGER: Final = status_part(lambda device: device.ledger)
KERNEL: Final = status_part(lambda device: device.kernel)
POSITION: Final = status_part(lambda device: device.position)
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
    """Return a reader of ledger fields, one per label value: `crc="lost_crc"`."""
    return LEDGER.by(label, lambda ledger: {value: ledger[field] for value, field in fields.items()})


def _vector(label: str, names: tuple[str, ...], read: Callable[[MotionValues], Vector3 | None]) -> Reader:
    """Return a reader of the three components of a vector."""
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


# --- daemon and device identity ---------------------------------------------------------------------------------------

DAEMON_FAMILIES: Final = (
    _info(
        "imud_build_info", "Version of imud and Python; always 1.",
        Reader(("version", "python"), lambda _snapshot: (((imud.__version__, platform.python_version()), 1),)),
    ),
    _gauge(
        "imud_heartbeat_age_seconds",
        "Time since the last tick of the event loop, which ticks at least twice per second.",
        daemon(lambda snapshot: snapshot.heartbeat_age_ns), SECONDS,
    ),
    _counter(
        "imud_log_messages_dropped_total", "Log messages that imud dropped because the log was not read in time.",
        daemon(lambda snapshot: snapshot.log_messages_dropped),
    ),
    _info("imud_device_info", "Identity of the device; always 1.", Reader(DEVICE_INFO_LABELS, _device_info)),
)  # fmt: skip

# --- each device ------------------------------------------------------------------------------------------------------

DEVICE_FAMILIES: Final = (
    _gauge(
        "imud_device_up", "1 if the device sends samples, otherwise 0.",
        DEVICE.one(lambda d: d.state is DeviceState.RUNNING),
    ),
    _gauge(
        "imud_device_state", "1 for the present device state, 0 for the others.",
        DEVICE.by("state", lambda d: {state.value: d.state is state for state in DeviceState}),
    ),
    _gauge(
        "imud_device_condition", "1 for the present condition of the device, 0 for the others.",
        CONDITION.by("condition", lambda c: {one.value: c.condition is one for one in Condition}),
    ),
    _gauge(
        "imud_device_reason", "1 for each reason of a condition other than ok; absent for the other reasons.",
        CONDITION.by("code", lambda c: {reason.code.value: 1 for reason in c.reasons if not c.is_ok}),
    ),
    _counter("imud_device_connects_total", "Number of connections to the link.", DEVICE.one(lambda d: d.connects)),
    _counter("imud_bytes_in_total", "Bytes received from the link.", _ledger("bytes_in")),
    _counter(
        "imud_bytes_total", "Received bytes by use.",
        _ledger_by("fate", good_frames="bytes_in_good_frames", bad_frames="bytes_in_bad_frames",
                   skipped="bytes_skipped"), BYTES,
    ),
    _gauge("imud_bytes_pending", "Received bytes of an incomplete frame.", _ledger("bytes_pending")),
    _counter("imud_frames_good_total", "Frames with a correct checksum.", _ledger("frames_good")),
    _counter(
        "imud_frames_total", "Good frames by use.",
        _ledger_by("fate", samples="frames_in_samples", replies="frames_in_replies", ignored="frames_ignored"),
    ),
    _gauge("imud_frames_pending", "Good frames of an incomplete sample.", _ledger("frames_pending")),
    _counter(
        "imud_frames_bad_total", "Damaged frames by reason; imud uses the possible values of a not_finite frame.",
        _ledger_by("reason", crc="frames_bad_crc", length="frames_bad_length", content="frames_bad_content",
                   not_finite="frames_not_finite"),
    ),
    _counter("imud_unknown_tags_total", "Sub-packets of good frames with an unknown tag.", _ledger("unknown_tags")),
    _counter(
        "imud_frames_lost_total", "CAN frames that did not arrive, by the SID or the period of their kind.",
        _ledger("frames_lost"),
    ),
    _gauge(
        "imud_ledger_unaccounted_bytes", "Received bytes minus the bytes in the ledger; 0 unless imud has a bug.",
        LEDGER.one(bytes_open), BYTES,
    ),
    _gauge(
        "imud_ledger_unaccounted_frames", "Good frames minus the frames in the ledger; 0 unless imud has a bug.",
        LEDGER.one(frames_open),
    ),
    _counter("imud_samples_total", "Samples made of the frames.", _ledger("samples")),
    _counter(
        "imud_samples_lost_total", "Lost samples by cause.",
        _ledger_by("cause", gap_device="lost_gap_device", crc="lost_crc", overrun="lost_overrun", queue="lost_queue"),
    ),
    _counter(
        "imud_gaps_unknown_total", "Gaps with an unknown number of lost samples.",
        _ledger("lost_unknown"),
    ),
    _counter(
        "imud_replies_stray_total", "Text lines from the device that were not a reply to a request in time.",
        _ledger_by("kind", late="replies_late", unsolicited="replies_unsolicited"),
    ),
    _gauge(
        "imud_sample_rate_hertz", "Samples per second over the last seconds.", DEVICE.one(lambda d: d.rate_hz), HERTZ
    ),
    _gauge(
        "imud_sample_rate_expected_hertz", "Sample rate according to the device time; absent if unknown.",
        DEVICE.one(lambda d: d.expected_rate_hz or None), HERTZ,
    ),
    _gauge(
        "imud_sample_hold_seconds", "Present hold of samples before imud processes them as a batch; 0: no hold.",
        DEVICE.one(lambda device: device.hold_ns), SECONDS,
    ),
    _gauge(
        "imud_sample_hold_wanted_seconds", "Lowest latency that a reader of the samples requested.",
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
        "imud_clock_skew_ratio",
        "Frequency error of the device clock relative to the unsteered host clock; 4e-05: 40 ppm fast.",
        CLOCK.one(lambda clock: clock.skew_ppm), RATIO,
    ),
    _gauge(
        "imud_clock_steering_ratio", "Frequency change of CLOCK_MONOTONIC by steering; 0.0005: a slew of 500 ppm.",
        CLOCK.one(lambda clock: clock.steering_ppm), RATIO,
    ),
    _gauge(
        "imud_clock_residual_seconds", "One-sigma spread of the arrival times around the fit.",
        CLOCK.one(lambda clock: clock.residual_ns), SECONDS,
    ),
    _gauge(
        "imud_clock_error_seconds", "One-sigma error of the newest time stamp.",
        CLOCK.one(lambda clock: clock.t_err_ns), SECONDS,
    ),
    _counter("imud_clock_resets_total", "Number of restarts of the device counter.", CLOCK.one(lambda c: c.resets)),
    _gauge("imud_temperature_celsius", "Temperature from the device.", DEVICE.one(lambda d: d.temperature_c), CELSIUS),
    _gauge(
        "imud_frame_problem", "1 if gravity or heading contradicts the attitude or the configuration, otherwise 0.",
        FRAME.one(lambda frame: bool(frame.problem)),
    ),
    _gauge("imud_position_quality", "Quality of the position as sent; 0: invalid.", POSITION.one(lambda p: p.quality)),
    _gauge("imud_position_satellites", "Satellites in the position.", POSITION.one(lambda p: p.satellites)),
    _gauge("imud_status_bits", "Status word of the newest sample.", DEVICE.one(lambda d: d.status_bits)),
    _counter(
        "imud_kernel_errors_total", "Port errors that the kernel counted since imud opened the link.",
        KERNEL.by("kind", lambda kernel: {
            "overrun": kernel.overrun, "framing": kernel.framing, "parity": kernel.parity, "break": kernel.break_,
            "error_passive": kernel.error_passive, "bus_off": kernel.bus_off,
        }),
    ),
)  # fmt: skip

# --- some devices -----------------------------------------------------------------------------------------------------

POLLING_FAMILIES: Final = (
    _counter("imud_polls_total", "Deadlines with a read of the device.", POLLING.one(lambda p: p.polls)),
    _counter(
        "imud_polls_late_total", "Reads that started more than a quarter of the period after the deadline.",
        POLLING.one(lambda p: p.late),
    ),
    _counter("imud_polls_missed_total", "Deadlines without a read.", POLLING.one(lambda p: p.missed)),
    _counter("imud_polls_stale_total", "Reads without a new measurement.", POLLING.one(lambda p: p.stale)),
    _counter(
        "imud_poll_delay_seconds_total", "Sum of the times from deadline to read.",
        POLLING.one(lambda p: p.late_sum_ns), SECONDS,
    ),
    _gauge(
        "imud_poll_delay_worst_seconds", "Longest time from deadline to read since the start.",
        POLLING.one(lambda p: p.late_worst_ns), SECONDS,
    ),
    _counter("imud_transfers_failed_total", "Failed transfers of polls.", POLLING.one(lambda p: p.failed)),
    _counter(
        "imud_device_vanished_total", "Number of times that imud identified a polled device again.",
        POLLING.one(lambda p: p.vanished),
    ),
    _counter(
        "imud_serial_line_timeouts_total", "Requests on the RS-485 bus of the device without a reply.",
        SERIAL_LINE.one(lambda line: line.timeouts),
    ),
    _counter(
        "imud_serial_line_late_bytes_total", "Bytes on the RS-485 bus of the device without a request.",
        SERIAL_LINE.one(lambda line: line.late_bytes), BYTES,
    ),
    _counter(
        "imud_serial_line_strange_bytes_total",
        "Bytes on the RS-485 bus of the device before a reply or in place of a reply.",
        SERIAL_LINE.one(lambda line: line.strange_bytes), BYTES,
    ),
    _counter(
        "imud_serial_line_echoes_total", "Requests on the RS-485 bus of the device that imud received as an echo.",
        SERIAL_LINE.one(lambda line: line.echoes),
    ),
)  # fmt: skip

TIME_FAMILIES: Final = (
    _gauge(
        "imud_clock_hold_seconds", "Maximum delay of received bytes by the latency timer of the adapter; 0: no delay.",
        CLOCK.one(lambda clock: clock.hold_ns), SECONDS,
    ),
    _counter(
        "imud_clock_edges_total", "Edges on SOUT or triggers on SIN that the clock used.",
        EDGES.one(lambda clock: clock.edges),
    ),
    _counter(
        "imud_clock_edges_unpaired_total", "Edges on SOUT without a sample.",
        EDGES.one(lambda clock: clock.edges_unpaired),
    ),
    _counter(
        "imud_clock_samples_unpaired_total",
        "Samples without an edge or trigger, although other samples have one.",
        EDGES.one(lambda clock: clock.samples_unpaired),
    ),
    _counter(
        "imud_triggers_unanswered_total", "Triggers on SIN without a sample.",
        TRIGGERS.one(lambda clock: clock.triggers_missed),
    ),
    _gauge(
        "imud_clock_reference_error_seconds", "One-sigma error of UTC on the host; absent if UTC is unknown.",
        CLOCK.one(lambda clock: clock.reference_error_ns or None), SECONDS,
    ),
    _gauge(
        "imud_utc_problem", "1 if the source of UTC or the feed of chronyd has a problem, otherwise 0.",
        UTC.one(lambda utc: bool(utc.problem)),
    ),
    _counter(
        "imud_utc_sentences_total", "RMC sentences received from the source.", SENTENCES.one(lambda utc: utc.sentences)
    ),
    _counter("imud_utc_sentences_sent_total", "RMC sentences sent to the device.", SENTENCES.one(lambda utc: utc.sent)),
    _counter(
        "imud_utc_sentences_refused_total", "RMC sentences that imud did not send, by cause.",
        SENTENCES.by("cause", lambda utc: utc.refused),
    ),
    _counter("imud_pps_pulses_total", "PPS pulses that imud used.", UTC.one(lambda utc: utc.pulses)),
    _counter(
        "imud_pps_pulses_ignored_total", "PPS pulses at an unexpected time, which imud ignored.",
        UTC.one(lambda utc: utc.pulses_ignored),
    ),
    _counter(
        "imud_chrony_samples_total", "Samples for chronyd: sent, or refused by chronyd.",
        UTC.by("fate", lambda utc: {"sent": utc.chrony_sent, "refused": utc.chrony_refused}),
    ),
)  # fmt: skip

LINE_FAMILIES: Final = (
    _gauge(
        "imud_line_problem", "1 if imud cannot use a line or if its level is implausible, otherwise 0.",
        LINES.by("line", _line_problems),
    ),
    _counter("imud_line_edges_total", "Edges on a line.", LINES.by("line", lambda lines: lines.edges)),
    _counter(
        "imud_line_edges_lost_total", "Edges that the kernel dropped because imud did not read them in time.",
        LINES.by("line", lambda lines: lines.edges_lost),
    ),
    _gauge(
        "imud_alarm_active", "1 if the ALARM line is active, otherwise 0; absent if its level is unknown.",
        LINES.one(lambda lines: lines.alarm),
    ),
    _counter("imud_alarms_total", "Activations of the ALARM line.", ALARM.one(lambda lines: lines.alarms)),
    _counter("imud_triggers_total", "Triggers on SIN.", SIN.one(lambda lines: lines.triggers)),
    _counter(
        "imud_triggers_missed_total", "Deadlines without a trigger because the host was busy.",
        SIN.one(lambda lines: lines.triggers_missed),
    ),
    _counter(
        "imud_trigger_delay_seconds_total", "Sum of the times from deadline to trigger.",
        SIN.one(lambda lines: lines.trigger_late_sum_ns), SECONDS,
    ),
    _gauge(
        "imud_trigger_delay_worst_seconds", "Longest time from deadline to trigger since the start.",
        SIN.one(lambda lines: lines.trigger_late_worst_ns), SECONDS,
    ),
)  # fmt: skip

SETTINGS_FAMILIES: Final = (
    _gauge(
        "imud_settings_differ", "Number of device settings that differ from the declared settings; absent if unknown.",
        COMPARED.one(lambda settings: len(settings.differences)),
    ),
    _gauge(
        "imud_settings_problem", "1 if imud cannot read, apply or save the declared settings, otherwise 0.",
        DECLARED.one(lambda settings: bool(settings.problem)),
    ),
    _counter(
        "imud_settings_repairs_total", "Number of times that imud applied the declared settings without a request.",
        DECLARED.one(lambda settings: settings.repairs),
    ),
    _counter(
        "imud_settings_flash_writes_total", "Writes to the flash of the device by imud, including earlier runs.",
        SETTINGS.one(lambda settings: settings.flash_writes),
    ),
    _gauge(
        "imud_settings_flash_writes_day", "Writes to the flash in the last 24 hours, which imud limits.",
        SETTINGS.one(lambda settings: settings.flash_writes_day),
    ),
)  # fmt: skip

# --- shared memory ----------------------------------------------------------------------------------------------------

RING_FAMILIES: Final = (
    _gauge(
        "imud_ring_written", "1 if imud writes the ring of the device in shared memory, otherwise 0.",
        RING.one(lambda ring: ring.written),
    ),
    _gauge(
        "imud_attitude_radians", "Attitude of the newest sample.",
        _vector("angle", ANGLES, lambda motion: motion.attitude_rad), RADIANS,
    ),
    _gauge(
        "imud_acceleration_norm_meters_per_second_squared", "Norm of the mean acceleration of the last second.",
        MOTION.one(lambda motion: motion.accel_norm_m_s2), ACCELERATION,
    ),
    _gauge(
        "imud_vibration_rms_meters_per_second_squared",
        "RMS of the deviation of the acceleration from its mean of each second.",
        _vector("axis", AXES, lambda motion: motion.vibration_rms_m_s2), ACCELERATION,
    ),
    _gauge(
        "imud_vibration_peak_meters_per_second_squared",
        "Maximum deviation of the acceleration from its mean of each second.",
        _vector("axis", AXES, lambda motion: motion.vibration_peak_m_s2), ACCELERATION,
    ),
    _gauge(
        "imud_motion_span_seconds", "Time from the oldest to the newest sample of the vibration values.",
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
        "imud_clients", "Clients by the encoding of their subscription; none: no subscription.",
        Reader(("encoding",), _clients_by_encoding),
    ),
    _gauge(
        "imud_client_queue_samples", "Samples in the queues of all clients.",
        daemon(lambda snapshot: sum(client.queue_samples for client in snapshot.clients)),
    ),
    _gauge(
        "imud_client_queue_samples_max", "Samples in the longest queue of a client.",
        daemon(lambda snapshot: max((client.queue_samples for client in snapshot.clients), default=0)),
    ),
    _gauge(
        "imud_client_queue_bytes", "Bytes in the queues of all clients.",
        daemon(lambda snapshot: sum(client.queue_bytes for client in snapshot.clients)), BYTES,
    ),
    _counter(
        "imud_client_samples_sent_total", "Samples sent to clients, updated at each scrape.",
        daemon(lambda snapshot: snapshot.client_samples_sent),
    ),
    _counter(
        "imud_client_samples_dropped_total",
        "Samples dropped for slow clients, updated at each scrape.",
        daemon(lambda snapshot: snapshot.client_samples_dropped),
    ),
    _counter(
        "imud_events_total", "Events by kind; device is empty for events of the daemon.",
        Reader(("device", "kind"), lambda snapshot: snapshot.events),
    ),
)  # fmt: skip

# All metrics in the order of the output
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


def _mqtt(read: Callable[[MqttStatus], float]) -> Reader:
    return each(lambda snapshot: snapshot.mqtts, read)


def _dropped(snapshot: Snapshot) -> Lines:
    return [((cause,), count) for status in snapshot.mqtts for cause, count in status.dropped.items()]


def _counter_of(name: str, words: str, read: Callable[[MqttStatus], float]) -> Family:
    return Family(f"imud_mqtt_{name}_total", MetricType.COUNTER, NO_UNIT, words, _mqtt(read))


def _gauge_of(name: str, unit: Unit, words: str, read: Callable[[MqttStatus], float]) -> Family:
    return Family(f"imud_mqtt_{name}", MetricType.GAUGE, unit, words, _mqtt(read))


MQTT_FAMILIES: Final = (
    _gauge_of(
        "connected", NO_UNIT, "1 if a broker is connected and acknowledges messages, otherwise 0.",
        lambda status: bool(status.broker) and not status.problem,
    ),
    _gauge_of(
        "spooling", NO_UNIT, "1 if imud can write the spool, 0 if the disk is full or fails.",
        lambda status: not status.spool_problem,
    ),
    _counter_of("queued", "Samples and events given to the output.", lambda status: status.queued),
    _counter_of("spooled_messages", "Messages written to the spool.", lambda status: status.spooled),
    _counter_of("sent_messages", "Sent messages, including repeated messages.", lambda status: status.sent),
    _counter_of("acknowledged_messages", "Messages that the broker acknowledged.", lambda status: status.acknowledged),
    _gauge_of("waiting_messages", NO_UNIT, "Messages in the spool.", lambda status: status.waiting),
    _gauge_of(
        "refused_topics", NO_UNIT, "Topics that the broker refuses; imud sends all other messages.",
        lambda status: len(status.refused),
    ),
    _gauge_of("spool_bytes", BYTES, "Size of the spool.", lambda status: status.spool_bytes),
    _counter_of(
        "thinned", "Samples that imud replaced by statistics because the spool was full.",
        lambda status: status.thinned,
    ),
    Family(
        "imud_mqtt_dropped_total", MetricType.COUNTER, NO_UNIT, "Dropped samples and events by cause.",
        Reader(("cause",), _dropped),
    ),
    _counter_of("reconnects", "Connections to a broker after the first.", lambda status: status.reconnects),
    _counter_of("commands", "Requests for commands that imud ran.", lambda status: status.commands),
    _counter_of("commands_refused", "Rejected requests for commands.", lambda status: status.commands_refused),
    _counter_of("replies_lost", "Discarded replies to requests for commands.", lambda status: status.replies_lost),
)  # fmt: skip


def _port(read: Callable[[OutputStatus], float]) -> Reader:
    """Return a reader of a value of each port."""

    def lines(snapshot: Snapshot) -> Lines:
        return [((output, port.name), read(port)) for output, ports in snapshot.ports.items() for port in ports]

    return Reader(("output", "port"), lines)


PORT_FAMILIES: Final = (
    Family(
        "imud_output_messages_total", MetricType.COUNTER, NO_UNIT, "Messages sent to a port of an output.",
        _port(lambda status: status.sent),
    ),
    Family(
        "imud_output_messages_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Messages that imud dropped because a port was missing or its queue was full.",
        _port(lambda status: status.dropped),
    ),
    Family(
        "imud_output_received_discarded_total", MetricType.COUNTER, NO_UNIT,
        "Received messages that imud ignored because they were invalid or above a limit.",
        _port(lambda status: status.discarded),
    ),
    Family(
        "imud_output_readers", MetricType.GAUGE, NO_UNIT,
        "Clients of a server; for a port or an address 1 if it accepts data, otherwise 0.",
        _port(lambda status: status.readers),
    ),
)  # fmt: skip


def _recorder(read: Callable[[RecorderStatus], float]) -> Reader:
    return each(lambda snapshot: snapshot.recorders, read)


def _flight(read: Callable[[FlightStatus], float]) -> Reader:
    return each(lambda snapshot: snapshot.flights, read)


def _snapshots(snapshot: Snapshot) -> Lines:
    """Return the number of snapshots by result."""
    return [
        ((result,), getattr(status, result))
        for status in snapshot.flights
        for result in ("saved", "failed", "left_out")
    ]


def _disk(snapshot: Snapshot) -> Lines:
    """Return the size of all recordings. Only the continuous recorder knows the size of its open file."""
    always = [status.disk_bytes for status in snapshot.recorders]
    return [((), size) for size in always or [status.disk_bytes for status in snapshot.flights]]


RECORDINGS_FAMILIES: Final = (
    Family(
        "imud_recordings_bytes", MetricType.GAUGE, BYTES,
        "Size of all recordings in the directory of the recorder, including snapshots.", Reader((), _disk),
    ),
)  # fmt: skip

RECORDER_FAMILIES: Final = (
    Family(
        "imud_recorder_active", MetricType.GAUGE, NO_UNIT, "1 if imud records, 0 if the disk is full or fails.",
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
        "Records that imud dropped because the disk was too slow.",
        _recorder(lambda status: status.records_dropped),
    ),
    Family(
        "imud_recorder_waiting_bytes", MetricType.GAUGE, BYTES, "Size of the records in the queue of the recorder.",
        _recorder(lambda status: status.waiting_bytes),
    ),
    Family(
        "imud_recorder_files_removed_total", MetricType.COUNTER, NO_UNIT,
        "Recordings that imud removed to stay below the size limit.",
        _recorder(lambda status: status.files_removed),
    ),
)  # fmt: skip

FLIGHT_FAMILIES: Final = (
    Family(
        "imud_flight_recorder_active", MetricType.GAUGE, NO_UNIT,
        "1 if the flight recorder records, 0 if there is no room for it.",
        _flight(lambda status: not status.problem),
    ),
    Family(
        "imud_flight_recorder_kept_seconds", MetricType.GAUGE, SECONDS, "Time that the flight recorder covers.",
        _flight(lambda status: status.kept_ns),
    ),
    Family(
        "imud_flight_recorder_kept_bytes", MetricType.GAUGE, BYTES, "Size of the data of the flight recorder.",
        _flight(lambda status: status.kept_bytes),
    ),
    Family(
        "imud_flight_recorder_records_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Records that the flight recorder dropped because the host was too slow.",
        _flight(lambda status: status.records_dropped),
    ),
    Family(
        "imud_flight_recorder_snapshots_total", MetricType.COUNTER, NO_UNIT,
        "Alerts by result: snapshot saved, failed, or left out because of the limit per hour.",
        Reader(("result",), _snapshots),
    ),
    Family(
        "imud_flight_recorder_snapshots_sent_total", MetricType.COUNTER, NO_UNIT, "Snapshots sent to clients.",
        _flight(lambda status: status.sent),
    ),
)  # fmt: skip


def _rule(read: Callable[[RuleStatus], float]) -> Reader:
    """Return a reader of a value of each rule and device."""

    def lines(snapshot: Snapshot) -> Lines:
        return [((one.device, one.rule), read(one)) for status in snapshot.rules for one in status.rules]

    return Reader(("device", "rule"), lines)


def _rule_commands(snapshot: Snapshot) -> Lines:
    return [((result,), count) for status in snapshot.rules for result, count in status.commands.items()]


def _rule_lines(snapshot: Snapshot) -> Lines:
    return [((rule,), bool(problem)) for status in snapshot.rules for rule, problem in status.lines.items()]


RULE_FAMILIES: Final = (
    Family(
        "imud_rule_active", MetricType.GAUGE, NO_UNIT, "1 if the rule is active for the device, otherwise 0.",
        _rule(lambda one: one.active),
    ),
    Family(
        "imud_rule_events_total", MetricType.COUNTER, NO_UNIT, "Number of times that the rule became active.",
        _rule(lambda one: one.begins),
    ),
    Family(
        "imud_rule_problem", MetricType.GAUGE, NO_UNIT, "1 if imud cannot evaluate the rule, otherwise 0.",
        _rule(lambda one: bool(one.problem)),
    ),
    Family(
        "imud_rule_line_problem", MetricType.GAUGE, NO_UNIT, "1 if imud cannot drive the GPIO line, otherwise 0.",
        Reader(("rule",), _rule_lines),
    ),
    Family(
        "imud_rule_commands_total", MetricType.COUNTER, NO_UNIT, "Commands of rules by result.",
        Reader(("result",), _rule_commands),
    ),
)  # fmt: skip
