"""Every SDO command that the manual prints, and conversations with the simulated module."""

from collections.abc import Callable
from typing import Literal

import pytest

from imud.contracts.codec import ReplyFrame
from imud.contracts.device_settings import Written
from imud.contracts.session import Outcome, Rejection, Reply, Request, RequestScript
from imud.devices.hipnuc.canopen import cia301, session
from imud.devices.hipnuc.canopen.cia301 import Aborted, NmtCommand, TpdoNumber
from imud.devices.hipnuc.canopen.session import InclinometerZero, Transmission
from imud.errors import BadArgument, DeviceRefused, NoReply
from imud.sim.hipnuc.canopen import NodeSettings, NodeVariant
from tests.support.simulated_modules import QUIET, CanopenBench, run_script, unpack

MANUAL: list[tuple[str, Callable[[], RequestScript[object]]]] = [
    ("23 A0 20 00 09 00 00 00", lambda: session.set_node_id(8, 9)),
    ("23 00 20 00 00 00 00 00", lambda: session.save(8)),
    ("23 00 20 00 01 00 00 00", lambda: session.factory_reset(8)),
    ("23 9A 20 00 00 00 00 00", lambda: session.set_bit_rate(8, 1_000_000)),
    ("23 9A 20 00 02 00 00 00", lambda: session.set_bit_rate(8, 500_000)),
    ("23 9A 20 00 03 00 00 00", lambda: session.set_bit_rate(8, 250_000)),
    ("23 9A 20 00 04 00 00 00", lambda: session.set_bit_rate(8, 125_000)),
    ("23 9E 20 00 00 00 00 00", lambda: session.set_inclinometer_signs(8, invert_x=False, invert_y=False)),
    ("23 9E 20 00 01 00 00 00", lambda: session.set_inclinometer_signs(8, invert_x=True, invert_y=False)),
    ("23 A5 20 00 02 00 00 00", lambda: session.set_inclinometer_zero(8, InclinometerZero.SET)),
    ("23 A5 20 00 05 00 00 00", lambda: session.set_inclinometer_zero(8, InclinometerZero.CANCEL)),
    ("2F 00 18 02 01 00 00 00", lambda: session.set_tpdo_type(8, 1, Transmission.SYNC)),
    ("2F 00 18 02 FF 00 00 00", lambda: session.set_tpdo_type(8, 1, Transmission.TIMER)),
]
TPDO_OBJECTS = {1: "00", 2: "01", 3: "02", 4: "03", 6: "04", 7: "05"}
PERIODS = {0: "00", 5: "05", 10: "0A", 20: "14", 50: "32", 100: "64"}


@pytest.mark.parametrize(("text", "make"), MANUAL)
@pytest.mark.manual(
    "B 5.4.1 node number",
    "B 5.4.1 save",
    "B 5.4.1 restart",
    "B 5.4.1 factory settings",
    "B 5.4.1 bit rate",
    "B 5.4.1 zero of the inclinometer",
    "B 5.4.2 transmission type",
)
def test_commands_of_the_manual(text: str, make: Callable[[], RequestScript[object]]) -> None:
    assert unpack(next(make()).payload) == (0x608, bytes.fromhex(text))


def test_the_restart_of_the_manual() -> None:
    assert unpack(session.restart_request(8).payload) == (0x608, bytes.fromhex("23 00 20 00 FF 00 00 00"))


@pytest.mark.parametrize("tpdo", TPDO_OBJECTS)
@pytest.mark.parametrize("period_ms", PERIODS)
@pytest.mark.manual("B 5.4.1 output rates")
def test_rate_commands_of_the_manual(tpdo: TpdoNumber, period_ms: int) -> None:
    text = f"2B {TPDO_OBJECTS[tpdo]} 18 05 {PERIODS[period_ms]} 00 00 00"
    assert unpack(next(session.set_tpdo_period(8, tpdo, period_ms)).payload) == (0x608, bytes.fromhex(text))


@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.manual("B 5.4.1 signs of the inclinometer")
def test_the_sign_of_y_has_its_own_object(invert: bool) -> None:
    bench = CanopenBench()
    bench.run_script(session.set_inclinometer_signs(8, invert_x=False, invert_y=invert))
    assert (0x608, bytes([0x23, 0x9F, 0x20, 0, invert, 0, 0, 0])) in bench.sent


