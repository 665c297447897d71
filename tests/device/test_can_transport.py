"""A device on a CAN bus in memory: samples, lost frames by cause, bus down and up."""

import asyncio
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from random import Random
from typing import Any

import msgspec
import pytest

from imud.config.model import DeviceConfig
from imud.contracts.driver import CanDriver
from imud.contracts.script import RequestScript, pause
from imud.contracts.setting import OnDifference, SettingsState
from imud.contracts.status import DeviceState, KernelCounters
from imud.device.can_transport import CanBuses
from imud.device.latency import Need
from imud.device.recordable import RecordableDevices
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.drivers.imu61x.can import Imu61xCanOptions, encode_set
from imud.formats.can import EXTENDED_FLAG, RAW_FRAME, CanFilter, CanFrame, CyclicFrame
from imud.formats.records import Kind, records_of
from imud.host.clock import HostClock
from imud.links.memory import MemoryCanLink, MemoryOptions
from imud.model.event import EventKind
from imud.model.options import Options
from imud.model.units import NS_PER_S
from imud.sim.can_module import CanModule, CanModules
from imud.sim.hipnuc.canopen import NODE_VARIANTS, HipnucCanopenHardware, HipnucCanopenModule, NodeSettings
from imud.sim.hipnuc.j1939 import J1939_VARIANTS, HipnucJ1939Module, J1939Hardware, J1939Settings
from tests.support.device_rig import DeviceRig, DeviceRigs
from tests.support.device_rig import play as play_rigs
from tests.support.event_loops import VirtualClock, run_virtually
from tests.support.stories import told

MS = 1_000_000


def configured(
    driver: str = "imu61x-can", settings: Options | None = None, *, base_id: int = 101, bitrate: int = 0
) -> DeviceConfig:
    link = MemoryOptions(baud=bitrate, name="can0")
    return DeviceConfig("mast", driver, settings or Imu61xCanOptions(base_id=base_id), True, "memory", link)


