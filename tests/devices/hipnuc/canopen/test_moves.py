"""A node is followed to another number, over everything that no manual settles."""

import pytest

from imud.contracts.device_settings import Written
from imud.contracts.session import Outcome, Reply, Request, RequestScript, Silence
from imud.devices.hipnuc.canopen import moves, session
from imud.devices.hipnuc.canopen.cia301 import Aborted, NmtCommand
from imud.devices.hipnuc.canopen.codec import HipnucCanopenSettings
from imud.errors import BadArgument, DeviceRefused, NoReply
from imud.sim.hipnuc.canopen import NODE_VARIANTS, NodeSettings, NodeVariant
from tests.support.simulated_modules import QUIET, CanopenBench, run_script

BUS = 500_000


@pytest.fixture(params=NODE_VARIANTS)
def bench(request: pytest.FixtureRequest) -> CanopenBench:
    """A node of each kind, and another one on the bus."""
    return CanopenBench(NodeSettings(node=8), boot_ms=300, variant=NODE_VARIANTS[request.param], others=(12,))


def variant_of(bench: CanopenBench) -> NodeVariant:
    return bench.module.hardware.variant


def test_a_node_is_followed_to_another_number(bench: CanopenBench) -> None:
    bench.run(500_000_000)
    written = bench.run_script(moves.change_node(bench.settings, 9))
    variant = variant_of(bench)
    is_read = variant.reads == "answered"
    if variant.number_at_once:
        assert written is (Written.VERIFIED if is_read else Written.UNVERIFIED)
        assert (bench.module.node, bench.settings.node) == (9, 9)
    else:
        assert written is (Written.PENDING if is_read else Written.UNVERIFIED_PENDING)
        assert (bench.module.node, bench.settings.node) == (8, 8)
    bench.run_script(session.save(bench.settings.node))
    assert bench.run_script(moves.restart(bench.settings, BUS)) == "restarted, as node 9"
    assert (bench.module.node, bench.settings.node) == (9, 9)
    before = len(bench.measured)
    bench.run(1_000_000_000)
    assert len(bench.measured) > before + 50


def test_an_unsaved_number_is_left_at_a_restart(bench: CanopenBench) -> None:
    bench.run(500_000_000)
    bench.run_script(moves.change_node(bench.settings, 9))
    if variant_of(bench).number_at_once and not variant_of(bench).sends_boot_up:
        pytest.skip("no such kind")
    assert bench.run_script(moves.restart(bench.settings, BUS)) == "restarted, as node 8"
    assert bench.module.node == bench.settings.node == 8


def test_a_number_that_is_heard_on_the_bus_is_refused_and_nothing_is_written(bench: CanopenBench) -> None:
    bench.run(500_000_000)
    with pytest.raises(BadArgument, match=r"node 12 is taken: frame 0x.* of it is on the bus"):
        bench.run_script(moves.change_node(bench.settings, 12))
    assert all(data[0] == 0x40 for can_id, data in bench.sent)
    assert bench.settings.node == 8
    bench.run_script(moves.change_node(bench.settings, 8))
    assert bench.settings.node == bench.module.node == 8


def test_which_frames_make_a_number_taken() -> None:
    """Also SDO replies, but not 0x600 + node and 0x200 + node, which are sent to a node."""
    bench = CanopenBench(NodeSettings(node=8), others=(12,))
    bench.others[0].objects.settings = NodeSettings(node=12, periods_ms=QUIET.periods_ms)
    bench.run(100_000_000)
    with pytest.raises(BadArgument, match=r"frame 0x58C of it"):
        bench.run_script(moves.change_node(bench.settings, 12))
    request = next(moves.change_node(HipnucCanopenSettings(node=8), 12))
    assert {wanted.can_id for wanted in request.also} == {
        0x08C, 0x18C, 0x28C, 0x38C, 0x48C, 0x58C, 0x68C, 0x70C, 0x78C,
    }  # fmt: skip


def test_a_refused_number_says_why() -> None:
    bench = CanopenBench(variant=NodeVariant(refuses=frozenset({0x20A0})))
    with pytest.raises(Aborted, match="invalid value"):
        bench.run_script(moves.change_node(bench.settings, 9))
    bench = CanopenBench(variant=NodeVariant(ignores=frozenset({0x20A0})))
    with pytest.raises(DeviceRefused, match="reads back 8"):
        bench.run_script(moves.change_node(bench.settings, 9))


def test_a_node_that_is_heard_nowhere_is_told_to_go_back() -> None:
    sent: list[bytes] = []

    def silent(request: Request) -> Outcome:
        sent.append(request.payload)
        return Reply(()) if request.silent else Silence(())

    with pytest.raises(NoReply, match="answers neither as node 9 nor as node 8"):
        run_script(moves.change_node(HipnucCanopenSettings(node=8), 9), silent)
    can_id, data = sent[-1][:2], sent[-1][8:]
    assert int.from_bytes(can_id, "little") == 0x609
    assert data == bytes.fromhex("23 A0 20 00 08 00 00 00")


def test_a_restart_is_followed_by_nmt_too() -> None:
    bench = CanopenBench(NodeSettings(node=8), boot_ms=300)
    bench.run_script(moves.change_node(bench.settings, 9))
    bench.run_script(session.save(bench.settings.node))
    assert bench.run_script(moves.reset(bench.settings, BUS, NmtCommand.RESET_NODE)) == "restarted, as node 9"
    assert bench.settings.node == bench.module.node == 9


def test_a_restart_that_loses_the_node_is_told() -> None:
    bench = CanopenBench(NodeSettings(node=8), boot_ms=300)
    bench.run(500_000_000)
    bench.run_script(session.set_bit_rate(8, 250_000))
    bench.module.hardware = bench.module.hardware.__class__(boot_ms=60_000)  # what it sends then is not understood
    result = bench.run_script(moves.restart(bench.settings, BUS))
    assert result == "restarted; it has 250000 bit/s now, which this bus has not"
    bench = CanopenBench(NodeSettings(node=8), boot_ms=60_000)
    bench.now_ns += 70_000_000_000
    with pytest.raises(NoReply, match="nothing is heard of node 8 after the restart"):
        bench.run_script(moves.restart(bench.settings, BUS))


def test_factory_settings_are_in_force_after_a_restart() -> None:
    bench = CanopenBench(NodeSettings(node=9))
    bench.run_script(session.set_node_id(9, 20))
    assert "node 8" in bench.run_script(moves.factory_reset(bench.settings))
    bench = CanopenBench(NodeSettings(node=9), others=(8,))
    bench.run(100_000_000)
    with pytest.raises(BadArgument, match="node 8 is taken"):
        bench.run_script(moves.factory_reset(bench.settings))
    assert all(data[0] == 0x40 for _, data in bench.sent)


@pytest.mark.parametrize("told", [0, 128, 0xF006_0102])
def test_a_number_that_is_none_is_not_looked_for(told: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Found by fuzzing: such a number made an identifier that no frame can have, a ValueError."""

    def read_values(*_arguments: object, **_more: object) -> RequestScript[dict[tuple[int, int], int]]:
        return {(session.NODE_ID, 0): told}
        yield  # makes it a generator

    monkeypatch.setattr(session, "read_values", read_values)
    with pytest.raises(NoReply, match="nothing is heard of node 8 after the restart"):
        run_script(moves.restart(HipnucCanopenSettings(node=8), BUS), lambda _request: Silence(()))
