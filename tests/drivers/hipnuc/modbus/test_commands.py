"""Scripts that change a device on the simulated bus, for all behaviors that no manual documents."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from imud.contracts.script import Transfer, TransferScript, run_transfer_script
from imud.contracts.setting import Written
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.modbus import commands
from imud.drivers.hipnuc.modbus.registers import BY_NAME
from imud.formats.modbus import framed
from imud.model.errors import BadArgument, DeviceRefused, NoReply, TransferError
from imud.sim.hipnuc.modbus import SLAVE_VARIANTS, SlaveSettings, SlaveVariant
from tests.support.pty_port import LINE_BAUD as BAUD
from tests.support.pty_port import ModbusBench
from tests.support.pty_port import modbus_slave as module

NINE = AttitudeMode.NINE_AXIS


@pytest.fixture(params=SLAVE_VARIANTS)
def bench(request: pytest.FixtureRequest) -> ModbusBench:
    """Yield a device of each kind, with another device on the bus."""
    return ModbusBench(module(7, variant=SLAVE_VARIANTS[request.param]), module(12))


def restarted(bench: ModbusBench) -> str:
    return bench.run(commands.restart((bench.at, 7), BAUD))


@pytest.mark.manual("B 4.3.1 save")
def test_settings_are_read_back_and_saved_only_on_request(bench: ModbusBench) -> None:
    assert bench.run(commands.set_heading_mode(NINE)) is Written.VERIFIED
    assert [request[0] for _, request in bench.sent] == [6, 3]
    assert bench.run(commands.read(BY_NAME["HEADING_MODE"])) == (1,)
    restarted(bench)
    assert bench.slave.settings.heading_mode == 0
    bench.run(commands.set_heading_mode(NINE))
    bench.run(commands.save())
    restarted(bench)
    assert (bench.slave.settings.heading_mode, bench.slave.writes_to_flash) == (1, 1)
    before_ns = bench.now_ns
    bench.run(commands.save())
    assert bench.now_ns - before_ns >= bench.slave.variant.flash_ms * 1_000_000
    with pytest.raises(TransferError):
        ModbusBench(module(7, variant=SlaveVariant(flash_ms=2600))).run(commands.save())


def test_each_write_has_as_much_time_as_a_save() -> None:
    slow = ModbusBench(module(7, processing_ns=2_000_000_000))
    assert slow.run(commands.set_heading_mode(NINE)) is Written.UNVERIFIED  # the bench gives the read less time
    assert slow.slave.settings.heading_mode == 1


@pytest.mark.manual("B 4.3.3 address")
def test_a_module_is_followed_to_another_address(bench: ModbusBench) -> None:
    written = bench.run(commands.change_address(7, 9))
    if bench.slave.variant.address_at_once:
        assert (written, bench.at, bench.slave.address) == (Written.VERIFIED, 9, 9)
    else:
        assert (written, bench.at, bench.slave.address) == (Written.PENDING, 7, 7)
    bench.run(commands.save())
    assert restarted(bench) == "found at address 9"
    assert (bench.at, bench.slave.address) == (9, 9)
    assert bench.run(commands.read(BY_NAME["MD_ID"])) == (9,)


def test_an_address_that_another_module_has_is_refused_before_anything_is_written(bench: ModbusBench) -> None:
    with pytest.raises(BadArgument, match="address 12 is in use by the device with serial number A00000000000000C"):
        bench.run(commands.change_address(7, 12))
    assert not any(request[0] == 6 for _, request in bench.sent)
    assert bench.at == 7
    assert bench.run(commands.change_address(7, 7)) is Written.VERIFIED
    assert bench.at == 7
    bench.run(commands.change_address(7, 9))
    assert restarted(bench) == "found at address 7"
    assert bench.at == bench.slave.address == 7


def test_addresses_that_are_taken_not_accepted_or_lost() -> None:
    bench = ModbusBench(module(7), module(12, serial=0x0F), module(12, serial=0xF0))
    with pytest.raises(BadArgument, match="address 12 is in use: got a reply"):
        bench.run(commands.change_address(7, 12))
    bench = ModbusBench(module(7), module(12, mute=2))
    with pytest.raises(BadArgument, match="in use"):
        bench.run(commands.change_address(7, 12))
    with pytest.raises(BadArgument, match=r"1 … 128, got 129"):
        ModbusBench().run(commands.change_address(7, 129))
    bench = ModbusBench(module(7), module(80))
    with pytest.raises(BadArgument, match="address 80 is in use"):
        bench.run(commands.factory_reset((7,), BAUD))
    assert not any(request[0] == 6 for _, request in bench.sent)
    bench = ModbusBench(module(7, variant=SlaveVariant(ignores=frozenset({"MD_ID"}))))
    with pytest.raises(DeviceRefused, match="expected 9 after the write, got 7"):
        bench.run(commands.change_address(7, 9))
    bench = ModbusBench(module(7, variant=SlaveVariant(refuses=frozenset({"MD_ID"}))))
    with pytest.raises(DeviceRefused, match="the value is not allowed"):
        bench.run(commands.change_address(7, 9))

    bench = ModbusBench(module(7))
    script = commands.change_address(7, 9)

    def transfer(transfer: Transfer) -> bytes:
        answer = bench.transfer(transfer)
        if transfer.sends[0][0] == 6:
            assert transfer.holds, "no other transfer before the next address"
            bench.slave.mute = 6  # three tries at each address against noise
        return answer

    with pytest.raises(NoReply, match="neither at address 9 nor at 7"):
        run_transfer_script(script, transfer)
    assert bench.sent[-1] == (9, bytes.fromhex("0600050007"))
    assert bench.slave.address == 9 or bench.slave.settings.slave == 7


@pytest.mark.manual("B 4.3.1 restart")
def test_a_rate_is_in_force_after_saving_and_restarting(bench: ModbusBench) -> None:
    if bench.slave.variant.rate_at_once:
        with pytest.raises(NoReply, match="it now uses 9600 baud"):
            bench.run(commands.set_baud(9600))
        return
    assert bench.run(commands.set_baud(9600)) is Written.PENDING
    assert bench.slave.baud == BAUD
    bench.run(commands.save())
    assert restarted(bench) == "the device now uses 9600 baud and the RS-485 bus does not; set the bus to 9600 baud"
    assert bench.slave.baud == 9600


@pytest.mark.manual("B 4.3.1 factory settings")
def test_mounting_level_and_factory_settings(bench: ModbusBench) -> None:
    assert bench.run(commands.set_mounting(commands.LineMounting.X_UP)) is Written.UNVERIFIED
    bench.run(commands.auto_level(LevelReset.AUTOMATIC))
    assert [request.hex() for _, request in bench.sent] == ["0600a60003", "0600a50003"]
    bench.run(commands.set_heading_mode(NINE))
    assert bench.run(commands.factory_reset((7,), BAUD)) == "found at address 80"
    assert (bench.slave.settings, bench.at) == (SlaveSettings(), 80)


def test_devices_with_unexpected_replies() -> None:
    bench = ModbusBench(module(7, variant=SlaveVariant(ignores=frozenset({"HEADING_MODE"}))))
    with pytest.raises(DeviceRefused, match="expected 1 after the write, got 0"):
        bench.run(commands.set_heading_mode(NINE))

    def answer(transfer: Transfer) -> bytes:
        request = transfer.sends[0]
        return framed(7, request if request[0] == 6 else b"\x83\x02")

    assert run_transfer_script(commands.set_heading_mode(NINE), answer) is Written.UNVERIFIED
    (report,) = run_transfer_script(
        commands.read_settings(), lambda _transfer: framed(7, bytes((3, 6, 0, 10, 0, 7, 0, 2)))
    ).values()
    assert report.words == {"baud": "code 10", "id": "7", "heading_mode": "code 2"}
    assert report.values == {"address": 7}

    bench = ModbusBench(module(7, variant=SlaveVariant(boot_ms=60_000)))
    before_ns = bench.now_ns
    with pytest.raises(NoReply, match="does not reply at address 7 after its restart"):
        restarted(bench)
    assert (bench.now_ns - before_ns) // 10**9 == 3
    written = [request[0] for _, request in bench.sent].index(6)
    assert len(bench.sent) - written == 1 + 30

    made = module(7)
    made.settings = made.flash = replace(made.settings, baud=9600)
    made.baud = 9600
    bench = ModbusBench(made, baud=9600)
    assert "115200 baud and address 80" in bench.run(commands.factory_reset((7,), 9600))


def test_absence_and_rejections_are_reported() -> None:
    bench = ModbusBench(module(7, dead=True))
    begins: list[Callable[[], TransferScript[Any]]] = [
        lambda: commands.restart((7,), BAUD), lambda: commands.set_baud(9600), lambda: commands.change_address(7, 9),
        commands.save,
    ]  # fmt: skip
    for begin in begins:
        with pytest.raises((TransferError, NoReply)):
            bench.run(begin())

    scripts: dict[str, Callable[[], TransferScript[Any]]] = {
        "CTRL": lambda: commands.restart((7,), BAUD), "MD_ID": lambda: commands.set_id(9),
        "HEADING_MODE": lambda: commands.set_heading_mode(NINE),
    }  # fmt: skip
    for name, script in scripts.items():
        bench = ModbusBench(module(7, variant=SlaveVariant(refuses=frozenset({name}))))
        with pytest.raises(DeviceRefused, match="the value is not allowed"):
            bench.run(script())
