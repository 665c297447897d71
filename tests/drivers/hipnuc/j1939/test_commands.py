"""Every row of table 6.2.2 in the manual as frames on the bus, reply matching, and rejected values."""

from collections.abc import Callable
from typing import Any

import pytest

from imud.contracts.command import Target, VerbResult
from imud.contracts.script import Outcome, Rejection, Reply, ReplyFrame, Request, RequestScript, Silence
from imud.contracts.setting import Written, combined
from imud.drivers.hipnuc.j1939 import commands as session
from imud.drivers.hipnuc.j1939.codec import HOST_ADDRESS, HipnucJ1939Options, J1939Node
from imud.drivers.hipnuc.j1939.commands import X_SIGN, Y_SIGN, Zero
from imud.drivers.hipnuc.j1939.driver import DRIVER, SETTINGS
from imud.formats.can import EXTENDED_FLAG, RAW_FRAME
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.ledger import Ledger
from imud.sim.hipnuc.j1939 import J1939_VARIANTS, J1939Settings, J1939Variant
from tests.support.old_spellings import script_of
from tests.support.script_runners import offline_runner, unanswered_ms
from tests.support.simulated_modules import J1939Bench, run_script

PEER = J1939Node(8)
Frame = tuple[int, bytes]


def sent(request: Request) -> Frame:
    can_id, size, data = RAW_FRAME.unpack(request.payload)
    assert can_id & EXTENDED_FLAG
    return can_id & ~EXTENDED_FLAG, data[:size]


def played(conversation: RequestScript[object], *outcomes: Outcome | bytes | None) -> tuple[list[Frame], object]:
    """Return the sent frames and the result; `answers` contains the data of each reply, None for silence."""
    frames: list[Frame] = []
    answers = iter(outcomes)

    def ask(request: Request) -> Outcome:
        frames.append(sent(request))
        answer = next(answers)
        if isinstance(answer, bytes):
            reply = ReplyFrame(0x0CEF5508, answer)
            assert request.is_end(reply)
            return Reply((reply,))
        return answer if isinstance(answer, Reply) else Silence(())

    return frames, run_script(conversation, ask)


ROWS: list[tuple[str, dict[str, object], str]] = [
    ("interval", {"pgn": "FF34", "interval_ms": 5}, "34 01 06 00 05 00 00 00"),
    ("interval", {"pgn": "FF37", "interval_ms": 100}, "37 01 06 00 64 00 00 00"),  # the manual's own example
    ("interval", {"pgn": "FF3D", "interval_ms": 1000}, "3D 01 06 00 E8 03 00 00"),
    ("interval", {"pgn": "FF41", "interval_ms": 20}, "41 01 06 00 14 00 00 00"),
    ("interval", {"pgn": "FF4A", "interval_ms": 500}, "4A 01 06 00 F4 01 00 00"),  # printed 4A 01 60 00
    ("interval", {"pgn": "FF3A", "interval_ms": 10}, "3A 01 06 00 0A 00 00 00"),
    ("interval", {"pgn": "FF43", "interval_ms": 10}, "43 01 06 00 0A 00 00 00"),
    ("interval", {"pgn": "FF46", "interval_ms": 10}, "46 01 06 00 0A 00 00 00"),
    ("interval", {"pgn": "FF2F", "interval_ms": 1000}, "2F 01 06 00 E8 03 00 00"),
    ("save", {}, "00 00 06 00 00 00 00 00"),
    ("factory_reset", {}, "00 00 06 00 01 00 00 00"),
    ("restart", {}, "00 00 06 00 FF 00 00 00"),
    ("bitrate", {"bitrate": 1_000_000}, "9A 00 06 00 00 00 00 00"),
    ("bitrate", {"bitrate": 800_000}, "9A 00 06 00 01 00 00 00"),
    ("bitrate", {"bitrate": 500_000}, "9A 00 06 00 02 00 00 00"),
    ("bitrate", {"bitrate": 250_000}, "9A 00 06 00 03 00 00 00"),
    ("bitrate", {"bitrate": 125_000}, "9A 00 06 00 04 00 00 00"),
    ("address", {"address": 1}, "9C 00 06 00 01 00 00 00"),
    ("address", {"address": 128}, "9C 00 06 00 80 00 00 00"),
    ("zero", {"zero": "here"}, "A5 00 06 00 02 00 00 00"),
    ("zero", {"zero": "cancel"}, "A5 00 06 00 05 00 00 00"),
    ("direction", {"axis": "X", "reversed": True}, "9E 00 06 00 01 00 00 00"),
    ("direction", {"axis": "X", "reversed": False}, "9E 00 06 00 00 00 00 00"),
    ("direction", {"axis": "Y", "reversed": True}, "9F 00 06 00 01 00 00 00"),
    ("send_once", {"pgn": "FF34"}, "96 00 06 00 34 FF 00 00"),
]
READABLE = ("interval", "bitrate", "address", "direction")


