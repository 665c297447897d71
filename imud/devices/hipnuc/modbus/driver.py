"""Table: the row `DRIVER` of HiPNUC modules on RS-485."""

from random import Random
from typing import Final

from imud.attitude import euler312_from_quat, quat_normalized
from imud.contracts.polling import PolledDriver
from imud.devices.hipnuc.common.data_sheet import REGISTERS
from imud.devices.hipnuc.common.heading import heading_by_mode
from imud.devices.hipnuc.common.main_status import MAIN_STATUS
from imud.devices.hipnuc.modbus.actions import ACTIONS
from imud.devices.hipnuc.modbus.calibrations import CALIBRATIONS
from imud.devices.hipnuc.modbus.codec import HipnucModbusCodec, HipnucModbusSettings, pack_block, update_ns
from imud.devices.hipnuc.modbus.frames import FACTORY_ID, registers_reply
from imud.devices.hipnuc.modbus.session import probe, set_up
from imud.devices.hipnuc.modbus.settings import SETTINGS
from imud.formats.modbus import SLAVES, framed
from imud.sample import Vector3
from imud.units import NS_PER_MS


def _example_reading(random: Random) -> bytes:
    """A block with random values."""
    quat = quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1)))

    def three(spread: float) -> Vector3:
        return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))

    data = pack_block(
        accel_m_s2=three(9.8), gyro_rad_s=three(2), mag_t=three(5e-5), euler_rad=euler312_from_quat(quat),
        quat_wxyz=quat, temperature_c=random.uniform(-40, 85), pressure_pa=random.uniform(80_000, 110_000),
        uptime_ms=random.randrange(2**32),
    )  # fmt: skip
    return framed(FACTORY_ID, registers_reply(data))


DRIVER: Final = PolledDriver(
    name="hipnuc-modbus",
    title="HiPNUC CH0x0, CH10x, HI14 (RS-485, Modbus RTU)",
    settings=HipnucModbusSettings,
    tick_ns=NS_PER_MS,
    tick_modulus=2**32,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above",
    navigation_frame="ENU",
    data_sheet=REGISTERS,
    heading=heading_by_mode,
    link="rs485",
    targets=(FACTORY_ID, *(slave for slave in SLAVES if slave != FACTORY_ID)),
    probe=probe,
    set_up=set_up,
    make_codec=HipnucModbusCodec,
    update_ns=update_ns,
    example_reading=_example_reading,
    status_bits=MAIN_STATUS,
    actions=ACTIONS,
    device_settings=SETTINGS,
    calibrations=CALIBRATIONS,
)
