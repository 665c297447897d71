"""Table: the row `DRIVER` of the Forsense IMU61x on a UART."""

from random import Random
from typing import Final

from imud.contracts.driver import StreamDriver
from imud.devices.imu61x.common.data_sheet import SHEET
from imud.devices.imu61x.common.family import EULER_CONVENTION, NAVIGATION_FRAME, random_vector, relative_heading
from imud.devices.imu61x.uart.actions import ACTIONS
from imud.devices.imu61x.uart.calibrations import CALIBRATIONS
from imud.devices.imu61x.uart.codec import TIMER_MODULUS, Imu61xCodec, encode_ahrs
from imud.devices.imu61x.uart.commands import BAUD_RATES
from imud.devices.imu61x.uart.contact import Imu61xUartSettings
from imud.devices.imu61x.uart.session import identify, read_settings, wake
from imud.devices.imu61x.uart.settings import SETTINGS
from imud.frames.conventions import FLU_LEVEL
from imud.units import NS_PER_US


def _example_frame(random: Random) -> bytes:
    """An AHRS frame with random values."""
    return encode_ahrs(
        timer_us=random.randrange(TIMER_MODULUS),
        accel_m_s2=random_vector(random, 9.8),
        gyro_rad_s=random_vector(random, 2),
        euler_rad=(random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)),
        temperature_c=random.uniform(-40, 85),
    )


DRIVER: Final = StreamDriver(
    name="imu61x-uart",
    title="Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B (UART)",
    baud_rates=BAUD_RATES,
    settings=Imu61xUartSettings,
    make_codec=Imu61xCodec,
    tick_ns=NS_PER_US,
    tick_modulus=TIMER_MODULUS,
    euler_convention=EULER_CONVENTION,
    navigation_frame=NAVIGATION_FRAME,
    data_sheet=SHEET,
    axes=FLU_LEVEL,
    heading=relative_heading,
    lines=frozenset({"reset"}),
    actions=ACTIONS,
    calibrations=CALIBRATIONS,
    device_settings=SETTINGS,
    identify=identify,
    read_settings=read_settings,
    wake=wake,
    example_frame=_example_frame,
)
