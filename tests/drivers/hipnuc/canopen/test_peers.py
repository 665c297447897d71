"""The library canopen on python-can's virtual bus: its client with the simulated device, and its LocalNode as the
device for the codec and the scripts. A wait ends with its event; the limit applies only to a failure.
"""

import math
import struct
import threading
from collections.abc import Iterator
from time import monotonic, monotonic_ns

import can
import canopen
import pytest
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

from imud.contracts.codec import CodecEvent, message_of
from imud.contracts.command import Target
from imud.contracts.script import Outcome, Reply, ReplyFrame, Request
from imud.contracts.setting import combined
from imud.drivers.hipnuc.canopen import cia301
from imud.drivers.hipnuc.canopen import commands as session
from imud.drivers.hipnuc.canopen.cia301 import NmtCommand
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenCodec, HipnucCanopenOptions
from imud.drivers.hipnuc.canopen.commands import Transmission
from imud.drivers.hipnuc.canopen.driver import SETTINGS
from imud.model.errors import NoReply
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.hipnuc.canopen import HipnucCanopenHardware, HipnucCanopenModule, NodeSettings
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.script_runners import offline_runner
from tests.support.simulated_modules import run_script, unpack

pytestmark = pytest.mark.live

NODE = 8
ACCEL, GYRO = 0x2100, 0x2101
"""Objects of their node that the TPDOs contain."""
QUIET = dict.fromkeys((1, 2, 3, 4, 6, 7), 0)


def dictionary() -> canopen.ObjectDictionary:
    od = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]  # the library has it so
    od.bitrate = 500_000
    for index, name, kind in (
        (0x1000, "device type", datatypes.UNSIGNED32), (0x1008, "device name", datatypes.VISIBLE_STRING),
        (0x1017, "heartbeat time", datatypes.UNSIGNED16), (0x2000, "control", datatypes.UNSIGNED32),
        (0x209A, "bit rate", datatypes.UNSIGNED32), (0x209E, "sign x", datatypes.UNSIGNED32),
        (0x209F, "sign y", datatypes.UNSIGNED32), (0x20A0, "node", datatypes.UNSIGNED32),
        (0x20A5, "zero", datatypes.UNSIGNED32),
    ):  # fmt: skip
        od.add_object(variable(name, index, 0, kind))
    identity = ODRecord("identity", 0x1018)
    for sub in range(1, 5):
        identity.add_member(variable(f"identity {sub}", 0x1018, sub, datatypes.UNSIGNED32))
    od.add_object(identity)
    for place in range(6):
        record = ODRecord(f"TPDO communication {place}", 0x1800 + place)
        for sub, kind in ((1, datatypes.UNSIGNED32), (2, datatypes.UNSIGNED8), (5, datatypes.UNSIGNED16)):
            record.add_member(variable(f"parameter {sub}", 0x1800 + place, sub, kind))
        od.add_object(record)
        mapping = ODRecord(f"TPDO mapping {place}", 0x1A00 + place)
        for sub in range(4):
            mapping.add_member(variable(f"mapped {sub}", 0x1A00 + place, sub, datatypes.UNSIGNED32))
        od.add_object(mapping)
    for index, name in ((ACCEL, "acceleration"), (GYRO, "angular rate")):
        vector = ODRecord(name, index)
        for sub in range(1, 4):
            vector.add_member(variable(f"axis {sub}", index, sub, datatypes.INTEGER16))
        od.add_object(vector)
    return od


def variable(name: str, index: int, sub: int, kind: int) -> ODVariable:
    made = ODVariable(name, index, sub)
    made.data_type = kind
    made.access_type = "rw"
    return made


@pytest.fixture
def network(request: pytest.FixtureRequest) -> Iterator[canopen.Network]:
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.02  # maximum time of its thread after the test
    network.connect(interface="virtual", channel=request.node.name)
    yield network
    network.disconnect()


class Pump(threading.Thread):
    """The simulated device on a bus, in real time."""

    def __init__(self, channel: str, factory: NodeSettings) -> None:
        super().__init__()
        self.bus = can.Bus(channel, interface="virtual")
        self.module = HipnucCanopenModule(monotonic_ns(), HipnucCanopenHardware(factory=factory, boot_ms=0))
        self.done = threading.Event()

    def run(self) -> None:
        while not self.done.is_set():
            message = self.bus.recv(0.002)
            if message is not None:
                self.module.receive(message.arbitration_id, False, bytes(message.data), monotonic_ns())
            for frame in self.module.advance(monotonic_ns()):
                self.bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))
        self.bus.shutdown()


