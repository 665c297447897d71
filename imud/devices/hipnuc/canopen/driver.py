"""Table: the row `DRIVER` of HiPNUC modules on CANopen."""

from random import Random
from typing import Final

from imud.contracts.can import CanDriver
from imud.contracts.driver import SAMPLE_COUNTER
from imud.contracts.sensors.data_sheet import DataSheet
from imud.devices.hipnuc.canopen.actions import ACTIONS
from imud.devices.hipnuc.canopen.cia301 import (
    EMERGENCY,
    FUNCTION_MASK,
    HEARTBEAT,
    NODE_DEFAULT,
    NODE_MASK,
    SDO_REPLY,
    SYNC,
    TPDO_FUNCTIONS,
)
from imud.devices.hipnuc.canopen.codec import (
    ACCEL_M_S2_PER_LSB,
    GYRO_RAD_S_PER_LSB,
    LAYOUTS,
    HipnucCanopenCodec,
    HipnucCanopenSettings,
    encode_tpdos,
)
from imud.devices.hipnuc.canopen.session import identify, read_settings
from imud.devices.hipnuc.canopen.settings import SETTINGS
from imud.devices.hipnuc.common.calibrations import inclinometer_zero
from imud.devices.hipnuc.common.data_sheet import DOCUMENT
from imud.formats.can import STANDARD_ID_MAX, CanFilter, CanFrame, CyclicFrame
from imud.units import NS_PER_S, NS_PER_US

US_PER_S: Final = NS_PER_S // NS_PER_US


def _example_frames(random: Random) -> list[CanFrame]:
    """TPDO1 … TPDO4 with random values."""
    frames = encode_tpdos(
        accel_m_s2=(random.gauss(0, 5), random.gauss(0, 5), random.gauss(0, 5)),
        gyro_rad_s=(random.gauss(0, 2), random.gauss(0, 2), random.gauss(0, 2)),
        euler_rad=(random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)),
        quat_wxyz=(random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1)),
    )
    return [CanFrame(TPDO_FUNCTIONS[number] + NODE_DEFAULT, False, data, 0) for number, data in frames.items()]


def _filters(settings: HipnucCanopenSettings) -> list[CanFilter]:
    functions = (*TPDO_FUNCTIONS.values(), SDO_REPLY, HEARTBEAT, EMERGENCY)
    return [CanFilter(function + settings.node, STANDARD_ID_MAX, False) for function in functions]


_SIZES: Final = {function: LAYOUTS[number].size for number, function in TPDO_FUNCTIONS.items()}


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """The sender of what has a TPDO's function and length."""
    node = can_id & NODE_MASK
    return node if node and not extended and _SIZES.get(can_id & FUNCTION_MASK) == len(data) else None


def _cyclic(settings: HipnucCanopenSettings) -> list[CyclicFrame]:
    return [CyclicFrame(SYNC, False, b"", round(US_PER_S / settings.sync_hz) * NS_PER_US)] if settings.sync_hz else []


DRIVER: Final = CanDriver(
    name="hipnuc-canopen",
    title="HiPNUC CH0x0, CH10x, HI14 (CANopen)",
    settings=HipnucCanopenSettings,
    make_codec=HipnucCanopenCodec,
    filters=_filters,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312 (Z-X-Y): pitch about X, roll about Y, yaw about Z counter-clockwise from above",
    navigation_frame="ENU",
    data_sheet=DataSheet(document=DOCUMENT, gyro_step_rad_s=GYRO_RAD_S_PER_LSB, accel_step_m_s2=ACCEL_M_S2_PER_LSB),
    actions=ACTIONS,
    calibrations=inclinometer_zero("5.4.1", ACTIONS),
    device_settings=SETTINGS,
    node_of=_node_of,
    node_settings=lambda node: HipnucCanopenSettings(node=node),
    node_title=lambda node: f"node {node}",
    identify=lambda settings: identify(settings.node),
    read_settings=lambda settings: read_settings(settings.node),
    sample_frames=4,
    example_frames=_example_frames,
    cyclic=_cyclic,
)
