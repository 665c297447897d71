"""Every SDO command in the manual, replies, scripts against the simulated device, and verbs with their effect on it."""

from typing import Any, Literal

import pytest

from imud.contracts.command import Target, VerbResult
from imud.contracts.script import Outcome, Rejection, Reply, ReplyFrame, Request, RequestScript, Silence
from imud.contracts.setting import Written, combined
from imud.drivers.hipnuc.canopen import cia301
from imud.drivers.hipnuc.canopen import commands as session
from imud.drivers.hipnuc.canopen.cia301 import Aborted, NmtCommand, TpdoNumber
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.canopen.driver import DRIVER, SETTINGS
from imud.model.errors import BadArgument, DeviceRefused, NoReply
from imud.sim.hipnuc.canopen import NodeSettings, NodeVariant
from tests.support.old_spellings import script_of
from tests.support.script_runners import unanswered_ms
from tests.support.simulated_modules import QUIET, CanopenBench, run_script, unpack

TPDO_OBJECTS = {1: "00", 2: "01", 3: "02", 4: "03", 6: "04", 7: "05"}
PERIODS = {0: "00", 5: "05", 10: "0A", 20: "14", 50: "32", 100: "64"}


@pytest.mark.manual("B 5.4.1 signs of the inclinometer")
def test_a_restart_a_slow_save_and_a_refused_write() -> None:
    for period_ms in (1, 4):
        with pytest.raises(BadArgument, match="expected 0 or 5 … 1000"):
            next(session.set_tpdo_period(8, 1, period_ms))
    restart = 0x608, bytes.fromhex("23 00 20 00 FF 00 00 00")
    assert unpack(session.restart_request(8).payload) == restart
    aborts = [ReplyFrame(at, bytes.fromhex("80 00 20 00 02 00 01 06")) for at in (0x588, 0x589)]
    assert [session.restart_request(8).is_rejection(one) for one in aborts] == [True, False]
    script = session.restart(HipnucCanopenOptions(), 500_000)
    next(script)
    script.send(Reply((ReplyFrame(0x588, bytes.fromhex("43 A0 20 00 08 00 00 00")),)))
    assert unpack(script.send(Silence(())).payload) == restart, "the bit rate is unreadable"
    bench = CanopenBench(variant=NodeVariant(flash_ms=1900))
    bench.run_script(session.save(8))
    assert bench.module.objects.writes_to_flash == 1
    bench = CanopenBench()
    with pytest.raises(Aborted, match="invalid value"):
        bench.run_script(cia301.write_object(8, 0x20A0, 0, 200, 4))

    for invert in (False, True):
        bench = CanopenBench()
        bench.run_script(session.set_inclinometer_sign(8, "y", invert=invert))
        assert (0x608, bytes([0x23, 0x9F, 0x20, 0, invert, 0, 0, 0])) in bench.sent


@pytest.mark.parametrize("tpdo", TPDO_OBJECTS)
@pytest.mark.manual("B 5.4.1 output rates")
def test_rate_commands_of_the_manual(tpdo: TpdoNumber) -> None:
    for period_ms, digits in PERIODS.items():
        text = f"2B {TPDO_OBJECTS[tpdo]} 18 05 {digits} 00 00 00"
        assert unpack(next(session.set_tpdo_period(8, tpdo, period_ms)).payload) == (0x608, bytes.fromhex(text))


def test_identify_and_read_settings() -> None:
    bench = CanopenBench()
    identity = bench.run_script(session.identify(8))
    assert (identity.product, identity.serial_number, identity.firmware) == ("HI14", "0x17080042", "0x0000009C")
    assert (identity.details or {})["device type"] == "0x00000000"
    assert "NMT state" not in (identity.details or {})
    assert all(data[0] == 0x40 for _, data in bench.sent)
    bench = CanopenBench(NodeSettings(periods_ms=QUIET.periods_ms, heartbeat_ms=200))
    bench.run_script(session.nmt(8, NmtCommand.PRE_OPERATIONAL))
    bench.run(1_000_000_000)
    identity = bench.run_script(session.identify(8))
    assert (identity.details or {})["NMT state"] == "pre-operational"
    with pytest.raises(NoReply, match="node 9"):
        CanopenBench().run_script(session.identify(9))

    target = Target(HipnucCanopenOptions(), 0)
    settings = combined(CanopenBench(NodeSettings()).run_script(SETTINGS.read(target, None))).words
    assert (settings["1800.2"], settings["1804.5"], settings["1805.5"]) == ("255", "50", "10")
    assert (settings["20A0.0"], settings["209A.0"]) == ("8", "2")
    assert len(settings) == 17

    asked: list[tuple[int, int]] = []

    def refuse(request: Request) -> Outcome:
        can_id, data = unpack(request.payload)
        asked.append((int.from_bytes(data[1:3], "little"), data[3]))
        reply = ReplyFrame(can_id - 0x80, b"\x80" + data[1:4] + (0x0602_0000).to_bytes(4, "little"))
        assert request.is_rejection(reply)
        return Rejection((reply,))

    identity = run_script(session.identify(8), refuse)
    assert (identity.product, identity.details) == ("", {})
    assert asked[:6] == [(0x1000, 0), (0x1008, 0), (0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4)]
    assert run_script(SETTINGS.read(Target(HipnucCanopenOptions(), 0), None), refuse) == {}