@pytest.fixture
def pump(request: pytest.FixtureRequest) -> Iterator[Pump]:
    pump = Pump(request.node.name, NodeSettings(periods_ms=QUIET))
    pump.start()
    yield pump
    pump.done.set()
    pump.join()


@pytest.fixture
def remote(network: canopen.Network, pump: Pump) -> canopen.RemoteNode:
    node = network.add_node(NODE, dictionary())
    node.sdo.RESPONSE_TIMEOUT = LIMIT_S
    assert pump.is_alive()
    return node


def test_their_client_reads_and_writes_our_objects(remote: canopen.RemoteNode, pump: Pump) -> None:
    assert (remote.sdo[0x1008].raw, remote.sdo[0x1018][4].raw) == ("HI14", 0x1708_0042)
    assert remote.sdo[0x1805][1].raw == 0x788
    remote.sdo[0x1804][5].raw = 100
    assert remote.sdo[0x1804][5].raw == 100
    remote.sdo[0x20A0].raw = 30
    remote.sdo[0x2000].raw = 0
    remote.sdo[0x2000].raw = 0xFF
    wait_until(lambda: pump.module.node == 30, "the node is 30")


def test_their_client_understands_our_abort_codes(remote: canopen.RemoteNode) -> None:
    with pytest.raises(canopen.SdoAbortedError) as caught:
        remote.sdo.download(0x1800, 5, b"\4\0")
    assert caught.value.code == 0x0609_0030
    with pytest.raises(canopen.SdoAbortedError) as caught:
        remote.sdo.upload(0x3000, 0)
    assert caught.value.code == 0x0602_0000


def test_their_client_manages_our_node(remote: canopen.RemoteNode) -> None:
    remote.sdo[0x1017].raw = 20
    remote.nmt.wait_for_heartbeat(LIMIT_S)
    for state in ("PRE-OPERATIONAL", "OPERATIONAL", "STOPPED"):
        remote.nmt.state = state
        remote.nmt.wait_for_heartbeat(LIMIT_S)
        remote.nmt.wait_for_heartbeat(LIMIT_S)
        assert remote.nmt.state == state
    remote.nmt.send_command(0x81)
    remote.nmt.wait_for_bootup(LIMIT_S)


def test_their_client_hears_our_tpdos(remote: canopen.RemoteNode, network: canopen.Network) -> None:
    accel = remote.tpdo[1]
    accel.cob_id = 0x180 + NODE
    for sub in range(1, 4):
        accel.add_variable(0x2100, sub)
    accel.enabled = True
    accel.subscribe()
    remote.sdo[0x1800][2].raw = 1
    network.sync.transmit()
    assert accel.wait_for_reception(LIMIT_S) is not None
    assert 500 < accel[2].raw < 1500  # mG, upright within the range of the motion
    got = threading.Event()
    network.subscribe(0x788, lambda can_id, data, timestamp: got.set())
    remote.sdo[0x1805][5].raw = 10
    assert got.wait(LIMIT_S)


