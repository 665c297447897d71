"""Device and client records with made-up but consistent numbers, for tests and benchmarks of the metrics."""

import msgspec

from imud.kit.status import LATENCY_BOUNDS_NS, ClientStatus, ClockStatus, DeviceState, DeviceStatus, KernelCounters
from imud.ledger import LEDGER_FIELDS
from imud.sample import Sync


def device(name: str, number: int = 0, **changes: object) -> DeviceStatus:
    """A running device whose ledger closes and whose counters all differ from each other and between devices."""
    ledger = {field: 1000 * (number + 1) + index for index, field in enumerate(LEDGER_FIELDS)}
    ledger["bytes_in"] = sum(
        ledger[key] for key in ("bytes_in_good_frames", "bytes_in_bad_frames", "bytes_skipped", "bytes_pending")
    )
    ledger["frames_good"] = sum(
        ledger[key] for key in ("frames_in_samples", "frames_in_replies", "frames_ignored", "frames_pending")
    )
    status = DeviceStatus(
        name=name,
        device_id=number,
        driver="hipnuc-uart",
        link=f"/dev/ttyUSB{number} at 115200 baud",
        state=DeviceState.RUNNING,
        problem="",
        identity={"product": "HI13", "serial_number": f"{number:08d}", "firmware": "1.7.6", "other": "x"},
        settings={},
        rate_hz=999.5 + number,
        expected_rate_hz=1000.25,
        newest_seq=123,
        clock=ClockStatus(Sync.REGRESSION, 5_250_000_000, -40.0, 30_000, 45_000, 2),
        ledger=ledger,
        kernel=KernelCounters(7, 8, 9, 10),
        latency_buckets=tuple(range(1, len(LATENCY_BOUNDS_NS) + 2)),
        latency_sum_ns=2_500_000_000,
        temperature_c=36.5,
        status_bits=4,
        connects=3,
    )
    return msgspec.structs.replace(status, **changes)


def client(number: int, encoding: str = "json", sent: int = 0, dropped: int = 0, queue: int = 0) -> ClientStatus:
    """A client that watches."""
    return ClientStatus(number, 100 + number, 1000, False, encoding, sent, dropped, queue, queue * 256)
