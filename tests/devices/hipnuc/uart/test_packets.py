"""The layouts of the sub-packets are as long as the manual says."""

import pytest

from imud.devices.hipnuc.uart.packets import HI91, HI92, PPS_STAMP_MODULUS_MS


@pytest.mark.manual("B 3.3.1 size", "B 3.3.2 size", "B 3.3.1 pps_sync_stamp")
def test_sizes_and_the_pps_stamp_that_runs_free() -> None:
    assert (HI91.size, HI92.size) == (76, 48)
    assert (8190 + 10) % PPS_STAMP_MODULUS_MS == 8
