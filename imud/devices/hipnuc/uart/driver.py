"""Table: the row `DRIVER` of HiPNUC modules on a UART."""

from collections.abc import Mapping
from random import Random
from typing import Any, Final

from imud.attitude import euler312_from_quat, quat_normalized
from imud.contracts.codec import StreamCodec
from imud.contracts.driver import Identity, StreamDriver
from imud.devices.hipnuc.common.data_sheet import FLOATS
from imud.devices.hipnuc.common.heading import heading_by_mode
from imud.devices.hipnuc.common.main_status import MAIN_STATUS
from imud.devices.hipnuc.uart.actions import ACTIONS
from imud.devices.hipnuc.uart.alarm import alarm_ranges
from imud.devices.hipnuc.uart.calibrations import CALIBRATIONS
from imud.devices.hipnuc.uart.codec import (
    HEADER,
    TIME_BITS,
    HipnucCodec,
    HipnucSettings,
    encode_frame,
    encode_hi91,
    encode_hi92,
)
from imud.devices.hipnuc.uart.commands import BAUD_RATES
from imud.devices.hipnuc.uart.line_check import declared_line_differences, line_differences, message_limits
from imud.devices.hipnuc.uart.packets import PPS_STAMP_MODULUS_MS
from imud.devices.hipnuc.uart.session import identify, read_settings, wake, why_silent
from imud.devices.hipnuc.uart.settings import SETTINGS, shown
from imud.units import NS_PER_MS


def _example_frame(random: Random) -> bytes:
    """HI91 or HI92 with random values; one in four carries both."""
    quat = quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1)))
    common: Mapping[str, Any] = {
        "accel_m_s2": (random.gauss(0, 5), random.gauss(0, 5), random.gauss(9.8, 5)),
        "gyro_rad_s": (random.gauss(0, 2), random.gauss(0, 2), random.gauss(0, 2)),
        "mag_t": (random.gauss(0, 5e-5), random.gauss(0, 5e-5), random.gauss(0, 5e-5)),
        "quat_wxyz": quat,
        "euler_rad": euler312_from_quat(quat),
        "temperature_c": random.uniform(-40, 85),
        "pressure_pa": random.uniform(80_000, 110_000),
    }
    word = random.randrange(PPS_STAMP_MODULUS_MS)
    floats = encode_hi91(system_time_ms=random.randrange(2**32), word_1_2=word, **common)
    integers = encode_hi92(pps_stamp_ms=word, status=random.randrange(2**16), **common)
    both = encode_frame(floats[HEADER.size :] + integers[HEADER.size :])
    return random.choice((floats, floats, integers, both))


def _apply_identity(codec: StreamCodec, identity: Identity) -> None:
    version = (identity.details or {}).get("APP_VER", "")
    if isinstance(codec, HipnucCodec) and version.isdecimal():
        codec.learn_app_ver(int(version))


DRIVER: Final = StreamDriver(
    name="hipnuc-uart",
    title="HiPNUC CH0x0, CH10x, HI14 (UART, RS-232, USB)",
    baud_rates=BAUD_RATES,
    settings=HipnucSettings,
    make_codec=HipnucCodec,
    tick_ns=NS_PER_MS,
    tick_modulus=2**32,
    stamp_modulus=PPS_STAMP_MODULUS_MS,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above",
    navigation_frame="ENU",
    heading=heading_by_mode,
    lines=frozenset({"sout", "sout_div", "sin", "alarm", "pps"}),
    alarm_ranges=alarm_ranges,
    time_bits=TIME_BITS,
    status_bits=MAIN_STATUS,
    data_sheet=FLOATS,
    shown_settings=shown,
    line_differences=line_differences,
    declared_line_differences=declared_line_differences,
    limits=message_limits,
    actions=ACTIONS,
    device_settings=SETTINGS,
    calibrations=CALIBRATIONS,
    identify=identify,
    read_settings=read_settings,
    apply_identity=_apply_identity,
    wake=wake,
    why_silent=why_silent,
    example_frame=_example_frame,
)
