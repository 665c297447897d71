"""The simulated CANopen device compared with its true values and the manual. imud's codec decodes its frames."""

import itertools
import math

import pytest

from imud.drivers.hipnuc.canopen import cia301
from imud.drivers.hipnuc.canopen import commands as session
from imud.drivers.hipnuc.canopen.cia301 import NmtCommand
from imud.drivers.hipnuc.canopen.commands import InclinometerZero, Transmission
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.can_module import SentFrame
from imud.sim.hipnuc import canopen
from imud.sim.sensor import SimulatorOptions
from tests.support.simulated_modules import BEGIN_NS, QUIET, CanopenBench

MS = NS_PER_MS
SECOND_NS = NS_PER_S


def times_of(frames: list[SentFrame], can_id: int) -> list[int]:
    return [frame.due_ns for frame in frames if frame.can_id == can_id]


@pytest.mark.manual("B 5.1 defaults")
def test_timers_and_wire() -> None:
    periods_ms, types = {1: 10, 2: 10, 3: 10, 4: 10, 6: 50, 7: 10}, dict.fromkeys((1, 2, 3, 4, 6, 7), 0xFF)
    assert canopen.NodeSettings() == canopen.NodeSettings(8, 500_000, periods_ms, types, 0, 0, 0)
    settings = canopen.NodeSettings(periods_ms={1: 5, 2: 20, 3: 0, 4: 0, 6: 100, 7: 0}, bit_rate=250_000)
    module = canopen.HipnucCanopenModule(
        BEGIN_NS, canopen.HipnucCanopenHardware(factory=settings, boot_ms=0, skew_ppm=1000)
    )
    frames = module.advance(BEGIN_NS + SECOND_NS + 2 * MS)
    counts = [len(times_of(frames, can_id)) for can_id in (0x188, 0x288, 0x388, 0x488, 0x688, 0x788)]
    assert counts == [200, 50, 0, 0, 10, 0]
    assert module.counters() == {"samples_sent": 200, "frames_sent": 261}  # with the boot-up message
    first = times_of(frames, 0x188)[:3]
    assert [b - a for a, b in itertools.pairwise(first)] == pytest.approx([4_995_005] * 2, abs=2)
    together = [frame for frame in frames if frame.sample_ns == frames[-1].sample_ns]
    assert [b.due_ns - a.due_ns for a, b in itertools.pairwise(together)] == [480_000] * (len(together) - 1)
    silent = canopen.HipnucCanopenModule(BEGIN_NS, canopen.HipnucCanopenHardware(factory=QUIET, boot_ms=0))
    silent.advance(BEGIN_NS + SECOND_NS)
    assert silent.next_ns() is None
    bench = CanopenBench(canopen.NodeSettings(periods_ms=QUIET.periods_ms, heartbeat_ms=100), boot_ms=50)
    bench.run(400 * MS)
    assert (bench.heard, bench.module.samples_sent) == ([(0x708, b"\0"), *[(0x708, b"\5")] * 3], 0)


@pytest.mark.manual("B 5.4.2 transmission type")
def test_sync_sends_what_is_of_type_1() -> None:
    bench = CanopenBench(canopen.NodeSettings(periods_ms={1: 10, 2: 10, 3: 0, 4: 0, 6: 0, 7: 0}))
    bench.run_script(session.set_tpdo_type(8, 1, Transmission.SYNC))
    bench.run_script(session.set_tpdo_type(8, 3, Transmission.SYNC))
    bench.heard.clear()
    bench.run(35 * MS)
    assert {can_id for can_id, _ in bench.heard} == {0x288}
    bench.heard.clear()
    bench.send(0x080, b"")
    bench.run(4 * MS)
    assert [can_id for can_id, _ in bench.heard if can_id != 0x288] == [0x188, 0x388]
    bench.run_script(session.set_tpdo_type(8, 1, Transmission.TIMER))
    bench.heard.clear()
    bench.run(35 * MS)
    assert sum(can_id == 0x188 for can_id, _ in bench.heard) >= 3
    bench = CanopenBench(canopen.NodeSettings())
    bench.run_script(session.nmt(8, NmtCommand.PRE_OPERATIONAL))
    bench.run(20 * MS)
    bench.heard.clear()
    bench.run(50 * MS)
    assert bench.heard == []
    assert bench.run_script(session.identify(8)).product == "HI14"  # SDO still works
    bench.send(0x000, b"\2\0")  # stop all
    bench.heard.clear()
    bench.send(0x608, cia301.read_frame(0x1000, 0))
    bench.run(50 * MS)
    assert bench.heard == []
    bench.send(0x000, b"\1\0")
    bench.run(50 * MS)
    assert 0x188 in {can_id for can_id, _ in bench.heard}
    for code in (b"\x81", b"\x82"):  # reset of the node, and of its communication
        bench.heard.clear()
        bench.send(0x000, code + b"\0")
        bench.run(5 * MS)
        assert (0x708, b"\0") in bench.heard