def test_settings_are_read_back_and_compared() -> None:
    bench = CanopenBench()
    assert bench.run_script(session.set_tpdo_period(8, 7, 20)) is Written.VERIFIED
    assert bench.sent[-1] == (0x608, bytes.fromhex("40 05 18 05 00 00 00 00"))
    assert bench.module.objects.settings.periods_ms[7] == 20

    def answer(request: Request) -> Outcome:
        _, data = unpack(request.payload)
        command = 0x4B if data[0] == 0x40 else 0x60
        return Reply((ReplyFrame(0x588, bytes([command]) + data[1:4] + b"\7\0\0\0"),))

    with pytest.raises(DeviceRefused, match=r"0x1800\.5 = 10 after the write, got 7"):
        run_script(session.set_tpdo_period(8, 1, 10), answer)


def test_timeouts_without_replies() -> None:
    for make, timeout_ms in ((session.identify, 500), (session.save, 2000), (session.factory_reset, 2000)):
        assert [*unanswered_ms(make(8))] == [timeout_ms]


@pytest.mark.parametrize("reads", ["ignored", "aborted"])
def test_a_confirmed_write_to_an_unreadable_node_is_unverified(reads: Literal["ignored", "aborted"]) -> None:
    bench = CanopenBench(variant=NodeVariant(reads=reads))
    assert bench.run_script(session.set_tpdo_period(8, 7, 20)) is Written.UNVERIFIED
    assert bench.module.objects.settings.periods_ms[7] == 20
    assert bench.run_script(session.set_inclinometer_sign(8, "x", invert=True)) is Written.UNVERIFIED
    assert bench.run_script(session.set_bit_rate(8, 250_000)) is Written.UNVERIFIED_PENDING


def test_which_frames_make_a_number_taken_and_a_restart_by_nmt_is_followed() -> None:
    """Also SDO replies, but not 0x600 + node and 0x200 + node, which other nodes send to the node."""
    bench = CanopenBench(NodeSettings(node=8), others=(12,))
    bench.others[0].objects.settings = NodeSettings(node=12, periods_ms=QUIET.periods_ms)
    bench.run(100_000_000)
    with pytest.raises(BadArgument, match=r"its frame 0x58C"):
        bench.run_script(session.change_node(bench.settings, 12))
    request = next(session.change_node(HipnucCanopenOptions(node=8), 12))
    assert {wanted.can_id for wanted in request.also} == {
        0x08C, 0x18C, 0x28C, 0x38C, 0x48C, 0x58C, 0x68C, 0x70C, 0x78C,
    }  # fmt: skip
    bench = CanopenBench(NodeSettings(node=8), boot_ms=300)
    bench.run_script(session.change_node(bench.settings, 9))
    bench.run_script(session.save(bench.settings.node))
    found = bench.run_script(session.reset(bench.settings, 500_000, NmtCommand.RESET_NODE))
    assert found == VerbResult(True, "the device moved from node 8 to 9", "found as node 9")
    assert bench.settings.node == bench.module.node == 9


def begun(name: str, at: int = 8, /, **given: object) -> RequestScript[Any]:
    """Return the script of a verb or of a setting for the node in the options."""
    conversation: RequestScript[Any] = script_of(DRIVER, Target(HipnucCanopenOptions(node=at), 500_000), name, given)
    return conversation


