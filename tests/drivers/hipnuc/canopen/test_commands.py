"""Every SDO command in the manual, and scripts against the simulated device."""

from typing import Literal

import pytest

from imud.contracts.command import Target
from imud.contracts.script import Outcome, Rejection, Reply, ReplyFrame, Request, Silence
from imud.contracts.setting import Written, words_of
from imud.drivers.hipnuc.canopen import cia301
from imud.drivers.hipnuc.canopen import commands as moves
from imud.drivers.hipnuc.canopen import commands as session
from imud.drivers.hipnuc.canopen.cia301 import Aborted, NmtCommand, TpdoNumber
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.canopen.driver import SETTINGS
from imud.model.errors import BadArgument, DeviceRefused, NoReply
from imud.sim.hipnuc.canopen import NodeSettings, NodeVariant
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


def test_timeouts_without_replies() -> None:
    for make, timeout_ms in ((session.identify, 500), (session.save, 2000), (session.factory_reset, 2000)):
        assert [*unanswered_ms(make(8))] == [timeout_ms]


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
    assert identity.details is not None
    assert identity.details["device type"] == "0x00000000"
    assert "NMT state" not in identity.details
    assert all(data[0] == 0x40 for _, data in bench.sent)
    bench = CanopenBench(NodeSettings(periods_ms=QUIET.periods_ms, heartbeat_ms=200))
    bench.run_script(session.nmt(8, NmtCommand.PRE_OPERATIONAL))
    bench.run(1_000_000_000)
    identity = bench.run_script(session.identify(8))
    assert identity.details is not None
    assert identity.details["NMT state"] == "pre-operational"
    with pytest.raises(NoReply, match="node 9"):
        CanopenBench().run_script(session.identify(9))

    settings = words_of(CanopenBench(NodeSettings()).run_script(SETTINGS.read(Target(HipnucCanopenOptions(), 0), None)))
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


@pytest.mark.parametrize("reads", ["ignored", "aborted"])
def test_a_confirmed_write_to_an_unreadable_node_is_unverified(reads: Literal["ignored", "aborted"]) -> None:
    bench = CanopenBench(variant=NodeVariant(reads=reads))
    assert bench.run_script(session.set_tpdo_period(8, 7, 20)) is Written.UNVERIFIED
    assert bench.module.objects.settings.periods_ms[7] == 20
    assert bench.run_script(session.set_inclinometer_sign(8, "x", invert=True)) is Written.UNVERIFIED
    assert bench.run_script(session.set_bit_rate(8, 250_000)) is Written.UNVERIFIED_PENDING


def test_which_frames_make_a_number_taken() -> None:
    """Also SDO replies, but not 0x600 + node and 0x200 + node, which other nodes send to the node."""
    bench = CanopenBench(NodeSettings(node=8), others=(12,))
    bench.others[0].objects.settings = NodeSettings(node=12, periods_ms=QUIET.periods_ms)
    bench.run(100_000_000)
    with pytest.raises(BadArgument, match=r"its frame 0x58C"):
        bench.run_script(moves.change_node(bench.settings, 12))
    request = next(moves.change_node(HipnucCanopenOptions(node=8), 12))
    assert {wanted.can_id for wanted in request.also} == {
        0x08C, 0x18C, 0x28C, 0x38C, 0x48C, 0x58C, 0x68C, 0x70C, 0x78C,
    }  # fmt: skip


def test_a_restart_is_followed_by_nmt_too() -> None:
    bench = CanopenBench(NodeSettings(node=8), boot_ms=300)
    bench.run_script(moves.change_node(bench.settings, 9))
    bench.run_script(session.save(bench.settings.node))
    assert bench.run_script(moves.reset(bench.settings, 500_000, NmtCommand.RESET_NODE)) == "found as node 9"
    assert bench.settings.node == bench.module.node == 9
