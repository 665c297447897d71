"""The metrics of devices and daemon: name, help, labels, and how each is read. `docs/metrics.md` lists them.

Base units, `_total` for counters, labels of bounded sets only. Counters of one scrape come from one moment of the
event loop, so sums over them are exact: the ledger closes in every scrape.
"""

import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)

import imud
from imud.contracts.status import LATENCY_BOUNDS_NS, DeviceState, DeviceStatus
from imud.ledger import bytes_open, frames_open
from imud.publishers.metrics.clock import TIME_FAMILIES
from imud.publishers.metrics.family import Family, Labelled, one, seconds
from imud.publishers.metrics.lines import LINE_FAMILIES
from imud.publishers.metrics.polling import POLLING_FAMILIES
from imud.sample import Sync
from imud.units import NS_PER_S


def _ledger(*fields: str) -> Callable[[DeviceStatus], Labelled]:
    """One counter, `bytes_in`; or several with a label, `crc=lost_crc`."""
    pairs = [(tuple(label for label in field.split("=")[:-1]), field.split("=")[-1]) for field in fields]
    return lambda device: ((labels, device.ledger[field]) for labels, field in pairs)


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
        "imud_device_up", "1 while samples flow, else 0.", (), one(lambda d: float(d.state is DeviceState.RUNNING))
    ),
    Family(
        "imud_device_state", "1 for the state the device is in, 0 for the others.", ("state",),
        lambda d: (((state.value,), float(d.state is state)) for state in DeviceState),
    ),
    Family("imud_device_connects_total", "Times the link was opened.", (), one(lambda d: d.connects)),
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
        one(lambda device: bytes_open(device.ledger)),
    ),
    Family(
        "imud_ledger_unaccounted_frames", "Good frames less frames accounted for; 0 unless imud has a bug.", (),
        one(lambda device: frames_open(device.ledger)),
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
    Family("imud_sample_rate_hertz", "Samples per second over the last seconds.", (), one(lambda d: d.rate_hz)),
    Family(
        "imud_sample_rate_expected_hertz", "Rate by the device's own time stamps; absent while unknown.", (),
        one(lambda d: d.expected_rate_hz or None),
    ),
    Family(
        "imud_clock_sync", "1 for the present source of time stamps, 0 for the others.", ("sync",),
        lambda d: (((sync.value,), float(d.clock.sync is sync)) for sync in Sync),
    ),
    Family(
        "imud_clock_offset_seconds", "Host CLOCK_MONOTONIC minus device time, at the newest sample.", (),
        seconds(lambda d: d.clock.offset_ns),
    ),
    Family(
        "imud_clock_skew_ratio", "How much faster than the host's the device's clock runs; 4e-05 is 40 ppm.", (),
        one(lambda d: d.clock.skew_ppm / 1e6),
    ),
    Family(
        "imud_clock_residual_seconds", "One-sigma spread of arrival times around the fitted clock.", (),
        seconds(lambda d: d.clock.residual_ns),
    ),
    Family(
        "imud_clock_error_seconds", "One-sigma error of the newest time stamp.", (),
        seconds(lambda d: d.clock.t_err_ns),
    ),
    Family("imud_clock_resets_total", "Times the device's clock started anew.", (), one(lambda d: d.clock.resets)),
    Family("imud_temperature_celsius", "Temperature that the device sends.", (), one(lambda d: d.temperature_c)),
    Family("imud_status_bits", "Status word of the newest sample.", (), one(lambda d: d.status_bits)),
    Family(
        "imud_kernel_errors_total", "Errors of the port that the kernel counted since the link was opened.", ("kind",),
        _kernel,
    ),
    *POLLING_FAMILIES,
    *TIME_FAMILIES,
    *LINE_FAMILIES,
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
