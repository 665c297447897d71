"""Transfer scripts of the IMU61x on I2C: identity and filters, on the simulated device."""

import pytest

from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import words_of
from imud.drivers.imu61x.i2c import probe, set_up
from imud.drivers.imu61x.registers import RegisterOptions
from imud.model.errors import DeviceRefused
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.support.simulated_modules import over_i2c


@pytest.mark.parametrize(
    ("last", "product"), [("2", "IMU612"), ("4", "IMU614"), ("8", "IMU618"), ("A", "IMU6132A"), ("B", "IMU6132B")]
)
@pytest.mark.manual("A 3.3.3 ID")
def test_probe_names_every_product(last: str, product: str) -> None:
    script = probe(RegisterOptions())
    assert next(script) == Transfer((b"\x6a",), 8)
    with pytest.raises(StopIteration) as end:
        script.send(b"\x00\x00IMU61" + last.encode())
    assert end.value.value.product == product


@pytest.mark.manual("A 3.3.2 filters")
def test_set_up_writes_reads_back_and_leaves_alone() -> None:
    device, log = Imu61xRegisters(lambda: 0), list[Transfer]()

    def transfer(one: Transfer) -> bytes:
        log.append(one)
        return over_i2c(device, one)

    words = words_of(run_transfer_script(set_up(RegisterOptions(accel_filter=4)), transfer))
    assert words == {"accel_filter": "10 Hz", "gyro_filter": "47 Hz"}
    assert [(one.sends[0].hex(), one.read_bytes) for one in log] == [("06", 1), ("064b", 0), ("06", 1)]
    log.clear()
    run_transfer_script(set_up(RegisterOptions()), transfer)
    assert len(log) == 1
    with pytest.raises(DeviceRefused, match="expected 0x4b after the write, got 0xbb"):
        run_transfer_script(set_up(RegisterOptions(accel_filter=4)), lambda one: b"\xbb" * one.read_bytes)
