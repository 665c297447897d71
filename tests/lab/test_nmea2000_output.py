"""The output `nmea2000` on a virtual interface: another output of imud, the address claim daemon of can-utils, a J1939
socket of the kernel, the packages `nmea2000` and `cantools`, and the driver `hipnuc-nmea2000` are its peers."""

import asyncio
import math
import socket
from collections.abc import Callable
from time import monotonic, monotonic_ns
from typing import Any

import can
import cantools
import msgspec
from nmea2000 import NMEA2000Decoder

from imud.contracts.publisher import Batch
from imud.drivers.hipnuc.nmea2000 import HipnucNmea2000Options
from imud.formats.can import CanFrame
from imud.formats.j1939 import split
from imud.model.sample import Sample, Sync
from imud.publishers.nmea2000 import Nmea2000Options
from imud.publishers.nmea2000.output import Nmea2000
from tests.lab.can_device import BusRig
from tests.lab.can_interface import CanInterface
from tests.lab.test_hipnuc_can import node, say
from tests.lab.tool import running
from tests.support.publisher_context import publisher_context

LIMIT_S = 60.0
# 0.1 rad/s about the axis that points up is a turn to port
TURN_RAD_S = -0.1 * math.cos(math.radians(10)) / math.cos(math.radians(5))
NAMES = (("Attitude", 127257), ("Turn", 127251), ("Heading", 127250))
# Fields as in the database of the project canboat: start bit, bits, sign, resolution. "Not available" has no scale.
DBC = """VERSION ""
BU_: imud
BO_ 2381388286 Attitude: 8 imud
 SG_ Yaw : 8|16@1- (1,0) [0|0] "" Vector__XXX
 SG_ Pitch : 24|16@1- (0.0001,0) [0|0] "rad" Vector__XXX
 SG_ Roll : 40|16@1- (0.0001,0) [0|0] "rad" Vector__XXX
BO_ 2314277886 Turn: 8 imud
 SG_ Rate : 8|32@1- (3.125e-08,0) [0|0] "rad/s" Vector__XXX
BO_ 2314277630 Heading: 8 imud
 SG_ Heading : 8|16@1+ (1,0) [0|0] "" Vector__XXX
 SG_ Reference : 56|2@1+ (1,0) [0|0] "" Vector__XXX
"""


class Sender:
    """An output with samples at 100 Hz: roll 10°, pitch 5°, without a heading."""

    def __init__(self, interface: str, **settings: Any) -> None:
        options = msgspec.convert({"interface": interface, **settings}, Nmea2000Options)
        self.output = Nmea2000(options, publisher_context(now_ns=monotonic_ns))
        self.output.start()
        self.output.add_device("bow", 0)
        self.seq = 0

    def step(self) -> None:
        now_ns = monotonic_ns()
        self.output.tick(now_ns)
        self.seq += 1
        euler = (math.radians(10), math.radians(5), 0.0)
        sample = Sample(
            "bow", self.seq, now_ns, 0, Sync.ARRIVAL, now_ns, now_ns, euler_rad=euler, gyro_rad_s=(0, 0, 0.1)
        )
        self.output.publish(Batch("bow", 0, [sample]))


async def until(senders: list[Sender], condition: Callable[[], object]) -> None:
    end = monotonic() + LIMIT_S
    while not condition():
        assert monotonic() < end, [sender.output.status() for sender in senders]
        for sender in senders:
            sender.step()
        await asyncio.sleep(0.01)


async def test_addresses_and_messages_on_a_real_bus(vcan: CanInterface) -> None:
    frames: list[CanFrame] = []
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW) as ear:
        ear.bind((vcan.name,))
        asyncio.get_running_loop().add_reader(ear, lambda: frames.append(heard(ear)))

        def addresses(pgn: int) -> set[int]:
            return {split(frame.can_id).source for frame in frames if split(frame.can_id).pgn == pgn}

        one, two = Sender(vcan.name, instance=1), Sender(vcan.name, instance=0)
        await until([one, two], lambda: addresses(127257) == {128, 129})
        assert {one.output.status()[0].problem, two.output.status()[0].problem} == {""}
        # The NAME 0 has the highest priority: the daemon of can-utils takes address 128.
        with running("j1939acd", "-a", "128", "-r", "128", "0000000000000001", vcan.name):
            frames.clear()
            await until([one, two], lambda: 130 in addresses(127257))
            frames.clear()
            await until([one, two], lambda: len(addresses(127257)) == 2)
            assert addresses(127257) == {129, 130}
        frames.clear()
        with node(vcan.name, 60) as peer:
            say(peer, vcan.name, 59904, (126996).to_bytes(3, "little"), 129)
            await until(
                [one, two],
                lambda: (
                    sum(split(frame.can_id).pgn == 126996 for frame in frames) == 20
                    and all(addresses(pgn) for pgn in (127250, 127251, 127257))
                ),
            )
        found = read(frames)
        assert found[126996]["modelId"] == "imud"
        dbc: Any = cantools.database.load_string(DBC)
        other = {split(one.can_id).pgn: one.data for one in frames}
        attitude, turn, heading = (dbc.decode_message(name, other[pgn]) for name, pgn in NAMES)
        for got, expected in (
            (found[127257]["roll"], math.radians(10)), (attitude["Roll"], math.radians(10)),
            (found[127257]["pitch"], math.radians(5)), (attitude["Pitch"], math.radians(5)),
            (found[127251]["rate"], TURN_RAD_S), (turn["Rate"], TURN_RAD_S),
        ):  # fmt: skip
            assert math.isclose(got, expected, abs_tol=1e-4)
        assert (attitude["Yaw"], heading["Heading"], heading["Reference"]) == (32767, 65535, 3)
        rig = BusRig(vcan.name, "hipnuc-nmea2000", HipnucNmea2000Options(source=129))
        async with rig.played(waits=False):
            await until([one, two], lambda: len(rig.samples) > 3)
        vcan.down()
        await until([one, two], lambda: "vcan0 is down" in one.output.status()[0].problem)
        vcan.up()
        frames.clear()
        await until([one, two], lambda: len(addresses(60928)) == 2)
        asyncio.get_running_loop().remove_reader(ear)
        one.output.close()
        two.output.close()


def heard(ear: socket.socket) -> CanFrame:
    raw = ear.recv(16)
    can_id = int.from_bytes(raw[:4], "little") & 0x1FFF_FFFF
    return CanFrame(can_id, True, raw[8 : 8 + raw[4]], 0)


def read(frames: list[CanFrame]) -> dict[int, dict[str, Any]]:
    decoder, found = NMEA2000Decoder(), {}
    for frame in frames:
        one = decoder.decode(can.Message(arbitration_id=frame.can_id, is_extended_id=True, data=frame.data))
        if one is not None:
            found[one.PGN] = {field.id: field.value for field in one.fields}
    return found
