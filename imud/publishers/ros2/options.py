"""Options of the output `ros2`. This module is light: a daemon without the output imports nothing else of it."""

from typing import Annotated, Final

import msgspec

from imud.contracts.publisher import PublisherType, make_later
from imud.model.host_object import InterfaceAddress
from imud.model.options import Options, is_ip_address, shown

# Ports (RTPS 2.2, section 9.6.1): PORT_BASE + PORT_STEP * domain for multicast
PORT_BASE: Final = 7400
PORT_STEP: Final = 250
DOMAIN_MAX: Final = 232  # maximum domain: the ports of larger domains exceed 65535
EVERY: Final = "*"  # key for all devices without an entry of their own
NodeName = Annotated[str, msgspec.Meta(pattern="^[A-Za-z][A-Za-z0-9_]{0,63}$", extra={"words": "a name of ROS 2"})]


class Ros2Sending(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of one device."""

    rate_hz: Annotated[float, msgspec.Meta(ge=0.01, le=2000)] | None = None
    """Messages per second in each topic; null: each sample."""


class Ros2Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the ROS 2 output."""

    enabled: bool = False
    """Publish topics of ROS 2."""
    domain_id: Annotated[int, msgspec.Meta(ge=0, le=DOMAIN_MAX)] = 0
    """Domain of the robot (ROS_DOMAIN_ID)."""
    node: NodeName = "imud"
    """Name of the node. Give each gateway of a domain its own name."""
    address: InterfaceAddress | None = None
    """IPv4 address of the network interface; null: all interfaces, 127.0.0.1: this host only. There is no password."""
    devices: dict[str, Ros2Sending] = msgspec.field(default_factory=lambda: {EVERY: Ros2Sending()})
    """Options of each device; `*`: of all devices without an entry of their own."""

    def __post_init__(self) -> None:
        """Raise ValueError if the address is invalid."""
        if self.address is not None and (not is_ip_address(self.address) or ":" in self.address):
            raise ValueError(f"address: expected an IPv4 address such as 192.168.1.10, got {shown(self.address)}")

    def sending(self, device: str) -> Ros2Sending | None:
        """Return the options of a device; None if imud publishes no topics of it."""
        return self.devices.get(device, self.devices.get(EVERY))


PUBLISHER = PublisherType("ros2", Ros2Options, make_later("imud.publishers.ros2.output:Ros2Output"), required=False)
