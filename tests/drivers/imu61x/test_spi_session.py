"""Transfer scripts of the IMU61x on SPI: identity, filters and kind of burst, with the simulated device."""

from typing import Literal

import pytest

from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import words_of
from imud.drivers.imu61x.spi import SpiDeviceOptions, probe, set_up
from imud.model.errors import DeviceRefused, TransferError, Trouble
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.uart import REGISTER_VARIANTS, RegisterBehaviour
from tests.support.simulated_modules import over_spi


class Wire:
    """Simulated device with a failure at one of its transfers."""

    def __init__(self, *, fail_at: int = -1, deaf: bool = False, behaviour: RegisterBehaviour | None = None) -> None:
        self.device = Imu61xRegisters(lambda: 0, behaviour=behaviour)
        self.sent: list[str] = []
        self._fail_at = fail_at
        self._deaf = deaf

    def transfer(self, transfer: Transfer) -> bytes:
        number = len(self.sent)
        self.sent.append(" ".join(item.hex() for item in transfer.sends))
        if number == self._fail_at:
            self.device.spi(transfer.sends[:3])  # the transfer fails in window 1
            raise TransferError(Trouble.DISTURBED, "by the test")
        data = over_spi(self.device, transfer)
        if self._deaf:
            self.device.filter, self.device.extended = 0xBB, 0
        return data


@pytest.mark.manual(
    "A 2.4 PROD_ID", "A 2.4.3 reading", "A 2.4 BURST_CTRL", "A 2.4 FILTER_CTRL", "A 2.4.2 write and read"
)
def test_probe_and_set_up() -> None:
    wire = Wire()
    assert run_transfer_script(probe(SpiDeviceOptions()), wire.transfer).product == "IMU614"
    assert wire.device.window == 0
    assert len(wire.sent) == 1

    wire = Wire()
    words = words_of(run_transfer_script(set_up(SpiDeviceOptions()), wire.transfer))
    assert words == {"accel_filter": "47 Hz", "gyro_filter": "47 Hz", "burst": "standard"}
    assert len(wire.sent) == 2  # the state and a burst
    settings = SpiDeviceOptions(accel_filter=4, gyro_filter=4, burst="extended")
    words = words_of(run_transfer_script(set_up(settings), wire.transfer))
    assert words == {"accel_filter": "10 Hz", "gyro_filter": "10 Hz", "burst": "extended"}
    assert wire.sent[3] == "fe01 8644 fe00 7e00 7e00"  # 10 Hz in the manual's example: 0x8644
    assert wire.sent[5] == "fe01 8d01 fe00 7e00 7e00"
    assert len(wire.sent) == 7
    assert (wire.device.filter, wire.device.extended, wire.device.window) == (0x44, 1, 0)

    wire = Wire()
    wire.device.extended = 1
    flips = iter([0, 0, 1, 0, 0])  # the first burst after the selection

    def transfer(one: Transfer) -> bytes:
        wire.device.faults.flips = next(flips)
        return wire.transfer(one)

    assert words_of(run_transfer_script(set_up(SpiDeviceOptions()), transfer))["burst"] == "standard"
    assert wire.device.extended == 0


@pytest.mark.parametrize("fail_at", [0, 1, 2])
@pytest.mark.manual("A 2.4.4 windows")
def test_window_is_closed_after_a_failure(fail_at: int) -> None:
    wire = Wire(fail_at=fail_at)
    with pytest.raises(TransferError):
        run_transfer_script(set_up(SpiDeviceOptions(gyro_filter=1)), wire.transfer)
    assert (wire.sent[-1], wire.device.window) == ("fe00 7e00 7e00", 0)
    wire = Wire(fail_at=3)  # the burst that shows its kind
    with pytest.raises(TransferError):
        run_transfer_script(set_up(SpiDeviceOptions(gyro_filter=1)), wire.transfer)
    assert len(wire.sent) == 4


def test_setting_that_does_not_take_is_refused() -> None:
    with pytest.raises(DeviceRefused, match="FILTER_CTRL: expected 0xb1 after the write, got 0xbb"):
        run_transfer_script(set_up(SpiDeviceOptions(gyro_filter=1)), Wire(deaf=True).transfer)
    words = "expected a burst of the selected kind extended: wrong check value: .* is 0x0000 at 0x0C and 0x0000 at 0x0D"
    with pytest.raises(DeviceRefused, match=words):
        run_transfer_script(set_up(SpiDeviceOptions(burst="extended")), Wire(deaf=True).transfer)


@pytest.mark.parametrize("variant", REGISTER_VARIANTS)
@pytest.mark.parametrize("before", [0, 1])
@pytest.mark.parametrize("burst", ["standard", "extended", "registers"])
def test_kind_of_burst_wherever_it_reads_back(
    variant: str, before: int, burst: Literal["standard", "extended", "registers"]
) -> None:
    wire = Wire(behaviour=REGISTER_VARIANTS[variant])
    wire.device.extended = before
    words = words_of(run_transfer_script(set_up(SpiDeviceOptions(burst=burst)), wire.transfer))
    if burst != "registers":
        assert words["burst"] == burst
        assert wire.device.extended == (burst == "extended")
    assert wire.device.window == 0


@pytest.mark.parametrize(
    ("product_id", "why"),
    [(b"\xff" * 8, "received only 0xFF"), (b"\x00" * 8, "received only 0x00"), (b"\x00\x00IMU61C", "SPI mode")],
)
def test_another_id_is_refused(product_id: bytes, why: str) -> None:
    wire = Wire()
    wire.device.faults.product_id = product_id
    with pytest.raises(DeviceRefused, match=why):
        run_transfer_script(probe(SpiDeviceOptions()), wire.transfer)
