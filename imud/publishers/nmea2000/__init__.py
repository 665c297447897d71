"""Output `nmea2000`: heading, rate of turn and attitude of one device on an NMEA 2000 network.

This module has only its options, so that an output that is off costs no import.
"""

from collections.abc import Iterator
from typing import Annotated, Final, Literal

import msgspec

from imud.contracts.link import Claim, HostProblem
from imud.contracts.publisher import PublisherType, make_later
from imud.formats.can import interface_problem
from imud.formats.nmea2000 import ADDRESS_LAST
from imud.model.options import Options

MessageName = Literal["heading", "rate_of_turn", "attitude"]
RateHz = Annotated[float, msgspec.Meta(ge=0.01, le=100)]
# First address for nodes that choose their address themselves (SAE J1939-81)
ADDRESS_FIRST: Final = 128


class Nmea2000Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the NMEA 2000 output."""

    enabled: bool = False
    """Send messages."""
    interface: Annotated[str, msgspec.Meta(min_length=1)] = "can0"
    """CAN interface of the NMEA 2000 network, 250 kbit/s."""
    device: str | None = None
    """Name of the device; null: the only device of the configuration."""
    messages: dict[MessageName, RateHz] = msgspec.field(
        default_factory=lambda: {"heading": 10.0, "rate_of_turn": 10.0, "attitude": 1.0}
    )
    """Messages and their rates, Hz: `heading` (PGN 127250), `rate_of_turn` (127251), `attitude` (127257). imud sends
    only the listed messages. The defaults are the rates of the standard."""
    address: Annotated[int, msgspec.Meta(ge=0, le=ADDRESS_LAST)] = ADDRESS_FIRST
    """Preferred address. imud uses another address if a node with a higher priority has this address."""
    instance: Annotated[int, msgspec.Meta(ge=0, le=252)] = 0
    """Device instance. Plotters distinguish several attitude sensors by it."""
    share_interface: bool = False
    """Send also if devices of the configuration use the interface. Other programs on this host then do not receive the
    messages of imud."""

    def __post_init__(self) -> None:
        """Raise ValueError without a message, and for an invalid name of an interface."""
        if reason := interface_problem(self.interface):
            raise ValueError(f"interface: {reason}")
        if not self.messages:
            raise ValueError("messages: expected at least one message, got none")


def _claims(settings: Nmea2000Options) -> list[Claim]:
    if not settings.enabled:
        return []
    advice = "use another interface, or set nmea2000.share_interface if all devices of this bus are on NMEA 2000"
    return [Claim(place=settings.interface, key="interface", shared=settings.share_interface, advice=advice)]


def _host_problems(settings: Nmea2000Options) -> Iterator[HostProblem]:
    """Yield the reason why this host has no such CAN interface."""
    from imud.host import netlink  # late, because an output that is off costs no import

    if misfit := netlink.misfit(settings.interface):
        yield HostProblem("interface", *misfit)


PUBLISHER: Final = PublisherType(
    "nmea2000",
    Nmea2000Options,
    make_later("imud.publishers.nmea2000.output:Nmea2000"),
    claims=_claims,
    required=False,
    host_problems=_host_problems,
)
