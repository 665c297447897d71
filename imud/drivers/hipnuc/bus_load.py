"""What a CAN bus carries: the cost of intervals, refusal of more than fits, and of another bit rate.

    message   frame, in bits                                   per second       at 500 kbit/s
    TPDO1     47 + 8 · 6 = 95                                  100: 9,500       1.9 %
    FF34      67 + 8 · 8 = 131                                 200: 26,200      5.2 %

Stuff bits, up to 22 % more by the data (ISO 11898-1), are not counted: what is refused cannot go over the bus whatever
the data are. What the other devices of the configuration send counts too; what devices send that imud does not know
about does not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from imud.contracts.command import Target
from imud.formats.can import frame_bits
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_MS, NS_PER_S

MS_PER_S: Final = NS_PER_S // NS_PER_MS


@dataclass(frozen=True, slots=True)
class CyclicMessage:
    """A message that a device sends at an interval."""

    data_bytes: int
    extended: bool
    """Whether its identifier has 29 bits."""
    interval_ms: float
    """0 for a message that is not sent."""

    @property
    def bits_per_s(self) -> float:
        """What it takes of the bus, without stuff bits."""
        if not self.interval_ms:
            return 0.0
        return frame_bits(self.extended, self.data_bytes) * MS_PER_S / self.interval_ms


def refuse_overload(messages: Mapping[str, CyclicMessage], other_bits_per_s: float, bus_bits_per_s: int) -> None:
    """Raise BadArgument where these messages, and what others send, are more than the bus carries.

    `messages`: all of one device by name. `other_bits_per_s`: what other devices send. `bus_bits_per_s`: rate of the
    bus, 0 where it is not known.
    """
    own = sum(one.bits_per_s for one in messages.values())
    if not bus_bits_per_s or own + other_bits_per_s <= bus_bits_per_s:
        return
    parts = ", ".join(
        f"{name} every {one.interval_ms:g} ms {_percent(one.bits_per_s, bus_bits_per_s)}"
        for name, one in messages.items()
        if one.interval_ms
    )
    raise BadArgument(
        f"expected messages that {bus_bits_per_s} bit/s carry, got {_percent(own + other_bits_per_s, bus_bits_per_s)} "
        f"of that: {parts}; other devices {_percent(other_bits_per_s, bus_bits_per_s)}; take longer intervals"
    )


def _percent(bits_per_s: float, bus_bits_per_s: int) -> str:
    return f"{100 * bits_per_s / bus_bits_per_s:.3g} %"


def refuse_other_rate(target: Target, values: Mapping[str, Any]) -> None:
    """Raise BadArgument for a `bit_rate` that the bus has not: such a device is lost, and disturbs the others."""
    rate = values.get("bit_rate")
    if rate is not None and target.baud and rate != target.baud:
        raise BadArgument(
            f"bit_rate: expected {target.baud}, the rate of the bus, got {rate}; to change the rate of a bus give all "
            "of its devices the new one with the actions `bitrate`, `save` and `restart`, and the interface"
        )
