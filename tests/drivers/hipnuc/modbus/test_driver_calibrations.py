"""Requests of the calibrations of a HiPNUC device on RS-485, and the meaning of its registers."""

from typing import Any

import pytest

from imud.contracts.command import Target, Verdict
from imud.contracts.script import Transfer, run_transfer_script
from imud.drivers.hipnuc.modbus.driver import CALIBRATIONS
from imud.drivers.hipnuc.modbus.registers import read_registers, write_register
from imud.formats.modbus import framed

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


@pytest.mark.parametrize(("kind", "value"), [("level", 2), ("accelerometer_level", 3)])
@pytest.mark.manual("B 4.3.5 level")
def test_levels(kind: str, value: int) -> None:
    calibration = CALIBRATIONS[kind]
    assert calibration.save is not None
    for step, write in ((calibration.begin, write_register(0xA5, value)), (calibration.save, write_register(0x00, 0))):
        (sent,) = value_of(step(TARGET), {})[0]
        assert sent.sends == write.sends


@pytest.mark.parametrize(
    ("percent", "verdict"),
    [(0, Verdict(False, "state 1, 0 %", 0.0)), (40, Verdict(False, "state 1, 40 %", 0.4)),
     (100, Verdict(True, "state 1, 100 %", 1.0)), (65535, Verdict(True, "state 1, 65535 %", 1.0))],
)  # fmt: skip
def test_verdict_by_progress(percent: int, verdict: Verdict) -> None:
    ask = CALIBRATIONS["magnetometer"].verdict
    assert ask is not None
    made, found = value_of(ask(TARGET), {0x0A: 1, 0x0B: percent})
    assert made == [read_registers(0x0A, 1), read_registers(0x0B, 1)]
    assert found == verdict


@pytest.mark.parametrize(("mode", "words"), [(0, "`imud settings NAME --set mode=9-axis`"), (1, "")])
def test_nine_axes_are_needed(mode: int, words: str) -> None:
    calibration = CALIBRATIONS["magnetometer"]
    assert calibration.unready is not None
    assert str(value_of(calibration.unready(TARGET), {0x06: mode})[1]).endswith(words)
    assert value_of(calibration.begin(TARGET), {}) == ([], None)
