"""Firmware updates that a boot loader refuses, that end early, and that change the baud rate, in virtual time."""

import asyncio
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from imud.contracts.condition import ReasonCode
from imud.contracts.status import DeviceState
from imud.device.firmware import normal_version
from imud.device.pending_updates import FILE_NAME
from imud.model.errors import CommandError
from imud.sim.hipnuc.boot_loader import LoaderFault
from tests.device.test_firmware import phases, result_of, running, start
from tests.support.simulated_modules import HIPNUC_STILL
from tests.support.stories import played
from tests.support.wired_device import LinkedDevice

LOADER = "boot loader"


def reasons(device: LinkedDevice) -> list[tuple[ReasonCode, str]]:
    condition = device.device.status().condition
    assert condition is not None
    return [(reason.code, reason.message) for reason in condition.reasons]


@played(LinkedDevice)
async def test_refused_erase_changes_nothing_and_says_so(device: LinkedDevice) -> None:
    await running(device)
    device.module.memory.fault = LoaderFault.REFUSES_ERASE
    with pytest.raises(
        CommandError,
        match=r"got 10200; imud changed nothing, and the device runs version 1\.5\.6 again; compare",
    ):
        await result_of(device, start(device))
    assert device.module.memory.erased == 0
    await running(device)
    assert device.problem == ""
    device.module.memory.fault = LoaderFault.NONE
    assert (await result_of(device, start(device))).after == "1.7.0"


@played(LinkedDevice)
async def test_refused_erase_without_application_is_a_boot_loader(device: LinkedDevice) -> None:
    """The device replies to no query after the refusal: imud does not state that nothing changed."""
    await running(device)
    device.module.memory.erase()
    device.module.memory.fault = LoaderFault.REFUSES_ERASE
    with pytest.raises(CommandError, match="The update is not complete: the device stays in its boot loader"):
        await result_of(device, start(device))
    assert LOADER in device.problem


@pytest.mark.parametrize(
    ("fault", "words"),
    [(LoaderFault.REFUSES_DATA, "end of the data: expected status 0, got 10203"),
     (LoaderFault.REFUSES_START, "reset: expected status 0, got 10101")],
)  # fmt: skip
@played(lambda fault, words: LinkedDevice())
async def test_refused_data_or_start_is_not_verified(device: LinkedDevice, fault: LoaderFault, words: str) -> None:
    await running(device)
    device.module.memory.fault = fault
    with pytest.raises(CommandError, match=words):
        await result_of(device, start(device, version="1.7.0"))
    assert LOADER in device.problem


@pytest.mark.parametrize("cut", [True, False], ids=["power lost", "cancelled"])
@played(lambda cut: LinkedDevice())
async def test_boot_loader_stays_the_reason(device: LinkedDevice, cut: bool) -> None:
    await running(device)
    updating = start(device)
    await device.until(lambda: "write" in phases(device))
    if cut:
        device.link.module_is_on = False
        with pytest.raises(CommandError, match="The update is not complete"):
            await result_of(device, updating)
        device.link.module_is_on = True
        device.module.reboot(device.clock.now_ns())
    else:
        updating.cancel()
        await asyncio.gather(updating, return_exceptions=True)
    for seconds in (2, 1, 1, 5, 30, 60):
        await device.wait(seconds)
        assert device.rig.state is not DeviceState.RUNNING
        ((code, message),) = reasons(device)
        assert code is ReasonCode.NO_SAMPLES
        assert LOADER in message
        assert "run `imud firmware bow FILE` again" in message
    assert (await result_of(device, start(device))).after == "1.7.0"
    await running(device)
    assert device.problem == ""


@played(lambda: LinkedDevice(hardware=replace(HIPNUC_STILL, baud_after_update=921600)))
async def test_new_firmware_with_another_baud_rate(device: LinkedDevice) -> None:
    await running(device)
    result = await result_of(device, start(device, version="1.7.0"))
    assert (result.verified, result.after) == (True, "1.7.0")
    assert "change `baud: 115200` in the configuration to 921600 or auto" in result.evidence
    await running(device)
    assert device.problem == ""


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("1.7.0", "0x000000AA", True), ("170", "1.7.0", True), ("v1.7.0", "0xaa", True), ("170", "0x000000AA", True),
        ("1.7.1", "0x000000AA", False), ("1.10.0", "200", False), ("1.10.0", "1.10.0", True), ("beta", "BETA ", True),
        ("0x", "0x", True), ("0x", "0", False),
    ],
)  # fmt: skip
def test_forms_of_one_version(one: str, other: str, is_same: bool) -> None:
    assert (normal_version(one) == normal_version(other)) is is_same


@pytest.mark.parametrize("version", ["170", "v1.7.0", "0x000000AA"])
@played(lambda version: LinkedDevice())
async def test_version_in_another_form_is_verified(device: LinkedDevice, version: str) -> None:
    await running(device)
    assert (await result_of(device, start(device, version=version))).verified


def stored(folder: Path) -> dict[str, int]:
    file = folder / FILE_NAME
    return msgspec.json.decode(file.read_bytes(), type=dict[str, int]) if file.exists() else {}


def test_restart_of_imud_names_interrupted_update(tmp_path: Path) -> None:
    first = LinkedDevice(state_dir=tmp_path)

    async def interrupt() -> None:
        await running(first)
        updating = start(first)
        await first.until(lambda: "write" in phases(first))
        assert not first.device.firmware.is_interruptible
        updating.cancel()
        await asyncio.gather(updating, return_exceptions=True)
        assert first.device.firmware.is_interruptible

    first.play(interrupt)
    first.rigs.factory.close()
    assert list(stored(tmp_path)) == ["bow"]

    second = LinkedDevice(state_dir=tmp_path)
    second.module.memory.erase()
    second.module.reboot(second.clock.now_ns())

    async def repeat() -> None:
        await second.wait(10)
        ((_, message),) = reasons(second)
        assert "did not end before imud stopped" in message
        assert "run `imud firmware bow FILE` again" in message
        done = await result_of(second, start(second, product="HI14R3"))
        assert done.after == "1.7.0"
        await running(second)

    second.play(repeat)
    second.rigs.factory.close()
    assert stored(tmp_path) == {}


def test_device_that_sends_samples_has_no_interrupted_update(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).write_bytes(b'{"bow": 1795000000}')
    device = LinkedDevice(state_dir=tmp_path)

    async def run() -> None:
        await running(device)
        assert device.problem == ""

    device.play(run)
    device.rigs.factory.close()
    assert stored(tmp_path) == {}