class Frames:
    """Frames of a module, 1 ms apart."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._clock, self._now_ns = now_ns, now_ns()

    def of(self, index: int, *, base_id: int = 101, lost: Sequence[int] = ()) -> list[CanFrame]:
        self._now_ns = max(self._now_ns, self._clock() - 10 * MS)
        made = []
        for place, (can_id, data) in enumerate(
            encode_set(
                index=index, accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0), euler_rad=(0, 0, 0), temperature_c=20,
                base_id=base_id,
            )
        ):  # fmt: skip
            self._now_ns += MS
            if place not in lost:
                made.append(CanFrame(can_id, False, data, self._now_ns))
        return made


class CanDeviceBench:
    def __init__(self, rig: DeviceRig) -> None:
        self.rig = rig
        self.link = rig.can_link
        self.frames = Frames(rig.now_ns).of

    def feed(self, *indices: int) -> None:
        assert self.link.feed([frame for index in indices for frame in self.frames(index)])


def play(story: Callable[[CanDeviceBench], Coroutine[Any, Any, None]], config: DeviceConfig | None = None) -> DeviceRig:
    """Run the device during the story. At the end the ledger balances and the link is closed."""
    clock = VirtualClock()
    rigs = DeviceRigs(clock.host)
    rig = rigs.add(config or configured())

    async def told(_made: list[DeviceRig]) -> None:
        await rig.turn(lambda: rig.can_link.listening)
        await story(CanDeviceBench(rig))

    play_rigs(rigs, told, clock)
    assert rig.ledger.frames_pending == 0
    return rig


@told(play, configured(bitrate=500_000))
async def test_samples_of_one_read_are_one_batch_with_their_own_times(bench: CanDeviceBench) -> None:
    rig = bench.rig
    bench.feed(1, 2, 3)
    rig.tick()
    assert rig.is_in(DeviceState.RUNNING)
    assert (rig.batches, [s.seq for s in rig.samples]) == (1, [1, 2, 3])
    # measured before the end of its first frame (111 bits at 500 kbit/s), complete after the fifth frame
    assert all(4 * MS + 222_000 <= s.t_rx_ns - s.t_ns < 4 * MS + 500_000 for s in rig.samples)
    assert [b.t_rx_ns - a.t_rx_ns for a, b in zip(rig.samples, rig.samples[1:], strict=False)] == [5 * MS] * 2
    assert rig.device.status().link == "can0 at 500 kbit/s"
    assert rig.events[0].kind is EventKind.UP
    assert rig.can_link.written == []


def delay_ns(name: str, settings: Options, bitrate: int) -> int:
    """Return the time from the measurement to the arrival; four frames, 0.3 ms apart, every 10 ms."""
    driver = DRIVERS[name]
    assert isinstance(driver, CanDriver)
    burst = driver.example_frames(Random(1))

    async def story(bench: CanDeviceBench) -> None:
        begin_ns = bench.rig.now_ns() - 300 * MS
        for number in range(20):
            t_ns = begin_ns + number * 10 * MS
            assert bench.link.feed([f._replace(t_rx_ns=t_ns + place * 300_000) for place, f in enumerate(burst)])

    rig = play(story, configured(name, settings, bitrate=bitrate))
    assert len(rig.samples) > 10
    return rig.samples[-1].t_rx_ns - rig.samples[-1].t_ns


@pytest.mark.parametrize(
    ("name", "settings", "bits"),
    [("hipnuc-canopen", HipnucCanopenOptions(), 95), ("hipnuc-j1939", HipnucJ1939Options(), 131)],
)
def test_the_time_stamp_precedes_the_first_frame_by_its_length(name: str, settings: Options, bits: int) -> None:
    """TPDO1 has six bytes; a 29-bit identifier makes a frame 20 bits longer."""
    taken_ns = delay_ns(name, settings, 500_000) - delay_ns(name, settings, 0)
    assert taken_ns == pytest.approx(bits * 2000, abs=2000)


@told(play, configured(base_id=300))
async def test_only_own_identifiers_pass(bench: CanDeviceBench) -> None:
    """Before the first sample, all frames pass: imud names unknown types. Frames that only another device receives do
    not pass. A second device with the same address is refused, and the first one continues."""
    buses = vars(bench.rig.device._transport)["_buses"]
    buses.join("rear", "can0", filters(101, *range(300, 305)), (), float)
    for index, bytes_in in ((1, 72), (2, 112)):
        bench.link.feed(bench.frames(index) + bench.frames(index, base_id=300))
        assert (len(bench.rig.samples), bench.rig.ledger.bytes_in) == (index, bytes_in)
        bench.rig.tick()
        bench.rig.tick()


@told(play)
async def test_lost_samples_are_counted_by_cause(bench: CanDeviceBench) -> None:
    bench.feed(1, 2)
    bench.link.feed(bench.frames(3, lost=[2]))  # no reason is known
    bench.feed(4)
    bench.link.counters = KernelCounters(overrun=7)
    after = bench.frames(6)
    bench.link.feed([after[0]._replace(after_loss=True), *after[1:]])  # the kernel counts 5
    damaged = bench.frames(7)
    bench.link.feed([*damaged[:4], damaged[4]._replace(data=b"\0" * 7)])
    bench.feed(8)
    bench.rig.tick()
    ledger = bench.rig.ledger
    assert (ledger.lost_gap_device, ledger.lost_overrun, ledger.lost_crc) == (1, 1, 1)
    assert (ledger.frames_bad_length, ledger.frames_ignored) == (1, 4 + 4)
    assert ledger.samples == 5
    assert EventKind.LOSS in bench.rig.kinds


@told(play)
async def test_damaged_frames_of_adapter_are_gaps(bench: CanDeviceBench) -> None:
    """The sender of a damaged frame is unknown. Each damaged frame is one gap of unknown size."""
    bench.feed(1, 2)
    bench.link.counters = KernelCounters(framing=2)
    bench.rig.tick()
    bench.rig.tick()
    assert bench.rig.ledger.lost_unknown == 2
    bench.feed(3)
    bench.link.counters = KernelCounters(framing=3)
    bench.rig.tick()
    assert (bench.rig.ledger.lost_unknown, bench.rig.ledger.samples) == (3, 3)


@told(play)
async def test_frames_from_before_a_loss_are_not_mixed_with_those_after(bench: CanDeviceBench) -> None:
    first, second = bench.frames(1), bench.frames(2)
    second[2] = second[2]._replace(after_loss=True)
    bench.link.feed(first[:2] + second[2:])
    assert bench.rig.samples == []


def test_a_device_without_reply_is_queried_again() -> None:
    """No device replies: after the first minutes one query in five minutes."""
    clock = VirtualClock()
    rigs = DeviceRigs(clock.host)
    rig = rigs.add(configured("hipnuc-canopen", HipnucCanopenOptions(node=8)))

    async def story(_made: list[DeviceRig]) -> None:
        await rig.until(lambda: rig.can_link.listening)
        counts = []
        for pass_s in (3.0, 180.0, 310.0, 310.0, 310.0):
            end_ns = clock.now_ns() + int(pass_s * 1e9)
            await rig.until(lambda end_ns=end_ns: clock.now_ns() > end_ns, limit_s=pass_s + 1, step_s=0.1)  # type: ignore[misc]
            counts.append(len(rig.can_link.written))
        assert counts == [3, 6, 7, 8, 9]  # a query is one request

    play_rigs(rigs, story, clock)


def test_a_suspend_of_the_host_is_a_gap_of_unknown_size() -> None:
    clock, asleep_ns, index = VirtualClock(), 0, count()
    now_ns = clock.now_ns
    host = HostClock(now_ns, clock.realtime_ns, now_ns, lambda: now_ns() + asleep_ns)
    rigs = DeviceRigs(host)
    rig = rigs.add(configured())

    def send() -> None:
        made = encode_set(
            index=next(index), accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0), euler_rad=(0, 0, 0), temperature_c=20,
            base_id=101,
        )  # fmt: skip
        rig.can_link.feed([CanFrame(can_id, False, data, now_ns()) for can_id, data in made])

    async def story(_made: list[DeviceRig]) -> None:
        nonlocal asleep_ns
        await rig.until(lambda: rig.can_link.listening)
        await rig.until(lambda: len(rig.samples) > 200, step=send, step_s=0.01)
        before = rig.ledger.lost_unknown
        for suspends in (1, 2):
            asleep_ns += 2 * NS_PER_S
            samples = len(rig.samples)
            await rig.until(lambda: len(rig.samples) > samples + 200, step=send, step_s=0.01)  # noqa: B023
            assert (host.suspends, rig.ledger.lost_unknown) == (suspends, before + suspends)

    play_rigs(rigs, story, clock)


@pytest.mark.parametrize("end", ["run ends", "closed"])
def test_a_closed_device_leaves_its_bus(end: str) -> None:
    clock = VirtualClock()
    rigs = DeviceRigs(clock.host)
    rig = rigs.add(configured())

    async def story() -> None:
        running = asyncio.create_task(rig.device.run())
        await rig.turn(lambda: rig.can_link.listening)
        claimed = rigs.factory._can_buses.claimed("other", "can0")
        assert claimed(101, False)
        if end == "closed":
            rig.device.close()
            assert not rig.can_link.is_open
            assert not claimed(101, False)
        running.cancel()
        await asyncio.wait([running])
        assert not claimed(101, False)

    run_virtually(clock, story())


@told(play)
async def test_bus_down_and_up(bench: CanDeviceBench) -> None:
    rig = bench.rig
    bench.feed(1, 2)
    bench.link.feed(bench.frames(3)[:3])
    rig.tick()
    bench.link.disappear()
    await rig.turn(lambda: rig.state is DeviceState.MISSING)
    await rig.turn(lambda: "is down" in rig.problem)
    assert rig.ledger.frames_pending == 0
    bench.link.appear()
    await rig.turn(lambda: bench.link.listening)
    bench.feed(10)
    rig.tick()
    assert rig.is_in(DeviceState.RUNNING)
    assert rig.kinds == [EventKind.UP, EventKind.DOWN, EventKind.UP]
    assert rig.ledger.lost() == 0
    assert rig.device.status().connects == 2


@told(play)
async def test_the_status_shows_a_problem_of_the_bus_while_it_lasts(bench: CanDeviceBench) -> None:
    rig = bench.rig
    bench.link.news("can0 is error-passive: x", "can0 is error-passive: x")
    bench.feed(1)
    rig.tick()
    assert rig.is_in(DeviceState.RUNNING)
    assert rig.problem == "can0 is error-passive: x"
    bench.link.news("can0 is bus-off: y", "can0 is bus-off: y")
    rig.tick(ahead_ns=3000 * MS)
    assert rig.is_in(DeviceState.SILENT)
    assert rig.problem == "can0 is bus-off: y"
    bench.link.news("can0 is error-active again", "")
    assert rig.problem == ""
    assert [e.message for e in rig.events if e.kind is EventKind.LINK][-1] == "can0 is error-active again"


@pytest.mark.parametrize(("lost", "words"), [([], "no frame of imu61x-can arrives"), ([4], "no complete sample")])
@told(play)
async def test_a_silent_device_reports_the_received_frames(bench: CanDeviceBench, lost: list[int], words: str) -> None:
    if lost:
        bench.link.feed(bench.frames(1, lost=lost))
    bench.rig.tick(ahead_ns=3000 * MS)
    assert words in bench.rig.problem
    if lost:
        bench.link.feed([bench.frames(2)[0]._replace(data=b"short")])
        bench.rig.tick(ahead_ns=3000 * MS)
        odd = "1 frame of a wrong length, the last of CAN identifier 065"
        assert bench.rig.problem.endswith(f"; {odd}")
        assert bench.rig.device.status().unused == odd


@pytest.mark.parametrize(
    ("driver", "can_id", "extended", "words"),
    [
        ("hipnuc-j1939", 0x0CFF6008, True, "(PGN 65376 (0xFF60)), but no sample; imud decodes FF10, "),
        ("hipnuc-canopen", 0x508, False, "(COB-ID 0x508), but no sample; imud decodes TPDO 1 "),
        ("hipnuc-nmea2000", 0x0DF80123, True, "(PGN 129025 (0x1F801)), but no sample; imud decodes PGN 127250 "),
        ("imu61x-can", 201, False, "(identifier 201), but no sample; imud decodes the identifiers base_id "),
    ],
)
@pytest.mark.parametrize("ran", [False, True])
def test_frames_of_unknown_types_are_named(driver: str, can_id: int, extended: bool, words: str, ran: bool) -> None:
    """Also if the device has sent samples before. The last incomplete sample does not end the silence."""
    row = DRIVERS[driver]
    assert isinstance(row, CanDriver)

    async def story(bench: CanDeviceBench) -> None:
        rig, begun_ns = bench.rig, bench.rig.now_ns()
        known = [
            frame._replace(t_rx_ns=begun_ns + (10 * number + place) * MS)
            for number in range(20)
            for place, frame in enumerate(row.example_frames(Random(number)))
        ]
        if ran:
            bench.link.feed(known)
            rig.tick()
            rig.tick()
            assert rig.is_in(DeviceState.RUNNING)
            assert bench.link.filters == tuple(row.filters(row.settings()))
        rig.tick(ahead_ns=3000 * MS)
        rig.tick(ahead_ns=6000 * MS)
        bench.link.feed([CanFrame(can_id, extended, bytes(8), begun_ns + 3000 * MS)])
        rig.tick(ahead_ns=6000 * MS)
        assert f"on can0: valid frames of unknown types {words}" in rig.problem

    play(story, configured(driver, row.settings()))


@told(play, configured(bitrate=500_000))
async def test_frames_are_not_held_while_a_script_runs(bench: CanDeviceBench) -> None:
    bench.feed(1, 2)
    bench.rig.tick()
    assert bench.link.gather_ns == 0
    bench.rig.device.set_need(Need(20 * MS, "client 1"))
    assert bench.link.gather_ns == 20 * MS
    transport = bench.rig.device._transport
    script = asyncio.create_task(transport.run_script(lambda _target: with_pause(5 * MS)))
    await asyncio.sleep(0)
    assert (transport.busy, transport.is_free, bench.link.gather_ns) == (True, False, 0)
    assert await script == "ended"
    assert (transport.busy, transport.is_free, bench.link.gather_ns) == (False, True, 20 * MS)
    bench.rig.device.set_need(Need(0, "client 1"))
    assert bench.link.gather_ns == 0


def with_pause(pause_ns: int) -> RequestScript[str]:
    yield pause(pause_ns)
    return "ended"


@told(play, configured(bitrate=500_000))
async def test_a_recording_starts_with_the_device_and_its_state(bench: CanDeviceBench) -> None:
    records, clock = list[bytes](), VirtualClock()
    devices = RecordableDevices({"mast": bench.rig.device}, host := clock.host)
    assert devices.names() == ["mast"]
    bench.feed(1)
    for put, number in ((devices.begin, 2), (devices.check, 3)):
        for name in ("stern", "mast"):
            put(name, records.append)
        bench.feed(number)
    devices.begin_host(records.append)
    devices.end(records.append)
    bench.feed(4)
    clock.advance(2 * NS_PER_S)
    host.utc_offset_ns()
    kinds = [record.kind for block in records for record in records_of(block)]
    assert kinds == [Kind.DEVICE, Kind.PATH, Kind.FRAMES, Kind.CHECK, Kind.FRAMES, Kind.CALL]


@told(play)
async def test_the_status_shows_two_devices_with_one_address(bench: CanDeviceBench) -> None:
    rig = bench.rig
    bench.feed(*(index for n in range(60) for index in (n, 5000 + n)))
    rig.tick()
    rig.tick()
    assert "do two or more devices on the bus have this base_id?" in rig.device.status().problem
    assert [event.kind for event in rig.events].count(EventKind.LINK) == 1
    bench.link.news("error-passive", "the bus is error-passive")
    assert "error-passive; INDEX alternates" in rig.device.status().problem
    bench.link.news("error-active", "")
    bench.feed(*range(6000, 6010))
    rig.tick()
    assert rig.device.status().problem == ""


SYNC = CyclicFrame(0x80, False, b"", 10_000_000)


def filters(*can_ids: int) -> list[CanFilter]:
    return [CanFilter(can_id, 0x7FF, False) for can_id in can_ids]


def test_claims_and_conflicts_of_devices_on_one_bus() -> None:
    buses = CanBuses()
    for name, bus, can_id, load in (("front", "can0", 0x181, 100.0), ("rear", "can1", 0x182, 20.0)):
        buses.join(name, bus, filters(can_id), (), partial(float, load))
    buses.join("top", "can0", (), (), partial(float, 3.0))
    assert [buses.bits_per_s(name, "can0") for name in ("front", "rear", "top")] == [3, 103, 100]
    claimed = buses.claimed("mast", "can0")
    assert claimed(0x181, False)
    assert not claimed(0x181, True)
    assert not claimed(0x182, False)
    assert not buses.claimed("front", "can0")(0x181, False)
    buses.leave("front")
    buses.leave("front")
    assert not claimed(0x181, False)
    buses = CanBuses()
    buses.join("front", "can0", (), [SYNC])
    buses.join("rear", "can0", (), [CyclicFrame(0x80, False, b"", 20_000_000)])
    buses.join("other", "can1", (), [SYNC])
    buses.join("far", "can0", (), [CyclicFrame(0x80, True, b"", 1_000_000)])
    assert [buses.conflict(name) for name in ("front", "other", "far", "nobody")] == [""] * 4
    assert (
        buses.conflict("rear") == "front and rear would both send 0x080 on can0; configure only one of them to send it"
    )
    buses.join("more", "can0", (), [CyclicFrame(0x80, True, b"", 1_000_000)])
    assert "far and more would both send 0x00000080" in buses.conflict("more")
    buses.leave("front")
    assert buses.conflict("rear") == ""
    buses = CanBuses()
    buses.join("found", "can0", filters(0x181, 0x281), ())
    buses.join("named", "can0", filters(0x381, 0x281), ())
    buses.join("other", "can1", filters(0x281), ())
    assert "found and named would receive the same device on can0, which sends 0x281" in buses.conflict("named")
    assert buses.conflict("found") == buses.conflict("other") == ""


BIT_RATE = 500_000


class BusInProcess:
    """Simulated modules in virtual time; the first module is the device."""

    def __init__(
        self,
        clock: VirtualClock,
        driver: str,
        options: Options | None,
        *modules: CanModule,
        identify: bool = True,
        **declared: object,
    ) -> None:
        """imud applies and saves the settings in `declared`."""
        self.clock = clock
        self.modules = CanModules(modules)
        self.rigs = DeviceRigs(HostClock(clock.now_ns, clock.realtime_ns, clock.now_ns))
        link = MemoryOptions(baud=BIT_RATE, name="can0")
        config = DeviceConfig("bow", driver, options, identify, "memory", link)
        if declared:
            table = DRIVERS[driver].device_settings
            assert table is not None
            config = replace(
                config, declared=msgspec.convert(declared, table.declarable), on_difference=OnDifference.APPLY_AND_SAVE
            )
        self.rig: DeviceRig = self.rigs.add(config, MemoryCanLink(link))
        self._passed_on = 0

    def step(self) -> None:
        """Deliver the frames of both sides."""
        link, now_ns = self.rig.can_link, self.clock.now_ns()
        for payload in link.written[self._passed_on :]:
            can_id, size, data = RAW_FRAME.unpack(payload)
            self.modules.receive(can_id & ~EXTENDED_FLAG, bool(can_id & EXTENDED_FLAG), data[:size], now_ns)
        self._passed_on = len(link.written)
        link.feed([CanFrame(f.can_id, f.extended, f.data, f.due_ns) for f in self.modules.advance(now_ns)])

    async def until(self, condition: Callable[[], object], what: str) -> None:
        await self.rig.until(condition, what, 120.0, step=self.step, step_s=0.01)

    async def done(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Return the result of `work`, while the modules run."""
        task = asyncio.create_task(work)
        await self.until(task.done, "its end")
        return task.result()

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def told(_made: list[DeviceRig]) -> None:
            await self.until(lambda: self.rig.state is DeviceState.RUNNING, "samples")
            await story()

        play_rigs(self.rigs, told, self.clock)


