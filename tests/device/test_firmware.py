"""Firmware updates through a device of imud in virtual time, on a UART and on CANopen."""

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest

from imud.contracts.firmware import FirmwareImage, FirmwareResult
from imud.contracts.status import DeviceState
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.model.errors import BadArgument, CommandError
from imud.model.event import EventKind
from imud.sim.hipnuc.boot_loader import APPLICATION, make_image
from imud.sim.hipnuc.canopen import HipnucCanopenHardware, HipnucCanopenModule
from tests.device.test_can_transport import BusInProcess
from tests.support.event_loops import VirtualClock
from tests.support.stories import played
from tests.support.wired_device import LinkedDevice

LINKS: list[dict[str, Any]] = [{}, {"baud": "auto"}, {"baud": "auto", "driver": "auto"}]
NEW = 170
IMAGE = FirmwareImage(APPLICATION, make_image("HI14R3", NEW, 6000))


def start(device: LinkedDevice, image: FirmwareImage = IMAGE, product: str = "", version: str = "") -> Any:
    return asyncio.ensure_future(device.device.firmware.update(image, product, version))


async def result_of(device: LinkedDevice, task: "asyncio.Future[FirmwareResult]") -> FirmwareResult:
    await device.until(task.done, "the end of the update", 200)
    return task.result()


def phases(device: LinkedDevice) -> list[object]:
    return [event.detail["phase"] for event in device.events if event.kind is EventKind.FIRMWARE]


async def running(device: LinkedDevice) -> None:
    await device.until(lambda: len(device.samples) > 20 and device.rig.is_in(DeviceState.RUNNING), limit_s=60)


@pytest.mark.parametrize("link", LINKS, ids=str)
@played(lambda link: LinkedDevice(**link))
async def test_update_writes_the_image_and_verifies_the_version(device: LinkedDevice, link: dict[str, Any]) -> None:
    await running(device)
    replies = device.rig.ledger.frames_in_replies
    updating = start(device, version="1.7.0")
    await device.until(lambda: "write" in phases(device))
    assert device.rig.is_in(DeviceState.SILENT)
    assert device.problem == "a firmware update is running"
    waiting = asyncio.ensure_future(device.device.act("save", {}))
    done = await result_of(device, updating)
    assert (done.product, done.before, done.after) == ("HI14R3", "1.5.6", "1.7.0")
    assert (done.verified, done.evidence) == (True, "expected version 1.7.0, got 1.7.0")
    assert device.module.hardware.firmware == NEW
    assert list(dict.fromkeys(phases(device))) == [
        "enter the boot loader", "erase", "write", "start the new firmware", "end",
    ]  # fmt: skip
    assert device.rig.ledger.frames_in_replies - replies > 6000 // 256
    count = len(device.samples)
    await device.until(lambda: len(device.samples) > count + 20)
    assert device.rig.is_in(DeviceState.RUNNING)
    assert device.device.status().identity["firmware"] == "1.7.0"
    await device.until(waiting.done)
    waiting.exception()


@played(LinkedDevice)
async def test_other_work_is_refused_during_an_update(device: LinkedDevice) -> None:
    await running(device)
    device.link.step_s = 1.0  # every reply takes a second
    updating = start(device)
    await device.until(lambda: phases(device))
    for other in (device.device.act("save", {}), device.device.firmware.update(IMAGE, "", "")):
        task = asyncio.ensure_future(other)
        await device.until(task.done)
        with pytest.raises(CommandError, match=r"the firmware update is running, started .* ago by imud; try again"):
            task.result()
    with pytest.raises(CommandError, match="the firmware update is running"):
        device.device.firmware.refuse_other_work()
    device.link.step_s = 0.002
    await device.until(updating.done, limit_s=200)
    updating.exception()


@pytest.mark.parametrize("link", LINKS, ids=str)
@played(lambda link: LinkedDevice(**link))
async def test_update_after_power_loss_continues_from_the_boot_loader(
    device: LinkedDevice, link: dict[str, Any]
) -> None:
    await running(device)
    updating = start(device)
    await device.until(lambda: "write" in phases(device))
    device.link.module_is_on = False
    with pytest.raises(CommandError, match=r"The update is not complete: .* run `imud firmware bow FILE` again"):
        await result_of(device, updating)
    device.link.module_is_on = True
    device.module.reboot(device.clock.now_ns())
    await device.wait(30)  # no search disturbs the boot loader
    assert "the device is in its boot loader after an interrupted firmware update" in device.problem
    assert device.module.memory.application("HI14R3") is None
    done = await result_of(device, start(device))
    assert (done.after, done.verified) == ("1.7.0", True)
    await running(device)
    assert device.problem == ""


