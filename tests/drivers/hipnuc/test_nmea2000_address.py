"""A sender of NMEA 2000 that moves to another address: imud follows its NAME, and the ledger stays right."""

import pytest

from imud.drivers.hipnuc import nmea2000
from imud.drivers.hipnuc.nmea2000 import HipnucNmea2000Codec, HipnucNmea2000Options
from imud.formats.can import CanFrame
from imud.formats.nmea2000 import ATTITUDE, HEADING, RATE_OF_TURN, Reference
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S

SENDER_NAME = 0xC0FFEE
PERIOD_NS = 100 * NS_PER_MS
FRAME_NS = 300_000


def claim_frame(source: int, name: int, t_ns: int) -> CanFrame:
    return CanFrame(6 << 26 | 0xEEFF << 8 | source, True, name.to_bytes(8, "little"), t_ns)


def instant(index: int, source: int, t_ns: int) -> list[CanFrame]:
    """Return the frames of one instant. The SIDs show losses."""
    sid = index % 253
    messages = (
        (HEADING, nmea2000.pack_heading(sid, 0.5, Reference.MAGNETIC)),
        (RATE_OF_TURN, nmea2000.pack_rate_of_turn(sid, 0.001 * index)),
        (ATTITUDE, nmea2000.pack_attitude(sid, (0.1, 0.2, 0.0), has_yaw=False)),
    )
    frames = [nmea2000.encode(pgn, data, source) for pgn, data in messages]
    return [CanFrame(can_id, True, data, t_ns + place * FRAME_NS) for place, (can_id, data) in enumerate(frames)]


def play_move(frames: list[CanFrame]) -> tuple[int, HipnucNmea2000Codec]:
    codec = HipnucNmea2000Codec(Ledger(), HipnucNmea2000Options())
    filters = nmea2000.DRIVER.filters(HipnucNmea2000Options())
    count = 0
    for frame in sorted(frames, key=lambda frame: frame.t_rx_ns):
        if any(entry.matches(frame.can_id, frame.extended) for entry in filters):
            count += len(codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns))
    count += len(codec.flush())
    assert codec.ledger.closes()
    return count, codec


@pytest.mark.parametrize("pause_ns", [0, 250 * NS_PER_MS])
@pytest.mark.parametrize("is_name_known", [False, True])
def test_codec_follows_name_of_sender(is_name_known: bool, pause_ns: int) -> None:
    frames = [claim_frame(9, SENDER_NAME, 0)] if is_name_known else []
    t_ns = NS_PER_S
    for index in range(200):
        if index == 100:
            frames.append(claim_frame(20, SENDER_NAME, t_ns + NS_PER_MS))
            t_ns += pause_ns
        t_ns += PERIOD_NS
        frames += instant(index, 9 if index < 100 else 20, t_ns)
    count, codec = play_move(frames)
    lost = codec.ledger.lost_gap_device
    assert (count + lost, codec.problem) == (200, "")
    assert lost <= (0 if is_name_known or pause_ns else 2)


def test_stronger_node_takes_address_of_sender() -> None:
    """The other node sends the same PGNs from the old address. imud follows the NAME and ignores the other node."""
    frames = [claim_frame(9, SENDER_NAME, 0)]
    for index in range(200):
        t_ns = NS_PER_S + index * PERIOD_NS
        if index == 100:
            frames += [claim_frame(9, 5, t_ns - 3), claim_frame(10, SENDER_NAME, t_ns - 2)]
        frames += instant(index, 9 if index < 100 else 10, t_ns)
        if index >= 100:
            frames += instant(index + 50, 9, t_ns + PERIOD_NS // 3)
    count, codec = play_move(frames)
    assert (count, codec.ledger.lost_gap_device) == (200, 0)
    assert codec.problem.startswith("several devices send these PGNs: imud uses source 10 and ignores source 9")


def test_change_of_sender_after_silence_is_gap() -> None:
    """Without claims, imud uses another address after 3 s, and counts a gap of unknown size."""
    frames: list[CanFrame] = []
    for index in range(200):
        frames += instant(index, 9 if index < 100 else 20, NS_PER_S + index * PERIOD_NS)
    count, codec = play_move(frames)
    assert (count, codec.ledger.lost_unknown) == (170, 1)
    assert codec.problem == "" or "source 9" not in codec.problem
