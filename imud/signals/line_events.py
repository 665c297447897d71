"""What the kernel writes for the edges of one GPIO line: `struct gpio_v2_line_event` of <linux/gpio.h>.

    timestamp_ns u64 | id u32 | offset u32 | seqno u32 | line_seqno u32 | padding 6 × u32        48 bytes, host order

`line_seqno` counts the edges of the line from 1 and is given before the edge goes into the kernel's buffer; a full
buffer drops its oldest. So a jump of the count is a loss, and its height says of how many.
"""

from struct import Struct
from typing import Final

from imud.contracts.lines import Edge

EVENT: Final = Struct("=QIIII24x")
RISING: Final = 1
"""`id` of an edge from inactive to active (GPIO_V2_LINE_EVENT_RISING_EDGE); 2 is the other one."""
_SEQNO_MODULUS: Final = 2**32


class LineEvents:
    """Numbers the edges of one line over all requests of it, and counts those that were dropped."""

    def __init__(self) -> None:
        self.lost = 0
        self._number = 0
        self._seqno = 0

    def restart(self) -> None:
        """The line is requested anew: the kernel counts from 1 again, the numbers of edges go on."""
        self._seqno = 0

    def edges(self, data: bytes) -> list[Edge]:
        """The edges in what was read, a whole number of events."""
        found = []
        for t_ns, kind, _offset, _seqno, seqno in EVENT.iter_unpack(data):
            step = (seqno - self._seqno) % _SEQNO_MODULUS
            self._seqno = seqno
            self._number += step
            self.lost += step - 1
            found.append(Edge(t_ns, kind == RISING, self._number))
        return found
