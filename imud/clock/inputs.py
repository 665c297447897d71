"""What a clock is given besides messages: edges of lines, triggers, and what the host knows of UTC."""

from collections.abc import Iterable, Sequence
from math import sqrt

from imud.clock.aids import AidingSources, EdgeSource
from imud.clock.marks import Marks
from imud.clock.pairing import Pairing
from imud.clock.pps import PpsAge
from imud.clock.pulses import Pulses, rising
from imud.contracts.lines import Edge
from imud.contracts.timing import SIN_DELAY_US, Mark, SoutTiming, TimeBits, TriggerStamp, TriggerTiming, UtcReference
from imud.units import NS_PER_US


class LineInputs:
    """The part of a clock that takes what is not a message. A line counts from its first call on.

    All are called before the messages that follow the edges, in the order of time. Only a device that sends time can
    make use of them; for others they are ignored.
    """

    def __init__(
        self, tick_ns: int, tick_modulus: int, bits: TimeBits, sout: SoutTiming | None, sin: TriggerTiming | None
    ) -> None:
        self._ticks = tick_ns, tick_modulus
        self._bits = bits
        self._sout_timing = sout or SoutTiming()
        self._sin_timing = sin or TriggerTiming()
        self._pulses = Pulses(int(self._sout_timing.width_us * NS_PER_US))
        self._aids: AidingSources | None = None
        self.own_status: int | None = None
        """Bits of the host's own that `sample` sets in the status from now on; None for none."""

    def edges(self, edges: Sequence[Edge]) -> None:
        """Edges of SOUT, rising and falling."""
        aids = self._with_aids()
        if aids.sout is None:
            timing = self._sout_timing
            aids.sout = aids.listen(
                EdgeSource(
                    Pairing(int(timing.width_us * NS_PER_US)),
                    int(timing.offset_us * NS_PER_US),
                    timing.bias_us * NS_PER_US / sqrt(3),
                    self._bits.sync_out,
                )
            )
        aids.sout.pairing.give(self._pulses.take(edges))

    def divided(self, edges: Sequence[Edge]) -> None:
        """Edges of SOUT_DIV; `take_marks` says which samples they belong to."""
        aids = self._with_aids()
        if aids.marks is None:
            aids.marks = Marks()
        aids.marks.give(rising(edges))

    def triggers(self, stamps: Iterable[TriggerStamp]) -> None:
        """Triggers that the host gave on SIN, each answered by one message."""
        aids = self._with_aids()
        if aids.sin is None:
            timing = self._sin_timing
            aids.sin = aids.listen(
                EdgeSource(
                    Pairing(int(SIN_DELAY_US * NS_PER_US)),
                    int(timing.offset_us * NS_PER_US),
                    timing.bias_us * NS_PER_US / sqrt(3),
                )
            )
        for t_ns, err_ns, number in stamps:
            aids.sin.stamp_error_ns = err_ns
            aids.sin.pairing.give(((t_ns, number),))

    def pulses(self, edges: Sequence[Edge]) -> None:
        """Edges of the pulse per second that the device's SIN gets; for messages with `pps_age_ms`."""
        aids = self._with_aids()
        if aids.pps is None:
            aids.pps = PpsAge()
        aids.pps.give(t_ns for t_ns, _ in rising(edges))

    @property
    def reference(self) -> UtcReference | None:
        """What the host knows of UTC; None while it knows nothing. A device on UTC is recognised by it."""
        return self._aids.utc.reference if self._aids else None

    @reference.setter
    def reference(self, reference: UtcReference | None) -> None:
        if reference is not None or self._aids is not None:
            self._with_aids().refer(reference)

    def take_marks(self) -> list[Mark]:
        """The pulses on SOUT_DIV whose samples are known by now, in order; each is told once."""
        if self._aids is None or self._aids.marks is None:
            return []
        found = self._aids.marks.found
        marks = list(found)
        found.clear()
        return marks

    def _with_aids(self) -> AidingSources:
        if self._aids is None:
            self._aids = AidingSources(*self._ticks, self._bits)
        return self._aids