@pytest.mark.parametrize("period_ms", [1, 4])
def test_a_period_below_the_shortest_is_not_sent(period_ms: int) -> None:
    with pytest.raises(BadArgument, match="expected 0 or 5 … 1000"):
        next(session.set_tpdo_period(8, 1, period_ms))


def test_identify() -> None:
    bench = CanopenBench()
    identity = bench.run_script(session.identify(8))
    assert (identity.product, identity.serial_number, identity.firmware) == ("HI14", "0x17080042", "0x0000009C")
    assert identity.details is not None
    assert identity.details["device type"] == "0x00000000"
    assert "NMT state" not in identity.details
    assert all(data[0] == 0x40 for _, data in bench.sent)


def test_identify_tells_of_a_node_that_does_not_send() -> None:
    bench = CanopenBench(NodeSettings(periods_ms=QUIET.periods_ms, heartbeat_ms=200))
    bench.run_script(session.nmt(8, NmtCommand.PRE_OPERATIONAL))
    bench.run(1_000_000_000)
    identity = bench.run_script(session.identify(8))
    assert identity.details is not None
    assert identity.details["NMT state"] == "pre-operational"


def test_read_settings() -> None:
    settings = CanopenBench(NodeSettings()).run_script(session.read_settings(8))
    assert settings["1800.2"] == "255"
    assert settings["1804.5"] == "50"
    assert settings["1805.5"] == "10"
    assert settings["20A0.0"] == "8"
    assert settings["209A.0"] == "2"
    assert len(settings) == 17


def test_what_a_node_does_not_know_is_left_out() -> None:
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
    assert run_script(session.read_settings(8), refuse) == {}


def test_a_node_that_is_not_there_does_not_answer() -> None:
    with pytest.raises(NoReply, match="node 9"):
        CanopenBench().run_script(session.identify(9))


def test_settings_are_read_back() -> None:
    bench = CanopenBench()
    assert bench.run_script(session.set_tpdo_period(8, 7, 20)) is Written.VERIFIED
    assert bench.sent[-1] == (0x608, bytes.fromhex("40 05 18 05 00 00 00 00"))
    assert bench.module.objects.settings.periods_ms[7] == 20


def test_a_setting_that_reads_back_otherwise_is_refused() -> None:
    def answer(request: Request) -> Outcome:
        _, data = unpack(request.payload)
        command = 0x4B if data[0] == 0x40 else 0x60
        return Reply((ReplyFrame(0x588, bytes([command]) + data[1:4] + b"\7\0\0\0"),))

    with pytest.raises(DeviceRefused, match=r"0x1800\.5 = 10, reads back 7"):
        run_script(session.set_tpdo_period(8, 1, 10), answer)


def test_a_refused_write_says_why() -> None:
    bench = CanopenBench()
    with pytest.raises(Aborted, match="invalid value"):
        bench.run_script(cia301.write_object(8, 0x20A0, 0, 200, 4))


@pytest.mark.parametrize("reads", ["ignored", "aborted"])
def test_a_node_that_cannot_be_read_has_taken_what_it_confirmed(reads: Literal["ignored", "aborted"]) -> None:
    bench = CanopenBench(variant=NodeVariant(reads=reads))
    assert bench.run_script(session.set_tpdo_period(8, 7, 20)) is Written.UNVERIFIED
    assert bench.module.objects.settings.periods_ms[7] == 20
    assert bench.run_script(session.set_inclinometer_signs(8, invert_x=True, invert_y=False)) is Written.UNVERIFIED
    assert bench.run_script(session.set_bit_rate(8, 250_000)) is Written.UNVERIFIED_PENDING


def test_a_save_may_take_two_seconds() -> None:
    bench = CanopenBench(variant=NodeVariant(flash_ms=1900))
    bench.run_script(session.save(8))
    assert bench.module.objects.writes_to_flash == 1


@pytest.mark.parametrize("command", NmtCommand)
def test_nmt_commands(command: NmtCommand) -> None:
    bench = CanopenBench()
    bench.run_script(session.nmt(8, command))
    assert bench.sent[-1] == (0x000, bytes([command.value, 8]))
