"""Status of a device at one moment: the record behind the command `status`, shared memory and the metrics."""

from enum import StrEnum
from typing import Annotated

import msgspec
from msgspec import Meta

from imud.attitude.conventions import Heading
from imud.attitude.published import FrameWords
from imud.contracts.setting import SettingsStatus
from imud.model.options import Options
from imud.model.sample import Sync

Sigma = Annotated[float, Meta(gt=0)] | None


class Deviations(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One-sigma noise of one sample, the same for every axis, in SI units; None where it is not known."""

    accel_m_s2: Sigma = None
    """Standard deviation of one sample of the specific force, m/s²; null where it is not known."""
    gyro_rad_s: Sigma = None
    """The same of the angular rate, rad/s."""
    mag_t: Sigma = None
    """The same of the magnetic field, T."""
    attitude_rad: Sigma = None
    """The same of the attitude, about each axis of the body, rad."""
    temperature_c: Sigma = None
    """The same of the temperature, K."""
    pressure_pa: Sigma = None
    """The same of the pressure, Pa."""

    def updated(self, other: "Deviations") -> "Deviations":
        """Return these, with those of `other` that are known in their place."""
        known = {name: sigma for name in self.__struct_fields__ if (sigma := getattr(other, name)) is not None}
        return msgspec.structs.replace(self, **known)


class DeviceState(StrEnum):
    """States of a device."""

    MISSING = "missing"
    """Its link is absent; imud waits for it."""
    SEARCHING = "searching"
    """The link is open; no valid frame was heard yet."""
    RUNNING = "running"
    """Samples flow."""
    SILENT = "silent"
    """It sends nothing now, though its link is present; it was running before."""
    FINISHED = "finished"
    """A replay came to its end."""
    FAILED = "failed"
    """It needs an operator's action, see `problem`; imud tries again all the same."""


class ClockStatus(msgspec.Struct, frozen=True):
    """State of one device's clock estimate."""

    sync: Sync = Sync.ARRIVAL
    offset_ns: int = 0
    """Host CLOCK_MONOTONIC minus unwrapped device time, at the newest sample."""
    skew_ppm: float = 0.0
    """Rate error of the device's clock against the host's, unsteered (CLOCK_MONOTONIC_RAW), 1e-6; +40: it gains 40 µs
    per second."""
    residual_ns: int = 0
    """One-sigma spread of the lower envelope of arrival times around the fit."""
    t_err_ns: int = 0
    """`sync` of the newest sample."""
    resets: int = 0
    """Times the device's clock started anew (restart of the device, jump of its counter)."""
    hold_ns: int = 0
    """Longest time that the link's adapter holds bytes back (USB latency timer); 0 for none."""
    edges: int = 0
    """Pulses on the SOUT line, or triggers given on SIN."""
    edges_unpaired: int = 0
    """Of the pulses, those that belong to no sample: its frame was lost, or they were no pulses of the device."""
    samples_unpaired: int = 0
    """Samples that came while pulses did and whose own was not seen."""
    triggers_missed: int = 0
    """Triggers on SIN that no frame answered."""
    reference_error_ns: int = 0
    """One-sigma error of the host's estimate of UTC; 0 without one."""
    steering_ppm: float = 0.0
    """How much faster than CLOCK_MONOTONIC_RAW CLOCK_MONOTONIC runs now, 1e-6: what an NTP client makes of it."""


class KernelCounters(msgspec.Struct, frozen=True):
    """Errors the kernel's driver counted since the link was opened."""

    overrun: int = 0
    """UART FIFO or tty buffer overruns (TIOCGICOUNT), CAN receive queue overflows."""
    framing: int = 0
    parity: int = 0
    break_: int = msgspec.field(default=0, name="break")
    error_passive: int = 0
    """Times a CAN controller became error-passive."""
    bus_off: int = 0
    """Times a CAN controller left its bus."""


class PollingStatus(msgspec.Struct, frozen=True):
    """Reads of a polled device, since start."""

    polls: int = 0
    """Deadlines at which it was read."""
    late: int = 0
    """Of these, begun later than a quarter of the period after the deadline."""
    missed: int = 0
    """Deadlines that passed without a read: the host or the bus was busy. Also in the ledger's `lost_queue`."""
    stale: int = 0
    """Reads that gave the same bytes as the one before: the device had nothing new."""
    failed: int = 0
    """Transfers that failed."""
    vanished: int = 0
    """Times the device had to be identified again."""
    late_mean_ns: int = 0
    """From deadline to read, mean over `polls`."""
    late_worst_ns: int = 0
    """The longest."""
    late_sum_ns: int = 0
    """Sum of all lateness."""


class SerialLineCounters(msgspec.Struct, frozen=True):
    """Bytes on a shared serial line other than replies, since it was opened."""

    timeouts: int = 0
    """Requests without a reply."""
    late_bytes: int = 0
    """Bytes that came when nothing was asked."""
    strange_bytes: int = 0
    """Bytes that came before a reply, or instead of it."""
    echoes: int = 0
    """Requests that came back as an echo; no fault."""


class LinesStatus(msgspec.Struct, frozen=True):
    """The GPIO lines of one device, since start."""

    problems: dict[str, str]
    """Why a line is not watched or driven now, by its key in the configuration; empty when all are."""
    edges: dict[str, int]
    """Edges seen, by line."""
    edges_lost: dict[str, int]
    """Edges that the kernel dropped because they were not read in time, by line."""
    alarm: bool | None = None
    """Whether the ALARM line is active; None without one, or while its level is not known."""
    alarms: int = 0
    """Times it became active."""
    sin: bool = False
    """Whether imud drives SIN, or is to; what follows is of it."""
    triggers: int = 0
    """Rising edges made on SIN."""
    triggers_missed: int = 0
    """Deadlines for which none was made: the host was busy."""
    trigger_late_mean_ns: int = 0
    """From deadline to edge, mean over `triggers`."""
    trigger_late_worst_ns: int = 0
    """The longest."""
    trigger_late_sum_ns: int = 0
    """All of them together."""


class UtcStatus(msgspec.Struct, frozen=True):
    """Sources of UTC for a device and for the host, since start."""

    source: str
    """Source of RMC sentences, for people; empty without a source."""
    problem: str
    """Present fault of the source or of the feed of chronyd, one sentence; empty for none."""
    sentences: int = 0
    """Sentences that the source gave."""
    sent: int = 0
    """Of these, sent to the device."""
    refused: dict[str, int] = {}  # msgspec copies a mutable default
    """Sentences that were not sent, by cause."""
    pulses: int = 0
    """Pulses per second that counted."""
    pulses_ignored: int = 0
    """Pulses that were in step with no other."""
    chrony_sent: int = 0
    """Samples given to chronyd."""
    chrony_refused: int = 0


class FrameStatus(msgspec.Struct, frozen=True):
    """Axes, angles and heading of the samples of one device."""

    frame: str
    """Axes of vectors: those of the sensor, or of the body that it is mounted in."""
    convention: str
    """`enu-flu` or `ned-frd`; `device`: as the device sends them."""
    euler_convention: str
    """Order, axes and signs of `euler_rad`."""
    navigation_frame: str
    """The frame that `quat_wxyz` turns into."""
    heading: Heading
    """Reference of yaw."""
    declination_deg: float | None
    """Added to the heading; None without one."""
    conventions: dict[str, FrameWords]
    """What a client gets that asks for a convention, by its name."""
    problem: str = ""
    """Contradiction of gravity to attitude or mounting, or of the heading to the configuration; empty for none."""


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
"""Upper bounds of the buckets of the latency histogram, ns; a last bucket without bound follows."""


class DeviceStatus(msgspec.Struct, frozen=True):
    """The full state of one device. Made for one answer and never changed."""

    name: str
    device_id: int
    driver: str
    link: str
    """The link for people, for example `/dev/ttyUSB0 at 115200 baud`."""
    state: DeviceState
    problem: str
    """Why it is not running, one sentence; empty when it runs."""
    identity: dict[str, str]
    """`product`, `serial_number`, `firmware` and what else the device sent."""
    settings: dict[str, str]
    """The device's own settings as read back, by name and with units as far as they are known."""
    rate_hz: float
    """Samples per second over the last seconds."""
    expected_rate_hz: float
    """Rate by the device's own time stamps; 0 while unknown."""
    newest_seq: int
    clock: ClockStatus
    ledger: dict[str, int]
    kernel: KernelCounters
    latency_buckets: tuple[int, ...]
    """Samples per bucket of LATENCY_BOUNDS_NS, the unbounded last included: time from measurement to publication."""
    latency_sum_ns: int
    temperature_c: float | None
    status_bits: int | None
    connects: int
    """Times the link was opened since start."""
    status_words: tuple[str, ...] = ()
    """Names of the bits in `status_bits` that are set, as far as they are known."""
    status_bit_names: dict[str, str] = {}  # msgspec copies a mutable default
    """Names of the bits of `status` by number, from the driver; empty while it is not known or has none."""
    euler_convention: str = ""
    """Order, axes and signs of `euler_rad` as published; empty while the driver is not known."""
    navigation_frame: str = ""
    """The frame that `quat_wxyz` turns into; empty while the driver is not known."""
    frame: FrameStatus | None = None
    """Axes and angles of what is published; None while the driver is not known."""
    polling: PollingStatus | None = None
    """None for a device that sends by itself."""
    serial_line: SerialLineCounters | None = None
    """None for a device that shares no serial line; the same for all devices of one line."""
    lines: LinesStatus | None = None
    """None for a device without lines."""
    utc: UtcStatus | None = None
    """None for a device that is neither fed sentences nor has its pulse per second at the host."""
    hold_ns: int = 0
    """How long its data waits at present to be processed together, ns; 0: each sample is processed as it comes."""
    hold_wanted_ns: int = 0
    """How long the consumers of its samples would let it wait, ns: the latency that the strictest of them asks for."""
    hold_by: str = ""
    """Who that is; empty while nobody asks."""
    declared: SettingsStatus | None = None
    """How its own settings compare with those that the configuration declares; None for a driver that does not know
    them, or is not known."""
    noise: Deviations | None = None
    """Noise of its samples as the configuration has it; None where it has none."""


class RecorderStatus(msgspec.Struct, frozen=True):
    """State of the recorder."""

    file: str
    """Name of the present file; empty while nothing is recorded."""
    problem: str
    """Why nothing is recorded, one sentence; empty while it is."""
    written_bytes: int
    """Bytes written to files since the start."""
    records: int
    """Records in them."""
    records_dropped: int
    """Records that had no room because the disk was too slow."""
    waiting_bytes: int
    """Records that wait to be written."""
    files_removed: int
    """Files removed to keep within the budget."""
    disk_bytes: int
    """Size of all recordings in the directory, snapshots and the present file included."""


class FlightStatus(msgspec.Struct, frozen=True):
    """State of the flight recorder."""

    problem: str
    """Why nothing is kept, one sentence; empty while it is."""
    kept_ns: int
    """Length of what is kept now."""
    kept_bytes: int
    records_dropped: int
    """Records that had no room because this machine was too slow."""
    saved: int
    """Snapshots saved to files since the start."""
    failed: int
    """Snapshots that could not be saved."""
    left_out: int
    """Alerts that were not saved because there were too many within an hour."""
    sent: int
    """Snapshots that clients asked for."""
    disk_bytes: int
    """Size of all recordings in the directory except the one that is written at present."""


class OutputStatus(msgspec.Struct, frozen=True):
    """One way out of an output that sends sentences."""

    name: str
    """Kind and address, for example `tcp 127.0.0.1:10110`."""
    sent: int
    """Sentences sent since the start; to each client, where there are several."""
    dropped: int
    """Sentences that were not sent because the way out had no room or was away."""
    readers: int
    """Clients that are connected; 1 for a port or an address while it takes what is sent, 0 while it does not."""
    problem: str
    """Why nothing is sent, one sentence; empty while it is."""


class MqttStatus(msgspec.Struct, frozen=True):
    """State of the output `mqtt`."""

    broker: str
    """The broker that is connected; empty while there is none."""
    problem: str
    """Why nothing is sent, one sentence; empty while it is."""
    spool_problem: str
    """Why nothing is spooled, one sentence; empty while it is."""
    queued: int
    """Samples and events that were given to the output since the start."""
    spooled: int
    """Messages written to the spool."""
    sent: int
    """Messages sent, those sent again included."""
    acknowledged: int
    """Messages that the broker has taken."""
    waiting: int
    """Messages in the spool now, those that earlier runs left included."""
    spool_bytes: int
    """Room that the spool uses."""
    thinned: int
    """Samples of which only statistics are left, for want of room."""
    dropped: dict[str, int]
    """Samples and events that were dropped, by cause."""
    reconnects: int
    """Connections after the first."""
    commands: int = 0
    """Requests for actions that were carried out, or tried."""
    commands_refused: int = 0
    """Requests that were refused."""


class ClientStatus(msgspec.Struct, frozen=True):
    """One client of the UNIX socket."""

    number: int
    """Counts connections since start."""
    pid: int
    uid: int
    control: bool
    """Whether it may change things."""
    encoding: str
    """`json` or `binary` while it watches, otherwise empty."""
    sent: int
    """Samples given to its socket."""
    dropped: int
    """Samples dropped because it did not read fast enough."""
    queue_samples: int
    """Samples that wait for it now."""
    queue_bytes: int
    """Bytes that wait for it now, replies included."""


class SocketStatus(msgspec.Struct, frozen=True):
    """The UNIX socket and its clients."""

    path: str
    clients: tuple[ClientStatus, ...]
    accepted: int
    """Connections since start."""
    refused: int
    """Connections refused since start: too many, or no right to read."""
    evicted: int
    """Clients disconnected since start because they asked without reading, asked too much, or sent a line too long."""
    failed: int = 0
    """Clients disconnected since start because of an error in the daemon."""
