"""A module is followed to another address, over everything that no manual settles."""

import pytest

from imud.contracts.device_settings import Written
from imud.contracts.session import Outcome, Reply, Request, RequestScript, Silence
from imud.devices.hipnuc.j1939 import moves, session
from imud.devices.hipnuc.j1939.codec import HipnucJ1939Settings
from imud.errors import BadArgument, NoReply, Rejected
from imud.sim.hipnuc.j1939 import J1939_VARIANTS, J1939Settings, J1939Variant
from tests.support.simulated_modules import J1939Bench, run_script

BUS = 500_000


@pytest.fixture(params=J1939_VARIANTS)
def bench(request: pytest.FixtureRequest) -> J1939Bench:
    """A module of each kind, and another one on the bus."""
    made = J1939Bench(boot_ms=300, variant=J1939_VARIANTS[request.param], others=(12,))
    made.run(500_000_000)
    return made


def variant_of(bench: J1939Bench) -> J1939Variant:
    return bench.module.hardware.variant


def test_a_module_is_followed_to_another_address(bench: J1939Bench) -> None:
    written = bench.run_script(moves.change_address(bench.settings, 9))
    is_read = variant_of(bench).reads != "ignored"
    if variant_of(bench).address_at_once:
        assert written is (Written.VERIFIED if is_read else Written.UNVERIFIED)
        assert bench.settings.address == 9
    else:
        assert written is (Written.PENDING if is_read else Written.UNVERIFIED_PENDING)
        assert bench.settings.address == 8
    bench.run_script(session.save(bench.settings.peer))
    assert bench.run_script(moves.restart(bench.settings, BUS)) == "restarted, at address 9"
    assert bench.settings.address == bench.module.settings.address == 9
    before = len(bench.measured)
    bench.run(2_000_000_000)
    assert len(bench.measured) > before + 5


def test_an_unsaved_address_is_left_at_a_restart(bench: J1939Bench) -> None:
    bench.run_script(moves.change_address(bench.settings, 9))
    if variant_of(bench).address_at_once and not variant_of(bench).claims_address:
        pytest.skip("no such kind")
    assert bench.run_script(moves.restart(bench.settings, BUS)) == "restarted, at address 8"
    assert bench.settings.address == 8


def test_an_address_that_is_heard_on_the_bus_is_refused_and_nothing_is_written(bench: J1939Bench) -> None:
    with pytest.raises(BadArgument, match=r"address 12 is taken: PGN F.* comes from it"):
        bench.run_script(moves.change_address(bench.settings, 12))
    assert not [data for can_id, data in bench.sent if data[2] == 6]
    assert bench.settings.address == 8
    bench.run_script(moves.change_address(bench.settings, 8))
    assert bench.settings.address == 8


def test_refusals_are_told() -> None:
    bench = J1939Bench(variant=J1939Variant(refuses=frozenset({session.ADDRESS})))
    with pytest.raises(Rejected, match="status 1"):
        bench.run_script(moves.change_address(bench.settings, 9))
    bench = J1939Bench(variant=J1939Variant(ignores=frozenset({session.ADDRESS})))
    with pytest.raises(Rejected, match="the module has 8"):
        bench.run_script(moves.change_address(bench.settings, 9))
    bench = J1939Bench(variant=J1939Variant(refuses=frozenset({session.CONTROL})))
    with pytest.raises(Rejected, match="restart: the module refused"):
        bench.run_script(moves.restart(bench.settings, BUS))


def test_a_module_that_is_heard_nowhere_is_told_to_go_back() -> None:
    sent: list[bytes] = []

    def silent(request: Request) -> Outcome:
        sent.append(request.payload)
        return Reply(()) if request.silent else Silence(())

    with pytest.raises(NoReply, match="answers neither at address 9 nor at 8"):
        run_script(moves.change_address(HipnucJ1939Settings(address=8), 9), silent)
    assert sent[-1][8:] == bytes.fromhex("9C 00 06 00 08 00 00 00")
    assert int.from_bytes(sent[-1][:4], "little") & 0x1FFF_FFFF == 0x0CEF0955


def test_a_restart_that_loses_the_module_is_told() -> None:
    bench = J1939Bench(boot_ms=300)
    bench.run(500_000_000)
    bench.run_script(session.set_bitrate(bench.settings.peer, 250_000))
    bench.module.hardware = bench.module.hardware.__class__(boot_ms=60_000)  # what it sends then is not understood
    assert "it has 250000 bit/s now" in bench.run_script(moves.restart(bench.settings, BUS))
    bench = J1939Bench(boot_ms=60_000)
    bench.now_ns += 70_000_000_000
    with pytest.raises(NoReply, match="nothing is heard of address 8 after the restart"):
        bench.run_script(moves.restart(bench.settings, BUS))


def test_factory_settings_are_in_force_after_a_restart() -> None:
    bench = J1939Bench(J1939Settings(address=9))
    assert "address 8 after the next restart" in bench.run_script(moves.factory_reset(bench.settings))
    bench = J1939Bench(J1939Settings(address=9), others=(8,))
    bench.run(100_000_000)
    with pytest.raises(BadArgument, match="address 8 is taken"):
        bench.run_script(moves.factory_reset(bench.settings))


@pytest.mark.parametrize("told", [254, 0xF006_0102])
def test_an_address_that_is_none_is_not_looked_for(told: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_values(*_arguments: object, **_more: object) -> RequestScript[dict[int, int]]:
        return {session.ADDRESS: told}
        yield  # makes it a generator

    monkeypatch.setattr(session, "read_values", read_values)
    with pytest.raises(NoReply):
        run_script(moves.restart(HipnucJ1939Settings(), 500_000), lambda _request: Silence(()))
