"""SDO frames from the manual, and replies."""

import pytest

from imud.contracts.script import Rejection, Reply, ReplyFrame, Silence
from imud.drivers.hipnuc.canopen import cia301
from imud.model.errors import NoReply
from tests.support.simulated_modules import unpack


def frame(text: str, can_id: int = 0x588) -> ReplyFrame:
    return ReplyFrame(can_id, bytes.fromhex(text))


@pytest.mark.manual("B 5.4.1 SDO")
def test_write_and_its_confirmation() -> None:
    conversation = cia301.write_object(8, 0x20A0, 0, 9, 4)
    request = next(conversation)
    assert unpack(request.payload) == (0x608, bytes.fromhex("23 A0 20 00 09 00 00 00"))
    done = frame("60 A0 20 00 00 00 00 00")
    assert request.is_end(done)
    assert not request.is_rejection(done)
    with pytest.raises(StopIteration):
        conversation.send(Reply((done,)))

    assert cia301.read_frame(0x1018, 4) == bytes.fromhex("40 18 10 04 00 00 00 00")
    values = {"4F": b"\1", "4B": b"\1\2", "47": b"\1\2\3", "43": b"\1\2\3\4", "42": b"\1\2\3\4", "41": None, "40": None}
    assert {cs: cia301.value_of(bytes.fromhex(cs) + bytes(3) + b"\1\2\3\4") for cs in values} == values
    for size, command in ((1, 0x2F), (2, 0x2B), (3, 0x27), (4, 0x23)):
        _, data = unpack(next(cia301.write_object(8, 0x1800, 5, 10, size)).payload)
        assert data == bytes([command, 0x00, 0x18, 5, 10, 0, 0, 0])


@pytest.mark.parametrize(
    "other",
    [
        frame("60 A1 20 00 00 00 00 00"), frame("60 A0 20 01 00 00 00 00"), frame("60 A0 20 00 00 00 00 00", 0x589),
        frame("43 A0 20 00 09 00 00 00"), frame("60 A0 20 00"), "60 A0 20 00",
    ],
)  # fmt: skip
def test_invalid_confirmations(other: ReplyFrame | str) -> None:
    request = next(cia301.write_object(8, 0x20A0, 0, 9, 4))
    assert not request.is_end(other)
    assert not request.is_rejection(other)
    assert not request.is_part(other)


def test_aborts_silence_and_values_in_segments() -> None:
    conversation = cia301.read_object(8, 0x2345, 1)
    request = next(conversation)
    refused = frame("80 45 23 01 00 00 02 06")
    assert request.is_rejection(refused)
    with pytest.raises(cia301.Aborted, match=r"node 8, read 0x2345.1: .*object does not exist.*0x06020000") as caught:
        conversation.send(Rejection((refused,)))
    assert caught.value.code == 0x0602_0000
    assert cia301.abort_text(0x1234) == "unknown abort code"
    assert len(cia301.ABORT_TEXTS) == 31
    conversation = cia301.read_object(8, 0x1000, 0)
    next(conversation)
    with pytest.raises(NoReply, match=r"node 8, read 0x1000\.0"):
        conversation.send(Silence(()))
    conversation = cia301.read_object(8, 0x1008, 0)
    request = next(conversation)
    announced = frame("41 08 10 00 0A 00 00 00")
    assert request.is_end(announced)
    abort = conversation.send(Reply((announced,)))
    assert unpack(abort.payload) == (0x608, bytes.fromhex("80 08 10 00 01 00 04 05"))
    assert abort.silent
    with pytest.raises(StopIteration) as end:
        conversation.send(Reply(()))
    assert end.value.value is None