async def made_so(
    bus: BusInProcess, wanted: Mapping[str, object], saves: Callable[[], int], *, verified: bool, is_number_seen: bool
) -> None:
    """Apply and save settings with a number that is in use, then with number 9. Check the result of each setting.

    `is_number_seen`: whether imud can verify the new number. Otherwise a person must save it.
    """
    number = "node" if "node" in wanted else "address"
    taken = await bus.done(bus.rig.device.settings.apply({number: 12}, save=True))
    assert f"{number} 12 is in use" in taken.problem
    assert saves() == 0
    applied = await bus.done(bus.rig.device.settings.apply(wanted, save=True))
    assert {step.name for step in applied.steps} == set(wanted)
    if not is_number_seen:
        assert (applied.saved, applied.restarted, saves()) == (False, False, 0)
        assert applied.problem.startswith(f"{number}: the device does not report this setting"), applied
        for command in ("save", "restart"):
            await bus.done(bus.rig.device.act(command, {}))
        return
    assert applied.problem == "", applied
    assert any("not verified" in str(step.outcome) for step in applied.steps) is not verified, applied
    assert applied.saved
    count = len(bus.rig.samples)
    await bus.until(lambda: len(bus.rig.samples) > count + 20, "samples afterwards")
    assert any("9 in the configuration" in event.message for event in bus.rig.events)
    assert saves() == 1


