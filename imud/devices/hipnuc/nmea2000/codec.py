"""HiPNUC modules on NMEA 2000, and any other heading or attitude sensor there. Messages: `nmea2000_messages.py`.

    09F112ss  127250 Vessel Heading     09F113ss  127251 Rate of Turn     0DF119ss  127257 Attitude

ss is the sender's address, which NMEA 2000 gives out anew each time the bus is put together. `source: auto` takes the
first sender of these messages and keeps it; when it has been silent for SILENT_NS, the next one who is heard.
imud sends nothing: it claims no address and asks no questions.

Messages of one instant have the same SID. `assembly.py` makes samples by their order and time; a SID that differs from
that of the frames held gives these up. A sender whose messages of one instant have SIDs of their own, against the
standard, would never make a sample: after SID_DOUBTS such samples in a row SIDs are not looked at, until they agree in
as many samples again.

A sender may give its heading twice, from true and from magnetic north. `heading` says which to take; `auto` takes the
reference that comes first and keeps it. Headings of the other one are ignored. Deviation and variation are not applied.
"""

from collections.abc import Sequence
from random import Random
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.attitude import euler312_from_quat, quat_normalized
from imud.contracts.can import CanDriver
from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.driver import SAMPLE_COUNTER, Identity
from imud.contracts.session import says_nothing
from imud.contracts.settings import Settings
from imud.devices.hipnuc.common.assembly import Assembly
from imud.devices.hipnuc.nmea2000 import messages
from imud.devices.hipnuc.nmea2000.messages import Reference
from imud.formats.can import CanFilter, CanFrame
from imud.formats.j1939 import ADDRESS_MAX, WITHOUT_PRIORITY, J1939Id, filter_of, join, sender_of
from imud.ledger import Ledger
from imud.units import NS_PER_S

SILENT_NS: Final = 3 * NS_PER_S
"""The slowest of the three messages comes once a second by the standard."""
SID_DOUBTS: Final = 8
EXAMPLE_SOURCE: Final = 35

_PGNS: Final = {join(J1939Id(0, pgn, 0)): pgn for pgn in messages.PGNS}
"""By identifier without priority and source."""
_REFERENCES: Final = {"true": Reference.TRUE, "magnetic": Reference.MAGNETIC, "auto": None}


