"""The sensor inside every simulated device follows the options, which arrive from the command line."""

import re
import struct
from argparse import ArgumentTypeError
from dataclasses import replace
from typing import Any
from zlib import crc32

import pytest

from imud.drivers.imu61x.uart.codec import HOST_SYNC, encode_frame, pack_parameters
from imud.formats.modbus import framed
from imud.model.units import NS_PER_S
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.control import make_parser, module_options, simulated
from imud.sim.hipnuc import canopen, j1939, modbus, uart_settings
from imud.sim.imu61x import uart
from imud.sim.physics import Noise, swing
from imud.sim.sensor import SensorHardware, SimulatorOptions, sensor_of
from imud.testing import simulator_tests

OPTIONS = SimulatorOptions(gravity_m_s2=9.7, noise="none", skew_ppm=-35.0, boot_ms=7, processing_ns=11)


def test_every_option_of_the_sensor_arrives() -> None:
    sensor = SensorHardware(**sensor_of(OPTIONS))
    assert (sensor.skew_ppm, sensor.boot_ms, sensor.processing_ns) == (-35.0, 7, 11)
    made = SensorHardware()
    assert (made.skew_ppm, made.boot_ms, made.processing_ns) == (20.0, 500, 125_000)
    assert sensor.noise is None
    assert sensor.reading(1.25) == swing(9.7).at(1.25)
    sensor = SensorHardware(**sensor_of(SimulatorOptions(seed=3)))
    assert sensor.reading(0.5) == Noise(3).add(swing().at(0.5), 0.5) != swing().at(0.5)
    with pytest.raises(ValueError, match="motion 'dance': expected"):
        sensor_of(SimulatorOptions(motion="dance"))


BEGIN_NS = 5 * NS_PER_S

# a Modbus device sends only replies
test_simulators = simulator_tests(
    *(SIMULATORS[name] for name in SIMULATORS if name != "hipnuc-modbus"), *CAN_SIMULATORS.values()
)


def register(number: int, value: int = 1, command: int = 6, size: int = 8) -> tuple[int, bool, bytes]:
    return 0x0CEF0855, True, struct.pack("<HBBI", number, command, 0, value)[:size]


def order(command: int, param1: float = 0.0, param3: int = 0) -> tuple[bytes]:
    return (encode_frame(HOST_SYNC, command, pack_parameters(param1, param3)),)


REQUESTS: dict[str, list[tuple[Any, ...]]] = {
    "hipnuc-uart": [
        (line.encode() + b"\r\n",)
        for line in (
            "LOG VERSION|CONFIG ATT MODE 1|CONFIG YAW 1 30|CONFIG YAW 2 30|CONFIG ATT RST 3|CONFIG ATT RST 2|"
            "CONFIG IMU URFR 0,1,0,-1,0,0,0,0,1|CONFIG PMUX4 DIV2|CONFIG PMUX5 X,-1,1,0,1|LOG HI92 ONTIME 0.5|"
            "LOG HI91 ONMARK 1|LOG HI91 ONMARK ONCE|UNLOGALL|LOG USRCONFIG|LOG COMCONFIG|LOG MAGCONFIG|LOG DISABLE|"
            "LOG ENABLE|SERIALCONFIG 460800|SERIALCONFIG 1|SAVECONFIG|REBOOT|CONFIG YAW 0 -20|CONFIG ATT RST 5|FRESET|"
            "LOG COMCONFIG|REBOOT|LOG COMCONFIG|" + "x" * 129
        ).split("|")
    ],
    "hipnuc-modbus": [
        (framed(int(row[:2], 16), bytes.fromhex(row[2:])),)
        for row in re.split(
            r"\|",
            "08 03 0004 0008|08 03 0034 001A|08 03 0034 0018|08 03 0070 0014|08 03 0034 007E|08 06 0006 0001|"
            "08 06 0004 0006|08 06 0000 0000|08 06 0005 0009|09 03 0005 0001|08 03 0005 0001|09 06 0000 0000|"
            "08 06 0000 0000|09 06 0000 00FF|09 03 0004 0003|08 06 00A5 0004|09 06 00A5 0005|09 06 0000 0001|"
            "50 03 0004 0003|00 06 0005 000A|0A 50 0031 0000 047D955F8D2A1701 000B|0B 03 0005 0001|0B 04 0000 0001|"
            "0B 03",
        )
    ],
    "hipnuc-canopen": [
        (int(row[:3], 16), False, bytes.fromhex(row[3:]))
        for row in re.split(
            r"\|",
            "608 40 18 10 01|608 40 18 10 01 00000000|608 40 18 10 07 00000000|608 2B 01 18 05 05000000|"
            "608 2F 02 18 02 01000000|080|608 2B 17 10 00 F4010000|000 80 08|000 02 08|000 01 08|"
            "608 23 A5 20 00 02000000|608 23 A5 20 00 05000000|608 23 9E 20 00 01000000|608 40 9E 20 00 00000000|"
            "608 23 00 20 00 00000000|608 23 A0 20 00 09000000|608 40 00 10 00 00000000|609 40 00 10 00 00000000|"
            "608 23 00 20 00 FF000000|608 40 A0 20 00 00000000|609 23 00 20 00 00000000|608 23 00 20 00 01000000|"
            "000 81 00|608 40 17 10 00 00000000",
        )
    ],
    "hipnuc-j1939": [
        *((0x18EA08FE, True, b"\0\xee\0"), register(0x78, 1, 3), register(0x78, 0, 3), register(0x71, 1, 3)),
        *(register(0x100 | pgn, value) for pgn, value in ((0x34, 400), (0x37, 1001), (0x3D, 1000), (0x4A, 4))),
        *(register(0x100, 1, 3), register(0x96, 0xFF34), register(0x9E), register(0x9F), register(0x9F, 2)),
        *(register(0xA5, 1), register(0xA5, 2), register(0xA5, 0), register(0x9A, 2), register(0x9A, 9)),
        *(register(0, 0), register(0x9C, 9), register(0x9C, 3, 3), register(0, 0xFF), register(0x9C, 1, 3)),
        *(register(0, 1), register(0, 0xFF), register(0x34, 1, 3), register(0, 2), register(0, 0, 6, 7),
          (0x0CEF0955, *register(0x134, 100)[1:]), register(0x134, 4), register(0x42, 1, 3)),
    ],
    "hipnuc-nmea2000": [(0x18EAFF01, True, b"\0\xee\0")],
    "imu61x-uart": [
        *(order(1), order(2), order(14, 50, 21), order(6, 0, 21), order(3, 100), order(1), order(3, 2), order(2)),
        *(order(4, 90), order(4, 361), order(2), order(14, 2, 27), order(14, 25, 30), order(14, 24, 30)),
        *(order(6, 0, 99), order(14, 255, 31), order(14, 256, 31), order(7), order(8), order(10), order(8)),
        *(order(6, 0, 11), order(5), order(14, 460800, 3), order(1), order(5), order(9), order(6, 0, 3)),
        *(order(3, 1), order(15), order(9), order(77)),
    ],
    "imu61x-can": [(0x65, False, b"")],
}  # fmt: skip
VARIANTS_OF: dict[str, Any] = {
    "hipnuc-uart": uart_settings.VARIANTS, "hipnuc-modbus": modbus.SLAVE_VARIANTS,
    "hipnuc-canopen": canopen.NODE_VARIANTS, "hipnuc-j1939": j1939.J1939_VARIANTS, "imu61x-uart": uart.VARIANTS,
}  # fmt: skip
REPLIES = {
    "hipnuc-uart": 0xF48E8C64, "hipnuc-modbus": 0xC5960473, "hipnuc-canopen": 0x2945F911, "hipnuc-j1939": 0xB2E17DA8,
    "hipnuc-nmea2000": 0x56276182, "imu61x-uart": 0x1D54A669, "imu61x-can": 0x1A1332E7,
}  # fmt: skip


