"""Time of a simulated HiPNUC module: ms since power-on, or UTC after PPS and RMC. Manual V1.5.9, section 1.2.1.

The manual: a rising edge on SIN/PPS at each full second of UTC, 5 ms long, and RMC sentences at 1-10 Hz; once the two
agree, the time in all frames is at once UTC in ms. The rest is assumed, with the reason:

- 32 bits cannot hold ms since 1970, so it is that modulo 2^32 ("unix"), or ms of the day ("day").
- Pulses are in step when they are 1 s apart within 1 %; three such, and two sentences in a row that name the same
  pulse, make UTC known, or correct it. A sentence names the last pulse if its time of the second has been.
- Every pulse in step sets the time anew; it is cut off to whole ms, as the PPS stamp is.
- Without pulses time runs on with the module's crystal and never goes back to time since power-on; after 2 s it counts
  as not synchronised (MAIN_STATUS bit 11). The first pulse near a full second of that time sets it again.
"""

from typing import Final, Literal

from imud.formats.rmc import Rmc, parse
from imud.units import NS_PER_MS, NS_PER_S

Epoch = Literal["unix", "day"]
MODULUS_MS: Final[dict[Epoch, int]] = {"unix": 2**32, "day": 86_400_000}
MS_PER_S: Final = 1000
STEP_TOLERANCE_NS: Final = 10 * NS_PER_MS
INTERVALS_NEEDED: Final = 2
SENTENCES_NEEDED: Final = 2
REGAIN_NS: Final = 100 * NS_PER_MS
"""Largest distance of a pulse from a full second at which it counts without a sentence."""
LOST_NS: Final = 2 * NS_PER_S
UPTIME_MODULUS_MS: Final = 2**32


class UtcTime:
    """Time in the module's frames. Arguments are ns of its own clock since power-on. Synchronization: one thread."""

    def __init__(self, epoch: Epoch) -> None:
        self._modulus_ms = MODULUS_MS[epoch]
        self._anchor: tuple[int, int] | None = None
        """The module's clock at a pulse, and the UTC second of that."""
        self._pulse_ns: int | None = None
        self._intervals = 0
        """Intervals in step up to the last pulse."""
        self._claim_s: int | None = None
        """The second that sentences give the last pulse."""
        self._agreed = 0

    def pulse(self, device_ns: int) -> None:
        """Note a rising edge on SIN/PPS."""
        in_step = self._pulse_ns is not None and abs(device_ns - self._pulse_ns - NS_PER_S) <= STEP_TOLERANCE_NS
        if in_step and self._claim_s is not None:
            self._claim_s += 1
        elif not in_step:
            self._claim_s, self._agreed = None, 0
        self._intervals = self._intervals + 1 if in_step else 0
        self._pulse_ns = device_ns
        if self._anchor is not None:
            anchor_ns, second = self._anchor
            seconds = round((device_ns - anchor_ns) / NS_PER_S)
            if seconds and abs(device_ns - anchor_ns - seconds * NS_PER_S) <= REGAIN_NS:
                self._anchor = device_ns, second + seconds

    def sentence(self, line: bytes, device_ns: int) -> None:
        """Process a line that begins with `$`; all but valid RMC sentences are ignored."""
        rmc = parse(line)
        if not isinstance(rmc, Rmc) or not rmc.valid or self._pulse_ns is None:
            return
        age_ns = device_ns - self._pulse_ns
        if self._intervals < INTERVALS_NEEDED or not rmc.fraction_ns <= age_ns < NS_PER_S:
            return
        self._agreed = self._agreed + 1 if rmc.unix_s == self._claim_s else 1
        self._claim_s = rmc.unix_s
        if self._agreed >= SENTENCES_NEEDED:
            self._anchor = self._pulse_ns, rmc.unix_s

    def synchronised(self, device_ns: int) -> bool:
        """Whether the time is UTC and pulses keep it so."""
        return self._anchor is not None and device_ns - self._anchor[0] < LOST_NS

    def shown_ms(self, device_ns: int) -> int:
        """`system_time` of a frame sampled now."""
        if self._anchor is None:
            return device_ns // NS_PER_MS % UPTIME_MODULUS_MS
        anchor_ns, second = self._anchor
        return (second * MS_PER_S + (device_ns - anchor_ns) // NS_PER_MS) % self._modulus_ms
