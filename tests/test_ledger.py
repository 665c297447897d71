"""The ledger's two sums."""

from imud.ledger import LEDGER_FIELDS, Ledger


def test_new_ledger_is_zero_and_closes() -> None:
    ledger = Ledger()
    assert ledger.closes()
    assert set(ledger.values()) == {0}
    assert tuple(ledger.snapshot()) == LEDGER_FIELDS


def test_every_byte_must_be_somewhere() -> None:
    ledger = Ledger()
    ledger.bytes_in = 100
    assert ledger.bytes_open() == 100
    assert not ledger.closes()
    ledger.bytes_in_good_frames, ledger.bytes_in_bad_frames, ledger.bytes_skipped, ledger.bytes_pending = 70, 10, 15, 5
    assert ledger.closes()


def test_every_good_frame_must_be_somewhere() -> None:
    ledger = Ledger()
    ledger.frames_good = 10
    assert ledger.frames_open() == 10
    ledger.frames_in_samples, ledger.frames_in_replies, ledger.frames_ignored, ledger.frames_pending = 4, 3, 2, 1
    assert ledger.closes()


def test_sums_by_reason_and_cause() -> None:
    ledger = Ledger()
    ledger.frames_bad_crc, ledger.frames_bad_length, ledger.frames_bad_content = 1, 2, 4
    assert ledger.frames_bad() == 7
    ledger.lost_gap_device, ledger.lost_crc, ledger.lost_overrun, ledger.lost_queue = 1, 2, 4, 8
    assert ledger.lost() == 15


def test_snapshot_is_a_copy() -> None:
    ledger = Ledger()
    before = ledger.snapshot()
    ledger.samples += 1
    assert before["samples"] == 0
    assert ledger.snapshot()["samples"] == 1