@pytest.mark.parametrize(("name", "arguments", "data"), ROWS, ids=[f"{name} {data}" for name, _, data in ROWS])
@pytest.mark.manual(
    "B 6.2.2 intervals", "B 6.2.2 save", "B 6.2.2 factory settings", "B 6.2.2 restart", "B 6.2.2 bit rate",
    "B 6.2.2 address", "B 6.2.2 zero", "B 6.2.2 directions", "B 6.2.2 source address",
)  # fmt: skip
def test_every_row_of_the_manual(name: str, arguments: dict[str, object], data: str) -> None:
    bench = J1939Bench()
    result = bench.act(name, **arguments)
    writes = [frame for frame in bench.sent if frame[0] == 0x0CEF0855 and frame[1][2] == 6]
    assert writes[0] == (0x0CEF0855, bytes.fromhex(data))
    assert (result in (Written.VERIFIED, Written.PENDING)) == (name in READABLE)


@pytest.mark.parametrize(
    ("script", "timeouts_ms"),
    [
        (session.identify(PEER), [500]), (session.save(PEER), [2500]), (session.factory_reset(PEER), [2500]),
        (session.read_values(PEER, [1, 2, 3]), [250, 250]),
        (session.change_address(HipnucJ1939Options(), 9), [1100, 500, 500, 500, 500]),
        (session.restart(HipnucJ1939Options(), 500_000), [250, 250, 3000, 1100]),
    ],
)  # fmt: skip
def test_timeouts_without_replies(script: RequestScript[object], timeouts_ms: list[float]) -> None:
    assert [*unanswered_ms(script)] == timeouts_ms


def test_missing_replies_unchanged_values_resets_and_rejected_arguments_are_reported() -> None:
    with pytest.raises(Rejected, match="restart: the device rejected the request"):
        J1939Bench(variant=J1939Variant(refuses=frozenset({session.CONTROL}))).act("restart")
    begins: list[Callable[[], RequestScript[object]]] = [
        lambda: session.save(PEER), lambda: session.zero(PEER, Zero.HERE),
        lambda: session.set_interval(PEER, 0xFF34, 10), lambda: session.set_address(PEER, 9),
    ]  # fmt: skip
    for begin in begins:
        with pytest.raises(NoReply, match="address 8"):
            played(begin(), None)
    once = session.send_once(PEER, 0xFF34)
    next(once)
    once.send(Silence(()))
    with pytest.raises(NoReply, match="address 8"):
        once.send(Silence(()))
    assert played(session.factory_reset(PEER), None)[1] is None
    with pytest.raises(NoReply, match="register 0x009c"):
        played(session.identify(PEER), None)
    assert played(session.set_interval(PEER, 0xFF34, 10), bytes.fromhex("340106000A000000"), None)[1] is (
        Written.UNVERIFIED
    )
    assert played(session.set_bitrate(PEER, 500_000), bytes.fromhex("9A00060002000000"), None)[1] is (
        Written.UNVERIFIED_PENDING
    )
    reply = bytes.fromhex("3701060064000000")
    with pytest.raises(Rejected, match="expected 50 after the write, got 100"):
        played(session.set_interval(PEER, 0xFF37, 50), reply, bytes.fromhex("3701030064000000"))
    for variant, result in (
        ("factory reset restarts", "restored, at address 8"),
        ("real", "restored; the device has address 8 after the next restart at the latest"),
    ):
        bench = J1939Bench(J1939Settings(address=9), variant=J1939_VARIANTS[variant])
        assert bench.act("factory_reset") == result
    for name, arguments in (
        ("interval", {"pgn": "FF34", "interval_ms": -1}), ("interval", {"pgn": "FF34", "interval_ms": 1001}),
        ("interval", {"pgn": "FF35", "interval_ms": 10}), ("bitrate", {"bitrate": 100_000}),
        ("address", {"address": 0}), ("address", {"address": 129}), ("direction", {"axis": "Z", "reversed": True}),
        ("zero", {"zero": "there"}), ("send_once", {"pgn": "FF35"}),
    ):  # fmt: skip
        with pytest.raises(BadArgument, match=r"expected (a|one of)"):
            script_of(DRIVER, J1939Bench().target(), name, arguments)