ROWS: list[tuple[str, dict[str, object], str]] = [
    ("save", {}, "23 00 20 00 00 00 00 00"), ("restart", {}, "23 00 20 00 FF 00 00 00"),
    ("factory_reset", {}, "23 00 20 00 01 00 00 00"), ("node", {"node": 9}, "23 A0 20 00 09 00 00 00"),
    ("bitrate", {"bitrate": 1_000_000}, "23 9A 20 00 00 00 00 00"),
    ("bitrate", {"bitrate": 500_000}, "23 9A 20 00 02 00 00 00"),
    ("bitrate", {"bitrate": 250_000}, "23 9A 20 00 03 00 00 00"),
    ("bitrate", {"bitrate": 125_000}, "23 9A 20 00 04 00 00 00"),
    ("interval", {"tpdo": 1, "interval_ms": 5}, "2B 00 18 05 05 00 00 00"),
    ("interval", {"tpdo": 6, "interval_ms": 0}, "2B 04 18 05 00 00 00 00"),
    ("interval", {"tpdo": 7, "interval_ms": 1000}, "2B 05 18 05 E8 03 00 00"),
    ("transmission", {"tpdo": 1, "by": "sync"}, "2F 00 18 02 01 00 00 00"),
    ("transmission", {"tpdo": 4, "by": "timer"}, "2F 03 18 02 FF 00 00 00"),
    ("direction", {"x_reversed": True, "y_reversed": False}, "23 9E 20 00 01 00 00 00"),
    ("direction", {"x_reversed": False, "y_reversed": False}, "23 9E 20 00 00 00 00 00"),
    ("transmission", {"tpdo": 1, "by": "timer"}, "2F 00 18 02 FF 00 00 00"),
    ("zero", {"zero": "here"}, "23 A5 20 00 02 00 00 00"), ("zero", {"zero": "cancel"}, "23 A5 20 00 05 00 00 00"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "given", "data"), ROWS)
@pytest.mark.parametrize("node", [8, 127])
@pytest.mark.manual(
    "B 5.4.1 node number", "B 5.4.1 save", "B 5.4.1 restart", "B 5.4.1 factory settings", "B 5.4.1 bit rate",
    "B 5.4.1 zero of the inclinometer", "B 5.4.2 transmission type",
)  # fmt: skip
def test_commands_of_the_manual_go_to_the_node_of_the_settings(
    name: str, given: dict[str, object], data: str, node: int
) -> None:
    bench = CanopenBench(NodeSettings(node=node))
    bench.run_script(begun(name, node, **given))
    writes = [frame for frame in bench.sent if frame[1][0] != 0x40]
    assert writes[0] == (0x600 + node, bytes.fromhex(data))


@pytest.mark.parametrize(
    ("command", "code"),
    [("start", 1), ("stop", 2), ("pre_operational", 0x80), ("reset_node", 0x81), ("reset_communication", 0x82)],
)
def test_network_management(command: str, code: int) -> None:
    bench = CanopenBench(NodeSettings(node=5))
    bench.run_script(begun("nmt", 5, command=command))
    assert (0, bytes([code, 5])) in bench.sent
    # only a reset returns to the settings of the flash
    verb = DRIVER.verbs["nmt"]
    assert verb.effect_on_flash(verb.arguments({"command": command})) == (code > 0x80, False)
    assert {name for name, _, _ in ROWS} | {"nmt"} == {*DRIVER.verbs, *DRIVER.renamed}


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("node", {"node": 128}), ("node", {"node": True}), ("bitrate", {"bitrate": 800_000}),
        ("interval", {"tpdo": 5, "interval_ms": 10}), ("interval", {"tpdo": 1, "interval_ms": 4}),
        ("interval", {"tpdo": 1, "interval_ms": 1001}), ("transmission", {"tpdo": 1, "by": "remote"}),
        ("direction", {"x_reversed": 1, "y_reversed": False}), ("zero", {"zero": 2}), ("nmt", {"command": "sleep"}),
    ],
)  # fmt: skip
def test_arguments_that_cannot_be_send_nothing(name: str, given: dict[str, object]) -> None:
    with pytest.raises(BadArgument, match=r"(?i)expected|invalid enum value"):
        next(begun(name, **given))