@pytest.mark.parametrize("variant", NODE_VARIANTS)
def test_declared_settings_are_applied_to_a_canopen_node(variant: str) -> None:
    clock, kind = VirtualClock(), NODE_VARIANTS[variant]
    module = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(boot_ms=200, variant=kind))
    other = NodeSettings(node=12)
    beside = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(factory=other, boot_ms=0))
    bus = BusInProcess(clock, "hipnuc-canopen", HipnucCanopenOptions(), module, beside)
    wanted = {"tpdo2_interval_ms": 100, "incli_x_reversed": True, "node": 9}
    is_seen = kind.reads == "answered" or kind.number_at_once
    bus.play(
        lambda: made_so(
            bus,
            wanted,
            lambda: module.objects.writes_to_flash,
            verified=kind.reads == "answered",
            is_number_seen=is_seen,
        )
    )
    saved = module.objects.saved
    assert (saved.periods_ms[2], saved.invert_x, saved.node, module.node) == (100, 1, 9, 9)
    assert beside.objects.settings == other


@pytest.mark.parametrize("variant", J1939_VARIANTS)
def test_declared_settings_are_applied_to_a_j1939_module(variant: str) -> None:
    clock, kind = VirtualClock(), J1939_VARIANTS[variant]
    module = HipnucJ1939Module(clock.now_ns(), J1939Settings(), J1939Hardware(boot_ms=200, variant=kind))
    beside = HipnucJ1939Module(clock.now_ns(), J1939Settings(address=12), J1939Hardware(boot_ms=0))
    bus = BusInProcess(clock, "hipnuc-j1939", HipnucJ1939Options(), module, beside)
    wanted = {"ff37_interval_ms": 50, "y_reversed": True, "address": 9}
    is_seen = kind.reads != "ignored" or kind.address_at_once
    bus.play(
        lambda: made_so(
            bus, wanted, lambda: module.writes_to_flash, verified=kind.reads != "ignored", is_number_seen=is_seen
        )
    )
    assert (module.flash.intervals_ms[0xFF37], module.flash.y_reversed, module.flash.address) == (50, 1, 9)
    assert beside.settings == J1939Settings(address=12)


