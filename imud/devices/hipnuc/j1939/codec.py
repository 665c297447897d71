"""HiPNUC CH0x0/CH10x/HI14 on SAE J1939. Manual "IMU配置手冊" V1.5.9, chapter 6.

    0CFF3408   priority 3 | PGN FF34 | source 08, the module's address     eight bytes, see `messages.py`
    0CEF5508   a reply to imud, see `session.py`

Several modules share a bus and have different addresses; priority means nothing on reception. A module sends each PGN
that is switched on at its own interval, with neither counter nor time: `common/assembly.py` makes samples of them.

FF2F (UTC) is accepted and ignored. It is a calendar time which jumps when the module's receiver finds out what
time it is, it has an interval of its own, and no source says of which instant it is: no device time for a sample.
"""

from collections.abc import Sequence
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.codec import BadFrame, BadReason, CodecEvent, ReplyFrame
from imud.contracts.settings import Settings
from imud.devices.hipnuc.common.assembly import Assembly
from imud.devices.hipnuc.j1939 import messages
from imud.devices.hipnuc.j1939.messages import MeasuredName
from imud.devices.hipnuc.j1939.session import HOST_ADDRESS, J1939Node
from imud.formats.j1939 import ADDRESS_MAX, WITHOUT_PRIORITY, J1939Id, join
from imud.ledger import Ledger

FACTORY_ADDRESS: Final = 8
Address = Annotated[int, Meta(ge=0, le=ADDRESS_MAX)]


class HipnucJ1939Settings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a module on J1939."""

    address: Address = FACTORY_ADDRESS
    """The module's address on the bus (J1939 source address); it can be set to 1 … 128."""
    pgns: Literal["auto"] | Annotated[tuple[MeasuredName, ...], Meta(min_length=1)] = "auto"
    """Messages that samples are made of; `auto` for all that come."""
    host_address: Address = HOST_ADDRESS
    """The address under which imud talks to the module; 0x55, which is 85, as in the manual."""

    @property
    def peer(self) -> J1939Node:
        """Address of the module, and imud's own."""
        return J1939Node(self.address, self.host_address)

    def measured(self) -> tuple[int, ...]:
        """PGNs that samples are made of."""
        if self.pgns == "auto":
            return messages.MEASURED
        return tuple(int(name, 16) for name in self.pgns)


class HipnucJ1939Codec:
    """Decoder of the frames of one module. Synchronization: one thread."""

    def __init__(self, ledger: Ledger, settings: HipnucJ1939Settings) -> None:
        self.ledger = ledger
        taken = (messages.UTC, *settings.measured())
        self._pgns = {join(J1939Id(0, pgn, settings.address)): pgn for pgn in taken}
        self._reply_ids = settings.peer.reply_ids()
        self._assembly = Assembly(ledger)

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Add one frame; return what it completed. Never raises for any frame."""
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
        whole = self._assembly.add_frame(pgn, data, t_rx_ns)
        return () if whole is None else (messages.measurement_of(whole),)

    def flush(self) -> Sequence[CodecEvent]:
        """No-op: the next frame shows what is lost."""
        return ()

    def reset(self) -> None:
        """Drop the incomplete sample: frames are missing here."""
        self._assembly.reset()


# --- the device's side ------------------------------------------------------------------------------------------------


def encode(pgn: int, data: bytes, address: int = FACTORY_ADDRESS) -> tuple[int, bytes]:
    """A message as (identifier, data)."""
    return join(J1939Id(messages.PRIORITY, pgn, address)), data
