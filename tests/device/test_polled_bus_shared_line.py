"""Modules on an RS-485 bus, in virtual time, and once from the port to samples."""

from collections.abc import AsyncIterator, Coroutine, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from math import dist
from pathlib import Path
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.command import Target, Verb
from imud.contracts.link import LinkType
from imud.contracts.script import Transfer, TransferScript
from imud.contracts.status import DeviceState, KernelCounters
from imud.drivers.hipnuc.modbus import commands as session
from imud.drivers.hipnuc.modbus import driver
from imud.drivers.hipnuc.modbus.registers import BY_NAME
from imud.links.rs485 import LineCounters, Rs485Link, Rs485Options
from imud.model.errors import CommandError, TransferError
from imud.model.event import EventKind
from imud.model.units import NS_PER_MS
from imud.sim.hipnuc.modbus import SLAVE_VARIANTS, Slave
from tests.support.device_rig import DeviceRig, DeviceRigs, device_config, running
from tests.support.event_loops import LoopWorker, VirtualClock, in_loop, run_virtually
from tests.support.old_spellings import act
from tests.support.pty_port import BAUD, BEGIN_NS, LINE_BAUD, ModbusBench, modbus_slave, serial_of, slave, wired
from tests.support.stories import in_bench


class VirtualLine:
    """An `Rs485Line` without a port. Transfers take virtual time."""

    def __init__(self, clock: VirtualClock, *slaves: Slave) -> None:
        self.bench = ModbusBench(*slaves)
        self.counters = LineCounters()
        self.users = 0
        self._clock = clock

    @property
    def counted(self) -> "VirtualLine":
        return self

    def read(self) -> KernelCounters:
        return KernelCounters()

    def share(self, *_where: object) -> "VirtualLine":
        self.users += 1
        return self

    def release(self, _line: object) -> None:
        self.users -= 1

    def transfer(self, target: int, request: bytes, reply_bytes: int, reply_ns: int) -> bytes:
        bench, begin_ns = self.bench, self._clock.now_ns()
        bench.now_ns = begin_ns
        try:
            return bench.transfer(Transfer((request,), reply_bytes, at=target, reply_ms=reply_ns // NS_PER_MS))
        except TransferError as error:
            self.counters.timeouts += 1
            raise TransferError(error.trouble, f"no reply from address {target} on the line") from None
        finally:
            self._clock.advance(bench.now_ns - begin_ns)


class LineBench:
    """Modules on an RS-485 bus and their devices, in virtual time."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = VirtualClock(BEGIN_NS)
        self.path = folder / "line"
        self.path.touch()
        self._patch = monkeypatch

    @asynccontextmanager
    async def running(
        self, *modules: Slave, at: Sequence[int | str] = (), **link: Any
    ) -> AsyncIterator[list[DeviceRig]]:
        """Run a device for each module, or for each address of `at`."""
        self.line = VirtualLine(self.clock, *modules)
        ports: Any = self.line
        row = LinkType("rs485", Rs485Options, make_polled=lambda settings: Rs485Link(settings, ports=ports))
        self._patch.setattr("imud.links.rs485.LINK", row)
        configs = [on(self.path, address, **link) for address in at or [one.settings.slave for one in modules]]
        async with running(*configs, rigs=DeviceRigs(self.clock.host, start_worker=LoopWorker)) as rigs:
            yield rigs
        assert self.line.users == 0

    def run(self, body: Coroutine[Any, Any, None]) -> None:
        run_virtually(self.clock, body)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LineBench:
    return LineBench(tmp_path, monkeypatch)


def on(path: Path, address: int | str, **more: Any) -> DeviceConfig:
    link = {"line": str(path), "baud": LINE_BAUD, "address": address, **more}
    return device_config(f"imu{address}", "hipnuc-modbus", "rs485", link)


def told(rig: DeviceRig) -> str:
    return " ".join(event.message for event in rig.events)


@in_bench
async def test_several_modules_alternate(bench: LineBench) -> None:
    """Old and new firmware on one bus: each device is correct, and turns are fair."""
    modules = [modbus_slave(1), modbus_slave(2, firmware=152), modbus_slave(3, inclinometer="dual")]
    async with bench.running(*modules) as rigs:
        for rig in rigs:
            await rig.until_samples(30)
        for rig, module in zip(rigs, modules, strict=True):
            status = rig.device.status()
            assert status.identity["serial_number"] == module.serial.hex().upper()
            assert status.settings["id"] == str(module.settings.slave)
            assert rig.polling.missed == rig.polling.late == 0
            assert status.expected_rate_hz == 0
        counts = [rig.polling.polls for rig in rigs]
        await rigs[0].until_samples(30)
        more = [rig.polling.polls - n for rig, n in zip(rigs, counts, strict=True)]
        assert max(more) - min(more) <= 1
        for rig, module in zip(rigs, modules, strict=True):
            for sample in rig.samples[-10:]:
                assert sample.accel_m_s2 is not None
                instants = range(sample.t_ns - BEGIN_NS, sample.t_rx_ns - BEGIN_NS, 500_000)
                truths = [module.motion.at(instant / 1e9).accel_m_s2 for instant in instants]
                assert min(dist(sample.accel_m_s2, truth) for truth in truths) < 0.02
        assert rigs[1].device.ledger.frames_in_replies >= 1  # the exception of old firmware
        assert [rig.samples[-1].incli_rad is None for rig in rigs] == [True, True, False]
        assert [rig.kinds.count(EventKind.UP) for rig in rigs] == [1, 1, 1]


@in_bench
async def test_a_dead_module_does_not_delay_other_modules(bench: LineBench) -> None:
    gone = modbus_slave(2)
    async with bench.running(modbus_slave(1), gone, modbus_slave(3)) as rigs:
        for rig in rigs:
            await rig.until_samples(10)
        gone.dead = True
        await rigs[1].until(lambda: rigs[1].is_in(DeviceState.SEARCHING), "given up")
        assert rigs[1].device.status().problem.startswith("no reply from address 2")
        assert rigs[1].device.ledger.lost_gap_device == 3
        line = rigs[0].device.status().serial_line  # of all devices, also of devices that reply
        assert line is not None
        assert line.timeouts >= 3
        await rigs[0].until_samples(30)
        await rigs[2].until_samples(30)
        assert rigs[1].is_in(DeviceState.SEARCHING)
        gone.dead = False
        await rigs[1].until_samples(10)
        assert [rig.kinds.count(EventKind.DOWN) for rig in rigs] == [0, 1, 0]


@in_bench
async def test_noise_loses_one_sample(bench: LineBench) -> None:
    module = modbus_slave(1)
    async with bench.running(module) as (rig,):
        await rig.until_samples(10)
        module.bad_crc = 1
        await rig.until(lambda: rig.device.ledger.lost_crc == 1, "damage counted")
        for silences in (1, 2):
            module.mute = 1
            await rig.until(
                partial(lambda count: rig.device.ledger.lost_gap_device == count, silences), "silence counted"
            )
            assert rig.polling.failed == silences
        await rig.until_samples(10)
        assert rig.kinds.count(EventKind.DOWN) == 0


@in_bench
async def test_a_command_runs_between_reads(bench: LineBench) -> None:
    module, other = modbus_slave(1), modbus_slave(2)
    async with bench.running(module, other) as rigs:
        for rig in rigs:
            await rig.until_samples(5)
        assert rigs[0].device.status().status_words == ("time not UTC",)  # register 0x0800 of the simulated module
        await act(rigs[0].device, "attitude_mode", {"axes": 9})
        assert rigs[0].device.status().settings["heading_mode"] == "nine axes"  # imud reads again without a request
        assert await rigs[0].device.act("read", {"register": "HEADING_MODE"}) == (1,)
        assert (module.settings.heading_mode, other.settings.heading_mode) == (1, 0)
        await rigs[0].until_samples(5)
        assert rigs[0].kinds.count(EventKind.DOWN) == 0


@in_bench
async def test_a_module_with_a_new_address_is_followed(bench: LineBench, monkeypatch: pytest.MonkeyPatch) -> None:
    def moving(_target: Target, *, address: int) -> TransferScript[None]:
        with suppress(TransferError):
            yield replace(next(session.set_id(address)), then_at=address)
        yield next(session.read(BY_NAME["MD_ID"]))

    monkeypatch.setattr(driver, "DRIVER", replace(driver.DRIVER, verbs={"move": Verb("move it", moving)}))
    module, other = modbus_slave(1), modbus_slave(3)
    async with bench.running(module, other) as rigs:
        for rig in rigs:
            await rig.until_samples(5)
        await rigs[0].device.act("move", {"address": 2})
        assert (module.settings.slave, rigs[0].device.status().link) == (2, f"{bench.path}, address 2")
        await rigs[0].until_samples(5)
        assert EventKind.DOWN not in rigs[0].kinds
        module.dead = True  # found at the new address, although the configuration contains the old address
        await rigs[0].until(lambda: rigs[0].is_in(DeviceState.SEARCHING), "given up")
        module.dead = False
        await rigs[0].until_samples(5)
        module.serial = serial_of(9)
        other.dead = True
        await rigs[0].device.act("move", {"address": 3})
        assert "another device of this configuration has" in told(rigs[0])


@in_bench
async def test_a_replaced_module_at_the_same_address_is_reported(
    bench: LineBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imud.drivers.hipnuc.modbus.codec.CHECK_NS", 20 * NS_PER_MS)
    module = modbus_slave(1)
    async with bench.running(module) as (rig,):
        await rig.until_samples(10)
        await rig.until(lambda: rig.device.ledger.frames_in_replies > 1, "serial number read")
        module.serial = serial_of(77)
        await rig.until(lambda: EventKind.CONFIGURATION in rig.kinds, "told of another module")
        await rig.until_samples(5)
        assert rig.device.status().identity["serial_number"] == serial_of(77).hex().upper()


@in_bench
async def test_unknown_address_and_fixed_rate(bench: LineBench) -> None:
    async with bench.running(modbus_slave(4), at=["auto"], rate_hz=20) as (rig,):
        await rig.until_samples(5)
        status = rig.device.status()
        assert (status.link, status.expected_rate_hz) == (f"{bench.path}, address 4", 20)
        steps = [after.t_ns - before.t_ns for before, after in pairwise(rig.samples)]
        assert steps == pytest.approx([50 * NS_PER_MS] * len(steps), abs=NS_PER_MS)
        await act(rig.device, "address", {"address": 9})
        assert rig.device.status().link == f"{bench.path}, address 9"
        assert "in the configuration" not in told(rig)


@pytest.mark.parametrize("variant", ["manual", "address after restart", "confirms from the new address"])
@in_bench
async def test_a_module_is_followed_to_another_address_and_back(bench: LineBench, variant: str) -> None:
    module, other = modbus_slave(1, variant=SLAVE_VARIANTS[variant]), modbus_slave(2)
    async with bench.running(module, other) as (rig, beside):
        await rig.until_samples(5)
        await beside.until_samples(5)
        with pytest.raises(CommandError, match="address 2 is in use"):
            await act(rig.device, "address", {"address": 2})
        await act(rig.device, "address", {"address": 9})
        await rig.device.act("save", {})
        await rig.device.act("restart", {})
        await rig.until_samples(10)
        assert rig.device.status().link == f"{bench.path}, address 9"
        assert module.address == module.flash.slave == 9
        assert "change address 1 in the configuration" in told(rig)
        await act(rig.device, "address", {"address": 1})
        await rig.device.act("restart", {})  # not saved: address 9 after the restart
        await rig.until_samples(10)
        assert rig.device.status().link == f"{bench.path}, address 9"
        assert beside.kinds.count(EventKind.DOWN) == 0


@pytest.mark.parametrize("variant", SLAVE_VARIANTS)
@in_bench
async def test_declared_settings_are_applied_to_every_kind_of_module(bench: LineBench, variant: str) -> None:
    module, other = modbus_slave(1, variant=SLAVE_VARIANTS[variant]), modbus_slave(2)
    async with bench.running(module, other) as (rig, beside):
        await rig.until_samples(10)
        assert rig.kinds.count(EventKind.UP) == 1
        assert rig.ledger.lost_gap_device == (2 if module.variant.long_block == "silent" else 0)
        assert "address 2 is in use" in (await rig.device.settings.apply({"address": 2}, save=True)).problem
        applied = await rig.device.settings.apply({"mode": "9-axis", "mounting": "x_up", "address": 9}, save=True)
        assert applied.problem == "", applied
        assert {step.name: str(step.outcome) for step in applied.steps}["mounting"] == "sent, not verified"
        await rig.until_samples(5)
        assert rig.device.status().link == f"{bench.path}, address 9"
        assert (module.flash.heading_mode, module.flash.slave, module.address) == (1, 9, 9)
        assert (module.writes_to_flash, other.writes_to_flash) == (1, 0)
        assert beside.kinds.count(EventKind.DOWN) == 0


@in_bench
async def test_a_device_with_another_rate_keeps_the_rate_of_its_bus_until_the_restart(bench: LineBench) -> None:
    module, other = modbus_slave(1), modbus_slave(2)
    async with bench.running(module, other) as (rig, beside):
        await rig.until_samples(5)
        applied = await rig.device.settings.apply({"baud": 921600}, save=True)
        assert (applied.failure, applied.saved, applied.restarted) == ("", True, False)
        assert "restart them with `imud command NAME restart`" in applied.advice
        assert module.flash.baud == 921600
        await rig.until_samples(5)
        applied = await rig.device.settings.apply({"mode": "9-axis"}, save=False)
        assert applied.failure == ""
        assert (rig.kinds.count(EventKind.DOWN), beside.kinds.count(EventKind.DOWN)) == (0, 0)


@pytest.mark.live
@in_loop
async def test_on_a_real_port(tmp_path: Path) -> None:
    modules = [slave(1), slave(2, firmware=152)]
    with wired(tmp_path, *modules) as (path, _):
        async with running(*(on(path, address, baud=BAUD, reply_ms=1000) for address in (1, 2))) as rigs:
            for rig, module in zip(rigs, modules, strict=True):
                await rig.until_samples(5)
                assert rig.device.status().identity["serial_number"] == module.serial.hex().upper()
            await act(rigs[0].device, "attitude_mode", {"axes": 9})
            assert [module.settings.heading_mode for module in modules] == [1, 0]
            await rigs[0].until_samples(5)
