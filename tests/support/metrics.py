"""Status records with invented, consistent values, and HTTP requests to the server under test."""

import asyncio
import socket

import msgspec
from prometheus_client.parser import text_string_to_metric_families

from imud.attitude.conventions import Heading
from imud.contracts.condition import Condition, DeviceCondition, Reason, ReasonCode
from imud.contracts.status import (
    LATENCY_BOUNDS_NS,
    ClientStatus,
    ClockStatus,
    DeviceState,
    DeviceStatus,
    FrameStatus,
    KernelCounters,
    LinesStatus,
    PollingStatus,
    SerialLineCounters,
    UtcStatus,
)
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import Position, Sync
from imud.publishers.metrics.metric import Snapshot
from imud.publishers.metrics.publisher import Renderer
from imud.publishers.metrics.rings import MotionValues, RingView


def device(name: str, number: int = 0, **changes: object) -> DeviceStatus:
    ledger = {field: 1000 * (number + 1) + index for index, field in enumerate(LEDGER_FIELDS)}
    ledger["bytes_in"] = sum(
        ledger[key] for key in ("bytes_in_good_frames", "bytes_in_bad_frames", "bytes_skipped", "bytes_pending")
    )
    ledger["frames_good"] = sum(
        ledger[key] for key in ("frames_in_samples", "frames_in_replies", "frames_ignored", "frames_pending")
    )
    status = DeviceStatus(
        name=name, device_id=number, driver="hipnuc-uart", link=f"/dev/ttyUSB{number} at 115200 baud",
        state=DeviceState.RUNNING, problem="",
        identity={"product": "HI13", "serial_number": f"{number:08d}", "firmware": "1.7.6", "other": "x"}, settings={},
        rate_hz=999.5 + number, expected_rate_hz=1000.25, hold_ns=5_000_000, hold_wanted_ns=20_000_000, newest_seq=123,
        clock=ClockStatus(Sync.REGRESSION, 5_250_000_000, -40.0, 30_000, 45_000, 2, steering_ppm=500.0), ledger=ledger,
        kernel=KernelCounters(7, 8, 9, 10), latency_buckets=tuple(range(1, len(LATENCY_BOUNDS_NS) + 2)),
        latency_sum_ns=2_500_000_000, temperature_c=36.5, status_bits=4, connects=3,
    )  # fmt: skip
    return judged(msgspec.structs.replace(status, **changes))


def judged(status: DeviceStatus) -> DeviceStatus:
    """Return a status with a simple condition, unless it has one."""
    if status.condition is not None:
        return status
    is_ok = status.state in (DeviceState.RUNNING, DeviceState.FINISHED) and not status.problem
    reason = Reason(ReasonCode.NONE_LOST if is_ok else ReasonCode.FAILED, status.problem or "No sample was lost.")
    known = DeviceCondition(Condition.OK if is_ok else Condition.MISSING, 0, (reason,))
    return msgspec.structs.replace(status, condition=known)


POLLING = PollingStatus(
    polls=1000, late=20, missed=3, stale=4, failed=5, vanished=6,
    late_mean_ns=70_000, late_worst_ns=8_000_000, late_sum_ns=70_000_123,
)  # fmt: skip
SERIAL_LINE = SerialLineCounters(timeouts=11, late_bytes=12, strange_bytes=13, echoes=14)
LINES = LinesStatus(
    problems={"alarm": "/dev/gpiochip0 is not there"}, edges={"sout": 5000, "alarm": 2, "pps": 60},
    edges_lost={"sout": 7, "alarm": 0, "pps": 0}, alarm=True, alarms=3, sin=True, triggers=400, triggers_missed=8,
    trigger_late_mean_ns=30_000, trigger_late_worst_ns=900_000, trigger_late_sum_ns=12_000_456,
)  # fmt: skip
PLACE = Position(0.5, 0.25, 10.0, 1, 9)
UTC = UtcStatus(
    source="gpsd at 127.0.0.1:2947", problem="chronyd does not take samples", sentences=100, sent=90,
    refused={"stale": 7, "busy": 3}, pulses=59, pulses_ignored=1, chrony_sent=40, chrony_refused=19,
)  # fmt: skip
EDGED = ClockStatus(
    Sync.EDGE, 5_250_000_000, -40.0, 30_000, 4_500, 2, hold_ns=16_000_000, edges=4998, edges_unpaired=9,
    samples_unpaired=17, triggers_missed=21, reference_error_ns=250_000,
)  # fmt: skip
FRAME = FrameStatus("sensor", "device", "", "", Heading.UNKNOWN, None, {})
MOTION = MotionValues(12_500_000_000, (0.1, -0.2, 3.0), 9.81, (0.01, 0.02, 0.03), (0.04, 0.05, 0.06))


def equipped(name: str, number: int = 0, **changes: object) -> DeviceStatus:
    parts = {
        "frame": FRAME, "clock": EDGED, "polling": POLLING, "serial_line": SERIAL_LINE, "lines": LINES, "utc": UTC,
        "position": PLACE,
    }  # fmt: skip
    return device(name, number, **(parts | changes))


def views(*names: str) -> dict[str, RingView]:
    return {name: RingView(True, MOTION) for name in names}


def client(number: int, encoding: str = "json", sent: int = 0, dropped: int = 0, queue: int = 0) -> ClientStatus:
    return ClientStatus(number, 100 + number, 1000, False, encoding, sent, dropped, queue, queue * 256)


LIMIT_S = 60.0


async def ask(port: int, path: str = "/metrics", method: str = "GET", headers: str = "") -> tuple[str, str, str]:
    """Return status line, head and body of one reply, after the server has closed the connection."""
    async with asyncio.timeout(LIMIT_S):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"{method} {path} HTTP/1.1\r\nHost: x\r\n{headers}\r\n".encode())
        answer = (await reader.read()).decode()
        writer.close()
        await writer.wait_closed()
    head, _, body = answer.partition("\r\n\r\n")
    return head.partition("\r\n")[0], head, body


def read_all(connection: socket.socket) -> bytes:
    parts = []
    try:
        while part := connection.recv(65536):
            parts.append(part)
    except ConnectionResetError:
        pass
    return b"".join(parts)


def shown(prefix: str, snapshot: Snapshot) -> dict[str, float]:
    """Return the values of the metrics that start with `prefix`, by the rest of the name and the label values."""
    body = Renderer(pause=lambda: None).render(snapshot, "").body.decode()
    lines = [line for metric in text_string_to_metric_families(body) for line in metric.samples]
    return {
        " ".join((line.name.removeprefix(prefix), *line.labels.values())): line.value
        for line in lines
        if line.name.startswith(prefix)
    }