@pytest.mark.parametrize("status", [1, 0x5A, 0xFF])
def test_a_reply_with_a_status_is_a_rejection(status: int) -> None:
    """Byte 3 of the reply, in writes and in reads."""
    for begin, head in (
        (session.save(PEER), "000006"), (session.zero(PEER, Zero.HERE), "A50006"),
        (session.set_interval(PEER, 0xFF34, 10), "340106"), (session.send_once(PEER, 0xFF34), "960006"),
        (session.factory_reset(PEER), "000006"), (session.read(PEER, 0x009C), "9C0003"),
    ):  # fmt: skip
        request = next(begin)
        if not request.payload:  # `send_once` first listens
            request = begin.send(Silence(()))
        reply = ReplyFrame(0x0CEF5508, bytes.fromhex(head) + bytes([status]) + bytes(4))
        assert request.is_rejection(reply)
        assert not request.is_end(reply)
        with pytest.raises(Rejected, match=f"status {status}"):
            begin.send(Rejection((reply,)))


def test_which_frames_answer_a_request() -> None:
    """A message that is sent once is its own reply. It is evidence only if it does not arrive without the request."""
    script = session.send_once(PEER, 0xFF43)
    assert not next(script).payload
    request = script.send(Silence(()))
    assert request.is_end(ReplyFrame(0x0CFF4308, bytes(8)))
    assert not request.is_end(ReplyFrame(0x0CFF4309, bytes(8)))
    assert not request.is_end(ReplyFrame(0x0CFF3408, bytes(8)))
    assert not request.is_end(ReplyFrame(0x0CEF5508, bytes.fromhex("9600060043FF0000")))
    for variant in (J1939Variant(), J1939Variant(confirms_once=True)):
        bench = J1939Bench(J1939Settings(intervals_ms={0xFF34: 1000}), variant=variant)
        bench.run(10_000_000)
        answer = bench.act("send_once", pgn="FF43")
        assert isinstance(answer, VerbResult)
        assert (answer.verified, answer.evidence) == (True, "FF43 arrived, and did not arrive before the request")
        assert [can_id for can_id, _ in bench.heard].count(0x0CFF4308) == 1
        answer = bench.act("send_once", pgn="FF34")
        assert isinstance(answer, VerbResult)
        assert (answer.verified, answer.evidence) == (False, "the device also sends FF34 without the request")

    talk = offline_runner(ledger := Ledger())
    talk.start(next(session.read(PEER, X_SIGN)), 0)
    assert talk.on_message(ReplyFrame(0x0CEF5508, bytes.fromhex("9F00030001000000")), 1) is None
    outcome = talk.on_message(ReplyFrame(0x0CEF5508, bytes.fromhex("9E00030001000000")), 2)
    assert isinstance(outcome, Reply)
    assert ledger.replies_unsolicited == 1
    talk.start(next(session.read(PEER, Y_SIGN)), 3)
    assert talk.on_time(3 + session.REPLY_TIMEOUT_NS - 1) is None
    assert isinstance(talk.on_time(3 + session.REPLY_TIMEOUT_NS), Silence)


@pytest.mark.parametrize(
    ("can_id", "data", "is_reply"),
    [
        (0x0CEF5508, "3701030064000000", True),
        (0x18EF5508, "3701030064000000", True),  # another priority
        (0x0CEF2008, "3701030064000000", True),  # to the requesting address
        (0x0CEF5509, "3701030064000000", False),  # from another device
        (0x0CEF2108, "3701030064000000", False),  # to another host
        (0x0CEF5508, "3401030064000000", False),  # another register
        (0x0CEF5508, "3701060064000000", False),  # another command
        (0x0CEF5508, "37010300640000", False),
    ],
)
@pytest.mark.manual("B 6.2.1 request and reply")
def test_a_reply_is_matched_by_sender_register_and_command(can_id: int, data: str, is_reply: bool) -> None:
    request = next(session.read(J1939Node(8, 0x20), 0x0137))
    assert sent(request) == (0x0CEF0820, bytes.fromhex("3701030001000000"))
    reply = ReplyFrame(can_id, bytes.fromhex(data))
    assert request.is_end(reply) is request.is_part(reply) is is_reply
    assert not request.is_rejection(reply)
    assert not request.is_end("OK")


