"""Table of the systems of the lab: release, architecture, packages and kernel modules."""

from dataclasses import dataclass

PYTHONS = {"bookworm": "3.11", "trixie": "3.13"}

SYSTEM = (
    *("systemd", "systemd-sysv", "dbus", "udev", "kmod", "iproute2", "procps", "python3"),
    *("can-utils", "gpiod", "i2c-tools", "pps-tools", "gpsd", "chrony"),
)
"""Debian packages of the guest: the system, its installation, and the programs that imud uses."""

BOOT_MODULES = ("virtio_pci", "virtio_blk", "crc32c_generic", "ext4", "virtio_console", "9pnet_virtio", "9p", "autofs4")
"""Modules that the initramfs loads, in this order. Some kernels contain some of them."""

MODULES = (
    *("vcan", "can-raw", "can-j1939", "i2c-dev", "i2c-stub", "spidev", "pps-ldisc", "pps-gpio", "usbserial"),
    *("ftdi_sio", "cdc-acm", "xhci-pci", "virtio-rng", "8250_pci", "rng-core", "gpio-pl061"),
    *("pcengines-apuv2", "parport_pc", "spi-butterfly"),
)
"""Modules for udev and the checks. Modules that a kernel does not have are skipped. The last row creates GPIO lines and
an SPI bus on amd64 (machine.py)."""


@dataclass(frozen=True)
class Release:
    suite: str
    architecture: str

    @property
    def name(self) -> str:
        return f"{self.suite}-{self.architecture}"

    @property
    def foreign(self) -> bool:
        return self.architecture != "amd64"

    @property
    def qemu(self) -> str:
        return {"amd64": "qemu-system-x86_64", "arm64": "qemu-system-aarch64"}[self.architecture]


AMD64 = (Release("bookworm", "amd64"), Release("trixie", "amd64"))
ARM64 = (Release("trixie", "arm64"),)
