"""The row `DRIVER` of the Forsense IMU61x on CAN, with the filters and the detection that it names."""

from random import Random
from typing import Final

from imud.contracts.can import CanDriver
from imud.contracts.driver import SAMPLE_COUNTER, Identity
from imud.contracts.session import says_nothing
from imud.devices.imu61x.can.codec import (
    BASE_ID,
    FRAME_BYTES,
    INDEX_MODULUS,
    SET_FRAMES,
    Imu61xCanCodec,
    Imu61xCanSettings,
    encode_set,
)
from imud.devices.imu61x.common.data_sheet import SHEET
from imud.devices.imu61x.common.family import EULER_CONVENTION, NAVIGATION_FRAME, random_vector, relative_heading
from imud.formats.can import STANDARD_ID_MAX, CanFilter, CanFrame
from imud.frames.conventions import FLU_LEVEL


def _example_frames(random: Random) -> list[CanFrame]:
    """A set with random values."""
    frames = encode_set(
        index=random.randrange(INDEX_MODULUS),
        accel_m_s2=random_vector(random, 9.8),
        gyro_rad_s=random_vector(random, 2),
        euler_rad=(random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)),
        temperature_c=random.uniform(-40, 85),
    )
    return [CanFrame(can_id, False, data, 0) for can_id, data in frames]


def _filters(settings: Imu61xCanSettings) -> list[CanFilter]:
    """The five identifiers, each by itself: other devices may have those next to them."""
    return [CanFilter(settings.base_id + slot, STANDARD_ID_MAX, False) for slot in range(SET_FRAMES)]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """BASE_ID for a frame with one of the identifiers as delivered; a device with others cannot be recognized."""
    slot = can_id - BASE_ID
    return BASE_ID if 0 <= slot < SET_FRAMES and not extended and len(data) == FRAME_BYTES else None


DRIVER: Final = CanDriver(
    name="imu61x-can",
    title="Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B (CAN)",
    settings=Imu61xCanSettings,
    make_codec=Imu61xCanCodec,
    filters=_filters,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=INDEX_MODULUS,
    euler_convention=EULER_CONVENTION,
    navigation_frame=NAVIGATION_FRAME,
    data_sheet=SHEET,
    axes=FLU_LEVEL,
    heading=relative_heading,
    node_of=_node_of,
    node_settings=lambda base_id: Imu61xCanSettings(base_id=base_id),
    node_title=lambda base_id: f"base_id {base_id}",
    identify=lambda _settings: says_nothing(Identity()),
    read_settings=lambda _settings: says_nothing({}),
    sample_frames=SET_FRAMES,
    example_frames=_example_frames,
)
