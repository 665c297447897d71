"""Dialogues that change a module, held with the simulated one."""

from random import Random

import pytest

from imud.contracts.polling import Transfer, TransferScript, run_transfer_script
from imud.devices.hipnuc.modbus.registers import BY_NAME
from imud.devices.hipnuc.modbus.session import (
    LineMounting,
    auto_level,
    factory_reset,
    read,
    restart,
    save,
    set_baud,
    set_heading_mode,
    set_id,
    set_mounting,
)
from imud.devices.hipnuc.uart.commands import AttitudeMode, LevelReset
from imud.errors import DeviceRefused, TransferError, Trouble
from imud.formats.modbus import framed
from imud.sim.hipnuc.modbus import Slave, SlaveSettings


class Wire:
    """One module at the end of a perfect line, and what it was asked."""

    def __init__(self) -> None:
        self.slave = Slave(bytes(range(8)), SlaveSettings(7, 115200))
        self.asked: list[bytes] = []
        self.replace: bytes | None = None
        self.silent = False

    def transfer(self, transfer: Transfer) -> bytes:
        self.asked.append(transfer.sends[0])
        if self.silent:
            raise TransferError(Trouble.DISTURBED, "silence")
        reply = self.slave.obey(transfer.sends[0], 10**9, 0, Random(1))
        return framed(7, self.replace or reply)

    def hold(self, dialogue: TransferScript[object]) -> object:
        return run_transfer_script(dialogue, self.transfer)


def test_what_is_written_is_read_back_and_saved_only_when_told() -> None:
    wire = Wire()
    wire.hold(set_heading_mode(AttitudeMode.NINE_AXIS))
    assert [asked[0] for asked in wire.asked] == [6, 3]
    assert wire.slave.settings.heading_mode == 1
    assert wire.hold(read(BY_NAME["HEADING_MODE"])) == (1,)
    wire.hold(restart())
    assert wire.slave.settings.heading_mode == 0
    wire.hold(set_heading_mode(AttitudeMode.NINE_AXIS))
    wire.hold(save())
    wire.hold(restart())
    assert wire.slave.settings.heading_mode == 1
    wire.hold(factory_reset())
    assert wire.slave.settings == SlaveSettings()


def test_id_and_baud_rate() -> None:
    wire = Wire()
    wire.hold(set_id(9))
    wire.hold(set_baud(921600))
    assert wire.slave.settings == SlaveSettings(9, 921600)


def test_mounting_and_level_are_confirmed_only() -> None:
    wire = Wire()
    wire.hold(set_mounting(LineMounting.X_UP))
    wire.hold(auto_level(LevelReset.AUTOMATIC))
    assert [asked.hex() for asked in wire.asked] == ["0600a60003", "0600a50003"]


def test_a_value_that_did_not_take_is_told() -> None:
    wire = Wire()
    wire.replace = bytes.fromhex("06 0006 0001")  # confirmed, and then the reply to reading back is none
    with pytest.raises(DeviceRefused):
        wire.hold(set_heading_mode(AttitudeMode.NINE_AXIS))

    def answer(transfer: Transfer) -> bytes:
        return framed(7, transfer.sends[0] if transfer.sends[0][0] == 6 else b"\x03\x02\x00\x00")

    with pytest.raises(DeviceRefused, match="wrote 1, the module has 0"):
        run_transfer_script(set_heading_mode(AttitudeMode.NINE_AXIS), answer)


def test_silence_is_no_failure_where_the_module_may_have_gone() -> None:
    wire = Wire()
    wire.silent = True
    for dialogue in (restart(), factory_reset(), set_id(9), set_baud(9600)):
        wire.hold(dialogue)
    with pytest.raises(TransferError):
        wire.hold(save())


def test_a_refusal_is_always_told() -> None:
    wire = Wire()
    wire.replace = b"\x86\x03"
    for dialogue in (restart(), set_id(9), save()):
        with pytest.raises(DeviceRefused, match="the value is not allowed"):
            wire.hold(dialogue)