def test_a_found_node_with_another_number_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The configuration forbids queries of the identity."""
    monkeypatch.setattr("imud.device.can_search.LISTEN_NS", 100_000_000)
    clock = VirtualClock()
    module = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(factory=NodeSettings(node=9), boot_ms=0))
    bus = BusInProcess(clock, "auto", None, module, identify=False)

    async def story() -> None:
        await bus.done(bus.rig.device.settings.apply({"tpdo1_interval_ms": 20}, save=False))
        assert module.objects.settings.periods_ms[1] == 20

    bus.play(story)


def test_a_node_with_a_declared_number_is_followed() -> None:
    clock = VirtualClock()
    module = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(boot_ms=0))
    bus = BusInProcess(
        clock, "hipnuc-canopen", HipnucCanopenOptions(), module, tpdo1_interval_ms=20, tpdo2_interval_ms=20, node=9
    )

    async def story() -> None:
        rig = bus.rig
        saved = "; saved to flash; restarted"
        await bus.until(lambda: any(saved in event.message for event in rig.events), saved)
        count = len(rig.samples)
        await bus.until(lambda: len(rig.samples) > count + 20, "samples afterwards")
        declared = rig.device.status().declared
        assert declared is not None
        assert (module.node, declared.repairs, declared.state) == (9, 1, SettingsState.AGREE)

    bus.play(story)
