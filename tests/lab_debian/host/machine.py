"""The virtual machine of the guest: QEMU's command line, its control with QMP, and the requests of the guest.

While it runs, the guest requests `plug` and `unplug` of the USB adapter, one line each. The reply is one line.
"""

import contextlib
import json
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Self

from tests.lab.host.errors import LabError
from tests.lab_debian.host.image import Image
from tests.lab_debian.host.release import Release

PLATFORMS = {"amd64": ("q35", "max", "ttyS0"), "arm64": ("virt,gic-version=3", "cortex-a72", "ttyAMA0")}
"""Machine, processor and console by architecture. Processors are always emulated: results do not depend on KVM."""

ADAPTER = {"driver": "usb-serial", "chardev": "imu", "id": "imu", "bus": "xhci.0", "serial": "LAB0001"}
"""Adapter of the guest, an FTDI: ftdi_sio, /dev/ttyUSB0, /dev/serial/by-id/usb-QEMU_…. The serial number is explicit,
because QEMU would otherwise derive it from the USB port, which changes."""
BUSES = {
    "amd64": (
        *("-smbios", "type=1,manufacturer=PC Engines", "-smbios", "type=2,product=apu2"),
        *("-chardev", "null,id=parallel", "-device", "isa-parallel,chardev=parallel"),
    ),
    "arm64": (),
}
"""Options for buses. Debian's kernel for amd64 has neither gpio-sim nor a driver for an SPI controller of QEMU. Due to
these names, pcengines-apuv2 assumes a board with GPIO registers at an address that QEMU does not use: the lines have no
effect. spi-butterfly creates an SPI bus on a parallel port, without devices. On arm64, `-M virt` has a PL061 and no
SPI."""
REQUESTS = "requests"
"""Name of the socket for requests of the guest to the host, one line each."""
QMP = "qmp"
SENSOR = "sensor"
CONSOLE_OPTIONS = "systemd.show_status=yes systemd.log_target=console"
CONNECT_LIMIT_S = 60.0
ANSWER_LIMIT_S = 60.0
POLL_S = 0.05


@dataclass(frozen=True)
class DebianMachine:
    release: Release
    image: Image
    share: Path
    """Folder that the guest may write, its /run/lab."""
    sockets: Path
    """Folder of REQUESTS, QMP and SENSOR. Its name is short, because the path of a socket has at most 107 bytes."""
    memory_mb: int = 1024
    processors: int = 2

    def command(self, monitor_fd: int) -> list[str]:
        """Return QEMU's arguments. Standard output receives the guest's output. `monitor_fd` is a socket."""
        machine, processor, console = PLATFORMS[self.release.architecture]
        return [
            *(self.release.qemu, "-nodefaults", "-no-user-config", "-no-reboot", "-display", "none"),
            *(
                "-machine", machine, "-accel", "tcg,thread=multi", "-cpu", processor, "-smp", str(self.processors),
                "-m", str(self.memory_mb),
            ),
            *("-kernel", str(self.image.kernel), "-initrd", str(self.image.initramfs)),
            *("-append", f"console={console} panic=-1 mitigations=off {CONSOLE_OPTIONS}"),
            *("-drive", f"file={_escaped(self.image.disk)},format=raw,if=none,id=root,snapshot=on,cache=unsafe"),
            *("-device", "virtio-blk-pci,drive=root", "-device", "virtio-rng-pci"),
            *("-virtfs", f"local,path={_escaped(self.share)},mount_tag=lab,security_model=none"),
            *("-chardev", f"file,id=console,path={_escaped(self.share / 'console.log')}", "-serial", "chardev:console"),
            *("-device", "virtio-serial-pci"),
            *("-chardev", "file,id=live,path=/dev/stdout,append=on", "-device", "virtserialport,chardev=live,name=lab"),
            *("-chardev", f"socket,id=requests,path={_escaped(self.sockets / REQUESTS)},server=on,wait=off"),
            *("-device", "virtserialport,chardev=requests,name=requests"),
            *("-chardev", f"socket,id=monitor,fd={monitor_fd}", "-mon", "chardev=monitor"),
            *("-qmp", f"unix:{_escaped(self.sockets / QMP)},server=on,wait=off"),
            *BUSES[self.release.architecture],
            *("-device", "qemu-xhci,id=xhci", "-chardev", f"serial,id=imu,path={_escaped(self.sockets / SENSOR)}"),
            *("-device", ",".join([ADAPTER["driver"], *(f"{k}={v}" for k, v in ADAPTER.items() if k != "driver")])),
        ]  # fmt: skip


