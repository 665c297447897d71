"""Table: the row `DRIVER` of HiPNUC modules on SAE J1939."""

from random import Random
from typing import Final

from imud.attitude import euler312_from_quat, quat_normalized
from imud.contracts.can import CanDriver
from imud.contracts.driver import SAMPLE_COUNTER
from imud.devices.hipnuc.common.calibrations import inclinometer_zero
from imud.devices.hipnuc.common.data_sheet import REGISTERS
from imud.devices.hipnuc.j1939 import messages, session
from imud.devices.hipnuc.j1939.actions import ACTIONS
from imud.devices.hipnuc.j1939.codec import HipnucJ1939Codec, HipnucJ1939Settings, encode
from imud.devices.hipnuc.j1939.session import CONFIGURE, HOST_ADDRESS
from imud.devices.hipnuc.j1939.settings import SETTINGS
from imud.formats.can import CanFilter, CanFrame
from imud.formats.j1939 import filter_of, sender_of
from imud.sample import Vector3


def _example_frames(random: Random) -> list[CanFrame]:
    """A sample of the four PGNs that every module sends, with random values."""
    quat = quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1)))
    roll, pitch, yaw = euler312_from_quat(quat)

    def three(spread: float) -> Vector3:
        return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))

    made = (
        encode(messages.ACCEL, messages.pack_accel(three(9.8))),
        encode(messages.GYRO, messages.pack_gyro(three(2))),
        encode(messages.ROLL_PITCH, messages.pack_roll_pitch(roll, pitch)),
        encode(messages.HEADING, messages.pack_heading(yaw)),
    )
    return [CanFrame(can_id, True, data, 0) for can_id, data in made]


def _filters(settings: HipnucJ1939Settings) -> list[CanFilter]:
    """The messages of one module, and its replies."""
    wanted = [filter_of(pgn, settings.address) for pgn in (messages.UTC, *settings.measured())]
    hosts = sorted({settings.host_address, HOST_ADDRESS})
    return wanted + [filter_of(CONFIGURE, settings.address, host) for host in hosts]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """The sender of a message that samples are made of."""
    return sender_of(can_id, extended, data, messages.MEASURED)


DRIVER: Final = CanDriver(
    name="hipnuc-j1939",
    title="HiPNUC CH0x0, CH10x, HI14 (CAN, SAE J1939)",
    settings=HipnucJ1939Settings,
    make_codec=HipnucJ1939Codec,
    filters=_filters,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above; "
    "NaN for an angle that the module does not send",
    navigation_frame="ENU",
    data_sheet=REGISTERS,
    actions=ACTIONS,
    device_settings=SETTINGS,
    calibrations=inclinometer_zero("6.2.2", ACTIONS),
    node_of=_node_of,
    node_settings=lambda address: HipnucJ1939Settings(address=address),
    node_title=lambda address: f"address {address}",
    identify=lambda settings: session.identify(settings.peer),
    read_settings=lambda settings: session.read_settings(settings.peer),
    sample_frames=4,
    example_frames=_example_frames,
)
