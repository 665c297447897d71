"""S1, P1 and K1: golden payloads, every length of S1, and other messages."""

import pytest

from imud.contracts.script import ReplyFrame
from imud.drivers.imu61x.uart.codec import (
    STATUS_BYTES_MIN,
    Acknowledgement,
    Imu61xCodec,
    Parameter,
    ParameterValue,
    Status,
    encode_status,
    is_reply,
    pack_acknowledgement,
    pack_parameters,
    pack_status,
    parse_acknowledgement,
    parse_parameter,
    parse_status,
)
from imud.model.ledger import Ledger

S1 = bytes.fromhex(
    "04030201"  # software 0x01020304
    "02000000"  # hardware 2
    "6602"  # model 614
    "47003200 0D513331 36373833"  # serial number
    "01000000"  # system status 1
    "7800 0300"  # CPU load 120, drop rate 3
    "01 32 02 04"  # I2C master, voltage 50, user configuration 2, calibration 4
) + bytes(range(32))
FULL = Status(
    0x01020304, 2, 614, (0x00320047, 0x3133510D, 0x33383736), 1, 120, 3, 1, 50, 2, 4, bytes(range(32))
)  # fmt: skip


@pytest.mark.manual("A 1.4 software version", "A 1.4 hardware version", "A 1.4 status members", "A 1.4 frame")
def test_s1() -> None:
    assert len(S1) == 0x42
    assert parse_status(ReplyFrame(0xFF, S1)) == FULL
    assert pack_status(FULL) == S1
    frame = encode_status(FULL)
    assert frame[:6] == bytes.fromhex("AA55FF004200")
    assert len(frame) == 76
    (event,) = Imu61xCodec(Ledger()).feed(frame)
    assert isinstance(event, ReplyFrame)
    assert parse_status(event) == FULL


@pytest.mark.parametrize("size", [STATUS_BYTES_MIN, 25, 26, 28, 30, 31, 32, 33, 34, 65, 66, 89])
@pytest.mark.manual("A 1.4 frame")
def test_s1_of_any_length_contains_its_complete_members(size: int) -> None:
    ends = {
        "system_status": 26, "cpu_load": 28, "drop_rate": 30, "i2c_master": 31, "voltage": 32,
        "user_config_fault": 33, "calibration_fault": 34, "imu_health": 66,
    }  # fmt: skip
    status = parse_status(ReplyFrame(0xFF, S1.ljust(90, b"\x77")[:size]))
    assert status is not None
    assert status.serial_number == FULL.serial_number
    for name, end in ends.items():
        assert getattr(status, name) == (getattr(FULL, name) if size >= end else None)
    if size in {22, *ends.values()}:
        assert pack_status(status) == S1[:size]


@pytest.mark.parametrize("message", [ReplyFrame(0xFF, S1[:21]), ReplyFrame(0xFE, S1), "S1", ReplyFrame(6, bytes(24))])
def test_messages_other_than_s1(message: ReplyFrame | str) -> None:
    assert parse_status(message) is None


@pytest.mark.manual("A 1.5 frame", "A 1.5 parameter 3", "A 1.7 K1")
def test_p1_and_k1() -> None:
    """Parameter 3 = 921600 bit/s: 0x49610000 as a float."""
    payload = bytes.fromhex("00006149 00000000 03000000 00000000 00000000 00000000")
    assert parse_parameter(ReplyFrame(6, payload)) == ParameterValue(3, 921600.0)
    assert pack_parameters(921600, 3) == payload
    assert parse_parameter(ReplyFrame(6, payload[:23])) is None
    assert parse_parameter(ReplyFrame(7, payload)) is None
    assert parse_parameter("P1") is None
    assert [parameter.value for parameter in Parameter] == [3, 8, 9, 10, 16, 17, 18, 21, 27, 30, 31]
    payload = bytes.fromhex("0E00 0500")
    assert parse_acknowledgement(ReplyFrame(0x1234, payload)) == Acknowledgement(14, 5)
    assert pack_acknowledgement(14, 5) == payload
    assert parse_acknowledgement(ReplyFrame(0x1234, payload + b"\x00")) is None
    assert parse_acknowledgement("K1") is None


@pytest.mark.parametrize(
    ("frame_id", "size", "wanted"),
    [(0xFF, 22, True), (0xFF, 21, False), (6, 24, True), (6, 23, False), (9, 4, True), (2, 44, False), (9, 24, False)],
)
def test_replies_by_id_and_length(frame_id: int, size: int, wanted: bool) -> None:
    assert is_reply(frame_id, bytes(size)) is wanted
