"""Status of a device at one moment: the record behind the method `status`, shared memory and the metrics."""

from enum import StrEnum
from typing import Annotated

import msgspec
from msgspec import Meta

from imud.attitude.conventions import AttitudeSource, Heading
from imud.attitude.published import FrameWords
from imud.contracts.command import CalibrationStatus
from imud.contracts.condition import Condition, DeviceCondition, Reason, duration
from imud.contracts.setting import SettingsStatus
from imud.model.options import Options
from imud.model.sample import Position, Sync

Sigma = Annotated[float, Meta(gt=0)] | None


class Deviations(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One-sigma noise of one sample, equal for all axes, SI units; None if it is not known."""

    accel_m_s2: Sigma = None
    """Standard deviation of the specific force of one sample, m/s²; null if it is not known."""
    gyro_rad_s: Sigma = None
    """Standard deviation of the angular rate, rad/s."""
    mag_t: Sigma = None
    """Standard deviation of the magnetic field, T."""
    attitude_rad: Sigma = None
    """Standard deviation of the attitude about each axis of the body, rad."""
    temperature_c: Sigma = None
    """Standard deviation of the temperature, K."""
    pressure_pa: Sigma = None
    """Standard deviation of the pressure, Pa."""

    def updated(self, other: "Deviations") -> "Deviations":
        """Return these deviations, replaced by the known deviations of `other`."""
        known = {name: sigma for name in self.__struct_fields__ if (sigma := getattr(other, name)) is not None}
        return msgspec.structs.replace(self, **known)


class DeviceState(StrEnum):
    MISSING = "missing"  # the link is absent; imud waits for it
    SEARCHING = "searching"  # the link is open; imud has not received a valid frame
    RUNNING = "running"  # imud receives samples
    SILENT = "silent"  # the link is open and the device has stopped sending samples
    FINISHED = "finished"  # a replay is at its end
    FAILED = "failed"  # a fault that the user must repair, see `problem`. imud tries again periodically.


class WorkStatus(msgspec.Struct, frozen=True):
    """Running work that uses a device alone: a command, a calibration or a change of settings."""

    name: str  # for example `the command save`
    begun_ns: int  # CLOCK_MONOTONIC of the start, ns
    by: str  # who requested it, for example `uid 1000`; `imud` for its own work
    stop: str  # how a user can stop it; empty if there is no way

    def words(self, now_ns: int) -> str:
        """Describe the work for a user who waits for it."""
        started = f"{self.name} is running, started {duration(now_ns - self.begun_ns)} ago by {self.by}"
        return f"{started}; {self.stop}" if self.stop else started


class ErrorPart(msgspec.Struct, frozen=True):
    """Cause of the time stamp error, with its size and the next step."""

    name: str  # for example `adapter`
    value_ns: int  # one-sigma error from this cause, at most the time stamp error
    message: str  # the cause as a sentence
    next: str  # step that reduces this part; can be empty


class ClockStatus(msgspec.Struct, frozen=True):
    """State of the clock of one device."""

    sync: Sync = Sync.ARRIVAL
    offset_ns: int = 0  # host CLOCK_MONOTONIC minus unwrapped device time, at the newest sample
    # Rate error of the device clock against the host clock without steering (CLOCK_MONOTONIC_RAW), 1e-6; +40: the
    # device clock gains 40 µs per second
    skew_ppm: float = 0.0
    residual_ns: int = 0  # one-sigma spread of the lower envelope of arrival times around the fit
    t_err_ns: int = 0  # time stamp error of the newest sample, one sigma
    resets: int = 0  # number of restarts of the device clock (restart of the device, jump of its counter)
    # Latency timer of the link's USB adapter: maximum delay of received bytes; 0 without a USB adapter
    hold_ns: int = 0
    edges: int = 0  # number of pulses on the SOUT line, or of triggers on SIN
    # Number of pulses without a sample: the frame was lost, or the device did not send the pulse
    edges_unpaired: int = 0
    samples_unpaired: int = 0  # number of samples without a pulse of their own while pulses arrived
    triggers_missed: int = 0  # number of triggers on SIN without a frame
    reference_error_ns: int = 0  # one-sigma error of the host's estimate of UTC; 0 if there is no estimate
    # Rate of CLOCK_MONOTONIC relative to CLOCK_MONOTONIC_RAW minus 1, 1e-6: the correction by an NTP client
    steering_ppm: float = 0.0
    parts: tuple[ErrorPart, ...] = ()  # causes of `t_err_ns`, the largest first; empty before the first sample


class KernelCounters(msgspec.Struct, frozen=True):
    """Errors that the kernel counted since the link was opened."""

    overrun: int = 0  # overruns of the UART FIFO or tty buffer (TIOCGICOUNT), and overflows of the CAN receive queue
    framing: int = 0
    parity: int = 0
    break_: int = msgspec.field(default=0, name="break")
    error_passive: int = 0  # number of times that a CAN controller became error-passive
    bus_off: int = 0  # number of times that a CAN controller went to bus-off


class PollingStatus(msgspec.Struct, frozen=True):
    """Reads of a polled device since start."""

    polls: int = 0  # number of deadlines with a read
    late: int = 0  # number of reads that started later than a quarter of the period after the deadline
    # Number of deadlines without a read, because the host or the bus was busy. Also in `lost_queue` of the ledger.
    missed: int = 0
    stale: int = 0  # number of reads with the same bytes as the previous read: the device had no new values
    failed: int = 0  # number of failed transfers
    vanished: int = 0  # number of times that imud had to identify the device again
    late_mean_ns: int = 0  # time from the deadline to the read, mean over `polls`
    late_worst_ns: int = 0  # maximum time from the deadline to the read
    late_sum_ns: int = 0  # sum of the times from the deadline to the read


class SerialLineCounters(msgspec.Struct, frozen=True):
    """Unexpected bytes on an RS-485 bus since it was opened."""

    timeouts: int = 0  # number of requests without a reply
    late_bytes: int = 0  # number of bytes received without a pending request
    strange_bytes: int = 0  # number of bytes received before a reply, or in place of a reply
    echoes: int = 0  # number of requests that the adapter echoed; not a fault


class LinesStatus(msgspec.Struct, frozen=True):
    """GPIO lines of one device, since start."""

    problems: dict[str, str]  # reason for each line that imud cannot watch or drive, by key of the configuration
    edges: dict[str, int]  # number of received edges, by line
    edges_lost: dict[str, int]  # number of edges that the kernel dropped from a full buffer, by line
    alarm: bool | None = None  # whether the ALARM line is active; None if there is no line or its level is not known
    alarms: int = 0  # number of times that the ALARM line became active
    sin: bool = False  # Whether the configuration has a SIN line for this device. The following fields describe it.
    triggers: int = 0  # number of rising edges on SIN
    triggers_missed: int = 0  # number of deadlines without an edge, because the host was busy
    trigger_late_mean_ns: int = 0  # time from the deadline to the edge, mean over `triggers`
    trigger_late_worst_ns: int = 0  # maximum time from the deadline to the edge
    trigger_late_sum_ns: int = 0  # sum of the times from the deadline to the edge


class UtcStatus(msgspec.Struct, frozen=True):
    """Sources of UTC for a device and for the host, since start."""

    source: str  # readable name of the source of RMC sentences; empty if there is no source
    # Present fault of the source or of the connection to chronyd, one sentence; empty if there is no fault
    problem: str
    sentences: int = 0  # number of sentences from the source
    sent: int = 0  # number of sentences that imud sent to the device
    # Number of sentences that imud did not send, by cause
    refused: dict[str, int] = {}  # msgspec copies a mutable default
    pulses: int = 0  # number of accepted PPS pulses
    pulses_ignored: int = 0  # number of pulses outside the rhythm of the other pulses
    chrony_sent: int = 0  # number of samples that imud sent to chronyd
    chrony_refused: int = 0


class FrameProblem(StrEnum):
    """Kind of a contradiction in axes, angles or heading."""

    GRAVITY = "gravity"  # gravity at rest contradicts the attitude or the mounting
    DECLINATION = "declination"  # the heading of the device does not permit the declination of the configuration
    AXES = "axes"  # the device settings select axes that imud does not know


class RecentStatus(msgspec.Struct, frozen=True):
    """Counts of the last minute, made once per second."""

    begun_ns: int  # CLOCK_MONOTONIC at the start of all counters of the device
    rate_hz: float | None  # rate of sent samples, received or lost, over 10 s; null if it is not known
    samples: int = 0
    lost: dict[str, int] = {}  # number of lost samples by cause, without causes with no loss
    gaps: int = 0  # number of gaps of unknown size
    bytes_in: int = 0
    restarts: int = 0  # number of restarts of the device in the last hour that imud did not request
    last_sample_ns: int = 0  # CLOCK_MONOTONIC of the newest sample; 0 before the first sample
    loss_ns: int = 0  # CLOCK_MONOTONIC of the last loss; 0 before the first loss
    loss_samples: int = (
        0  # number of lost samples in the last loss; losses with less than one minute between them are one
    )
    loss_cause: str = ""  # largest cause of the last loss


class FrameStatus(msgspec.Struct, frozen=True):
    """Axes, angles and heading of the samples of one device."""

    frame: str  # axes of vectors: sensor axes, or axes of the body with the sensor
    convention: str  # `enu-flu` or `ned-frd`; `device`: as the device sends them
    euler_convention: str  # order, axes and signs of `euler_rad`
    navigation_frame: str  # destination frame of the rotation `quat_wxyz`
    heading: Heading  # reference of yaw
    declination_deg: float | None  # declination that imud adds to the heading; None without a declination
    # Axes and angles that a client receives if it requests a convention, by name of the convention
    conventions: dict[str, FrameWords]
    # Contradiction between gravity and attitude or mounting, or between the heading and the configuration; empty if
    # there is no contradiction
    problem: str = ""
    problem_kind: FrameProblem | None = None  # kind of the contradiction; null if there is none
    attitude: AttitudeSource = AttitudeSource.DEVICE  # source of `quat_wxyz` and `euler_rad`


# Upper bounds of the latency histogram, ns. One more bucket without a bound follows.
LATENCY_BOUNDS_NS = (
    50_000,
    100_000,
    200_000,
    500_000,
    1_000_000,
    2_000_000,
    5_000_000,
    10_000_000,
    20_000_000,
    50_000_000,
)


class DeviceStatus(msgspec.Struct, frozen=True):
    """Complete status of one device, made for one reply. Immutable."""

    name: str
    device_id: int
    driver: str
    link: str  # readable name of the link, for example `/dev/ttyUSB0 at 115200 baud`
    state: DeviceState
    problem: str  # reason why the device is not running, one sentence; empty while it is running
    identity: dict[str, str]  # `product`, `serial_number`, `firmware` and other properties that the device reported
    settings: dict[str, str]  # device settings as read from the device, with readable names and units if they are known
    rate_hz: float  # samples per second in the last seconds
    expected_rate_hz: float  # sample rate from the device time; 0 if it is not known
    newest_seq: int
    clock: ClockStatus
    ledger: dict[str, int]
    kernel: KernelCounters
    # Number of samples per bucket of LATENCY_BOUNDS_NS: time from measurement to publication. The last bucket has no
    # upper bound.
    latency_buckets: tuple[int, ...]
    latency_sum_ns: int
    temperature_c: float | None
    status_bits: int | None
    connects: int  # number of times that imud opened the link since start
    status_words: tuple[str, ...] = ()  # names of the known bits of `status_bits` that are set
    # Names of the bits of `status`, by number; empty if the driver is not known or has no names
    status_bit_names: dict[str, str] = {}  # msgspec copies a mutable default
    # Order, axes and signs of the published `euler_rad`; empty while the driver is not known
    euler_convention: str = ""
    navigation_frame: str = ""  # destination frame of the rotation `quat_wxyz`; empty while the driver is not known
    frame: FrameStatus | None = None  # axes and angles of published samples; None while the driver is not known
    polling: PollingStatus | None = None  # counters of the polls; None for a device that sends without requests
    # Counters of the RS-485 bus, equal for all devices of the bus; None for a device on another link
    serial_line: SerialLineCounters | None = None
    lines: LinesStatus | None = None  # status of the GPIO lines; None for a device without GPIO lines
    # Sources of UTC; None for a device that receives no sentences and has no pulse per second on the host
    utc: UtcStatus | None = None
    hold_ns: int = 0  # present hold of received data, ns; 0: imud processes each sample immediately
    hold_wanted_ns: int = 0  # maximum hold that all clients of its samples accept, ns: the strictest latency request
    hold_by: str = ""  # name of the client with this request; empty if there is no request
    # Comparison of device settings and declared settings; None if the driver is not known or has no table of settings
    declared: SettingsStatus | None = None
    # Noise of the samples from the configuration; None if the configuration does not give it
    noise: Deviations | None = None
    resets_requested: int = 0  # restarts of the device counter (`clock.resets`) that commands or settings caused
    # Condition with reasons, for all views; null for a device of a recording
    condition: DeviceCondition | None = None
    recent: RecentStatus | None = None  # counts of the last minute; null for a device of a recording
    calibration: CalibrationStatus | None = None  # running calibration; null if none is running
    work: WorkStatus | None = None  # running work that uses the device alone; null without work
    position: Position | None = None  # of the newest sample; null without a position
    unused: str = ""  # received frames that imud cannot decode: wrong length or unknown type; empty without such frames
    # Worst condition in each of the last 60 minutes, the oldest first; null for a minute before the start of imud
    history: tuple[Condition | None, ...] = ()

    @property
    def has_problem(self) -> bool:
        """Whether the condition is not `ok`."""
        return self.condition is not None and not self.condition.is_ok

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Reasons of the condition; empty for a device of a recording."""
        return self.condition.reasons if self.condition is not None else ()

    @property
    def word(self) -> str:
        """Condition; for a device of a recording its state."""
        return str(self.state if self.condition is None else self.condition.condition)


class CKernelStatus(msgspec.Struct, frozen=True):
    """Use of the optional kernel in C (`imud/_kernel.c`) by the daemon."""

    active: bool  # whether the daemon has loaded the kernel
    problem: str = ""  # reason why it is not active; empty if it is active


class RecorderStatus(msgspec.Struct, frozen=True):
    file: str  # name of the present file; empty if the recorder is not recording
    problem: str  # reason why the recorder is not recording, one sentence; empty while it is recording
    written_bytes: int  # number of bytes written to files since start
    records: int  # number of records in these files
    records_dropped: int  # number of dropped records: the queue was full, because the disk was too slow
    waiting_bytes: int  # size of the queued records
    files_removed: int  # number of files that the recorder removed to stay within its disk budget
    disk_bytes: int  # size of all recordings in the directory, with snapshots and the present file


class FlightStatus(msgspec.Struct, frozen=True):
    problem: str  # reason why the flight recorder keeps no data, one sentence; empty while it keeps data
    kept_ns: int  # time span of the data in memory
    kept_bytes: int
    records_dropped: int  # number of dropped records: the queue was full, because this host was too slow
    saved: int  # number of snapshots saved to files since start
    failed: int  # number of snapshots that could not be saved
    left_out: int  # number of alerts without a snapshot, because the limit per hour was reached
    sent: int  # number of snapshots sent to clients
    disk_bytes: int  # size of all recordings in the directory without the present file


class OutputStatus(msgspec.Struct, frozen=True):
    """One port of an output: a destination or a server."""

    name: str  # kind and address, for example `tcp 127.0.0.1:10110`
    sent: int  # number of messages (sentences, frames, lines) sent since start, the sum over all clients
    dropped: int  # number of messages that imud did not send, because the destination was full or absent
    readers: int  # Number of connected clients. For a port or an address: 1 while it accepts data, otherwise 0.
    problem: str  # reason why imud sends nothing, one sentence; empty while imud sends
    discarded: int = 0  # number of received messages that imud ignored, because they were invalid or above a limit


class OutputState(msgspec.Struct, frozen=True):
    """One configured output."""

    name: str  # key of the output in the configuration
    running: bool  # whether the output runs; False: imud starts it again after a pause
    problem: str = ""  # reason why the output or one of its ports does not work; empty if it works


class MqttStatus(msgspec.Struct, frozen=True):
    broker: str  # connected broker; empty if no broker is connected
    problem: str  # reason why imud sends nothing, one sentence; empty while imud sends
    spool_problem: str  # reason why imud does not use the spool, one sentence; empty while imud uses it
    queued: int  # number of samples and events that the output received since start
    spooled: int  # number of messages written to the spool
    sent: int  # number of messages sent, repetitions included
    acknowledged: int  # number of messages that the broker acknowledged
    waiting: int  # number of messages in the spool, with messages of earlier runs
    spool_bytes: int  # disk space of the spool, bytes
    thinned: int  # number of samples that imud reduced to statistics to save disk space
    dropped: dict[str, int]  # number of dropped samples and events, by cause
    reconnects: int  # number of connections after the first connection
    commands: int = 0  # number of requested commands that imud ran or tried to run
    commands_refused: int = 0  # number of rejected requests
    refused: dict[str, str] = {}  # reason for each topic that the broker refuses; imud sends all other messages
    replies_lost: int = 0  # number of discarded replies to requests: the broker refuses the topic, or too many wait
    # Limit that changes the messages of imud, one sentence: a broker without retained messages, or a broker that sends
    # more than imud processes; empty without a limit
    limit: str = ""


class RuleStatus(msgspec.Struct, frozen=True):
    """One rule for one device."""

    rule: str
    device: str
    active: bool  # whether the value is beyond the limit
    begins: int  # number of times that the rule became active since the start of the output
    problem: str  # reason why imud does not evaluate the rule, one sentence; empty if imud evaluates it


class RulesStatus(msgspec.Struct, frozen=True):
    """The output `rules`."""

    rules: tuple[RuleStatus, ...]
    lines: dict[str, str]  # reason for each GPIO line that imud cannot drive, by rule; empty if imud can drive it
    commands: dict[str, int]  # number of commands since the start of the output, by result

    def problems(self) -> dict[str, str]:
        """Return the problem of each rule and each GPIO line that does not work."""
        lines = {f"rules {rule} line": words for rule, words in self.lines.items() if words}
        return lines | {f"rules {one.rule} {one.device}": one.problem for one in self.rules if one.problem}


class ClientStatus(msgspec.Struct, frozen=True):
    """One client of the UNIX socket."""

    number: int  # number of the connection since start
    pid: int
    uid: int
    control: bool  # whether the client has the permission to control devices
    encoding: str  # `json` or `binary` while the client has a subscription, otherwise empty
    sent: int  # number of samples written to the client's socket
    dropped: int  # number of dropped samples, because the client did not read fast enough
    queue_samples: int  # number of samples in the client's queue
    queue_bytes: int  # number of bytes in the client's queue, replies included


class SocketStatus(msgspec.Struct, frozen=True):
    """UNIX socket and its clients."""

    path: str
    clients: tuple[ClientStatus, ...]
    accepted: int  # number of connections since start
    refused: int  # number of rejected connections since start: too many connections, or no permission to read
    # Number of clients that imud disconnected since start: no reads, too many requests, or a line that was too long
    evicted: int
    failed: int = 0  # number of clients disconnected since start because of an error in the daemon
