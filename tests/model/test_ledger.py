"""The two sums of the ledger."""

from imud.model.ledger import LEDGER_FIELDS, LOST_FIELDS, Ledger, bytes_open, frames_open, lost


def test_every_byte_and_every_good_frame_must_be_somewhere() -> None:
    ledger = Ledger()
    assert ledger.closes()
    assert set(ledger.values()) == {0}
    for number, name in enumerate(LEDGER_FIELDS):
        setattr(ledger, name, number)
    assert (ledger.values(), ledger.troubles()) == (tuple(range(24)), (*ledger.losses(), 10, 11, 12, 21))
    assert ledger.losses() == tuple(map(LEDGER_FIELDS.index, LOST_FIELDS))
    before, ledger.samples = ledger.snapshot(), 15
    assert (tuple(before), before["samples"], ledger.snapshot()["samples"]) == (LEDGER_FIELDS, 14, 15)
    ledger = Ledger()
    ledger.bytes_in = 100
    assert ledger.bytes_open() == bytes_open(ledger.snapshot()) == 100
    assert not ledger.closes()
    ledger.bytes_in_good_frames, ledger.bytes_in_bad_frames, ledger.bytes_skipped, ledger.bytes_pending = 70, 10, 15, 5
    assert ledger.closes()
    ledger.frames_good = 10
    assert ledger.frames_open() == frames_open(ledger.snapshot()) == 10
    assert not ledger.closes()
    ledger.frames_in_samples, ledger.frames_in_replies, ledger.frames_ignored, ledger.frames_pending = 4, 3, 2, 1
    assert ledger.closes()
    ledger = Ledger()
    ledger.frames_bad_crc, ledger.frames_bad_length, ledger.frames_bad_content = 1, 2, 4
    assert ledger.frames_bad() == 7
    ledger.lost_gap_device, ledger.lost_crc, ledger.lost_overrun, ledger.lost_queue = 1, 2, 4, 8
    ledger.add_unknown_gap()
    assert (ledger.lost(), ledger.lost_unknown) == (15, 1), "gaps of unknown size are not among them"
    assert lost(ledger.snapshot()) == 15