@pytest.mark.parametrize("name", REQUESTS)
def test_each_variant_replies_as_before(name: str) -> None:
    simulator: Any = SIMULATORS[name] if name in SIMULATORS else CAN_SIMULATORS[name]
    found = {}
    for variant in VARIANTS_OF.get(name, [""]):
        message = {"hipnuc-modbus": "8", "hipnuc-j1939": "all"}.get(name, "")
        options = SimulatorOptions(1.0, message=message, variant=variant, firmware=169 if name[0] == "h" else 0, node=0)
        module, now_ns, log = simulator.make(options, BEGIN_NS), BEGIN_NS, list[object]()
        for number, request in enumerate(REQUESTS[name]):
            now_ns += 2_500_000_000 if number % 3 else 100_000_000
            log.append((module.next_ns(), getattr(module, "baud", 0), *module.advance(now_ns)))
            log.append((module.counters(), *(module.pins(now_ns) if name == "hipnuc-uart" else ())))
            module.receive(*request, now_ns)
            if number % 5 == 0:
                module.mark(now_ns + 1000)
        log += module.advance(now_ns + 200_000_000)
        module.reboot(now_ns + 500_000_000)
        log += module.advance(now_ns + 2_500_000_000)
        found[variant] = crc32(repr(log).encode())
    assert crc32(repr(found).encode()) == REPLIES[name], found


GIVEN = SimulatorOptions(
    rate_hz=50.0, baud=921600, message="HI92", motion="still", gravity_m_s2=9.7, noise="none", skew_ppm=-3.0,
    firmware=169, boot_ms=250, processing_ns=12_500, seed=5, node=9, at_once=True, variant="slow flash",
)  # fmt: skip
ARGUMENTS = (
    "--rate 50 --baud 921600 --message HI92 --motion still --gravity 9.7 --no-noise --skew-ppm -3 --firmware 169 "
    "--boot 0.25 --processing-us 12.5 --seed 5 --node 9 --at-once"
)


def test_options_arrive_in_their_units() -> None:
    options = make_parser().parse_args([*ARGUMENTS.split(), "--variant", "slow flash"])
    assert make_parser().parse_args(["--rest"]).motion == "still"
    assert module_options(options, 0) == GIVEN
    assert module_options(options, 12) == replace(GIVEN, node=12)
    assert module_options(make_parser().parse_args([]), 0) == SimulatorOptions()


@pytest.mark.parametrize("name", [*SIMULATORS, *CAN_SIMULATORS])
def test_a_device_is_a_name_with_or_without_a_node(name: str) -> None:
    assert simulated(name) == (name, 0)
    assert simulated(f"{name}:17") == (name, 17)
    for text in (f"{name}:x", f"{name}x", ":1", ""):
        with pytest.raises(ArgumentTypeError, match="expected one of"):
            simulated(text)
