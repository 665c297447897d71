"""The simulated boot loaders with the vendor's host tools as independent peers.

Set IMUD_HIPNUC_SDK to a copy of the vendor's public SDK. The tests compile its C files outside the repository.
"""

import ctypes
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from time import monotonic_ns

import pytest
from intelhex import IntelHex

from imud.formats.can import frame_bits
from imud.sim.hipnuc.boot_loader import APPLICATION, make_image
from imud.sim.hipnuc.canopen import HipnucCanopenHardware, HipnucCanopenModule
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.ports.arrival import BARE_UART
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort

NODE, NEW = 8, 170


@pytest.fixture
def sdk() -> Path:
    path = os.environ.get("IMUD_HIPNUC_SDK", "")
    if not path:
        pytest.skip("IMUD_HIPNUC_SDK is not set: the vendor's SDK is not a part of the repository")
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    return Path(path)


class Frame(ctypes.Structure):
    """`hipnuc_can_frame_t`."""

    _fields_ = (
        ("can_id", ctypes.c_uint32), ("dlc", ctypes.c_uint8), ("data", ctypes.c_uint8 * 64), ("t_us", ctypes.c_uint64),
    )  # fmt: skip


SEND = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(Frame))
WAIT = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_uint32, ctypes.POINTER(Frame), ctypes.c_uint32)
DELAY = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32)
PROGRESS = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint8, ctypes.c_uint8)
LOG = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint8, ctypes.c_char_p)


class Port(ctypes.Structure):
    """`can_update_port_t`."""

    _fields_ = (
        ("send", SEND), ("wait", WAIT), ("delay", DELAY), ("progress", PROGRESS), ("log", LOG),
        ("user", ctypes.c_void_p),
    )  # fmt: skip


class SimulatedBus:
    """A node in simulated time, with the callbacks of the vendor's library."""

    def __init__(self, lost: int = 0) -> None:
        """`lost`: number of the reply that does not arrive; 0: every reply arrives."""
        self.now_ns = 1_000_000_000
        self.module = HipnucCanopenModule(0, HipnucCanopenHardware(boot_ms=0))
        self.said: list[str] = []
        self.progress: list[int] = []
        self._lost = lost
        self._waits = 0
        self.port = Port(
            SEND(self._send), WAIT(self._wait), DELAY(self._delay), PROGRESS(self._note), LOG(self._log), None
        )

    def _send(self, _user: object, frame: "ctypes._Pointer[Frame]") -> int:
        one = frame.contents
        self.module.receive(one.can_id, False, bytes(one.data[: one.dlc]), self.now_ns)
        return 0

    def _wait(self, _user: object, can_id: int, frame: "ctypes._Pointer[Frame]", timeout_ms: int) -> int:
        self._waits += 1
        end_ns = self.now_ns + timeout_ms * 1_000_000
        while self.now_ns < end_ns:
            self.now_ns += frame_bits(False, 8) * 2_000
            for sent in self.module.advance(self.now_ns):
                if sent.can_id == can_id and self._waits != self._lost:
                    frame.contents.can_id, frame.contents.dlc = sent.can_id, len(sent.data)
                    ctypes.memmove(frame.contents.data, sent.data, len(sent.data))
                    return 0
        return -1

    def _delay(self, _user: object, duration_ms: int) -> None:
        self.now_ns += duration_ms * 1_000_000

    def _note(self, _user: object, _node: int, percent: int) -> None:
        self.progress.append(percent)

    def _log(self, _user: object, _node: int, text: bytes) -> None:
        self.said.append(text.decode())


@pytest.fixture
def library(sdk: Path, tmp_path: Path) -> ctypes.CDLL:
    made, source = tmp_path / "update.so", sdk / "drivers/hipnuc_can_update.c"
    subprocess.run(["cc", "-shared", "-fPIC", f"-I{sdk}/drivers", "-o", made, source], check=True)
    return ctypes.CDLL(str(made))


def run_on_can(library: ctypes.CDLL, bus: SimulatedBus, image: bytes) -> int:
    context = ctypes.create_string_buffer(1024)
    library.can_update_init(context, ctypes.byref(bus.port))
    status: int = library.can_update_update_node(context, NODE, image, len(image))
    return status


@pytest.mark.parametrize("lost", [0, 4])
def test_vendor_library_updates_the_simulated_node(library: ctypes.CDLL, lost: int) -> None:
    bus, image = SimulatedBus(lost), make_image("HI14", NEW, 2000)
    status = run_on_can(library, bus, image)
    print(bus.said, bus.progress[-1:])
    if lost:  # the tool does not repeat a segment: it ends with CAN_UPDATE_ERR_TIMEOUT
        assert (status, bus.module.memory.application("HI14")) == (-3, None)
        status = run_on_can(library, bus, image)
    bus.module.advance(bus.now_ns)
    assert status == 0
    assert bus.progress[-1] == 100
    assert bytes(bus.module.memory.data) == image
    assert (bus.module.loader, bus.module.objects.revision) == (None, NEW)


@pytest.fixture
def simulated_port(tmp_path: Path) -> Iterator[SimulatedPort]:
    now_ns = monotonic_ns()
    port = SimulatedPort(HipnucModule(now_ns), PtyNode(tmp_path / "tty"), Adapter(BARE_UART, now_ns))
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            port.step(monotonic_ns())
            ended.wait(0.0005)

    thread = threading.Thread(target=serve)
    thread.start()
    yield port
    ended.set()
    thread.join()
    port.close()


@pytest.mark.live
def test_vendor_tool_updates_the_simulated_device(sdk: Path, tmp_path: Path, simulated_port: SimulatedPort) -> None:
    source, tool = sdk / "examples/C", tmp_path / "hihost"
    folders = (source, source / "commands", source / "fw_downloader", sdk / "drivers")
    unused = {"hipnuc_can_common.c", "hipnuc_can_update.c", "canopen_parser.c", "hipnuc_j1939_parser.c"}
    files = [file for folder in folders for file in folder.glob("*.c") if file.name not in unused]
    includes = [f"-I{one}" for one in (source, source / "fw_downloader", sdk / "drivers")]
    define = f'-DHIHOST_SOURCE_DIR="{source}"'
    command = ["cc", "-std=gnu99", "-w", define, *includes, "-o", str(tool), *map(str, files), "-lm"]
    subprocess.run(command, check=True)
    image = make_image("HI14R3", NEW, 20_000)
    hexadecimal = IntelHex()
    hexadecimal.frombytes(image, APPLICATION)
    hexadecimal.write_hex_file(str(tmp_path / "new.hex"))
    port = str(simulated_port.node.path.resolve())  # the tool cuts a longer name
    asked = [str(tool), "-p", port, "-b", "115200", "update", str(tmp_path / "new.hex")]
    done = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=False)
    print(done.stdout[-600:], done.stderr)
    assert done.returncode == 0
    module = simulated_port.module
    assert isinstance(module, HipnucModule)
    assert bytes(module.memory.data) == image
    assert module.hardware.firmware == NEW
