"""HiPNUC CH0x0/CH10x/HI14 on SAE J1939. Manual "IMU配置手冊" V1.5.9, chapter 6.

    0CFF3408   priority 3 | PGN FF34 | source 08, the module's address     eight bytes, see `j1939_messages.py`
    0CEF5508   a reply to imud, see `j1939_session.py`

Several modules share a bus, told apart by their addresses; priority means nothing on reception. A module sends each PGN
that is switched on at its own interval, with neither counter nor time: `assembly.py` makes samples of them.

FF2F (UTC) is taken and comes to nothing. It is a calendar time which jumps when the module's receiver finds out what
time it is, it has an interval of its own, and no source says of which instant it is: no device time for a sample.
"""

from collections.abc import Sequence
from random import Random
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.attitude import euler312_from_quat, quat_normalized
from imud.contracts.can import CanDriver
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, ReplyFrame
from imud.contracts.driver import SAMPLE_COUNTER
from imud.contracts.settings import Settings
from imud.devices.hipnuc.common.assembly import Assembly
from imud.devices.hipnuc.j1939 import messages, session
from imud.devices.hipnuc.j1939.actions import ACTIONS, MeasuredName
from imud.devices.hipnuc.j1939.session import CONFIGURE, HOST_ADDRESS, J1939Node
from imud.formats.can import CanFilter, CanFrame
from imud.formats.j1939 import ADDRESS_MAX, WITHOUT_PRIORITY, J1939Id, filter_of, join, sender_of
from imud.ledger import Ledger
from imud.sample import Vector3

FACTORY_ADDRESS: Final = 8
Address = Annotated[int, Meta(ge=0, le=ADDRESS_MAX)]


class HipnucJ1939Settings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What can be configured of the codec."""

    address: Address = FACTORY_ADDRESS
    """The module's address on the bus (J1939 source address); it can be set to 1 … 128."""
    pgns: Literal["auto"] | Annotated[tuple[MeasuredName, ...], Meta(min_length=1)] = "auto"
    """Messages that samples are made of; `auto` for all that come."""
    host_address: Address = HOST_ADDRESS
    """The address under which imud talks to the module; 0x55, which is 85, as in the manual."""

    @property
    def peer(self) -> J1939Node:
        """The module, and imud as it sees it."""
        return J1939Node(self.address, self.host_address)

    def measured(self) -> tuple[int, ...]:
        """PGNs that samples are made of."""
        if self.pgns == "auto":
            return messages.MEASURED
        return tuple(int(name, 16) for name in self.pgns)


class HipnucJ1939Codec:
    """Measurements and replies out of the frames of one module. Synchronization: one thread."""

    def __init__(self, ledger: Ledger, settings: HipnucJ1939Settings) -> None:
        self.ledger = ledger
        taken = (messages.UTC, *settings.measured())
        self._pgns = {join(J1939Id(0, pgn, settings.address)): pgn for pgn in taken}
        self._reply_ids = settings.peer.reply_ids()
        self._assembly = Assembly(ledger)

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Take one frame; return what it completed. Never raises for any frame."""
        ledger, size = self.ledger, len(data)
        ledger.bytes_in += size
        key = can_id & WITHOUT_PRIORITY
        pgn = self._pgns.get(key)
        if not extended or (pgn is None and key not in self._reply_ids):
            ledger.bytes_skipped += size
            return ()
        if size != messages.MESSAGE_BYTES:
            ledger.bytes_in_bad_frames += size
            ledger.frames_bad_length += 1
            return (BadFrame(BadReason.LENGTH, data),)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        if pgn is None:
            ledger.frames_in_replies += 1
            return (ReplyFrame(can_id, data),)
        if pgn == messages.UTC:
            ledger.frames_ignored += 1
            return ()
        whole = self._assembly.take(pgn, data, t_rx_ns)
        return () if whole is None else (messages.measurement_of(whole),)

    def flush(self) -> Sequence[CodecEvent]:
        """The bus is idle: the next frame begins a sample."""
        self._assembly.flush()
        return ()

    def reset(self) -> None:
        """Frames are missing here: what is held is given up."""
        self._assembly.reset()


# --- the device's side ------------------------------------------------------------------------------------------------


def encode(pgn: int, data: bytes, address: int = FACTORY_ADDRESS) -> tuple[int, bytes]:
    """A message as (identifier, data)."""
    return join(J1939Id(messages.PRIORITY, pgn, address)), data


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
    actions=ACTIONS,
    node_of=_node_of,
    node_settings=lambda address: HipnucJ1939Settings(address=address),
    node_title=lambda address: f"address {address}",
    identify=lambda settings: session.identify(settings.peer),
    read_settings=lambda settings: session.read_settings(settings.peer),
    sample_frames=4,
    example_frames=_example_frames,
)
