"""Scripts and verbs that change a device on the simulated bus, for all behaviors that no manual documents.
Every request in the manual, byte by byte, and rejected requests."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from imud.contracts.command import Target, VerbResult, Verdict, parameters_of
from imud.contracts.script import Transfer, TransferScript, run_transfer_script
from imud.contracts.setting import Effect, Written, combined
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.modbus import commands, registers
from imud.drivers.hipnuc.modbus.codec import HipnucModbusOptions
from imud.drivers.hipnuc.modbus.driver import CALIBRATIONS, DRIVER, SETTINGS
from imud.drivers.hipnuc.modbus.registers import BY_NAME, read_registers, write_register
from imud.formats.modbus import framed
from imud.model.errors import BadArgument, DeviceRefused, NoReply, TransferError
from imud.sim.hipnuc.modbus import SLAVE_VARIANTS, SlaveSettings, SlaveVariant
from tests.support.old_spellings import script_of
from tests.support.pty_port import LINE_BAUD as BAUD
from tests.support.pty_port import ModbusBench
from tests.support.pty_port import modbus_slave as module

NINE = AttitudeMode.NINE_AXIS


@pytest.fixture(params=SLAVE_VARIANTS)
def bench(request: pytest.FixtureRequest) -> ModbusBench:
    """Yield a device of each kind, with another device on the bus."""
    return ModbusBench(module(7, variant=SLAVE_VARIANTS[request.param]), module(12))


def restarted(bench: ModbusBench) -> VerbResult:
    """Restart the device. A report without evidence becomes a result that is not verified."""
    answer = bench.run(commands.restart((bench.at, 7), BAUD))
    return answer if isinstance(answer, VerbResult) else VerbResult(False, "", answer)


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
    # the newest firmware confirms a save without an effect: it loses the value, or it has already saved it itself
    for variant, kept in ((SlaveVariant(saves=False), 0), (SlaveVariant(saves=False, saves_at_once=True), 1)):
        newest = ModbusBench(module(7, variant=variant))
        newest.run(commands.set_heading_mode(NINE))
        newest.run(commands.save())
        restarted(newest)
        assert newest.run(commands.read(BY_NAME["HEADING_MODE"])) == (kept,)
    assert not SETTINGS.save_is_certain
    with pytest.raises(TransferError):
        ModbusBench(module(7, variant=SlaveVariant(flash_ms=2600))).run(commands.save())
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
    assert restarted(bench).result == "found at address 9"
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
    assert restarted(bench).result == "found at address 7"
    assert bench.at == bench.slave.address == 7


def test_addresses_that_are_taken_not_accepted_or_lost() -> None:
    bench = ModbusBench(module(7), module(12, serial=0x0F), module(12, serial=0xF0))
    with pytest.raises(BadArgument, match="address 12 is in use: got a reply"):
        bench.run(commands.change_address(7, 12))
    bench = ModbusBench(module(7), module(12, mute=2))
    with pytest.raises(BadArgument, match="in use"):
        bench.run(commands.change_address(7, 12))
    with pytest.raises(BadArgument, match=r"1 … 247, got 248"):
        ModbusBench().run(commands.change_address(7, 248))
    for firmware, at in ((169, 7), (170, 247)):  # firmware of the manual rejects an address above 128
        bench = ModbusBench(module(7, firmware=firmware))
        with nullcontext() if at == 247 else pytest.raises(DeviceRefused, match="assign PORT --serial SN --id 247"):
            assert bench.run(commands.change_address(7, 247)) is Written.VERIFIED
        assert (bench.at, bench.slave.address) == (at, at)
    bench = ModbusBench(module(7, firmware=170, variant=SlaveVariant(ignores=frozenset({"MD_ID"}))))
    with pytest.raises(DeviceRefused, match="got 7; older firmware accepts 1 … 128: try"):
        bench.run(commands.change_address(7, 129))
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

    bench, mute = ModbusBench(module(7)), 2

    def transfer(transfer: Transfer) -> bytes:
        answer = bench.transfer(transfer)
        if transfer.sends[0][0] == 6:
            assert transfer.holds, "no other transfer before the next address"
            bench.slave.mute = mute  # three tries at each address against noise
        return answer

    assert run_transfer_script(commands.change_address(7, 9), transfer) is Written.VERIFIED
    bench, mute = ModbusBench(module(7)), 6
    with pytest.raises(NoReply, match="neither at address 9 nor at 7"):
        run_transfer_script(commands.change_address(7, 9), transfer)
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
    found = restarted(bench)
    assert found.result == "the device now uses 9600 baud and the RS-485 bus does not; set the bus to 9600 baud"
    assert (found.verified, found.evidence) == (False, "imud cannot receive the device at another baud rate")
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
    assert run_transfer_script(commands.read_present(), answer) == (None, None, None)
    bench = ModbusBench(module(7, variant=SlaveVariant(ignores=frozenset({"UART1_BAUD"}))))
    with pytest.raises(DeviceRefused, match="UART1_BAUD: expected 1 after the write, got 5"):
        bench.run(commands.set_baud(9600))
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


@pytest.mark.parametrize(("boot_ms", "ignores"), [(800, ()), (800, ("CTRL",)), (200, ()), (300, ())])
def test_pause_is_not_evidence_of_a_restart(boot_ms: int, ignores: tuple[str, ...]) -> None:
    """A busy device does not reply either. Only its uptime or another address shows a restart."""
    bench = ModbusBench(module(7, variant=SlaveVariant(boot_ms=boot_ms, ignores=frozenset(ignores))))
    found = restarted(bench)
    assert (found.verified, found.evidence, found.result) == (False, "", "found at address 7")
    if not ignores:
        bench.run(commands.change_address(7, 9))
        found = restarted(bench)
        assert (found.verified, found.evidence) == (True, "the device moved from address 9 to 7")


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


def act(bench: ModbusBench, name: str, **given: object) -> object:
    result: object = bench.run(script_of(DRIVER, bench.target, name, given))
    return result


@pytest.mark.parametrize(
    ("name", "given", "sent"),
    [
        ("save", {}, "0600000000"), ("factory_reset", {}, "0600000001"), ("restart", {}, "06000000ff"),
        ("address", {"address": 128}, "0600050080"), ("baud", {"baud": 4800}, "0600040000"),
        ("baud", {"baud": 256000}, "0600040009"), ("attitude_mode", {"axes": 9}, "0600060001"),
        ("attitude_mode", {"axes": 6}, "0600060000"), ("level", {"level": "relative"}, "0600a50002"),
        ("level", {"level": "cancel"}, "0600a50005"), ("mounting", {"mounting": "level"}, "0600a60000"),
        ("mounting", {"mounting": "y_down"}, "0600a60001"), ("mounting", {"mounting": "x_up"}, "0600a60003"),
    ],
)  # fmt: skip
@pytest.mark.manual("B 4.3.1 save", "B 4.3.2 baud rate", "B 4.3.4 mounting", "B 4.3.5 level", "B 4.3.6 axes")
def test_requests_as_sent(name: str, given: dict[str, object], sent: str) -> None:
    bench = ModbusBench()
    act(bench, name, **given)
    assert next(request.hex() for _, request in bench.sent if request[0] == 6) == sent


def test_actions_without_an_address_reading_by_name_and_unsupported_values() -> None:
    with pytest.raises(BadArgument, match="expected a device on an RS-485 bus with a known address"):
        script_of(DRIVER, Target(HipnucModbusOptions(), 0), "address", {"address": 9})
    bench = ModbusBench(module(7))
    assert act(bench, "read", register="MD_ID") == (7,)
    assert act(bench, "read", register="sn") == (0xA000, 0, 0, 7)
    for name in ("CTRL", "nothing"):
        with pytest.raises(BadArgument, match="HEADING_MODE"):
            act(bench, "read", register=name)
    assert all(verb.help for verb in DRIVER.verbs.values())
    assert [str(one) for one in parameters_of(DRIVER.verbs["level"])] != []
    for name, given, names in (
        ("address", {"address": 248}, "from 1 to 247"),
        ("address", {}, "address is a setting: imud settings bow --set address=ADDRESS"),
        ("baud", {"baud": 12345}, "4800, 9600"), ("mounting", {"mounting": 1}, "level"),
        ("attitude_mode", {"axes": 1}, '"6-axis", "9-axis"'), ("level", {"level": 3}, "automatic"),
    ):  # fmt: skip
        bench = ModbusBench()
        with pytest.raises(BadArgument, match=names):
            act(bench, name, **given)
        assert bench.sent == []


TARGET = Target(None, 0)


def value_of(script: Any, registers: dict[int, int]) -> tuple[list[Transfer], object]:
    """Run a script on registers of one word each; writes are echoed. Return the transfers and the result."""
    made: list[Transfer] = []

    def transfer(wanted: Transfer) -> bytes:
        made.append(wanted)
        (request,) = wanted.sends
        if request[0] == 0x06:
            return framed(1, request)
        address = int.from_bytes(request[1:3], "big")
        return framed(1, bytes([0x03, 2]) + registers[address].to_bytes(2, "big"))

    return made, run_transfer_script(script, transfer)


@pytest.mark.manual("B 4.3.5 level")
def test_calibrations_levels_verdict_by_progress_and_the_required_mode() -> None:
    for kind, value in (("level", 2), ("accelerometer_level", 3)):
        calibration = CALIBRATIONS[kind]
        assert calibration.save is not None
        for step, write in (
            (calibration.begin, write_register(0xA5, value)),
            (calibration.save, write_register(0x00, 0)),
        ):
            (sent,) = value_of(step(TARGET), {})[0]
            assert sent.sends == write.sends
    for percent, verdict in (
        (0, Verdict(False, "state 1, 0 %", 0.0)), (40, Verdict(False, "state 1, 40 %", 0.4)),
        (100, Verdict(True, "state 1, 100 %", 1.0)), (65535, Verdict(True, "state 1, 65535 %", 1.0)),
    ):  # fmt: skip
        ask = CALIBRATIONS["magnetometer"].verdict
        assert ask is not None
        made, found = value_of(ask(TARGET), {0x0A: 1, 0x0B: percent})
        assert (made, found) == ([read_registers(0x0A, 1), read_registers(0x0B, 1)], verdict)
    for mode, words in ((0, "`imud settings NAME --set mode=9-axis`"), (1, "")):
        calibration = CALIBRATIONS["magnetometer"]
        assert calibration.unready is not None
        assert str(value_of(calibration.unready(TARGET), {0x06: mode})[1]).endswith(words)
        assert value_of(calibration.begin(TARGET), {}) == ([], None)


VALUES: dict[str, tuple[object, ...]] = {
    "mode": ("9-axis", "6-axis"), "mounting": ("x_up", "x_down", "y_up", "y_down", "level"), "baud": (115200,),
    "address": (1, 128),
}  # fmt: skip


def write(bench: ModbusBench, name: str, value: object) -> object:
    made = SETTINGS.table[name].write
    assert made is not None
    return bench.run(made(bench.target, value))


def present(bench: ModbusBench) -> dict[str, Any]:
    return dict(combined(bench.run(SETTINGS.read(bench.target, None))).values)


def test_the_table_has_effects_and_types() -> None:
    assert DRIVER.device_settings is SETTINGS
    assert set(VALUES) == set(SETTINGS.table)
    effects = {name: (one.effect, one.connection) for name, one in SETTINGS.table.items()}
    assert effects == {
        "mode": (Effect.IMMEDIATELY, False), "mounting": (Effect.AFTER_RESTART, False),
        "baud": (Effect.AFTER_RESTART, True), "address": (Effect.IMMEDIATELY, True),
    }  # fmt: skip
    for name, values in VALUES.items():
        for value in values:
            assert msgspec.convert(value, SETTINGS.table[name].type) == value
    for name, wrong in (("mode", 9), ("mounting", "z_up"), ("baud", 12345), ("address", 248), ("address", 0)):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(wrong, SETTINGS.table[name].type)


def test_present_values_are_read_and_nothing_is_written(bench: ModbusBench) -> None:
    assert present(bench) == {"mode": "6-axis", "baud": 115200, "address": 7}
    assert all(request[0] == 3 for _, request in bench.sent)


@pytest.mark.parametrize("name", VALUES)
def test_a_saved_setting_is_read_after_a_restart(bench: ModbusBench, name: str) -> None:
    setting = SETTINGS.table[name]
    for value in VALUES[name]:
        written = write(bench, name, value)
        assert isinstance(written, Written)
        assert SETTINGS.save is not None
        assert SETTINGS.restart is not None
        bench.run(SETTINGS.save(bench.target))
        bench.run(SETTINGS.restart(bench.target))
        if setting.readable:
            assert setting.agrees(value, present(bench)[name])
        else:
            assert name not in present(bench)
            assert written is Written.UNVERIFIED


def test_values_that_are_refused_left_out_or_ignored() -> None:
    bench = ModbusBench()
    SETTINGS.check(bench.target, {"baud": 115200, "mode": "9-axis"})
    SETTINGS.check(bench.target, {})
    with pytest.raises(BadArgument, match="expected 115200, the baud rate of the bus, got 9600"):
        SETTINGS.check(bench.target, {"baud": 9600})
    bench = ModbusBench(module(7, dead=True))
    with pytest.raises(TransferError):
        present(bench)
    strange = ModbusBench(module(7))
    strange.slave.settings = strange.slave.settings.__class__(7, 115200, 5)
    assert present(strange) == {"baud": 115200, "address": 7}
    for name in ("mode", "address"):
        register = {"mode": "HEADING_MODE", "address": "MD_ID"}[name]
        bench = ModbusBench(module(7, variant=SlaveVariant(ignores=frozenset({register}))))
        with pytest.raises(Exception, match="after the write, got"):
            write(bench, name, VALUES[name][0])


PRINTED = [  # sections 4.3.1 to 4.5, in their order
    ("50 06 00 00 00 00 84 4B", commands.save()),
    ("50 06 00 00 00 01 45 8B", commands.send_control(commands.FACTORY_RESET)),
    ("50 06 00 00 00 FF C4 0B", commands.send_control(commands.RESTART)),
    ("50 06 00 04 00 00 C5 8A", commands.set_baud(4800)),
    ("50 06 00 04 00 01 04 4A", commands.set_baud(9600)), ("50 06 00 04 00 02 44 4B", commands.set_baud(19200)),
    ("50 06 00 04 00 03 85 8B", commands.set_baud(38400)), ("50 06 00 04 00 04 C4 49", commands.set_baud(57600)),
    ("50 06 00 04 00 05 05 89", commands.set_baud(115200)), ("50 06 00 04 00 06 45 88", commands.set_baud(230400)),
    ("50 06 00 04 00 07 84 48", commands.set_baud(460800)), ("50 06 00 04 00 08 C4 4C", commands.set_baud(921600)),
    ("50 06 00 05 00 50 94 76", commands.set_id(0x50)), ("50 06 00 05 00 51 55 B6", commands.set_id(0x51)),
    ("50 06 00 05 00 52 15 B7", commands.set_id(0x52)), ("50 06 00 05 00 53 D4 77", commands.set_id(0x53)),
    ("50 06 00 A6 00 00 64 68", commands.set_mounting(commands.LineMounting.LEVEL)),
    ("50 06 00 A6 00 01 A5 A8", commands.set_mounting(commands.LineMounting.Y_DOWN)),
    ("50 06 00 A6 00 02 E5 A9", commands.set_mounting(commands.LineMounting.Y_UP)),
    ("50 06 00 A6 00 03 24 69", commands.set_mounting(commands.LineMounting.X_UP)),
    ("50 06 00 A6 00 04 65 AB", commands.set_mounting(commands.LineMounting.X_DOWN)),
    ("50 06 00 A5 00 02 15 A9", commands.auto_level(LevelReset.RELATIVE)),
    ("50 06 00 A5 00 05 54 6B", commands.auto_level(LevelReset.CANCEL)),
    ("50 06 00 06 00 00 64 4A", commands.set_heading_mode(AttitudeMode.SIX_AXIS)),
    ("50 06 00 06 00 01 A5 8A", commands.set_heading_mode(AttitudeMode.NINE_AXIS)),
    ("50 03 00 70 00 14 49 9F", registers.read_registers(0x70, 0x14)),
    ("50 03 00 34 00 18 09 8F", registers.read_registers(0x34, 0x18)),
]  # fmt: skip


@pytest.mark.parametrize(("printed", "asked"), PRINTED, ids=[row[0] for row in PRINTED])
@pytest.mark.manual("B 4 byte order", "B 4.1.1 read", "B 4.1.2 write", "B 4.3.2 baud rate")
def test_printed_requests(printed: str, asked: object) -> None:
    transfer = asked if isinstance(asked, Transfer) else next(asked)  # type: ignore[call-overload]  # a generator
    assert framed(0x50, transfer.sends[0]) == bytes.fromhex(printed)
    assert transfer.read_bytes == {3: 5 + 2 * transfer.sends[0][-1], 6: 8}[transfer.sends[0][0]]


@pytest.mark.manual("B 4.6 address by serial number", "B 4.6 random addresses", "B 4.1.1 read")
def test_requests_to_all_and_invalid_requests() -> None:
    """Section 4.6: sub-command, length of the data, then the data. No reply is expected."""
    by_serial = registers.set_id_by_serial("047D955F8D2A1708", 0x22)
    assert by_serial == Transfer((bytes.fromhex("50 0031 000A 047D955F8D2A1708 0022"),), 0)
    assert registers.randomise_ids(1, 247) == Transfer((bytes.fromhex("50 0030 0006 0001 00F7 FFFF"),), 0)

    good = framed(7, registers.registers_reply(b"\x00\x01\xff\xfe"))
    assert registers.registers_of(good, 2) == (1, 0xFFFE)
    write = registers.write_register(6, 1)
    registers.check_written(framed(7, write.sends[0]), write)
    for reply, why in (
        (framed(7, b"\x83\x02"), "exception 2: the register does not exist"), (good[:-1], "damaged"),
        (good[:-1] + b"\x00", "damaged"), (framed(7, b"\x04\x04\x00\x01\xff\xfe"), "function 0x03"),
        (framed(7, b"\x03\x05\x00\x01\xff\xfe"), "got a reply of 5"), (b"", "damaged"),
    ):  # fmt: skip
        with pytest.raises(DeviceRefused, match=why):
            registers.registers_of(reply, 2)
    with pytest.raises(DeviceRefused, match="expected the confirmation"):
        registers.check_written(framed(7, registers.write_register(6, 0).sends[0]), write)
    for begin, names in (
        (lambda: registers.set_id_by_serial("047D955F8D2A17", 1), "16 hexadecimal digits"),
        (lambda: registers.serial_bytes("what is this one"), "16 hexadecimal digits"),
        (lambda: registers.set_id_by_serial("047D955F8D2A1708", 0), "1 … 247"),
        (lambda: registers.set_id_by_serial("047D955F8D2A1708", 248), "1 … 247"),
        (lambda: registers.randomise_ids(9, 9), "below the highest"),
        (lambda: registers.randomise_ids(0, 9), "1 … 247"), (lambda: registers.randomise_ids(True, 9), "1 … 247"),
        (lambda: next(commands.set_id(248)), "1 … 247"), (lambda: next(commands.set_id(0)), "1 … 247"),
        (lambda: registers.read_registers(0, 126), "1 … 125"), (lambda: registers.read_registers(0xFFFF, 2), "0xFFFF"),
        (lambda: registers.write_register(0, 0x10000), "0xFFFF"),
    ):  # fmt: skip
        assert callable(begin)
        with pytest.raises(BadArgument) as refused:
            begin()
        assert names in str(refused.value)


@pytest.mark.manual("B 4.2 registers")
def test_table_of_registers() -> None:
    """Section 4.2 and newer firmware: no gap in the block, no duplicate, limits for writable registers."""
    taken = [
        address
        for register in registers.REGISTERS
        for address in range(register.address, register.address + register.count)
    ]
    assert sorted(taken) == taken == list(dict.fromkeys(taken))
    assert set(range(0x34, 0x54)) <= set(taken)
    assert {0x00, 0x04, 0x05, 0x06, 0x09, 0x0A, 0x0B, 0x70, 0x78, 0x79, 0x7F, 0x82, 0xA5, 0xA6} <= set(taken)
    assert all(register.values for register in registers.REGISTERS if register.access is not registers.Access.READ)
    assert all(register.meaning for register in registers.REGISTERS)
    assert (registers.BAUD_RATES[5], len({row[0] for row in PRINTED})) == (115200, 27)
    assert registers.BAUD_RATES[8:] == (921600, 256000)
    assert registers.BY_NAME["CTRL"].values == (0, 1, 255)