class Qmp:
    """QEMU's control socket. Synchronization: one thread."""

    def __init__(self, path: Path, limit_s: float = CONNECT_LIMIT_S) -> None:
        """Connect to QEMU. Raises LabError if QEMU does not open the socket within `limit_s`."""
        self._socket = connected(path, limit_s)
        self._lines: IO[str] = self._socket.makefile("r", encoding="utf-8")
        self._read()  # greeting
        self.ask({"execute": "qmp_capabilities"})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_reason: object) -> None:
        self._lines.close()
        self._socket.close()

    def plug(self) -> None:
        """Plug the USB adapter in. Raises LabError if QEMU reports an error."""
        self.ask({"execute": "device_add", "arguments": ADAPTER})

    def unplug(self) -> None:
        """Unplug the USB adapter. Return after QEMU has removed it. Raises LabError if QEMU reports an error."""
        self.ask({"execute": "device_del", "arguments": {"id": ADAPTER["id"]}}, event="DEVICE_DELETED")

    def ask(self, command: dict[str, object], event: str = "") -> None:
        """Send a command. Return after its reply and, if given, after the event. Raises LabError for an error."""
        self._socket.sendall(json.dumps(command).encode() + b"\n")
        answered = happened = False
        while not (answered and (happened or not event)):
            message = self._read()
            if "error" in message:
                raise LabError(f"QEMU refused {command['execute']}: {message['error']}")
            answered |= "return" in message
            happened |= message.get("event") == event

    def _read(self) -> dict[str, object]:
        try:
            line = self._lines.readline()
        except OSError as error:
            raise LabError(f"cannot read the reply of QEMU: {error}") from error
        if not line:
            raise LabError("expected a reply of QEMU; it closed its control socket")
        message: dict[str, object] = json.loads(line)
        return message


def connected(path: Path, limit_s: float) -> socket.socket:
    """Return a connection to the socket at `path` as soon as a program listens. Raises LabError after `limit_s`."""
    give_up_s = time.monotonic() + limit_s
    while True:
        sock = socket.socket(socket.AF_UNIX)
        try:
            sock.connect(str(path))
        except OSError as error:
            sock.close()
            if time.monotonic() >= give_up_s:
                raise LabError(f"cannot connect to {path} within {limit_s:.0f} s") from error
            time.sleep(POLL_S)
        else:
            sock.settimeout(ANSWER_LIMIT_S)
            return sock


def _escaped(path: Path) -> str:
    """Escape a value: QEMU's option syntax needs double commas."""
    return str(path).replace(",", ",,")


LINE_BYTES = 200
DRAIN_S = 0.5
"""Time for the bytes that the sensor sent before it stopped, s."""


@contextlib.contextmanager
def answered(sockets: Path, sensor_pid: int) -> Iterator[None]:
    """Process the guest's requests in a thread until the end of the block or of QEMU.

    `sensor_pid` is the process of the simulated sensor.
    """
    thread = threading.Thread(target=_serve_machine, args=(sockets, sensor_pid), daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join(CONNECT_LIMIT_S + 1)


def _serve_machine(sockets: Path, sensor_pid: int) -> None:
    with (
        contextlib.suppress(LabError),
        Qmp(sockets / QMP) as qmp,
        connected(sockets / REQUESTS, CONNECT_LIMIT_S) as guest,
    ):
        guest.settimeout(None)
        serve(guest, {"plug": qmp.plug, "unplug": partial(unplug_quietly, qmp.unplug, sensor_pid)})


def unplug_quietly(unplug: Callable[[], None], sensor_pid: int) -> None:
    """Unplug the adapter while the sensor is stopped, because a byte would crash QEMU 7.2 in this time."""
    os.kill(sensor_pid, signal.SIGSTOP)
    try:
        time.sleep(DRAIN_S)
        unplug()
    finally:
        os.kill(sensor_pid, signal.SIGCONT)


def serve(guest: socket.socket, actions: Mapping[str, Callable[[], None]]) -> None:
    """Reply to each line of `guest` with `ok` or one line with the error, until `guest` closes."""
    with contextlib.suppress(OSError), guest.makefile("rb") as lines:
        while line := lines.readline(LINE_BYTES):
            guest.sendall(f"{answer(line.decode('utf-8', 'replace').strip(), actions)}\n".encode())


def answer(word: str, actions: Mapping[str, Callable[[], None]]) -> str:
    action = actions.get(word)
    if action is None:
        return f"expected one of {', '.join(sorted(actions))}, got {word!r}"
    try:
        action()
    except LabError as error:
        return str(error)
    return "ok"
