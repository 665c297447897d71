"""Load of a CAN bus: the cost of intervals, and the check of intervals and bit rate.

    message   frame, in bits                                   per second       at 500 kbit/s
    TPDO1     47 + 8 · 6 = 95                                  100: 9,500       1.9 %
    FF34      67 + 8 · 8 = 131                                 200: 26,200      5.2 %

The calculation ignores stuff bits, up to 22 % (ISO 11898-1): rejected intervals exceed the bus with any data. It
includes the messages of all other configured devices, but no messages of devices that imud does not know.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from imud.contracts.command import Target
from imud.formats.can import frame_bits
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_MS, NS_PER_S

MS_PER_S: Final = NS_PER_S // NS_PER_MS
RATE_NOTE: Final = (
    "the device uses the new rate after its restart; set and save it in all devices of the bus, restart them with "
    "`imud command NAME restart`, then change the interface"
)


@dataclass(frozen=True, slots=True)
class CyclicMessage:
    """Message that a device sends periodically."""

    data_bytes: int
    extended: bool  # whether its identifier has 29 bits
    interval_ms: float  # 0: the device does not send the message

    @property
    def bits_per_s(self) -> float:
        """Load of the bus, bit/s without stuff bits."""
        if not self.interval_ms:
            return 0.0
        return frame_bits(self.extended, self.data_bytes) * MS_PER_S / self.interval_ms


def refuse_short_intervals(values: Mapping[str, Any], names: Iterable[str], least_ms: int, most_ms: int) -> None:
    """Raise BadArgument for an interval between 0, which means never, and `least_ms`."""
    for name in names:
        if 0 < (got := values.get(name, 0)) < least_ms:
            raise BadArgument(f"{name}: expected 0 or {least_ms} … {most_ms}, got {got}")


def refuse_overload(messages: Mapping[str, CyclicMessage], other_bits_per_s: float, bus_bits_per_s: int) -> None:
    """Raise BadArgument if these messages and the messages of other devices exceed the bit rate of the bus.

    `messages`: all messages of one device by name. `other_bits_per_s`: load by other devices. `bus_bits_per_s`: bit
    rate of the bus; 0 if it is not known.
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
        f"expected messages within {bus_bits_per_s} bit/s, got {_percent(own + other_bits_per_s, bus_bits_per_s)} "
        f"of it: {parts}; other devices {_percent(other_bits_per_s, bus_bits_per_s)}; try longer intervals"
    )


def _percent(bits_per_s: float, bus_bits_per_s: int) -> str:
    return f"{100 * bits_per_s / bus_bits_per_s:.3g} %"


def refuse_other_rate(target: Target, values: Mapping[str, Any]) -> None:
    """Raise BadArgument for a `bit_rate` other than the rate of the bus: such a device disturbs the bus."""
    rate = values.get("bit_rate")
    if rate is not None and target.baud and rate != target.baud:
        raise BadArgument(
            f"bit_rate: expected {target.baud}, the bit rate of the bus, got {rate}; to change it, set it in all "
            "devices with `imud settings NAME --set bit_rate=… --save`, restart them, then change the interface"
        )