class HipnucNmea2000Settings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What can be configured of the codec."""

    source: Literal["auto"] | Annotated[int, Meta(ge=0, le=ADDRESS_MAX)] = "auto"
    """Address of the sender; `auto` for the first who is heard, and another one when that is silent."""
    heading: Literal["auto", "true", "magnetic"] = "auto"
    """Which heading to take where the sender has two; `auto` for the first that is heard."""


class HipnucNmea2000Codec:
    """Measurements out of the frames of one sender. Synchronization: one thread."""

    def __init__(self, ledger: Ledger, settings: HipnucNmea2000Settings) -> None:
        self.ledger = ledger
        self._fixed = None if settings.source == "auto" else settings.source
        self._wanted_reference = _REFERENCES[settings.heading]
        self._take_sender(self._fixed)
        self._heard_ns = 0

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Take one frame; return what it completed. Never raises for any frame."""
        ledger, size = self.ledger, len(data)
        ledger.bytes_in += size
        pgn = _PGNS.get(can_id & WITHOUT_PRIORITY & ~0xFF) if extended else None
        if pgn is None or not self._is_sender(can_id & 0xFF, t_rx_ns):
            ledger.bytes_skipped += size
            return ()
        if size != messages.MESSAGE_BYTES:
            ledger.bytes_in_bad_frames += size
            ledger.frames_bad_length += 1
            return (BadFrame(BadReason.LENGTH, data),)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        sid, reference = messages.head_of(pgn, data)
        if reference is not None and not self._is_reference(reference):
            ledger.frames_ignored += 1
            return ()
        self._match(sid)
        whole = self._assembly.take(pgn, data, t_rx_ns)
        if whole is None:
            return ()
        self._count_sids(whole)
        self._has_heading |= any(kind == messages.HEADING for kind, _ in whole)
        return (messages.measurement_of(whole, heading_elsewhere=self._has_heading),)

    def flush(self) -> Sequence[CodecEvent]:
        """The bus is idle: the next frame begins a sample."""
        self._assembly.flush()
        return ()

    def reset(self) -> None:
        """Frames are missing here: what is held is given up."""
        self._assembly.reset()

    # --- whose frames --------------------------------------------------------------------------------------------

    def _is_sender(self, source: int, t_rx_ns: int) -> bool:
        if source != self._source:
            silent = t_rx_ns - self._heard_ns > SILENT_NS
            if self._fixed is not None or source > ADDRESS_MAX or (self._source is not None and not silent):
                return False
            self._assembly.reset()
            self._take_sender(source)
        self._heard_ns = t_rx_ns
        return True

    def _take_sender(self, source: int | None) -> None:
        """Nothing is known of this one."""
        self._source = source
        self._assembly = Assembly(self.ledger)
        self._reference = self._wanted_reference
        self._has_heading = False
        self._held_sid: int | None = None
        self._uses_sids = True
        self._sid_doubts = 0

    def _is_reference(self, reference: Reference) -> bool:
        """Whether it is the heading to take; an error is one of either, and its value absent."""
        if self._reference is None and reference is not Reference.ERROR:
            self._reference = reference
        return reference in (self._reference, Reference.ERROR)

    # --- what belongs together -----------------------------------------------------------------------------------

    def _match(self, sid: int | None) -> None:
        """Give up frames of another instant."""
        differs = sid is not None and self._held_sid is not None and sid != self._held_sid
        self._held_sid = sid
        if self._uses_sids and differs and self.ledger.frames_pending:
            self._assembly.reset()
            self._sid_doubts += 1
            if self._sid_doubts >= SID_DOUBTS:
                self._uses_sids, self._sid_doubts = False, 0

    def _count_sids(self, whole: Sequence[tuple[int, bytes]]) -> None:
        """A sample is whole."""
        if self._uses_sids:
            self._sid_doubts = 0
        elif len(whole) > 1:
            agree = len({data[0] for _, data in whole}) == 1
            self._sid_doubts = self._sid_doubts + 1 if agree else 0
            if self._sid_doubts >= SID_DOUBTS:
                self._uses_sids, self._sid_doubts = True, 0


# --- the device's side ------------------------------------------------------------------------------------------------


def encode(pgn: int, data: bytes, source: int) -> tuple[int, bytes]:
    """A message as (identifier, data)."""
    return join(J1939Id(messages.PRIORITIES[pgn], pgn, source)), data


def _example_frames(random: Random) -> list[CanFrame]:
    """A sample of all three, with random values."""
    quat = quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1)))
    euler = euler312_from_quat(quat)
    sid = random.randrange(messages.SID_MOST + 1)
    made = (
        encode(messages.HEADING, messages.pack_heading(sid, euler[2], Reference.MAGNETIC), EXAMPLE_SOURCE),
        encode(messages.RATE_OF_TURN, messages.pack_rate_of_turn(sid, random.gauss(0, 0.5)), EXAMPLE_SOURCE),
        encode(messages.ATTITUDE, messages.pack_attitude(sid, euler, has_yaw=False), EXAMPLE_SOURCE),
    )
    return [CanFrame(can_id, True, data, 0) for can_id, data in made]


def _filters(settings: HipnucNmea2000Settings) -> list[CanFilter]:
    """The three messages, of one sender or of any."""
    source = None if settings.source == "auto" else settings.source
    return [filter_of(pgn, source) for pgn in messages.PGNS]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """The sender of one of the messages."""
    return sender_of(can_id, extended, data, messages.PGNS)


DRIVER: Final = CanDriver(
    name="hipnuc-nmea2000",
    title="HiPNUC CH0x0, CH10x, HI14, other heading and attitude sensors (CAN, NMEA 2000)",
    settings=HipnucNmea2000Settings,
    make_codec=HipnucNmea2000Codec,
    filters=_filters,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above, "
    "0 with the bow to the north of the heading's reference; NaN for an angle that is not sent",
    navigation_frame="ENU",
    node_of=_node_of,
    node_settings=lambda source: HipnucNmea2000Settings(source=source),
    node_title=lambda source: f"source {source}",
    identify=lambda _settings: says_nothing(Identity()),
    read_settings=lambda _settings: says_nothing({}),
    sample_frames=len(messages.PGNS),
    example_frames=_example_frames,
)
