"""The metrics of devices and daemon: name, help, labels, and how each is read. `docs/metrics.md` lists them.

Base units, `_total` for counters, labels of bounded sets only. Counters of one scrape come from one moment of the
event loop, so sums over them are exact: the ledger closes in every scrape.
"""

import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)

import imud
from imud.kit.status import LATENCY_BOUNDS_NS, DeviceState, DeviceStatus, PollingStatus
from imud.ledger import bytes_open, frames_open
from imud.sample import Sync
from imud.units import NS_PER_S

Labelled = Iterable[tuple[tuple[str, ...], float]]
"""Label values (besides `device`) and value."""


@dataclass(frozen=True, slots=True)
class Family:
    """One metric of every device."""

    name: str
    """As it stands in the text, `_total` included."""
    help: str
    labels: tuple[str, ...]
    """Labels besides `device`."""
    read: Callable[[DeviceStatus], Labelled]

    def metric(self, devices: Sequence[DeviceStatus]) -> Metric:
        """The metric with its samples."""
        make = CounterMetricFamily if self.name.endswith("_total") else GaugeMetricFamily
        family = make(self.name, self.help, labels=("device", *self.labels))
        for device in devices:
            for labels, value in self.read(device):
                family.add_metric((device.name, *labels), value)
        return family


def _one(read: Callable[[DeviceStatus], float | None]) -> Callable[[DeviceStatus], Labelled]:
    """A value without labels; absent where the device has none, because absent is not zero."""

    def labelled(device: DeviceStatus) -> Labelled:
        value = read(device)
        return () if value is None else (((), value),)

    return labelled


def _seconds(read: Callable[[DeviceStatus], int]) -> Callable[[DeviceStatus], Labelled]:
    return _one(lambda device: read(device) / NS_PER_S)


def _ledger(*fields: str) -> Callable[[DeviceStatus], Labelled]:
    """One counter, `bytes_in`; or several with a label, `crc=lost_crc`."""
    pairs = [(tuple(label for label in field.split("=")[:-1]), field.split("=")[-1]) for field in fields]
    return lambda device: ((labels, device.ledger[field]) for labels, field in pairs)


def _polling(read: Callable[[PollingStatus], float]) -> Callable[[DeviceStatus], Labelled]:
    """A value of devices that are asked; absent for those that send by themselves."""
    return _one(lambda device: None if device.polling is None else read(device.polling))


def _kernel(device: DeviceStatus) -> Labelled:
    kernel = device.kernel
    return (
        (("overrun",), kernel.overrun),
        (("framing",), kernel.framing),
        (("parity",), kernel.parity),
        (("break",), kernel.break_),
        (("error_passive",), kernel.error_passive),
        (("bus_off",), kernel.bus_off),
    )


