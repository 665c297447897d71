"""HiPNUC modules on NMEA 2000, and any other heading or attitude sensor there. Messages: `messages.py`.

    09F112ss  127250 Vessel Heading     09F113ss  127251 Rate of Turn     0DF119ss  127257 Attitude

ss is the sender's address, which NMEA 2000 gives out anew each time the bus is put together. `source: auto` selects
the first sender of these messages and keeps it; after SILENT_NS without a message, the next sender. imud claims no
address and sends no requests.

Messages of one instant have the same SID. `common/assembly.py` makes samples by their order and time; frames held with
another SID than the newest are dropped. A sender whose messages of one instant have SIDs of their own, against the
standard, would never make a sample: after SID_DOUBTS such samples in a row SIDs are not looked at, until they agree in
as many samples again.

A sender may give its heading twice, from true and from magnetic north. `heading` selects the one to use; `auto` selects
the reference that comes first and keeps it. The other heading is ignored. Deviation and variation are not applied.
"""

from collections.abc import Sequence
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.settings import Settings
from imud.devices.hipnuc.common.assembly import Assembly
from imud.devices.hipnuc.nmea2000 import messages
from imud.devices.hipnuc.nmea2000.messages import Reference
from imud.formats.j1939 import ADDRESS_MAX, WITHOUT_PRIORITY, J1939Id, join
from imud.ledger import Ledger
from imud.units import NS_PER_S

SILENT_NS: Final = 3 * NS_PER_S
"""The slowest of the three messages comes once a second by the standard."""
SID_DOUBTS: Final = 8

_PGNS: Final = {join(J1939Id(0, pgn, 0)): pgn for pgn in messages.PGNS}
"""By identifier without priority and source."""
_REFERENCES: Final = {"true": Reference.TRUE, "magnetic": Reference.MAGNETIC, "auto": None}


class HipnucNmea2000Settings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a heading or attitude sensor."""

    source: Literal["auto"] | Annotated[int, Meta(ge=0, le=ADDRESS_MAX)] = "auto"
    """Address of the sender; `auto` for the first who is heard, and another one when that is silent."""
    heading: Literal["auto", "true", "magnetic"] = "auto"
    """Heading to use where the sender has two; `auto` for the first that is received."""


class HipnucNmea2000Codec:
    """Decoder of the frames of one sender. Synchronization: one thread."""

    def __init__(self, ledger: Ledger, settings: HipnucNmea2000Settings) -> None:
        self.ledger = ledger
        self._fixed = None if settings.source == "auto" else settings.source
        self._wanted_reference = _REFERENCES[settings.heading]
        self._set_sender(self._fixed)
        self._heard_ns = 0

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Add one frame; return what it completed. Never raises for any frame."""
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
        whole = self._assembly.add_frame(pgn, data, t_rx_ns)
        if whole is None:
            return ()
        self._count_sids(whole)
        self._has_heading |= any(kind == messages.HEADING for kind, _ in whole)
        return (messages.measurement_of(whole, heading_elsewhere=self._has_heading),)

    def flush(self) -> Sequence[CodecEvent]:
        """No-op: the next frame shows what is lost."""
        return ()

    def reset(self) -> None:
        """Drop the incomplete sample: frames are missing here."""
        self._assembly.reset()

    # --- whose frames --------------------------------------------------------------------------------------------

    def _is_sender(self, source: int, t_rx_ns: int) -> bool:
        if source != self._source:
            silent = t_rx_ns - self._heard_ns > SILENT_NS
            if self._fixed is not None or source > ADDRESS_MAX or (self._source is not None and not silent):
                return False
            self._assembly.reset()
            self._set_sender(source)
        self._heard_ns = t_rx_ns
        return True

    def _set_sender(self, source: int | None) -> None:
        """Begin anew with this sender."""
        self._source = source
        self._assembly = Assembly(self.ledger)
        self._reference = self._wanted_reference
        self._has_heading = False
        self._held_sid: int | None = None
        self._uses_sids = True
        self._sid_doubts = 0

    def _is_reference(self, reference: Reference) -> bool:
        """Whether this is the heading to use; an error counts for both, with its value absent."""
        if self._reference is None and reference is not Reference.ERROR:
            self._reference = reference
        return reference in (self._reference, Reference.ERROR)

    # --- messages of one instant ---------------------------------------------------------------------------------

    def _match(self, sid: int | None) -> None:
        """Drop the frames of another instant."""
        differs = sid is not None and self._held_sid is not None and sid != self._held_sid
        self._held_sid = sid
        if self._uses_sids and differs and self.ledger.frames_pending:
            self._assembly.reset()
            self._sid_doubts += 1
            if self._sid_doubts >= SID_DOUBTS:
                self._uses_sids, self._sid_doubts = False, 0

    def _count_sids(self, whole: Sequence[tuple[int, bytes]]) -> None:
        """Count the SIDs of a whole sample."""
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