class Host:
    """Codec and script runner on a bus, blocking."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(channel, interface="virtual")
        self.codec = HipnucCanopenCodec(Ledger(), HipnucCanopenOptions(node=NODE))
        self.session = offline_runner(self.codec.ledger)
        self.periods = 0
        self.limit_s = LIMIT_S  # real time limit of a request: their node runs in a thread

    def events(self, timeout_s: float) -> list[CodecEvent]:
        message = self.bus.recv(timeout_s)
        if message is None:
            return []
        extended, data = message.is_extended_id, bytes(message.data)
        self.periods += message.arbitration_id == 0x180 + NODE
        # fixed times, independent of the load of the host: TPDO1 starts each period
        t_ns = self.periods * 10_000_000 + (message.arbitration_id != 0x180 + NODE) * 250_000
        return list(self.codec.feed_frame(message.arbitration_id, extended, data, t_ns))

    def ask(self, request: Request) -> Outcome:
        payload = self.session.start(request, 0)
        if payload:
            can_id, data = unpack(payload)
            self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        if request.silent:
            return Reply(())
        limit_s = monotonic() + self.limit_s
        while monotonic() < limit_s:
            for event in self.events(0.05):
                message = message_of(event)
                outcome = self.session.on_message(message, 0) if message is not None else None
                if outcome is not None:
                    return outcome
        silence = self.session.on_time(request.timeout_ns)
        assert silence is not None
        return silence


@pytest.fixture
def host(request: pytest.FixtureRequest) -> Iterator[Host]:
    host = Host(request.node.name)
    yield host
    assert host.codec.ledger.closes()
    host.bus.shutdown()


@pytest.fixture
def local(network: canopen.Network) -> canopen.LocalNode:
    node = network.create_node(NODE, dictionary())
    node.set_data(0x1000, 0, struct.pack("<I", 0x0002_0194))
    node.set_data(0x1008, 0, b"HI14")
    for sub in range(1, 5):
        node.set_data(0x1018, sub, struct.pack("<I", 0x10 + sub))
    for place in range(6):
        node.set_data(0x1800 + place, 2, b"\xff")
        node.set_data(0x1800 + place, 5, struct.pack("<H", 10))
    return node


def test_our_conversations_with_their_node(local: canopen.LocalNode, host: Host) -> None:
    identity = run_script(session.identify(NODE), host.ask)
    assert (identity.product, identity.serial_number) == ("HI14", "0x00000014")
    assert identity.details is not None
    assert identity.details["device type"] == "0x00020194"
    run_script(session.set_tpdo_period(NODE, 6, 50), host.ask)
    assert local.get_data(0x1804, 5) == b"\x32\x00"
    run_script(session.set_tpdo_type(NODE, 2, Transmission.SYNC), host.ask)
    assert local.get_data(0x1801, 2) == b"\x01"
    run_script(session.set_bit_rate(NODE, 250_000), host.ask)
    assert local.get_data(0x209A, 0) == b"\x03\0\0\0"
    run_script(session.save(NODE), host.ask)
    settings = combined(run_script(SETTINGS.read(Target(HipnucCanopenOptions(node=NODE), 0), None), host.ask)).words
    assert (settings["1804.5"], settings["1801.2"], settings["209A.0"]) == ("50", "1", "3")
    assert "20A0.0" not in settings  # never written there: no data available

    assert local.id == NODE
    with pytest.raises(cia301.Aborted, match="object does not exist"):
        run_script(cia301.read_object(NODE, 0x3000, 0), host.ask)
    with pytest.raises(cia301.Aborted, match="sub-index does not exist"):
        run_script(cia301.read_object(NODE, 0x1800, 9), host.ask)
    host.limit_s = 0
    with pytest.raises(NoReply):
        run_script(session.identify(NODE + 1), host.ask)
    host.limit_s = LIMIT_S

    local.set_data(0x1008, 0, b"a name of many letters")
    identity = run_script(session.identify(NODE), host.ask)
    assert (identity.product, identity.serial_number) == ("", "0x00000014")


def test_their_node_executes_our_nmt_and_sends_its_heartbeat(local: canopen.LocalNode, host: Host) -> None:
    local.nmt.state = "RESET"
    assert host.events(LIMIT_S) == [ReplyFrame(0x708, b"\0")]
    run_script(session.nmt(NODE, NmtCommand.START), host.ask)
    wait_until(lambda: local.nmt.state == "OPERATIONAL", "the state")
    run_script(session.nmt(NODE, NmtCommand.PRE_OPERATIONAL), host.ask)
    wait_until(lambda: local.nmt.state == "PRE-OPERATIONAL", "the state")
    run_script(cia301.write_object(NODE, 0x1017, 0, 50, 2), host.ask)
    identity = run_script(session.identify(NODE), host.ask)
    local.nmt.stop_heartbeat()  # type: ignore[no-untyped-call]  # the library has it so
    assert identity.details is not None
    assert identity.details["NMT state"] == "pre-operational"


def test_their_tpdos_are_our_samples(network: canopen.Network, local: canopen.LocalNode, host: Host) -> None:
    """python-canopen maps, packs and sends two TPDOs per period. All frames are on the bus before the first read."""
    for number, index in ((1, ACCEL), (2, GYRO)):
        tpdo = local.tpdo[number]
        tpdo.cob_id = 0x080 + 0x100 * number + NODE
        for sub in range(1, 4):
            tpdo.add_variable(index, sub)
    counts = [(100 * n, -200, 1000 - n) for n in range(12)]
    for mg in counts:
        for number in (1, 2):
            for place, value in enumerate(mg):
                local.tpdo[number][place].raw = value
            local.tpdo[number].transmit()
    measured: list[Measurement] = []
    for _ in range(2 * len(counts)):
        measured += [event for event in host.events(LIMIT_S) if isinstance(event, Measurement)]
    assert network is local.network
    assert (host.codec.ledger.frames_good, len(measured)) == (2 * len(counts), len(counts))
    for sample, mg in zip(measured[::-1], counts[::-1], strict=False):
        assert sample.accel_m_s2 == pytest.approx([value * 0.0098 for value in mg])
        assert sample.gyro_rad_s == pytest.approx([math.radians(value * 0.1) for value in mg])
