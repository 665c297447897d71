"""Modules on an RS-485 line in the daemon's own path, from the port to samples."""

import asyncio
from collections.abc import Coroutine
from contextlib import suppress
from dataclasses import replace
from math import dist
from pathlib import Path
from typing import Any

import pytest

from imud.config import DeviceConfig
from imud.contracts.action import Action, Target
from imud.contracts.polling import TransferScript
from imud.contracts.status import DeviceState
from imud.devices.hipnuc.modbus import driver, session
from imud.devices.hipnuc.modbus.registers import BY_NAME
from imud.errors import BadArgument, TransferError
from imud.event import EventKind
from imud.sim.hipnuc.modbus import SLAVE_VARIANTS
from imud.units import NS_PER_MS
from tests.support.device_rig import device_config, running
from tests.support.pty_port import BAUD, serial_of, slave, wired


def run(body: Coroutine[Any, Any, None]) -> None:
    asyncio.run(body)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search takes less long than in life."""
    monkeypatch.setattr("imud.runtime.polled.transport.RETRY_S", 0.02)


def on(path: Path, address: int | str, **more: Any) -> DeviceConfig:
    link = {"line": str(path), "baud": BAUD, "address": address, "reply_ms": 100, **more}
    return device_config(f"imu{address}", "hipnuc-modbus", "rs485", link)


def test_several_modules_take_turns(tmp_path: Path) -> None:
    """Old and new firmware side by side; every one is the module it should be, and turns are fair."""

    async def body() -> None:
        modules = [slave(1), slave(2, firmware=152), slave(3, inclinometer="dual")]
        with wired(tmp_path, *modules) as (path, line):
            async with running(*(on(path, address) for address in (1, 2, 3))) as rigs:
                for rig in rigs:
                    await rig.until_samples(30)
                for rig, module in zip(rigs, modules, strict=True):
                    status = rig.device.status()
                    assert status.identity["serial_number"] == module.serial.hex().upper()
                    assert status.settings["id"] == str(module.settings.slave)
                    assert status.polling is not None
                    assert status.polling.missed == status.polling.late == 0
                    assert status.expected_rate_hz == 0
                counts = [rig.device.status().polling.polls for rig in rigs]  # type: ignore[union-attr]  # seen above
                await rigs[0].until_samples(30)
                more = [rig.device.status().polling.polls - n for rig, n in zip(rigs, counts, strict=True)]  # type: ignore[union-attr]  # seen above
                assert max(more) - min(more) <= 2
                for rig, module in zip(rigs, modules, strict=True):
                    for sample in rig.samples[-10:]:
                        assert sample.accel_m_s2 is not None
                        instants = range(sample.t_ns - line.epoch_ns, sample.t_rx_ns - line.epoch_ns, 500_000)
                        truths = [module.motion.at(instant / 1e9).accel_m_s2 for instant in instants]
                        assert min(dist(sample.accel_m_s2, truth) for truth in truths) < 0.02
                assert rigs[1].device.ledger.frames_in_replies >= 1  # the exception that told of old firmware
                assert [rig.samples[-1].incli_rad is None for rig in rigs] == [True, True, False]
                assert [rig.kinds.count(EventKind.UP) for rig in rigs] == [1, 1, 1]

    run(body())


def test_a_dead_module_does_not_stall_the_others(tmp_path: Path) -> None:
    async def body() -> None:
        gone = slave(2)
        with wired(tmp_path, slave(1), gone, slave(3)) as (path, _):
            async with running(*(on(path, address, reply_ms=20) for address in (1, 2, 3))) as rigs:
                for rig in rigs:
                    await rig.until_samples(10)
                gone.dead = True
                await rigs[1].until(lambda: rigs[1].state is DeviceState.SEARCHING, "given up")
                assert rigs[1].device.status().problem.startswith("no reply from address 2")
                assert rigs[1].device.ledger.lost_gap_device == 3
                line = rigs[0].device.status().serial_line  # of all its devices, also those that answer
                assert line is not None
                assert line.timeouts >= 3
                assert line.late_bytes == line.strange_bytes == line.echoes == 0
                await rigs[0].until_samples(30)
                await rigs[2].until_samples(30)
                assert rigs[1].state is DeviceState.SEARCHING
                gone.dead = False
                await rigs[1].until_samples(10)
                assert rigs[1].kinds.count(EventKind.DOWN) == 1
                assert [rig.kinds.count(EventKind.DOWN) for rig in rigs] == [0, 1, 0]

    run(body())


def test_noise_costs_one_sample_and_no_more(tmp_path: Path) -> None:
    async def body() -> None:
        module = slave(1)
        with wired(tmp_path, module) as (path, _):
            async with running(on(path, 1)) as (rig,):
                await rig.until_samples(10)
                module.bad_crc = 1
                await rig.until(lambda: rig.device.ledger.lost_crc == 1, "damage counted")
                module.mute = 1
                await rig.until(lambda: rig.device.ledger.lost_gap_device == 1, "silence counted")
                await rig.until_samples(10)
                assert rig.kinds.count(EventKind.DOWN) == 0

    run(body())


def test_module_is_told_something_while_it_is_read(tmp_path: Path) -> None:
    async def body() -> None:
        module, other = slave(1), slave(2)
        with wired(tmp_path, module, other) as (path, _):
            async with running(on(path, 1), on(path, 2)) as rigs:
                for rig in rigs:
                    await rig.until_samples(5)
                assert rigs[0].device.status().status_words == ("time not UTC",)  # 0x0800 of the simulated module
                await rigs[0].device.act("attitude_mode", {"axes": 9})
                assert rigs[0].device.status().settings["heading_mode"] == "nine axes"  # read again by itself
                assert await rigs[0].device.act("read", {"register": "HEADING_MODE"}) == (1,)
                assert (module.settings.heading_mode, other.settings.heading_mode) == (1, 0)
                await rigs[0].until_samples(5)
                assert rigs[0].kinds.count(EventKind.DOWN) == 0

    run(body())


def test_module_that_is_given_another_address_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def moving(_target: Target, *, address: int) -> TransferScript[None]:
        with suppress(TransferError):
            yield replace(next(session.set_id(address)), then_at=address)
        yield next(session.read(BY_NAME["MD_ID"]))

    monkeypatch.setattr(driver, "DRIVER", replace(driver.DRIVER, actions={"move": Action("move it", moving)}))

    async def body() -> None:
        module, other = slave(1), slave(3)
        with wired(tmp_path, module, other) as (path, _):
            async with running(on(path, 1), on(path, 3)) as rigs:
                for rig in rigs:
                    await rig.until_samples(5)
                await rigs[0].device.act("move", {"address": 2})
                assert module.settings.slave == 2
                assert rigs[0].device.status().link == f"{path}, address 2"
                await rigs[0].until_samples(5)
                assert EventKind.DOWN not in rigs[0].kinds
                module.dead = True  # and found again at the new address, although the configuration has the old one
                await rigs[0].until(lambda: rigs[0].state is DeviceState.SEARCHING, "given up")
                module.dead = False
                await rigs[0].until_samples(5)
                module.serial = serial_of(9)
                other.dead = True
                await rigs[0].device.act("move", {"address": 3})
                assert "another device of this configuration has" in " ".join(one.message for one in rigs[0].events)

    run(body())


def test_module_at_an_unknown_address_is_found(tmp_path: Path) -> None:
    async def body() -> None:
        with wired(tmp_path, slave(4)) as (path, _):
            async with running(on(path, "auto", reply_ms=20)) as (rig,):
                await rig.until_samples(5)
                assert rig.device.status().link == f"{path}, address 4"

    run(body())


def test_module_exchanged_for_another_at_the_same_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.devices.hipnuc.modbus.codec.CHECK_NS", 20 * NS_PER_MS)

    async def body() -> None:
        module = slave(1)
        with wired(tmp_path, module) as (path, _):
            async with running(on(path, 1)) as (rig,):
                await rig.until_samples(10)
                await rig.until(lambda: rig.device.ledger.frames_in_replies > 1, "serial number read")
                module.serial = serial_of(77)
                await rig.until(lambda: EventKind.CONFIGURATION in rig.kinds, "told of another module")
                await rig.until_samples(5)
                assert rig.device.status().identity["serial_number"] == serial_of(77).hex().upper()

    run(body())


def test_fixed_rate_on_a_line(tmp_path: Path) -> None:
    async def body() -> None:
        with wired(tmp_path, slave(1)) as (path, _):
            async with running(on(path, 1, rate_hz=20)) as (rig,):
                await rig.until_samples(5)
                assert rig.device.status().expected_rate_hz == 20

    run(body())


@pytest.mark.parametrize("variant", SLAVE_VARIANTS)
def test_modules_of_every_kind_are_read(tmp_path: Path, variant: str) -> None:
    async def body() -> None:
        module = slave(1, variant=SLAVE_VARIANTS[variant])
        with wired(tmp_path, module) as (path, _):
            async with running(on(path, 1)) as (rig,):
                await rig.until_samples(10)
                assert rig.kinds.count(EventKind.UP) == 1
                lost = rig.ledger.lost_gap_device
                assert lost == (2 if module.variant.long_block == "silent" else 0)

    run(body())


@pytest.mark.parametrize("variant", ["manual", "address after restart", "confirms from the new address"])
def test_a_module_is_followed_to_another_address_and_back(tmp_path: Path, variant: str) -> None:
    async def body() -> None:
        module, other = slave(1, variant=SLAVE_VARIANTS[variant]), slave(2)
        with wired(tmp_path, module, other) as (path, _):
            async with running(on(path, 1), on(path, 2)) as (rig, beside):
                await rig.until_samples(5)
                await beside.until_samples(5)
                with pytest.raises(BadArgument, match="address 2 is taken"):
                    await rig.device.act("address", {"address": 2})
                await rig.device.act("address", {"address": 9})
                await rig.device.act("save", {})
                await rig.device.act("restart", {})
                await rig.until_samples(10)
                assert rig.device.status().link == f"{path}, address 9"
                assert module.address == module.flash.slave == 9
                assert "change address 1 in the configuration" in " ".join(event.message for event in rig.events)
                await rig.device.act("address", {"address": 1})
                await rig.device.act("restart", {})  # not saved: it is at 9 again
                await rig.until_samples(10)
                assert rig.device.status().link == f"{path}, address 9"
                assert beside.kinds.count(EventKind.DOWN) == 0

    run(body())


@pytest.mark.parametrize("variant", SLAVE_VARIANTS)
def test_modules_of_every_kind_are_made_as_declared(tmp_path: Path, variant: str) -> None:
    async def body() -> None:
        module, other = slave(1, variant=SLAVE_VARIANTS[variant]), slave(2)
        with wired(tmp_path, module, other) as (path, _):
            async with running(on(path, 1), on(path, 2)) as (rig, beside):
                await rig.until_samples(5)
                taken = await rig.device.settings_apply({"address": 2}, save=True)
                assert "address 2 is taken" in taken.problem
                applied = await rig.device.settings_apply(
                    {"mode": "9-axis", "mounting": "x_up", "address": 9}, save=True
                )
                assert applied.problem == "", applied
                assert {step.name: str(step.outcome) for step in applied.steps}["mounting"] == "written, not verified"
                await rig.until_samples(5)
                assert rig.device.status().link == f"{path}, address 9"
                assert (module.flash.heading_mode, module.flash.slave, module.address) == (1, 9, 9)
                assert (module.writes_to_flash, other.writes_to_flash) == (1, 0)
                assert beside.kinds.count(EventKind.DOWN) == 0

    run(body())