DEVICE_FAMILIES: Final = (
    Family(
        "imud_device_up", "1 while samples flow, else 0.", (), _one(lambda d: float(d.state is DeviceState.RUNNING))
    ),
    Family(
        "imud_device_state", "1 for the state the device is in, 0 for the others.", ("state",),
        lambda d: (((state.value,), float(d.state is state)) for state in DeviceState),
    ),
    Family("imud_device_connects_total", "Times the link was opened.", (), _one(lambda d: d.connects)),
    Family("imud_bytes_in_total", "Bytes that the link delivered.", (), _ledger("bytes_in")),
    Family(
        "imud_bytes_total", "Bytes by what became of them.", ("fate",),
        _ledger("good_frames=bytes_in_good_frames", "bad_frames=bytes_in_bad_frames", "skipped=bytes_skipped"),
    ),
    Family("imud_bytes_pending", "Bytes that may still become a frame.", (), _ledger("bytes_pending")),
    Family("imud_frames_good_total", "Frames whose check value was right.", (), _ledger("frames_good")),
    Family(
        "imud_frames_total", "Good frames by what became of them.", ("fate",),
        _ledger("samples=frames_in_samples", "replies=frames_in_replies", "ignored=frames_ignored"),
    ),
    Family("imud_frames_pending", "Good frames that wait for the rest of their sample.", (), _ledger("frames_pending")),
    Family(
        "imud_frames_bad_total", "Damaged frames by reason; not_finite ones are used without those values.",
        ("reason",),
        _ledger(
            "crc=frames_bad_crc", "length=frames_bad_length", "content=frames_bad_content",
            "not_finite=frames_not_finite",
        ),
    ),
    Family("imud_unknown_tags_total", "Sub-packets of good frames with an unknown tag.", (), _ledger("unknown_tags")),
    Family(
        "imud_ledger_unaccounted_bytes", "Bytes delivered less bytes accounted for; 0 unless imud has a bug.", (),
        _one(lambda device: bytes_open(device.ledger)),
    ),
    Family(
        "imud_ledger_unaccounted_frames", "Good frames less frames accounted for; 0 unless imud has a bug.", (),
        _one(lambda device: frames_open(device.ledger)),
    ),
    Family("imud_samples_total", "Samples made.", (), _ledger("samples")),
    Family(
        "imud_samples_lost_total", "Samples lost by cause.", ("cause",),
        _ledger("gap_device=lost_gap_device", "crc=lost_crc", "overrun=lost_overrun", "queue=lost_queue"),
    ),
    Family(
        "imud_replies_stray_total", "Lines of text from the device that answered no request in time.", ("kind",),
        _ledger("late=replies_late", "unsolicited=replies_unsolicited"),
    ),
    Family("imud_sample_rate_hertz", "Samples per second over the last seconds.", (), _one(lambda d: d.rate_hz)),
    Family(
        "imud_sample_rate_expected_hertz", "Rate by the device's own time stamps; absent while unknown.", (),
        _one(lambda d: d.expected_rate_hz or None),
    ),
    Family(
        "imud_clock_sync", "1 for the present source of time stamps, 0 for the others.", ("sync",),
        lambda d: (((sync.value,), float(d.clock.sync is sync)) for sync in Sync),
    ),
    Family(
        "imud_clock_offset_seconds", "Host CLOCK_MONOTONIC minus device time, at the newest sample.", (),
        _seconds(lambda d: d.clock.offset_ns),
    ),
    Family(
        "imud_clock_skew_ratio", "How much faster than the host's the device's clock runs; 4e-05 is 40 ppm.", (),
        _one(lambda d: d.clock.skew_ppm / 1e6),
    ),
    Family(
        "imud_clock_residual_seconds", "One-sigma spread of arrival times around the fitted clock.", (),
        _seconds(lambda d: d.clock.residual_ns),
    ),
    Family(
        "imud_clock_error_seconds", "One-sigma error of the newest time stamp.", (),
        _seconds(lambda d: d.clock.t_err_ns),
    ),
    Family("imud_clock_resets_total", "Times the device's clock started anew.", (), _one(lambda d: d.clock.resets)),
    Family("imud_temperature_celsius", "Temperature that the device sends.", (), _one(lambda d: d.temperature_c)),
    Family("imud_status_bits", "Status word as the device sends it.", (), _one(lambda d: d.status_bits)),
    Family(
        "imud_kernel_errors_total", "Errors of the port that the kernel counted since the link was opened.", ("kind",),
        _kernel,
    ),
    Family("imud_polls_total", "Deadlines at which the device was read.", (), _polling(lambda p: p.polls)),
    Family(
        "imud_polls_late_total", "Of these, begun more than a quarter of the period after the deadline.", (),
        _polling(lambda p: p.late),
    ),
    Family("imud_polls_missed_total", "Deadlines that passed without a read.", (), _polling(lambda p: p.missed)),
    Family("imud_polls_stale_total", "Reads that gave nothing new.", (), _polling(lambda p: p.stale)),
    Family(
        "imud_poll_delay_seconds_total", "Time from deadline to read, summed over all polls.", (),
        _polling(lambda p: p.late_sum_ns / NS_PER_S),
    ),
    Family(
        "imud_poll_delay_worst_seconds", "Longest time from deadline to read since start.", (),
        _polling(lambda p: p.late_worst_ns / NS_PER_S),
    ),
    Family("imud_transfers_failed_total", "Transfers of polls that failed.", (), _polling(lambda p: p.failed)),
    Family(
        "imud_device_vanished_total", "Times a polled device had to be identified again.", (),
        _polling(lambda p: p.vanished),
    ),
)  # fmt: skip
"""Metrics of a device with one value per label set, in the order they are shown."""