@pytest.mark.parametrize("link", LINKS, ids=str)
@played(lambda link: LinkedDevice(**link))
async def test_update_after_loss_of_the_cable_continues_from_the_boot_loader(
    device: LinkedDevice, link: dict[str, Any]
) -> None:
    await running(device)
    updating = start(device)
    await device.until(lambda: "write" in phases(device))
    device.link.disappear()
    with pytest.raises(
        CommandError, match=r"bow: .*\. The update is not complete: .* run `imud firmware bow FILE` again"
    ):
        await result_of(device, updating)
    assert device.rig.is_in(DeviceState.MISSING)
    with pytest.raises(CommandError, match="bow is missing: "):
        await result_of(device, start(device))
    device.link.appear()
    await device.wait(3)
    assert (await result_of(device, start(device))).after == "1.7.0"
    await running(device)


@played(lambda: LinkedDevice(baud="auto", driver="auto"))
async def test_update_of_a_replugged_device_in_its_boot_loader(device: LinkedDevice) -> None:
    """The search for a silent device does not prevent the update. imud knows the driver and the rate."""
    await running(device)
    device.module.memory.erase()
    device.module.reboot(device.clock.now_ns())
    device.link.disappear()
    await device.until(lambda: device.rig.is_in(DeviceState.MISSING))
    device.link.appear()
    await device.wait(10)
    assert device.rig.is_in(DeviceState.SEARCHING)
    done = await result_of(device, start(device, version="1.7.0"))
    assert done.verified, done
    await running(device)


@pytest.mark.parametrize(
    ("image", "product", "words"),
    [
        (FirmwareImage(APPLICATION, make_image("CH020", NEW)), "", "expected an image for HI14R3, got .* names CH020"),
        (FirmwareImage(APPLICATION, bytes(4096)), "", "add --product HI14R3"),
        (FirmwareImage(0x0900_0000, bytes(4096)), "HI14R3", "expected addresses in the flash memory"),
    ],
)
@played(lambda image, product, words: LinkedDevice())
async def test_wrong_image_changes_nothing(
    device: LinkedDevice, image: FirmwareImage, product: str, words: str
) -> None:
    await running(device)
    with pytest.raises(BadArgument, match=words):
        await result_of(device, start(device, image, product))
    assert device.module.memory.erased == 0
    count = len(device.samples)
    await device.until(lambda: len(device.samples) > count + 20)
    assert device.problem == ""


@played(LinkedDevice)
async def test_version_that_does_not_change_is_not_verified(device: LinkedDevice) -> None:
    await running(device)
    same = FirmwareImage(APPLICATION, make_image("HI14R3", 156))
    done = await result_of(device, start(device, same))
    assert not done.verified
    assert "reports version 1.5.6 before and after; state the version of the file with --version" in done.evidence
    done = await result_of(device, start(device, version="1.7.1"))
    assert (done.verified, done.evidence) == (False, "expected version 1.7.1, got 1.7.0")
    other = FirmwareImage(APPLICATION, make_image("CH020", NEW) + b" HI14R3")
    done = await result_of(device, start(device, other))  # the device does not start it
    assert (done.verified, done.after) == (False, "")
    assert "the device reported no version within 20 s" in done.evidence
    assert (await result_of(device, start(device, product="HI14R3"))).after == "1.7.0"


@pytest.mark.parametrize("driver", ["hipnuc-canopen", "auto"])
def test_update_on_canopen(driver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.device.can_search.LISTEN_NS", 100_000_000)
    clock = VirtualClock()
    module = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(boot_ms=200))
    bus = BusInProcess(clock, driver, HipnucCanopenOptions() if driver != "auto" else None, module)
    image = FirmwareImage(APPLICATION, make_image("HI14", NEW, 200))

    def update() -> Coroutine[Any, Any, FirmwareResult]:
        return bus.rig.device.firmware.update(image, "", "0x000000AA")

    async def story() -> None:
        await bus.until(lambda: bus.rig.device.status().identity.get("product"), "the identity")
        updating = asyncio.create_task(update())
        written = {"phase": "write"}
        await bus.until(lambda: any(one.detail.items() >= written.items() for one in bus.rig.events), "the write")
        module.reboot(clock.now_ns())
        module.memory.erase()
        await bus.until(updating.done, "its end")
        done = updating.result()  # a node that restarts aborts a segment, and imud sends the image again
        assert (done.verified, done.after) == (True, "0x000000AA")
        module.memory.erase()
        module.reboot(clock.now_ns())
        end_ns = clock.now_ns() + 30_000_000_000
        await bus.until(lambda: clock.now_ns() > end_ns, "a search")
        done = await bus.done(update())
        assert (done.verified, bytes(module.memory.data)) == (True, image.data)
        count = len(bus.rig.samples)
        await bus.until(lambda: len(bus.rig.samples) > count + 20, "samples")

    bus.play(story)
    assert bus.rig.ledger.closes()
