"""Commands that change settings: examples of the manual, encoders of the host, and refused commands.
Each interpretation of the manual as a behavior of the simulated device: rate, factory reset, flash, refusals.
The magnetometer calibration without a command, and the change to UTC when PPS and RMC match (manual 1.2.1)."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from math import pi

import pytest

from imud.drivers.hipnuc.uart import commands
from imud.drivers.hipnuc.uart.commands import BAUD_RATES, RATES_HZ, Mounting, OutputMessage
from imud.formats.nmea0183 import build
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc import uart_settings
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import AlarmSetting, Behaviour, HipnucHardware, ModuleSettings, Output, changed
from imud.sim.physics import Still, tumble
from tests.support.simulated_modules import BEGIN_NS, Hi91, HipnucUartBench, hardware_of, unpack_hi91

FACTORY = ModuleSettings()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("SERIALCONFIG 115200", FACTORY), ("SERIALCONFIG 9600", replace(FACTORY, baud=9600)),
        ("CONFIG ATT MODE 1", replace(FACTORY, att_mode=1)),
        ("CONFIG IMU URFR 1,0,0,0,0,1,0,-1,0", replace(FACTORY, urfr=(1, 0, 0, 0, 0, 1, 0, -1, 0))),
        ("CONFIG IMU EN_MCAL 0", replace(FACTORY, mag_calibration=False)),
        ("CONFIG PMUX3 IO2", replace(FACTORY, pins=(1, 2, 2, 6, 9))),
        ("CONFIG PMUX4 IO9", replace(FACTORY, pins=(1, 2, 5, 9, 9))),
        ("CONFIG PMUX4 DIV4", replace(FACTORY, sout_div=4)),
        ("CONFIG PMUX5 Y,-5,5,0,1", replace(FACTORY, alarm_y=AlarmSetting(-5, 5, True))),
        ("CONFIG PMUX5 X,-7.5,2,0,0", replace(FACTORY, alarm_x=AlarmSetting(-7.5, 2, False))),
        ("LOG IMU91 ONTIME 0.01", FACTORY), ("LOG HI91 ONTIME 0.002", replace(FACTORY, hi91=Output(2))),
        ("LOG HI92 ONTIME 0.05", replace(FACTORY, hi92=Output(50))),
        ("LOG IMU91 ONTIME 0", replace(FACTORY, hi91=Output())),
        ("LOG IMU91 ONMARK 1", replace(FACTORY, hi91=Output(on_mark=True))),
        ("UNLOGALL", replace(FACTORY, hi91=Output())),
    ],
)  # fmt: skip
@pytest.mark.manual("B 2.2.5 names")
def test_examples_of_the_manual(line: str, expected: ModuleSettings) -> None:
    assert changed(FACTORY, line, 156) == expected


@pytest.mark.manual("B 2.2.4 pins by firmware", "B 1.2.2 timed output off", "B 2.2.4 URFR presets")
def test_rates_mountings_pins_unlogall_and_reports() -> None:
    for message in OutputMessage:
        for rate_hz in (0, *RATES_HZ):
            settings = changed(FACTORY, commands.log_ontime(message, rate_hz).name, 156)
            assert settings
            output = getattr(settings, message.lower())
            assert output.period_ms == (1000 // rate_hz if rate_hz else 0)
    for baud in BAUD_RATES:
        settings = changed(FACTORY, commands.serial_config(baud).name, 156)
        assert settings
        assert settings.baud == baud
    assert changed(FACTORY, "CONFIG PMUX3 IO2", 154) is None
    assert changed(FACTORY, "CONFIG PMUX3 IO2", 155) is not None
    settings = replace(FACTORY, hi92=Output(on_mark=True))
    assert changed(settings, "UNLOGALL", 156) == replace(settings, hi91=Output())
    settings = replace(FACTORY, hi92=Output(on_mark=True))
    assert settings.port_lines() == ["BAUD: 115200", "LOG HI91 ONTIME 0.01", "LOG HI92 ONMARK 1"]
    lines = settings.user_lines()
    assert lines[:3] == ["ATT_MODE: 0", "URFR: 1,0,0,0,1,0,0,0,1", "EN_MCAL: 1"]
    assert "ALARM_Y: -5,5,0,0" in lines
    for mounting in Mounting:
        settings = changed(FACTORY, commands.mounting(mounting).name, 156)
        assert settings
        assert settings.urfr == tuple(float(value) for row in mounting.value for value in row)


def test_bad_values_are_refused_and_other_commands_are_not_for_it() -> None:
    for line in (
        "SERIALCONFIG 57600", "SERIALCONFIG fast", "SERIALCONFIG 115200.0", "CONFIG ATT MODE 2",
        "CONFIG IMU URFR 1,0,0,0,1,0,0,0,-1", "CONFIG IMU URFR 1,0,0,0,1,0,0,0", "CONFIG IMU URFR 1,0,0,0,1,0,0,0,nan",
        "CONFIG IMU URFR 1,0,0,1,0,0,0,0,1", "CONFIG IMU EN_MCAL 2", "CONFIG PMUX1 IO0", "CONFIG PMUX4 DIV0",
        "CONFIG PMUX4 DIV65", "CONFIG PMUX5 X,5,-5,0,1", "CONFIG PMUX5 X,-5,5,1,1", "CONFIG PMUX5 X,-5,5,0,2",
        "CONFIG PMUX5 X,-5,inf,0,1", "LOG HI91 ONTIME 2", "LOG HI91 ONTIME -0.01", "LOG HI91 ONTIME 0.0005",
        "LOG HI91 ONMARK 2", "CONFIG PMUX3 IO10",
    ):  # fmt: skip
        with pytest.raises(uart_settings.CommandRefused):
            changed(FACTORY, line, 156)
    for line in ("LOG HI91 ONMARK ONCE", "LOG VERSION", "CONFIG PMUX6 IO1", "CONFIG PMUX5 Z,0,1,0,1"):
        assert changed(FACTORY, line, 156) is None


@pytest.mark.parametrize(
    ("variant", "line", "reply"),
    [
        ("firmware 1.7", "CONFIG IMU COORD 4", "OK"), ("firmware 1.7", "CONFIG IMU COORD 1", "ERR"),
        ("firmware 1.7", "CONFIG IMU URFR 205", "OK"), ("firmware 1.7", "CONFIG IMU URFR 206", "ERR"),
        ("firmware 1.7", "CONFIG IMU URFR 135", "ERR"), ("firmware 1.7", "CONFIG IMU URFR 1,0,0,0,1,0,0,0,1", "OK"),
        ("firmware 1.7", "CONFIG ATT MODE 7", "OK"), ("firmware 1.7", "CONFIG ATT MODE 6", "ERR"),
        ("firmware 1.7", "LOG COM2 HI91 ONTIME 0.01", "OK"), ("firmware 1.7", "LOG COM3 HI91 ONTIME 0.01", "ERR"),
        ("firmware 1.7", "SERIALCONFIG COM2 9600", "OK"), ("firmware 1.7", "SERIALCONFIG COM2 1", "ERR"),
        ("firmware 1.7", "CONFIG MCAL START 3D", "ERR"), ("firmware 1.7", "LOG GGA ONTIME 1", "ERR"),
        ("firmware 1.7", "CONFIG IMU ABW 1", "ERR"), ("firmware 1.7", "LOG COM1 HI91 ONTIME 0", "OK"),
        ("INS, firmware 1.7", "LOG GGA ONTIME 1", "OK"), ("INS, firmware 1.7", "SETBASELINE x", "ERR"),
        ("older firmware", "CONFIG IMU GRG 3", "OK"), ("older firmware", "CONFIG IMU GRG 4", "ERR"),
        ("older firmware", "CONFIG ATT RST 1", "OK"), ("older firmware", "CONFIG IMU COORD 0", ""),
        ("as in the manual", "CONFIG IMU COORD 0", ""), ("as in the manual", "CONFIG ATT RST 1", "ERR"),
        ("as in the manual", "LOG MCAL STAT", ""), ("as in the manual", "CONFIG IMU URFR 024", "ERR"),
    ],
)  # fmt: skip
def test_commands_by_firmware(variant: str, line: str, reply: str) -> None:
    """An NMEA sentence is between the lines of newer firmware."""
    behaviour = uart_settings.VARIANTS[variant]
    bench = HipnucUartBench(replace(FACTORY, hi91=Output()), hardware_of(behaviour, firmware=behaviour.firmware))
    lines = bench.ask(line)
    assert [one for one in lines if one[0] != "$"] == [reply] * bool(reply)
    assert sum(one[0] == "$" for one in lines) == behaviour.newer


def test_newer_firmware_counts_modulo_24_hours_and_sends_a_frame_without_ok() -> None:
    newer = uart_settings.VARIANTS["firmware 1.7"]
    bench = HipnucUartBench(None, hardware_of(newer, uptime_ms=86_399_000, boot_ms=500))
    assert [one.system_time_ms for one in bench.frames(600)][-60:-8:10] == [
        86_399_510, 86_399_610, 86_399_710, 86_399_810, 86_399_910, 10,
    ]  # fmt: skip
    bench = HipnucUartBench(replace(FACTORY, hi91=Output(on_mark=True)), hardware_of(newer))
    bench.module.receive(b"LOG HI91 ONMARK ONCE\r\n", bench.now_ns)
    assert [burst.sample_ns is not None for burst in bench.wait(50)] == [True]


def bench_of(settings: ModuleSettings | None = None, **behaviour: object) -> HipnucUartBench:
    return HipnucUartBench(settings, hardware_of(Behaviour(**behaviour)))  # type: ignore[arg-type]  # names of fields


@pytest.mark.parametrize(
    ("change", "rate_of_answer", "rate_afterwards"),
    [
        (uart_settings.RateChange.AFTER_RESTART, 115_200, 115_200),
        (uart_settings.RateChange.BEFORE_ANSWER, 921_600, 921_600),
        (uart_settings.RateChange.AFTER_ANSWER, 115_200, 921_600),
    ],
)
def test_when_the_rate_changes(change: uart_settings.RateChange, rate_of_answer: int, rate_afterwards: int) -> None:
    bench = bench_of(ModuleSettings(hi91=Output()), rate_change=change)
    bench.module.receive(b"SERIALCONFIG 921600\r\n", bench.now_ns)
    assert bench.text(1.0) == ["OK"]
    assert bench.module.baud == rate_of_answer
    bench.wait(20.0)
    assert bench.module.baud == rate_afterwards
    bench.reboot()
    assert bench.module.baud == 115_200  # the baud rate was not saved


@pytest.mark.parametrize(
    ("effect", "rate", "mode", "answer"),
    [
        (uart_settings.ResetEffect.RATE_AFTER_RESTART, 921_600, 0, ["OK"]),
        (uart_settings.ResetEffect.AFTER_RESTART, 921_600, 1, ["OK"]),
        (uart_settings.ResetEffect.BEFORE_ANSWER, 115_200, 0, ["OK"]),
    ],
)
def test_when_a_factory_reset_acts(effect: uart_settings.ResetEffect, rate: int, mode: int, answer: list[str]) -> None:
    bench = bench_of(ModuleSettings(baud=921_600, att_mode=1), factory_reset=effect)
    assert bench.ask("FRESET") == answer
    assert (bench.module.baud, bench.module.settings.att_mode) == (rate, mode)
    bench.reboot()
    assert (bench.module.settings, bench.module.baud) == (ModuleSettings(), 115_200)


def test_slow_flash_quiet_refusals_and_all_variants() -> None:
    bench = bench_of(flash_ms=2000)
    bench.wait(50.0)
    bench.module.receive(b"SAVECONFIG\r\n", bench.now_ns)
    assert bench.wait(1900.0)[1:] == []  # one frame may have been on the wire
    assert bench.text(150.0) == ["OK"]
    assert bench.frames(500.0)
    assert bench.ask("LOG ENABLE") == ["OK"]
    bench = HipnucUartBench(hardware=hardware_of(Behaviour(quiet_ms=300), processing_ns=0))
    bench.wait(20.0)
    assert bench.ask("LOG ENABLE") == ["OK"]
    assert [burst.sample_ns for burst in bench.wait(280.0)] == [BEGIN_NS + 820 * NS_PER_MS]
    bench = bench_of(refuses=("CONFIG ATT",), ignores=("LOG MAGCONFIG",))
    assert bench.ask("CONFIG ATT MODE 1") == ["ERR"]
    assert bench.module.settings.att_mode == 0
    assert bench.ask("LOG MAGCONFIG") == []
    assert bench.ask("LOG ENABLE") == ["OK"]
    assert {variant.rate_change for variant in uart_settings.VARIANTS.values()} == set(uart_settings.RateChange)
    assert {variant.factory_reset for variant in uart_settings.VARIANTS.values()} == set(uart_settings.ResetEffect)


HARD_IRON_T: Vector3 = (14.14e-6, -2.08e-6, -8.75e-6)
ZERO: Vector3 = (0.0, 0.0, 0.0)


@pytest.mark.manual("B 8.1.3 in the background", "B 8.2 EN_MCAL")
def test_one_turn_about_each_axis_is_enough() -> None:
    magnetometer = uart_settings.SelfCalibration(HARD_IRON_T, ZERO)
    assert magnetometer.measured((1e-6, 2e-6, 3e-6)) == pytest.approx((15.14e-6, -0.08e-6, -5.75e-6))
    for axis in range(3):
        assert magnetometer.found_t == ZERO
        assert (magnetometer.state, magnetometer.progress) == (uart_settings.NOT_CALIBRATED, 0.0)
        x, y, z = (pi / 2 if number == axis else 0.0 for number in range(3))
        for second in range(6):
            magnetometer.sample((axis * 6 + second) * NS_PER_S, (x, y, z))
    assert magnetometer.found_t == HARD_IRON_T
    assert (magnetometer.state, magnetometer.progress) == (uart_settings.CALIBRATED, 1.0)
    assert magnetometer.measured((1e-6, 2e-6, 3e-6)) == pytest.approx((1e-6, 2e-6, 3e-6))
    hardware = HipnucHardware(motion=tumble(), hard_iron_t=HARD_IRON_T)
    bench = HipnucUartBench(ModuleSettings(att_mode=1), hardware)
    assert "MB=0.00, 0.00, 0.00" in bench.ask("LOG MAGCONFIG")
    bench.wait(60_000)
    assert "MB=14.14, -2.08, -8.75" in bench.ask("LOG MAGCONFIG")
    bench.reboot()
    assert "MB=14.14, -2.08, -8.75" in bench.ask("LOG MAGCONFIG")  # the device has saved it without a command
    for settings in (ModuleSettings(att_mode=0), ModuleSettings(att_mode=1, mag_calibration=False)):
        bench = HipnucUartBench(settings, HipnucHardware(motion=tumble(), hard_iron_t=HARD_IRON_T))
        bench.wait(30_000)
        assert "MB=0.00, 0.00, 0.00" in bench.ask("LOG MAGCONFIG")


UTC_S = 1_795_000_000
NO_UTC = 1 << 11


class Receiver:
    """A GNSS receiver connected to a device. It sends a pulse at each full second, and a sentence some time later."""

    def __init__(self, hardware: HipnucHardware) -> None:
        self.module = HipnucModule(BEGIN_NS, ModuleSettings(), hardware)
        self.second = UTC_S
        self.begin_ns = BEGIN_NS + hardware.boot_ms * NS_PER_MS + 123_456
        """CLOCK_MONOTONIC at `second`."""
        self.frames: list[tuple[int, Hi91]] = []
        """Pairs of (sampling time in UTC in ns, frame)."""

    def utc_ns(self, t_ns: int) -> int:
        return self.second * NS_PER_S + t_ns - self.begin_ns

    def go(self, seconds: int, *, pulse: bool = True, says: int | None = 0, late_ms: int = 150) -> None:
        """Let seconds pass. `says` is the error of the sentence in s; None for no sentence."""
        for _ in range(seconds):
            if pulse:
                self.module.mark(self.begin_ns)
            if says is not None:
                self.sentence(build((self.second + says) * NS_PER_S), late_ms)
            self.second += 1
            self.begin_ns += NS_PER_S
            self.advance()

    def sentence(self, data: bytes, late_ms: int) -> None:
        self.module.receive(data, self.begin_ns + late_ms * NS_PER_MS)

    def advance(self) -> None:
        for burst in self.module.advance(self.begin_ns):
            if burst.sample_ns is None:  # incomplete due to a restart
                continue
            self.frames.append((self.utc_ns(burst.sample_ns), unpack_hi91(burst.data)))

    def last(self, seconds: int) -> list[tuple[int, Hi91]]:
        return [(utc_ns, frame) for utc_ns, frame in self.frames if utc_ns >= (self.second - seconds) * NS_PER_S]

    def error_ms(self, modulus: int = 2**32, seconds: int = 1) -> list[float]:
        """Return the true time minus the time of the device, ms, over the last `seconds`."""
        half = modulus / 2
        return [
            (utc_ns / NS_PER_MS - frame.system_time_ms + half) % modulus - half for utc_ns, frame in self.last(seconds)
        ]


def still(skew_ppm: float = 20.0, **values: object) -> HipnucHardware:
    return HipnucHardware(motion=Still(), skew_ppm=skew_ppm, **values)  # type: ignore[arg-type]  # named by the caller


def test_time_becomes_utc_at_once_until_a_reboot() -> None:
    receiver = Receiver(still())
    receiver.go(3)
    assert all(frame.system_time_ms < 10_000 for _, frame in receiver.frames)
    receiver.go(1)
    assert receiver.frames[-1][1].system_time_ms > 10_000
    receiver.go(3)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms())
    times = [frame.system_time_ms for _, frame in receiver.frames]
    jumps = [after - before for before, after in pairwise(times) if abs(after - before - 10) > 1]
    assert len(jumps) == 1
    assert times[-1] == pytest.approx((UTC_S + 7) * 1000 % 2**32, abs=11)
    receiver = Receiver(still(utc_epoch="day"))
    receiver.go(6)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms(86_400_000))
    assert receiver.frames[-1][1].system_time_ms < 86_400_000
    receiver = Receiver(still(utc_epoch="day"))
    receiver.go(8)
    for _, frame in receiver.last(1):
        assert frame.word_1_2 == frame.system_time_ms % 1000
    receiver = Receiver(still())
    receiver.go(6)
    receiver.module.reboot(receiver.begin_ns)
    receiver.go(1, says=None)
    assert receiver.frames[-1][1].system_time_ms < 2000


@pytest.mark.manual("B 1.2.1 RMC sentences")
def test_midnight_many_sentences_the_status_bit_and_lost_pulses() -> None:
    for epoch, modulus, begin_s in (("day", 86_400_000, 1_795_046_400 - 8), ("unix", 2**32, 1_799_678_000)):
        receiver = Receiver(still(utc_epoch=epoch))
        receiver.second = begin_s - begin_s * 1000 % modulus // 1000 + modulus // 1000 - 8
        receiver.go(16)
        assert all(-0.05 <= error < 1.05 for error in receiver.error_ms(modulus))
        assert receiver.frames[-1][1].system_time_ms < 10_000
    receiver = Receiver(still())
    for _ in range(6):
        receiver.module.mark(receiver.begin_ns)
        for tenth in range(10):
            utc_ns = receiver.second * NS_PER_S + tenth * 100 * NS_PER_MS
            receiver.sentence(build(utc_ns), 100 * tenth + 60)
        receiver.go(1, pulse=False, says=None)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms())
    receiver = Receiver(still(firmware=169))
    receiver.go(6)
    statuses = [frame.word_1_2 for _, frame in receiver.frames]
    assert statuses[0] & NO_UTC
    assert not statuses[-1] & NO_UTC
    receiver.go(4, pulse=False)
    assert receiver.frames[-1][1].word_1_2 & NO_UTC
    receiver.go(1)
    assert not receiver.frames[-1][1].word_1_2 & NO_UTC
    receiver = Receiver(still(skew_ppm=100.0))
    receiver.go(6)
    receiver.go(100, pulse=False, says=None)
    drifted = receiver.error_ms()
    assert min(drifted) < -9  # 100 ppm over 100 s
    receiver.go(2, says=None)
    assert all(-0.2 <= error < 1.2 for error in receiver.error_ms())
    times = [frame.system_time_ms for _, frame in receiver.last(102)]
    assert all(abs(after - before) <= 20 for before, after in pairwise(times))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda utc_ns: build(utc_ns, valid=False), lambda utc_ns: build(utc_ns).replace(b"A*", b"D*"),
        lambda utc_ns: build(utc_ns).replace(b"RMC", b"GGA"), lambda utc_ns: build(utc_ns + 500 * NS_PER_MS),
        lambda utc_ns: build(utc_ns)[:40],
    ],
    ids=["status V", "checksum", "another sentence", "not yet", "cut"],
)  # fmt: skip
def test_bad_sentences_say_nothing(spoil: Callable[[int], bytes]) -> None:
    receiver = Receiver(still())
    for _ in range(8):
        receiver.module.mark(receiver.begin_ns)
        receiver.sentence(spoil(receiver.second * NS_PER_S), 150)
        receiver.go(1, pulse=False, says=None)
    assert receiver.frames[-1][1].system_time_ms < 10_000


def test_both_are_needed_one_wrong_sentence_changes_nothing_and_a_lasting_change_is_followed() -> None:
    receiver = Receiver(still())
    receiver.go(6)
    receiver.go(1, says=5)
    receiver.go(2)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms())
    receiver.go(3, says=5)
    assert all(-5000.05 <= error < -4998.95 for error in receiver.error_ms())
    receiver = Receiver(still())
    receiver.go(6)
    for _ in range(5):
        receiver.module.mark(receiver.begin_ns)
        receiver.module.mark(receiver.begin_ns + 400 * NS_PER_MS)
        receiver.module.mark(receiver.begin_ns + 700 * NS_PER_MS)
        receiver.go(1, pulse=False, says=None)
    assert all(-0.05 <= error < 1.05 for error in receiver.error_ms(seconds=5))
    for pulse, says in ((False, 0), (True, None)):
        receiver = Receiver(still())
        receiver.go(8, pulse=pulse, says=says)
        assert receiver.frames[-1][1].system_time_ms < 10_000