LATENCY_NAME: Final = "imud_sample_latency_seconds"
LATENCY_HELP: Final = "Time from the measurement to its publication."
DEVICE_INFO_NAME: Final = "imud_device_info"
DEVICE_INFO_HELP: Final = "What the device is; always 1."
DEVICE_INFO_LABELS: Final = ("device", "driver", "link", "product", "serial_number", "firmware")
BUILD_INFO_NAME: Final = "imud_build_info"
BUILD_INFO_HELP: Final = "What runs here; always 1."
HEARTBEAT_NAME: Final = "imud_heartbeat_age_seconds"
HEARTBEAT_HELP: Final = "Time since the daemon's ten-times-a-second tick; grows when the event loop is stuck."
EVENTS_NAME: Final = "imud_events_total"
EVENTS_HELP: Final = "Events by kind; device is empty for the daemon's own."

_BOUNDS: Final = (*(str(bound / NS_PER_S) for bound in LATENCY_BOUNDS_NS), "+Inf")


def device_metrics(devices: Sequence[DeviceStatus]) -> Iterator[Metric]:
    """All metrics of all devices, one at a time, so that a caller can pause between them."""
    yield device_info(devices)
    for family in DEVICE_FAMILIES:
        yield family.metric(devices)
    yield latency(devices)


def device_info(devices: Sequence[DeviceStatus]) -> Metric:
    """Driver, link and identity of each device as labels."""
    info = InfoMetricFamily(DEVICE_INFO_NAME.removesuffix("_info"), DEVICE_INFO_HELP, labels=DEVICE_INFO_LABELS)
    for device in devices:
        identity = (device.identity.get(key, "") for key in ("product", "serial_number", "firmware"))
        info.add_metric((device.name, device.driver, device.link, *identity), {})
    return info


def latency(devices: Sequence[DeviceStatus]) -> Metric:
    """Histogram of the time from measurement to publication; its counts are cumulative, as Prometheus has them."""
    histogram = HistogramMetricFamily(LATENCY_NAME, LATENCY_HELP, labels=("device",))
    for device in devices:
        count, buckets = 0, []
        for bound, samples in zip(_BOUNDS, device.latency_buckets, strict=True):
            count += samples
            buckets.append((bound, count))
        histogram.add_metric((device.name,), buckets, device.latency_sum_ns / NS_PER_S)
    return histogram


def build_info() -> Metric:
    """Versions of imud and Python."""
    info = InfoMetricFamily(BUILD_INFO_NAME.removesuffix("_info"), BUILD_INFO_HELP, labels=("version", "python"))
    info.add_metric((imud.__version__, platform.python_version()), {})
    return info


def heartbeat(age_ns: int) -> Metric:
    """How long ago the daemon's tick was."""
    return GaugeMetricFamily(HEARTBEAT_NAME, HEARTBEAT_HELP, value=age_ns / NS_PER_S)


def events(counts: Iterable[tuple[tuple[str, str], int]]) -> Metric:
    """Counts by (device, kind)."""
    family = CounterMetricFamily(EVENTS_NAME, EVENTS_HELP, labels=("device", "kind"))
    for labels, count in counts:
        family.add_metric(labels, count)
    return family
