"""A simulated device behind a real pseudo-terminal, stepped by the test: no clock, no waiting.
The wire of a UART: duration of bursts, and bytes at ends with different rates."""

import fcntl
import io
import os
import termios
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest

from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings, Output
from imud.sim.ports.arrival import BARE_UART, USB_16MS, ArrivalProfile
from imud.sim.ports.faults import FaultRates, Faults
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort, set_baud
from imud.sim.ports.uart_wire import Transmitter, heard

BEGIN_NS = 77 * NS_PER_S
QUICK = HipnucHardware(skew_ppm=0, boot_ms=0)


class PluggedPort:
    """A port, a program that can open it, and the time."""

    def __init__(
        self, path: Path, *, settings: ModuleSettings | None = None, profile: ArrivalProfile = BARE_UART,
        faults: Faults | None = None,
    ) -> None:  # fmt: skip
        self.now_ns = BEGIN_NS
        self.path = path
        self.truth = io.StringIO()
        self.module = HipnucModule(BEGIN_NS, settings, QUICK)
        self.port = SimulatedPort(self.module, PtyNode(path), Adapter(profile, BEGIN_NS), faults, self.truth)
        self.fd = -1

    def open(self, baud: int | None = None) -> None:
        self.fd = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        if baud:
            set_baud(self.fd, baud)

    def close(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1

    def run(self, duration_ms: float) -> bytes:
        """Let time pass from deadline to deadline. Return the data that the program has read."""
        end_ns, got = self.now_ns + round(duration_ms * NS_PER_MS), b""
        while self.now_ns < end_ns:
            self.now_ns = min(self.port.next_ns(self.now_ns), end_ns)
            self.port.step(self.now_ns)
            got += self.read()
        return got

    def read(self) -> bytes:
        try:
            return os.read(self.fd, 65536) if self.fd >= 0 else b""
        except OSError:  # no data, or the other end is closed
            return b""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[PluggedPort]:
    rig = PluggedPort(tmp_path / "tty")
    yield rig
    rig.close()
    rig.port.close()


def frames_of(data: bytes) -> int:
    ledger = Ledger()
    codec = DRIVER.make_codec(ledger, DRIVER.settings())
    return sum(isinstance(event, Measurement) for event in (*codec.feed(data), *codec.flush()))


def test_a_program_reads_frames_and_gets_answers(rig: PluggedPort) -> None:
    rig.open(115_200)
    fcntl.ioctl(rig.fd, termios.TIOCEXCL)  # an exclusive program also gets the frames
    fcntl.flock(rig.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert frames_of(rig.run(1000)) == pytest.approx(99, abs=1)
    os.write(rig.fd, b"LOG DISABLE\r\nLOG VERSION\r\n")
    text = rig.run(50)
    assert text.endswith(b"BL_VER=109\r\nOK\r\n")
    assert b"OK\r\nPNAME=HI14R3\r\n" in text
    assert rig.run(100) == b""


def test_the_terminal_is_raw_and_does_not_echo_frames_into_the_module(rig: PluggedPort) -> None:
    rig.open()
    flags = termios.tcgetattr(rig.fd)
    assert not flags[3] & (termios.ECHO | termios.ICANON)
    rig.run(200)
    assert rig.port.node.read() == b""
    for baud in DRIVER.baud_rates:
        set_baud(rig.fd, baud)
        assert rig.port.node.baud == baud


def test_the_wrong_rate_is_garbage_both_ways(rig: PluggedPort) -> None:
    rig.open(460_800)
    garbage = rig.run(500)
    assert len(garbage) > 1000
    assert frames_of(garbage) == 0
    os.write(rig.fd, b"LOG DISABLE\r\n")
    rig.run(50)
    assert rig.port.summary()["bursts_wrong_baud"] > 40
    set_baud(rig.fd, 115_200)
    assert frames_of(rig.run(200)) == pytest.approx(20, abs=1)  # the device did not receive the command


def test_baud_follows_save_and_reboot(rig: PluggedPort) -> None:
    rig.open(115_200)
    os.write(rig.fd, b"SERIALCONFIG 921600\r\nSAVECONFIG\r\nREBOOT\r\n")
    rig.run(50)
    assert frames_of(rig.run(200)) == 0
    set_baud(rig.fd, 921_600)
    assert frames_of(rig.run(200)) >= 19


def test_with_no_reader_bytes_are_lost_and_counted(rig: PluggedPort) -> None:
    assert rig.run(1000) == b""
    counted = rig.port.summary()
    assert counted["bytes_written"] == 0
    assert counted["bytes_unheard"] == pytest.approx(99 * 82, abs=82)
    rig.open(115_200)
    assert frames_of(rig.run(100)) == pytest.approx(10, abs=1)  # no frames from before
    rig.close()
    before = rig.port.summary()["bytes_written"]
    rig.run(100)
    assert rig.port.summary()["bytes_written"] == before


def test_a_command_of_a_program_that_left_is_obeyed_and_a_silent_module_notices_the_next_program(
    rig: PluggedPort,
) -> None:
    rig.open(115_200)
    os.write(rig.fd, b"LOG DISABLE\r\n")
    rig.close()
    rig.run(50)
    rig.open()
    assert rig.run(100) == b""
    rig.close()
    rig.module.receive(b"UNLOGALL\r\n", rig.now_ns)
    rig.run(50)
    assert rig.module.next_ns() is None
    assert rig.port.next_ns(rig.now_ns) == rig.now_ns + 20 * NS_PER_MS
    rig.open()
    assert rig.port.next_ns(rig.now_ns) == rig.now_ns + NS_PER_S  # select reports its bytes after this step


def test_unplugging_takes_the_node_away_and_brings_it_back(rig: PluggedPort) -> None:
    rig.open(115_200)
    rig.run(700)
    assert rig.path.is_symlink()
    rig.port.unplug(rig.now_ns, 300 * NS_PER_MS)
    assert not rig.path.is_symlink()
    rig.path.with_name(f".{rig.path.name}.{os.getpid()}").symlink_to("left by a killed process with this number")
    with pytest.raises(OSError, match="Input/output error"):
        os.write(rig.fd, b"anybody there?")
    rig.run(299)
    assert not rig.path.is_symlink()
    rig.run(2)
    assert rig.path.is_symlink()
    rig.close()
    rig.open(115_200)
    codec = DRIVER.make_codec(Ledger(), DRIVER.settings())
    (measurement, *_) = [event for event in codec.feed(rig.run(50)) if isinstance(event, Measurement)]
    assert measurement.dev_ticks is not None
    assert measurement.dev_ticks < 100  # the device has restarted
    counted = rig.port.summary()
    assert counted["unplugs"] == 1
    assert counted["bytes_written"] + counted["bytes_unheard"] == pytest.approx(counted["frames_sent"] * 82, abs=3 * 82)


def test_adapters_with_a_timer_and_a_reader_that_stops(tmp_path: Path) -> None:
    rig = PluggedPort(tmp_path / "tty", settings=ModuleSettings(baud=921_600, hi91=Output(1)), profile=USB_16MS)
    rig.open(921_600)
    rig.run(500)
    rows = [tuple(map(int, line.split(","))) for line in rig.truth.getvalue().splitlines()[2:]]
    written = [row[2] for row in rows]
    steps = {after - before for before, after in pairwise(written) if after > before}
    assert len(set(written)) == pytest.approx(500 / 16, abs=2)
    assert steps == {round(16 * NS_PER_MS / (1 - 30e-6))}
    assert all(0 < row[2] - row[0] <= 17.1 * NS_PER_MS for row in rows)
    rig.close()
    rig.port.close()
    rig = PluggedPort(tmp_path / "tty", settings=ModuleSettings(baud=921_600, hi91=Output(1)), profile=USB_16MS)
    rig.open(921_600)
    rig.run(16 * 3 + 10)
    rig.port.step(rig.now_ns)
    rig.port.unplug(rig.now_ns, NS_PER_S)
    assert rig.port.summary()["bytes_unheard"] == pytest.approx(10 * 82, abs=82)
    rig.close()
    rig.port.close()
    rig = PluggedPort(tmp_path / "tty", settings=ModuleSettings(baud=921_600, hi91=Output(1)))
    rig.open(921_600)
    rig.read = lambda: b""  # type: ignore[method-assign]  # a program that never reads
    rig.run(2000)
    counted = rig.port.summary()
    assert counted["bytes_lost_full"] > 50_000
    total = counted["bytes_lost_full"] + counted["bytes_written"] + counted["bytes_unheard"]
    assert total == pytest.approx(2000 * 82, abs=5 * 82)
    rig.close()
    rig.port.close()


def test_the_truth_log_tells_when_each_frame_was_measured(rig: PluggedPort) -> None:
    rig.open(115_200)
    rig.run(300)
    head, names, *rows = rig.truth.getvalue().splitlines()
    assert head == f"# epoch_ns={BEGIN_NS}"
    assert names == "sample_ns,device_ms,written_ns"
    for row in rows:
        sample_ns, device_ms, written_ns = map(int, row.split(","))
        assert sample_ns == BEGIN_NS + device_ms * NS_PER_MS
        assert written_ns == sample_ns + 125_000 + 82 * 10 * NS_PER_S // 115_200
    assert len(rows) == pytest.approx(29, abs=1)


def test_faults_of_the_line_and_of_the_cable(tmp_path: Path) -> None:
    faults = Faults(4, FaultRates(flip=0.2))
    rig = PluggedPort(tmp_path / "tty", faults=faults)
    rig.open(115_200)
    ledger = Ledger()
    codec = DRIVER.make_codec(ledger, DRIVER.settings())
    codec.feed(rig.run(2000))
    codec.flush()
    assert ledger.frames_in_samples == faults.bursts - len({fault.burst for fault in faults.log})
    assert rig.port.summary()["fault_flip"] == len(faults.log) > 20
    rig.close()
    rig.port.close()
    rig = PluggedPort(tmp_path / "tty", faults=Faults(1, FaultRates(flip=0.5)))
    rig.run(100)
    assert rig.port.summary()["fault_flip"] > 0
    rig.port.unplug(rig.now_ns, NS_PER_S)
    before = rig.port.summary()["fault_flip"]
    rig.run(900)
    assert rig.port.summary()["fault_flip"] == before
    rig.port.close()
    faults = Faults(4, FaultRates(unplug=0.05, unplug_ns=100 * NS_PER_MS))
    rig, seen = PluggedPort(tmp_path / "tty", faults=faults), set()
    for _ in range(200):
        rig.run(10)
        seen.add(rig.path.is_symlink())
    assert seen == {True, False}
    assert rig.port.summary()["unplugs"] == rig.port.summary()["fault_unplug"] > 1
    rig.port.close()


def test_closing_twice_is_allowed_and_leaves_nothing(tmp_path: Path) -> None:
    before, rig = set(os.listdir("/proc/self/fd")), PluggedPort(tmp_path / "tty")
    rig.run(20)
    rig.port.close()
    rig.port.close()
    assert list(tmp_path.iterdir()) == []
    assert not PtyNode(tmp_path / "tty").is_open
    assert set(os.listdir("/proc/self/fd")) == before


BYTE_NS = 10_000_000  # 1000 baud: 10 bits of 1 ms
DATA = bytes(range(256)) * 2
RATES = DRIVER.baud_rates


def test_what_ends_at_equal_near_and_other_rates_hear_and_garbage_by_hand() -> None:
    for baud in RATES:
        assert heard(DATA, baud, baud) == heard(DATA, baud, round(baud * 1.02)) == DATA
    assert heard(DATA, 104_000, 100_000) == DATA  # a difference of 4 % is within half a bit at bit 10
    assert heard(DATA, 100_000, 104_000) == DATA
    assert heard(DATA, 115_200, 100_000) != DATA
    assert heard(DATA, 115_200, 0) == b""
    assert heard(DATA, 0, 115_200) == b""
    assert heard(b"", 9600, 115_200) == b""
    assert len(heard(DATA, 921_600, 9600)) < len(DATA) / 20
    assert len(heard(DATA, 9600, 115_200)) > len(DATA)
    for data, sent, listening, expected in (
        (b"\xff", 100, 200, b"\xfe"),  # two half bits: a start bit, then ones
        (b"\x00", 100, 200, b"\x00"),  # nine zeros become eighteen: a break, then the UART waits for idle
        (b"\x55", 100, 200, b"\x66\xe6"),  # every bit twice; stop bit wrong at 9, idle at 10, next start at 12
        (b"\xff", 400, 100, b""),  # the start bit is shorter than half a bit: a glitch
    ):
        assert heard(data, sent, listening) == expected


@pytest.mark.parametrize("sent", [9600, 115_200, 921_600])
@pytest.mark.parametrize("listening", RATES)
def test_no_frame_survives_a_wrong_rate(sent: int, listening: int) -> None:
    random, ledger = Random(f"{sent} {listening}"), Ledger()
    codec = DRIVER.make_codec(ledger, DRIVER.settings())
    events = [
        event
        for _ in range(10)
        for event in codec.feed(heard(DRIVER.example_frame(random), sent, listening))
        if isinstance(event, Measurement)
    ]
    assert bool(events) == (sent == listening)


def transmitter() -> Transmitter:
    return Transmitter(1000, 20, free_ns=1000)


def test_wire_time_buffer_and_power_loss() -> None:
    wire = transmitter()
    wire.send(0, b"abc")
    wire.send(5, b"de", sample_ns=4, device_ms=1)
    assert wire.next_ns() == 1000 + 3 * BYTE_NS
    assert wire.sent(1000 + 3 * BYTE_NS - 1) == []
    assert [burst.data for burst in wire.sent(1000 + 3 * BYTE_NS)] == [b"abc"]
    assert wire.sent(10**12) == [(1000 + 5 * BYTE_NS, b"de", 4, 1)]
    assert wire.next_ns() is None
    wire = transmitter()
    assert wire.due_ns(10**9, 2) == 10**9 + 2 * BYTE_NS
    wire = transmitter()
    wire.send(1000, bytes(15))
    assert wire.fits(1000, 5)
    assert not wire.fits(1000, 6)
    assert wire.fits(1000 + BYTE_NS, 6)
    wire = transmitter()
    for data in (b"whole", b"broken", b"never"):
        wire.send(1000, data)
    through = wire.stopped(1000 + 5 * BYTE_NS + 2 * BYTE_NS + BYTE_NS // 2)
    assert [burst.data for burst in through] == [b"whole", b"br"]
    assert wire.sent(10**12) == []
    wire = transmitter()
    wire.send(1000, b"never")
    assert wire.stopped(500) == []