@pytest.mark.parametrize("name", canopen.NODE_VARIANTS)
def test_which_variant_confirms_a_restart(name: str) -> None:
    bench = CanopenBench(variant=canopen.NODE_VARIANTS[name])
    bench.run(5 * MS)
    bench.heard.clear()
    bench.send(0x608, cia301.write_frame(0x2000, 0, b"\xff\0\0\0"))
    bench.run(5 * MS)
    expected = {"restarts without a reply": [], "no boot-up message": [0x588]}.get(name, [0x588, 0x708])
    assert [can_id for can_id, _ in bench.heard] == expected


def test_what_applies_at_once_and_what_after_a_restart() -> None:
    bench = CanopenBench()
    bench.run_script(session.set_tpdo_period(8, 1, 50))
    bench.run_script(session.set_node_id(8, 20))
    bench.run_script(session.set_bit_rate(8, 250_000))
    bench.heard.clear()
    bench.run(120 * MS)
    assert [can_id for can_id, _ in bench.heard] in ([0x188] * 2, [0x188] * 3)
    assert bench.module.node == 8
    bench.send(0x608, cia301.write_frame(0x2000, 0, b"\xff\0\0\0"))
    assert bench.module.node == 8  # the setting was not saved
    assert bench.module.objects.settings == QUIET
    bench = CanopenBench()
    bench.run_script(session.set_node_id(8, 20))
    bench.run_script(session.set_tpdo_period(8, 2, 100))
    bench.run_script(session.save(8))
    bench.send(0x608, cia301.write_frame(0x2000, 0, b"\xff\0\0\0"))
    assert (bench.module.node, bench.module.objects.settings.periods_ms[2]) == (20, 100)
    bench.send(0x614, cia301.write_frame(0x2000, 0, b"\1\0\0\0"))
    assert bench.module.node == 20
    bench.module.reboot(bench.now_ns)
    assert (bench.module.node, bench.module.objects.settings) == (8, QUIET)


@pytest.mark.manual("B 5.4.1 zero of the inclinometer")
def test_inclinometer_signs_and_zero() -> None:
    def incli() -> tuple[float, float]:
        bench.run(20 * MS)
        angles = bench.measured[-1].incli_rad
        assert angles is not None
        return angles

    bench = CanopenBench(canopen.NodeSettings(periods_ms={**QUIET.periods_ms, 7: 5}))
    bench.run(700 * MS)
    x, y = incli()
    bench.run_script(session.set_inclinometer_sign(8, "x", invert=True))
    turned = incli()
    assert math.copysign(1, turned[0]) == -math.copysign(1, x)
    assert math.copysign(1, turned[1]) == math.copysign(1, y)
    bench.run_script(session.set_inclinometer_zero(8, InclinometerZero.SET))
    bench.measured.clear()
    assert incli() == pytest.approx((0, 0), abs=0.05)
    bench.run_script(session.set_inclinometer_zero(8, InclinometerZero.CANCEL))
    assert incli() == pytest.approx(turned, abs=0.1)


@pytest.mark.parametrize(
    ("request_hex", "code"),
    [
        ("40 34 12 00 00 00 00 00", 0x0602_0000), ("40 00 18 07 00 00 00 00", 0x0609_0011),
        ("40 00 20 00 00 00 00 00", 0x0601_0001), ("23 00 10 00 00 00 00 00", 0x0601_0002),
        ("23 00 18 05 0A 00 00 00", 0x0607_0010), ("2B 00 18 05 04 00 00 00", 0x0609_0030),
        ("A0 00 10 00 00 00 00 00", 0x0504_0001), ("2B 00 18 05 E9 03 00 00", 0x0609_0030),  # 1001 ms
    ],
)  # fmt: skip
def test_abort_codes(request_hex: str, code: int) -> None:
    request, objects = bytes.fromhex(request_hex), canopen.ObjectDictionary(canopen.NodeSettings())
    for period_ms in (5, 1000):  # the limits
        assert objects.serve(b"\x2b\x00\x18\x05" + period_ms.to_bytes(4, "little"))[0][0] == 0x60
    reply, _ = objects.serve(request)
    assert reply == b"\x80" + request[1:4] + code.to_bytes(4, "little")


@pytest.mark.parametrize(("rate_hz", "period_ms", "pressure_ms"), [(1, 1000, 1000), (125, 8, 48), (200, 5, 50)])
def test_options_make_rates_that_divide(rate_hz: float, period_ms: int, pressure_ms: int) -> None:
    module = canopen.SIMULATOR.make(SimulatorOptions(rate_hz=rate_hz, node=5, at_once=True), BEGIN_NS)
    assert isinstance(module, canopen.HipnucCanopenModule)
    assert module.node == 5
    assert module.objects.settings.periods_ms == dict.fromkeys((1, 2, 3, 4, 7), period_ms) | {6: pressure_ms}
    for rate in (0, 0.5, 250, 3 * rate_hz / 2):
        with pytest.raises(ValueError, match="expected a period of 5 … 1000 whole milliseconds"):
            canopen.SIMULATOR.make(SimulatorOptions(rate_hz=rate), BEGIN_NS)
