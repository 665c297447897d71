"""What `imud status` prints of a device."""

import msgspec

from imud.cli.status import block
from imud.kit.status import PollingStatus
from tests.publishers.device_status import device


def test_polling_is_shown_for_a_device_that_is_polled() -> None:
    polling = PollingStatus(
        polls=1000, late=20, missed=3, stale=4, failed=5, vanished=6, late_mean_ns=70_500, late_worst_ns=8_000_000
    )
    assert "polling" not in block(device("front"))
    assert block(msgspec.structs.replace(device("front"), polling=polling)).splitlines()[-1] == (
        "  polling   1000 reads, 20 late, 3 missed, 4 stale, 5 failed; 70.5 µs after the deadline, 8000.0 at worst;"
        " vanished 6 times"
    )
