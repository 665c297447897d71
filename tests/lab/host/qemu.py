"""The virtual machine of the guest: the QEMU command line."""

from dataclasses import dataclass
from pathlib import Path

QEMU = "qemu-system-x86_64"
INIT = Path(__file__).resolve().parents[1] / "guest" / "init"
SHARING = "security_model=none"
ROOT_FLAGS = "trans=virtio,version=9p2000.L,msize=262144,cache=loose"
"""Options of the root file system. cache=loose: no program writes through this mount, and without it each import
requests the file again."""
PANIC_BY_NMI = "unknown_nmi_panic panic_print=0x5"
"""Kernel options: a panic prints the wait state of every task and the active timers. `examine` causes a panic in a hung
guest."""
STEADY = ("-icount", "shift=0")
"""Options for a clock that counts instructions: an instruction takes 2^0 ns. Waiting uses the clock of the host."""


@dataclass(frozen=True)
class Machine:
    image: Path
    share: Path
    """Folder that the guest may write, its /run/lab."""
    console: Path
    memory_mb: int
    processors: int
    uart_fds: tuple[int, int]
    """Both ends of a socket pair: the extra UARTs of the guest, connected to each other."""
    monitor_fd: int
    """Socket of QEMU's monitor."""
    steady: bool = False
    """True: an instruction of the guest takes 1 ns. False: the guest uses the time of the host."""

    def command(self) -> list[str]:
        first_fd, second_fd = self.uart_fds
        return [
            *(QEMU, "-nodefaults", "-no-user-config", "-no-reboot", "-display", "none"),
            *("-machine", "pc,accel=tcg", "-cpu", "max", "-smp", str(self.processors), "-m", str(self.memory_mb)),
            *("-kernel", str(self.image), "-append", self.kernel_arguments()),
            *("-virtfs", f"local,path=/,mount_tag=hostroot,{SHARING},readonly=on,multidevs=remap"),
            *("-virtfs", f"local,path={_escaped(self.share)},mount_tag=lab,{SHARING}"),
            *("-chardev", f"file,id=console,path={_escaped(self.console)}", "-serial", "chardev:console"),
            *("-chardev", "file,id=live,path=/dev/stdout,append=on"),
            *("-device", "virtio-serial-pci", "-device", "virtserialport,chardev=live"),
            *("-chardev", f"socket,id=uart1,fd={first_fd}", "-chardev", f"socket,id=uart2,fd={second_fd}"),
            *("-device", "pci-serial-2x,chardev1=uart1,chardev2=uart2"),
            *("-chardev", f"socket,id=monitor,fd={self.monitor_fd}", "-mon", "chardev=monitor,mode=readline"),
            *(STEADY if self.steady else ()),
            *("-object", "can-bus,id=can", "-device", "kvaser_pci,canbus=can", "-device", "kvaser_pci,canbus=can"),
        ]

    def kernel_arguments(self) -> str:
        root = f'root=hostroot rootfstype=9p rootflags={ROOT_FLAGS} ro init="{INIT}"'
        return f"console=ttyS0 panic=-1 {PANIC_BY_NMI} tsc=reliable {root}"


def _escaped(path: Path) -> str:
    return str(path).replace(",", ",,")