def test_the_module_obeys() -> None:
    bench = CanopenBench(NodeSettings(periods_ms=QUIET.periods_ms))
    bench.run_script(begun("direction", x_reversed=False, y_reversed=True))
    bench.run_script(begun("interval", tpdo=2, interval_ms=20))
    bench.run(100_000_000)
    assert 0x288 in {can_id for can_id, _ in bench.heard}
    assert bench.present() == {
        **{f"tpdo{tpdo}_by": "timer" for tpdo in TPDO_OBJECTS},
        **{f"tpdo{tpdo}_interval_ms": 20 * (tpdo == 2) for tpdo in TPDO_OBJECTS},
        "node": 8, "bit_rate": 500_000, "incli_x_reversed": False, "incli_y_reversed": True, "heartbeat_ms": 0,
    }  # fmt: skip
    found = VerbResult(True, "the device sent its boot message", "found as node 8")
    assert bench.run_script(begun("nmt", command="reset_node")) == found
    assert not bench.module.objects.settings.invert_y  # nothing was saved


def test_an_interval_above_the_bus_load_is_rejected_with_numbers() -> None:
    def interval(bit_rate: int, others_bit_s: float) -> object:
        bench = CanopenBench(NodeSettings(node=8))
        target = bench.target(bit_rate, others_bit_s)
        return bench.run_script(script_of(DRIVER, target, "interval", {"tpdo": 1, "interval_ms": 5}, **bench.present()))

    # 95 bits · 200 + (95 + 95 + 111 + 111) · 100 + 79 · 20 = 61,780 bit/s: 49.4 % of 125 kbit/s (TPDO1: 15.2 %)
    assert interval(125_000, 63_220.0) is Written.VERIFIED
    with pytest.raises(BadArgument, match=r"got 101 % of it: TPDO1 every 5 ms 15.2 %, .*; other devices 51.2 %"):
        interval(125_000, 64_000.0)
    assert interval(0, 1e9) is Written.VERIFIED  # a virtual bus has no rate
    with pytest.raises(BadArgument, match=r": TPDO1 every 20 ms 3.8 %; other"):  # every SYNC
        SETTINGS.check(Target(HipnucCanopenOptions(sync_hz=50), 125_000, 0, (), 124e3), {"tpdo1_by": "sync"})


def frame(text: str, can_id: int = 0x588) -> ReplyFrame:
    return ReplyFrame(can_id, bytes.fromhex(text))


@pytest.mark.manual("B 5.4.1 SDO")
def test_a_write_with_valid_and_invalid_confirmations() -> None:
    conversation = cia301.write_object(8, 0x20A0, 0, 9, 4)
    request = next(conversation)
    assert unpack(request.payload) == (0x608, bytes.fromhex("23 A0 20 00 09 00 00 00"))
    done = frame("60 A0 20 00 00 00 00 00")
    assert (request.is_end(done), request.is_rejection(done)) == (True, False)
    with pytest.raises(StopIteration):
        conversation.send(Reply((done,)))

    assert cia301.read_frame(0x1018, 4) == bytes.fromhex("40 18 10 04 00 00 00 00")
    values = {"4F": b"\1", "4B": b"\1\2", "47": b"\1\2\3", "43": b"\1\2\3\4", "42": b"\1\2\3\4", "41": None, "40": None}
    assert {cs: cia301.value_of(bytes.fromhex(cs) + bytes(3) + b"\1\2\3\4") for cs in values} == values
    for size, command in ((1, 0x2F), (2, 0x2B), (3, 0x27), (4, 0x23)):
        _, data = unpack(next(cia301.write_object(8, 0x1800, 5, 10, size)).payload)
        assert data == bytes([command, 0x00, 0x18, 5, 10, 0, 0, 0])
    for other in (
        frame("60 A1 20 00 00 00 00 00"), frame("60 A0 20 01 00 00 00 00"), frame("60 A0 20 00 00 00 00 00", 0x589),
        frame("43 A0 20 00 09 00 00 00"), frame("60 A0 20 00"), "60 A0 20 00",
    ):  # fmt: skip
        request = next(cia301.write_object(8, 0x20A0, 0, 9, 4))
        assert not any((request.is_end(other), request.is_rejection(other), request.is_part(other)))


def test_aborts_silence_and_values_in_segments() -> None:
    conversation = cia301.read_object(8, 0x2345, 1)
    request = next(conversation)
    refused = frame("80 45 23 01 00 00 02 06")
    assert request.is_rejection(refused)
    with pytest.raises(cia301.Aborted, match=r"node 8, read 0x2345.1: .*object does not exist.*0x06020000") as caught:
        conversation.send(Rejection((refused,)))
    assert (caught.value.code, cia301.abort_text(0x1234)) == (0x0602_0000, "unknown abort code")
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