def test_all_that_can_be_read() -> None:
    replies = [
        None,  # FF2F is unknown
        "3401030064000000", "370103000A000000", None, "3D01030064000000", "4101030064000000", None, None, None,
        "9E00030001000000", "9F00030000000000", "9A00030002000000", "9C00030008000000",
        None, "1401030000000000", None, None, None, None, "9D00030000000000",  # newer firmware: FF14 is off
    ]  # fmt: skip
    reports: Any
    frames, reports = played(
        SETTINGS.read(Target(HipnucJ1939Options(), 0), None),
        *(None if text is None else bytes.fromhex(text) for text in replies),
    )
    assert combined(reports).words == {
        "address": "8", "bitrate": "500000", "x_reversed": "1", "y_reversed": "0", "interval_ms_FF34": "100",
        "interval_ms_FF37": "10", "interval_ms_FF3D": "100", "interval_ms_FF41": "100", "interval_ms_FF14": "0",
        "output_enabled": "0",
    }  # fmt: skip
    assert len(frames) == 20
    values = combined(reports).values
    assert (values["ff14_interval_ms"], values["output_enabled"], values["ff34_interval_ms"]) == (0, False, 100)
    older = [*replies[:13], None, None]  # older firmware: two requests without a reply end the read
    frames, _ = played(
        SETTINGS.read(Target(HipnucJ1939Options(), 0), None),
        *(None if text is None else bytes.fromhex(text) for text in older),
    )
    assert len(frames) == 15
    assert len(played(SETTINGS.read(Target(HipnucJ1939Options(), 0), None), None, None)[0]) == 2  # a silent device
    bit_rate = SETTINGS.read(Target(HipnucJ1939Options(), 0), {SETTINGS.table["bit_rate"].report})
    found = combined(played(bit_rate, bytes.fromhex("9A00030005000000"))[1])  # type: ignore[arg-type]  # reports
    assert (found.words, found.values) == ({"bitrate": "5"}, {})
    assert all(data[2:] == b"\3\0\1\0\0\0" for _, data in frames)

    def answer(request: Request) -> Outcome:
        data = sent(request)[1]
        if sent(request)[0] != 0x0CEF0855:  # J1939-21: PGN EA00 requests the address claim, PGN EE00
            assert (*sent(request), request.timeout_ns) == (0x18EA0855, b"\0\xee" + bytes(6), 250_000_000)
            return Silence(())
        value = 8 if data[0] == 0x9C else 0x0102
        return Reply((ReplyFrame(0x0CEF5508, data[:4] + value.to_bytes(4, "little")),))

    identity = run_script(session.identify(PEER), answer)
    assert (identity.product, identity.firmware) == ("", "2.5.8")


@pytest.mark.parametrize("variant", J1939_VARIANTS)
def test_identity(variant: str) -> None:
    bench = J1939Bench(variant=J1939_VARIANTS[variant])
    bench.run(10_000_000)
    if J1939_VARIANTS[variant].reads == "ignored":
        with pytest.raises(NoReply):
            bench.run_script(DRIVER.identify(bench.settings))
        return
    identity = bench.run_script(DRIVER.identify(bench.settings))
    assert (identity.product, identity.firmware) == ("HI14R2N-CAN-000", "1.6.9")
    claims = {"J1939 NAME": "80000000002A1708"} if J1939_VARIANTS[variant].claims_address else {}
    assert (identity.details, HOST_ADDRESS) == ({"address": "8", **claims}, 0x55)
    assert {data[0] for _, data in bench.sent} == {0x9C, 0, 0x78, *range(0x70, 0x78)}, "section 6.2.2"
    assert {name for name, _, _ in ROWS} == {*DRIVER.verbs, *DRIVER.renamed}
