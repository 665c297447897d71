"""Pins of the simulated device follow the manual, sections 1.2 and 2.2.4, in step with its frames."""

from itertools import pairwise
from math import degrees, radians

import pytest

from imud.drivers.hipnuc.uart.commands import AlarmAxis, alarm, sout_divider
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart_settings import AlarmSetting, HipnucHardware, ModuleSettings, Output
from imud.sim.physics import Still, swing
from imud.sim.sensor import Burst, Pin, PinEdge
from tests.support.simulated_modules import BEGIN_NS, FAST, HIPNUC_STILL, HipnucUartBench

HIGH_NS = 80_000  # SOUT pulse, 80 us


def pulses(edges: list[PinEdge], pin: Pin) -> list[tuple[PinEdge, PinEdge]]:
    mine = [edge for edge in edges if edge.pin is pin]
    mine = mine[not mine[0].rising : len(mine) - mine[-1].rising]  # without incomplete pulses at both ends
    assert [edge.rising for edge in mine] == [True, False] * (len(mine) // 2)
    return list(zip(mine[::2], mine[1::2], strict=True))


def run(bench: HipnucUartBench, duration_ms: float) -> tuple[list[Burst], list[PinEdge]]:
    bursts = bench.wait(duration_ms)
    return bursts, bench.module.pins(bench.now_ns)


@pytest.mark.parametrize("settings", [ModuleSettings(), FAST, ModuleSettings(baud=115_200, hi91=Output(1))])
@pytest.mark.manual("B 1.2.2 SOUT", "B 2.2.4 PMUX2 SOUT")
def test_each_frame_has_its_pulse_right_before_it(settings: ModuleSettings) -> None:
    bench = HipnucUartBench(settings)
    bursts, edges = run(bench, 1000.0)
    wire_ns = 82 * 10 * NS_PER_S // settings.baud
    found = pulses(edges, Pin.SOUT)[: len(bursts)]
    assert len(bursts) > 90
    for burst, (rise, fall) in zip(bursts, found, strict=True):
        assert fall.due_ns == burst.due_ns - wire_ns
        assert fall.due_ns - rise.due_ns == HIGH_NS
        assert rise.sample_ns == fall.sample_ns == burst.sample_ns
        assert rise.due_ns >= (burst.sample_ns or 0)


def test_which_frames_have_a_pulse_and_how_long_it_is() -> None:
    bench = HipnucUartBench(ModuleSettings(baud=115_200, hi91=Output(1)))
    _, edges = run(bench, 1000.0)
    assert bench.module.frames_dropped > 800
    assert len(pulses(edges, Pin.SOUT)) == pytest.approx(bench.module.frames_sent, abs=6)  # frames in the buffer

    bench = HipnucUartBench(ModuleSettings(baud=921_600, hi91=Output(10), hi92=Output(10)))
    bursts, edges = run(bench, 1000.0)
    assert len(bursts) == pytest.approx(200, abs=2)
    for burst, (_, fall) in zip(bursts, pulses(edges, Pin.SOUT), strict=True):
        assert fall.due_ns == burst.due_ns - len(burst.data) * 10 * NS_PER_S // 921_600

    bench = HipnucUartBench()
    bench.ask("UNLOGALL")
    bench.module.pins(bench.now_ns)
    assert bench.ask("LOG VERSION")[-1] == "OK"
    assert bench.module.pins(bench.now_ns) == []

    _, edges = run(HipnucUartBench(hardware=HipnucHardware(processing_ns=30_000, skew_ppm=0)), 100.0)
    for rise, fall in pulses(edges, Pin.SOUT):
        assert fall.due_ns - rise.due_ns == 30_000
        assert rise.due_ns == rise.sample_ns


def test_edges_come_in_order_whatever_the_steps() -> None:
    settings = ModuleSettings(hi91=Output(5), hi92=Output(7), baud=921_600, alarm_x=AlarmSetting(-1, 1, True))
    whole = run(HipnucUartBench(settings), 500.0)[1]
    bench = HipnucUartBench(settings)
    steps = [edge for _ in range(2500) for edge in run(bench, 0.2)[1]]
    assert steps == whole
    assert all(after.due_ns >= before.due_ns for before, after in pairwise(whole))
    assert {edge.pin for edge in whole} == set(Pin)
    bench = HipnucUartBench(ModuleSettings(alarm_y=AlarmSetting(-3, 3, True)))
    edges: list[PinEdge] = []
    while bench.now_ns < BEGIN_NS + 1500 * NS_PER_MS:
        next_ns = bench.module.next_pin_ns()
        assert next_ns is not None
        assert next_ns > bench.now_ns
        bench.now_ns = next_ns
        found = bench.module.pins(next_ns)
        assert all(edge.due_ns == next_ns for edge in found)
        edges += found
    assert len(edges) > 200


@pytest.mark.parametrize("divider", [1, 8, 64])
@pytest.mark.manual("B 2.2.4 divider")
def test_every_nth_pulse_is_repeated(divider: int) -> None:
    bench = HipnucUartBench()
    assert bench.ask(sout_divider(divider).payload.decode().strip()) == ["OK"]
    bench.module.pins(bench.now_ns)
    _, edges = run(bench, 2000.0)
    sout = [rise.due_ns for rise, _ in pulses(edges, Pin.SOUT)]
    divided = [rise.due_ns for rise, _ in pulses(edges, Pin.SOUT_DIV)]
    assert len(divided) == pytest.approx(200 / divider, abs=1)
    assert set(divided) <= set(sout)
    assert {sout.index(after) - sout.index(before) for before, after in pairwise(divided)} == {divider}


@pytest.mark.manual("B 2.2.4 PMUX4 SOUT_DIV")
def test_dividers_and_pins_that_nobody_watches() -> None:
    bench = HipnucUartBench(hardware=HIPNUC_STILL)
    bench.wait(45.0)  # within eight pulses
    bench.module.pins(bench.now_ns)
    assert bench.ask("CONFIG PMUX4 DIV20", 0.5) == []
    rises = [rise.due_ns for rise, _ in pulses(run(bench, 1000.0)[1], Pin.SOUT_DIV)]
    assert rises[0] - bench.now_ns + 1000 * NS_PER_MS == pytest.approx(20 * 10 * NS_PER_MS, abs=10 * NS_PER_MS)

    _, edges = run(HipnucUartBench(), 1000.0)
    periods = [(b.due_ns - a.due_ns) / NS_PER_MS for (a, _), (b, _) in pairwise(pulses(edges, Pin.SOUT_DIV))]
    assert periods == pytest.approx([80.0] * len(periods), rel=1e-4)  # manual, PMUX4
    assert len(periods) >= 11

    bench = HipnucUartBench(FAST)
    bench.wait(10_000.0)
    assert len(bench.module.pins(bench.now_ns)) <= 8192


@pytest.mark.manual("B 2.2.4 alarm level")
def test_alarm_follows_the_angles() -> None:
    motion = swing()
    bench = HipnucUartBench(hardware=HipnucHardware(motion=motion, skew_ppm=0))
    assert bench.ask(alarm(AlarmAxis.Y, -5, 5, enabled=True).payload.decode().strip()) == ["OK"]
    edges = [edge for edge in run(bench, 20_000.0)[1] if edge.pin is Pin.ALARM]
    assert len(edges) > 4
    level = edges.pop(0).rising  # the angle was out of range before the alarm was set
    assert level
    for edge in edges:
        assert edge.rising is not level
        level = edge.rising
        t_s = (edge.due_ns - BEGIN_NS) / NS_PER_S
        rolls = [degrees(motion.at(t_s - back_s).euler_rad[0]) for back_s in (0.0, 0.0101)]
        assert (abs(rolls[0]) > 5) is edge.rising
        assert (abs(rolls[1]) > 5) is not edge.rising  # the device checks the angle every 10 ms

    bench = HipnucUartBench(ModuleSettings(alarm_y=AlarmSetting(-1, 1, True)), HIPNUC_STILL)
    run(bench, 100.0)
    assert bench.ask("CONFIG PMUX5 Y,-1,1,0,0") == ["OK"]
    assert [edge.rising for edge in bench.module.pins(bench.now_ns) if edge.pin is Pin.ALARM] == [False]
    bench = HipnucUartBench(ModuleSettings(alarm_y=AlarmSetting(-1, 1, True)), HIPNUC_STILL)
    edges = run(bench, 105.0)[1]
    rise_ns = edges[-1].due_ns + 10 * NS_PER_MS  # without skew, SOUT falls every 10 ms: here it is high or rises soon
    bench.now_ns = rise_ns - 40_000
    bench.module.reboot(bench.now_ns)
    edges += bench.module.pins(bench.now_ns)
    for pin in Pin:
        levels = [edge.rising for edge in edges if edge.pin is pin]
        assert not levels or levels[-1] is False
    assert [edge.pin for edge in edges[-2:]] == [Pin.SOUT, Pin.ALARM]
    assert edges[-1].due_ns == edges[-2].due_ns == bench.now_ns
    assert all(edge.pin is not Pin.SOUT for edge in run(bench, 499.0)[1])  # still booting


@pytest.mark.parametrize(
    ("alarm_x", "alarm_y", "expected"),
    [
        (AlarmSetting(-5, 5, True), AlarmSetting(), True),  # X is pitch: 7°
        (AlarmSetting(-5, 5, False), AlarmSetting(), False),
        (AlarmSetting(-8, 8, True), AlarmSetting(-3, 3, True), False),  # Y is roll: 2°
        (AlarmSetting(-8, 8, True), AlarmSetting(2.5, 5, True), True),
        (AlarmSetting(8, 9, True), AlarmSetting(), True),  # below the range
    ],
)
def test_which_angle_alarms(alarm_x: AlarmSetting, alarm_y: AlarmSetting, expected: bool) -> None:
    hardware = HipnucHardware(motion=Still(radians(2), radians(7), 0.0))
    _, edges = run(HipnucUartBench(ModuleSettings(alarm_x=alarm_x, alarm_y=alarm_y), hardware), 100.0)
    assert [edge.rising for edge in edges if edge.pin is Pin.ALARM] == [True] * expected


@pytest.mark.manual("B 1.2.1 delay of the answer", "B 2.2.4 PMUX1 SIN")
def test_a_trigger_is_answered_125_us_later_on_average() -> None:
    bench = HipnucUartBench(ModuleSettings(baud=921_600, hi91=Output(on_mark=True)))
    delays, wire_ns = [], 82 * 10 * NS_PER_S // 921_600
    for _ in range(300):
        marked_ns = bench.now_ns
        bench.module.mark(marked_ns)
        (burst,), edges = run(bench, 10.0)
        (pulse,) = pulses(edges, Pin.SOUT)
        assert burst.sample_ns == pulse[0].sample_ns == marked_ns
        assert burst.due_ns - wire_ns == pulse[1].due_ns == pulse[0].due_ns + HIGH_NS
        delays.append(pulse[1].due_ns - marked_ns)
    assert sum(delays) / len(delays) == pytest.approx(125_000, abs=2000)
    assert 20_000 < max(delays) - min(delays) <= 30_000

    bench = HipnucUartBench(FAST, HIPNUC_STILL)
    bench.wait(0.7)
    bench.module.mark(bench.now_ns)
    frame = bench.frames(3.0)[-1]
    assert frame.word_1_2 == 1  # the sample is 2 ms later; minus 0.7: 0.3, 1.3, 2.3 …
    bench = HipnucUartBench(FAST, HIPNUC_STILL)
    bench.module.reboot(bench.now_ns)
    bench.wait(100.0)
    bench.module.mark(bench.now_ns)
    (frame, *_) = bench.frames(405.0)
    assert frame.word_1_2 == frame.system_time_ms
