"""Output `signalk`: motion of one device as Signal K deltas.

    batch ─▶ is a delta due? ─▶ newest sample, mean angular rate ──as ned-frd──▶ delta ─▶ server

Signs and units are from the schema of Signal K 1.7.0 (groups `navigation` and `environment`): roll positive to
starboard, pitch positive bow up, yaw and rate of turn positive to starboard, angles in rad, temperature in K, pressure
in Pa. The rate of turn is the mean angular rate since the previous delta.

A value without a new sample becomes stale. imud then sends `null` for its path, once on each connection, and the first
delta of a path on a connection contains `meta.timeout`, so that the server and its clients detect a missing imud.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

import msgspec

from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import OutputStatus
from imud.model.sample import Sample
from imud.model.staleness import is_stale, stale_after_ns
from imud.model.units import NS_PER_S
from imud.publishers.signalk.server import SignalKServer
from imud.publishers.signalk.settings import WHO, SignalKOptions
from imud.publishers.thinning import MeanRate, Pace
from imud.publishers.vessel import HeadingReference, VesselDevice, magnetic_rad, true_rad, turn_rate_rad_s, turned

SLOW_HZ: Final = 1.0  # maximum rate of variation, temperature and pressure, which change slowly
KELVIN: Final = 273.15  # 0 °C, K
TURN_RAD: Final = 2 * math.pi
NS_PER_US: Final = 1000
EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
NOT_IN_SOURCE: Final = re.compile("[^A-Za-z0-9_-]")  # characters that the schema does not allow in a part of `$source`


def source_of(device: str) -> str:
    """Return the `$source` of a device."""
    return f"imud.{NOT_IN_SOURCE.sub('_', device)}"


def motion(sample: Sample, reference: HeadingReference) -> Iterator[tuple[str, Any]]:
    """Yield path and value of the motion in a sample in `ned-frd`."""
    angles = zip(("roll", "pitch", "yaw"), sample.euler_rad or (), strict=False)
    attitude = {name: angle_rad for name, angle_rad in angles if math.isfinite(angle_rad)}
    if attitude:
        yield "navigation.attitude", attitude
    for name, heading_rad in (("True", true_rad(sample, reference)), ("Magnetic", magnetic_rad(sample, reference))):
        if heading_rad is not None:
            turned_rad = heading_rad % TURN_RAD
            yield f"navigation.heading{name}", turned_rad if turned_rad < TURN_RAD else 0.0
    rate_rad_s = turn_rate_rad_s(sample)
    if rate_rad_s is not None:
        yield "navigation.rateOfTurn", rate_rad_s
    if sample.heave_m is not None and math.isfinite(sample.heave_m):
        yield "environment.heave", sample.heave_m


def surroundings(sample: Sample, reference: HeadingReference) -> Iterator[tuple[str, Any]]:
    """Yield path and value of the variation, the temperature inside the device, and the air pressure."""
    if reference.declination_deg is not None:
        yield "navigation.magneticVariation", math.radians(reference.declination_deg)
    if sample.temperature_c is not None and math.isfinite(sample.temperature_c):
        yield "environment.inside.imu.temperature", sample.temperature_c + KELVIN
    if sample.pressure_pa is not None and math.isfinite(sample.pressure_pa):
        yield "environment.outside.pressure", sample.pressure_pa


def time_text(utc_ns: int) -> str:
    """Return UTC as ISO 8601 with milliseconds."""
    return (EPOCH + timedelta(microseconds=utc_ns // NS_PER_US)).isoformat(timespec="milliseconds")[:-6] + "Z"


def delta(
    source: str, utc_ns: int | None, values: Sequence[tuple[str, Any]], timeouts_s: Mapping[str, int] | None = None
) -> str:
    """Return a delta for the own vessel. Without `utc_ns`, the server sets the time of arrival. `timeouts_s`: age after
    which the value of a path is stale."""
    update: dict[str, Any] = {"$source": source}
    if utc_ns is not None:
        update["timestamp"] = time_text(utc_ns)
    update["values"] = [{"path": path, "value": value} for path, value in values]
    if timeouts_s:
        update["meta"] = [{"path": path, "value": {"timeout": timeout}} for path, timeout in timeouts_s.items()]
    return msgspec.json.encode({"updates": [update]}).decode()


@dataclass(slots=True)
class SentValue:
    """State of a path of one source, as the server knows it."""

    sent_ns: int = 0  # CLOCK_MONOTONIC of the newest value
    period_ns: int = 0  # time between two values
    timeout_s: int = 0  # timeout that the server knows on this connection; 0: none
    is_null: bool = False  # whether the server knows on this connection that the value is stale


class SignalK:
    """Output of the deltas of one device. Synchronization: the event loop's thread only."""

    def __init__(self, options: SignalKOptions, context: PublisherContext) -> None:
        self._context = context
        self._period_ns = round(NS_PER_S / options.rate_hz)
        self._pace, self._slow_pace = Pace(options.rate_hz), Pace(min(options.rate_hz, SLOW_HZ))
        self._device = VesselDevice(WHO, options.device, self._period_ns, context)
        self._server = SignalKServer(options, context.state_dir, context.clock)
        self._newest_ns = self._delta_ns = 0  # time stamps of the newest sample and of the newest delta
        self._step_ns = 0  # time between the last two samples; 0 before the second sample
        self._rate = MeanRate()
        self._sent_values: dict[tuple[str, str], SentValue] = {}  # by source and path
        self._connections = 0  # number of connections at the last delta

    def start(self) -> None:
        """Start to connect."""
        self._server.start()
        self._context.outputs.ports[WHO] = self.status

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. The output uses the configured device, or the only device."""
        self._device.add(name)

    def remove_device(self, name: str) -> None:
        self._device.remove(name)

    event: Final = None  # Signal K has no path for the events of a device

    def publish(self, batch: Batch) -> None:
        """Send a due delta with the values of the newest sample. Ignore the batches of other devices."""
        if batch.device != self._device.name:
            return
        self._rate.add(batch.samples)
        newest = batch.samples[-1]
        t_ns = newest.t_ns
        step_ns, self._newest_ns = t_ns - self._newest_ns, t_ns
        # one long step is a pause, not the period of the device
        device_period_ns = min(step_ns, self._step_ns)
        self._step_ns = step_ns
        if not self._pace.is_due(t_ns, step_ns):
            return
        delta_step_ns, self._delta_ns = t_ns - self._delta_ns, t_ns
        reference = self._device.reference
        sample = turned(batch, msgspec.structs.replace(newest, gyro_rad_s=self._rate.take()))
        values = list(motion(sample, reference))
        slow_values: list[tuple[str, Any]] = []
        if self._slow_pace.is_due(t_ns, delta_step_ns):
            slow_values = list(surroundings(sample, reference))
        if not values and not slow_values:
            return
        period_ns = max(self._period_ns, device_period_ns)
        source = source_of(batch.device)
        timeouts_s = self._note_values(source, values, period_ns)
        timeouts_s |= self._note_values(source, slow_values, max(period_ns, round(NS_PER_S / SLOW_HZ)))
        values += slow_values
        utc_ns = None if self._context.clock.utc_reference() is None else sample.utc_ns
        self._server.put(values[0][0], source, delta(source, utc_ns, values, timeouts_s))

    def tick(self, now_ns: int) -> None:
        """Read the heading reference. Send `null` for stale values."""
        self._device.tick(now_ns)
        self._follow_connection()
        stale_paths: dict[str, list[str]] = {}  # by source
        for (source, path), sent_value in self._sent_values.items():
            if not sent_value.is_null and is_stale(sent_value.sent_ns, now_ns, sent_value.period_ns):
                stale_paths.setdefault(source, []).append(path)
        for source, paths in stale_paths.items():
            self._send_null(source, paths, now_ns)

    def _send_null(self, source: str, paths: Sequence[str], now_ns: int) -> None:
        """Tell the server that the values of paths are no longer current; without a connection after the next one."""
        if not self._server.is_open:
            return
        clock = self._context.clock
        utc_ns = None if clock.utc_reference() is None else now_ns + clock.utc_offset_ns()
        self._server.put(paths[0], source, delta(source, utc_ns, [(path, None) for path in paths]))
        for path in paths:
            self._sent_values[source, path].is_null = True

    def _note_values(self, source: str, values: Sequence[tuple[str, Any]], period_ns: int) -> dict[str, int]:
        """Note the values of a delta. Return the timeouts that the server does not know yet."""
        self._follow_connection()
        now_ns = self._context.clock.now_ns()
        timeout_s = math.ceil(stale_after_ns(period_ns) / NS_PER_S)
        timeouts_s: dict[str, int] = {}
        for path, _ in values:
            sent_value = self._sent_values.setdefault((source, path), SentValue())
            sent_value.sent_ns = now_ns
            sent_value.period_ns = period_ns
            sent_value.is_null = False
            if sent_value.timeout_s < timeout_s:
                sent_value.timeout_s = timeouts_s[path] = timeout_s
        return timeouts_s

    def _follow_connection(self) -> None:
        """Forget after a new connection what the server knew: it may have restarted."""
        if self._connections == self._server.connections:
            return
        self._connections = self._server.connections
        for sent_value in self._sent_values.values():
            sent_value.timeout_s = 0
            sent_value.is_null = False

    def close(self) -> None:
        """Disconnect and withdraw the latency request. A second call does nothing."""
        self._server.close()
        self._device.close()
        self._context.outputs.ports.pop(WHO, None)

    def status(self) -> list[OutputStatus]:
        """Return the state of the connection."""
        return [self._server.status()]
