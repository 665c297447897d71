"""What a clock meets: devices, links and hosts with a fault each, simulated with the truth known (for `clock_table`).

The way of a message is that of `ArrivalModel`; here its parts misbehave. What no arrival can show, the constant part of
a link's delay, differs from machine to machine: each seed is another machine, spread evenly over what imud allows for
(`LinkDelay`), with another crystal. A stated error can be judged over several machines only: on one of them the
constant part is whatever it is.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import pi, sin
from random import Random
from typing import Final, NamedTuple

from imud.sample import Measurement
from imud.sim.ports.arrival import Arrival, ArrivalModel, ArrivalProfile
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

SECONDS: Final = 120
WakeLaw = Callable[[Random, float], float]
"""Wake-up of a read at a host time, ns, above the machine's shortest."""
SKEWS_PPM: Final = (12.0, -43.0, 50.0, -7.0, 28.0, 0.0)
TIMERS_PPM: Final = (-30.0, 14.0, 3.0, -11.0, 40.0, 0.0)
WAKE_MOST_NS: Final = 90 * NS_PER_US
POLL_NS: Final = 60 * NS_PER_US
"""Wait for a USB poll that differs from read to read; as much again is the machine's own."""
STAMP_MODULUS: Final = 8192


# --- links ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Link:
    """Wire and adapter, and what the system says of it."""

    name: str
    baud: int = 115_200
    """0: a CAN bus, where the kernel stamps the first frame."""
    timer_ns: int = 0
    packet_bytes: int = 0
    told_hold_ns: int | None = None
    """What the system says of the timer; None: the truth."""

    @property
    def hold_ns(self) -> int:
        """Latency timer as the link reports it."""
        return self.timer_ns if self.told_hold_ns is None else self.told_hold_ns


UART: Final = Link("uart")
USB_1: Final = Link("usb-1ms", timer_ns=NS_PER_MS)
USB_16: Final = Link("usb-16ms", timer_ns=16 * NS_PER_MS)
FT232: Final = Link("ft232-16ms", timer_ns=16 * NS_PER_MS, packet_bytes=62)
FRAMES: Final = Link("usb-frames", 0, timer_ns=NS_PER_MS)
"""A device that is USB itself: the host asks in frames of 1 ms, and there is no wire."""
CAN: Final = Link("can", 0)
LINKS: Final = (UART, USB_1, USB_16, FT232, FRAMES)


# --- hosts ----------------------------------------------------------------------------------------------------------


def _exponential(random: Random, _t_ns: float, mean_ns: float, stall_share: float, stall_ns: float) -> float:
    wait = random.expovariate(1 / mean_ns)
    return wait + random.expovariate(1 / stall_ns) if random.random() < stall_share else wait


def _pareto(random: Random, _t_ns: float) -> float:
    """Most within 50 µs, one in a thousand over 5 ms, and no mean worth the name."""
    return min(25 * NS_PER_US * (random.paretovariate(1.3) - 1), 0.5 * NS_PER_S)


def _log_normal(random: Random, t_ns: float) -> float:
    """Idle states and frequencies of a processor: half of the reads wake it from sleep; every 7 s it is busy for 2."""
    wait = random.lognormvariate(10.0, 0.9)  # 22 µs
    if random.random() < 0.5:
        wait += random.uniform(20, 180) * NS_PER_US
    if t_ns % (7 * NS_PER_S) < 2 * NS_PER_S and random.random() < 0.3:
        wait += random.weibullvariate(3e6, 0.7)
    return wait


QUIET: Final[WakeLaw] = partial(_exponential, mean_ns=30e3, stall_share=0.005, stall_ns=1e6)
LOADED: Final[WakeLaw] = partial(_exponential, mean_ns=300e3, stall_share=0.05, stall_ns=8e6)
PARETO: Final[WakeLaw] = _pareto
LOG_NORMAL: Final[WakeLaw] = _log_normal


@dataclass(frozen=True, slots=True)
class Stalls:
    """Times in which nothing is handed over, evenly from each other."""

    every_ns: int
    for_ns: int
    from_ns: int = 0

    def end_of(self, since_ns: float) -> float:
        """When what comes `since_ns` after the begin is handed over."""
        at = (since_ns - self.from_ns) % self.every_ns
        return since_ns - at + self.for_ns if since_ns >= self.from_ns and at < self.for_ns else since_ns


# --- devices --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Device:
    """What sends, and what its messages say of time."""

    says: str = "time"
    """`time`: ms (HI91); `stamp`: ms modulo 8192 (HI92); `number`: of the sample, 8 bits; `trigger`: that there was
    one (HI92 on mark); `nothing`."""
    rates_hz: Sequence[tuple[float, float]] = ((0.0, 100.0),)
    """(from this second on, rate); a change moves the sampling within the tick too."""
    swing_ppm: float = 0.0
    """Temperature: the crystal swings by this much in `swing_s`."""
    swing_s: float = 200.0
    restarts_s: Sequence[float] = ()
    """It is silent for two seconds then, and its counter begins anew."""
    ticks_before_wrap: int | None = None
    loss: float = 0.0
    """Share of messages that are lost one by one."""
    loss_burst_s: tuple[float, float] | None = None
    """(every, for): all are lost."""
    size_bytes: int = 82


class Message(NamedTuple):
    """What `SampleClock.sample` gets, and the truth."""

    truth_ns: int
    measurement: Measurement
    t_rx_ns: int
    t_begin_ns: int | None


@dataclass(frozen=True, slots=True)
class Cell:
    """An adversity on a link."""

    adversity: str
    link: Link
    device: Device = field(default_factory=Device)
    wake: WakeLaw = QUIET
    stalls: Stalls | None = None

    @property
    def name(self) -> str:
        """Name in the table."""
        return f"{self.adversity}, {self.link.name}"

    def on(self, link: Link) -> "Cell":
        """The same on another link."""
        return replace(self, link=link)


@dataclass(slots=True)
class _AdverseModel(ArrivalModel):
    """Arrivals of a cell; the device's time is in whole ms from `_truth` on."""

    cell: Cell = field(default_factory=lambda: Cell("", UART))
    skew_ppm: float = 0.0

    def _truth(self, count: int, random: Random) -> Iterator[tuple[float, float]]:
        device, begin_ns = self.cell.device, self.begin_ns + random.random() * 50 * NS_PER_MS
        t_ns, dev_ns = begin_ns, 5e12 + random.random() * NS_PER_MS
        if device.ticks_before_wrap is not None:
            dev_ns += ((1 << 32) - device.ticks_before_wrap) * NS_PER_MS - 5e12
        rates, restarts, rate = list(device.rates_hz), list(device.restarts_s), 1.0
        for _ in range(count):
            since_s = (t_ns - begin_ns) / NS_PER_S
            if rates and since_s >= rates[0][0]:
                rate = rates.pop(0)[1]
                if since_s:
                    skipped_ns = random.uniform(20, 60) * NS_PER_MS  # the command is carried out
                    t_ns, dev_ns = t_ns + skipped_ns, dev_ns + skipped_ns
            if restarts and since_s >= restarts[0]:
                restarts.pop(0)
                t_ns, dev_ns = t_ns + 2 * NS_PER_S, 4e8 + random.random() * NS_PER_MS
            yield t_ns, dev_ns
            ppm = self.skew_ppm + device.swing_ppm * sin(2 * pi * since_s / device.swing_s)
            dev_ns += NS_PER_S / rate
            t_ns += NS_PER_S / rate / (1 + ppm * 1e-6)

    def _handed_over(self, begins: list[float], random: Random) -> list[float]:
        handed = ArrivalModel._handed_over(self, begins, random)
        stalls, begin_ns = self.cell.stalls, self.begin_ns
        return [stalls.end_of(t - begin_ns) + begin_ns for t in handed] if stalls else handed

    def run(self, count: int) -> Iterator[Arrival]:
        """As `ArrivalModel.run`, with the cell's own way of waking up."""
        random = Random(f"{self.cell.name} {self.seed}")
        truth = list(self._truth(count, random))
        begins = self._on_wire([t for t, _ in truth])
        handed = self._handed_over(begins, random)
        floor_ns, poll_ns, wake = self.profile.floor_ns, self.profile.poll_ns, self.cell.wake
        first = 0
        while first < count:
            t_rx_ns = int(handed[first] + floor_ns + poll_ns * random.random() + wake(random, handed[first]))
            last = first
            while last + 1 < count and handed[last + 1] <= t_rx_ns:
                last += 1
            rest = self._begun_bytes(begins, last + 1, self._newest_hand_over(handed[last], t_rx_ns))
            for i in range(first, last + 1):
                trailing = (last - i) * self.size_bytes + rest if self.baud else 0
                yield Arrival(int(truth[i][0]), int(truth[i][1]), self.size_bytes, trailing, t_rx_ns)
            first = last + 1


def _machine(cell: Cell, seed: int, of: int) -> ArrivalProfile:
    """The link on machine `seed` of so many."""
    link, part = cell.link, ((seed + 0.5) / of, (seed * 2 % of + 0.5) / of)
    poll = POLL_NS if link.timer_ns else 0
    return ArrivalProfile(
        cell.name, timer_ns=link.timer_ns, timer_ppm=TIMERS_PPM[seed % len(TIMERS_PPM)], packet_bytes=link.packet_bytes,
        poll_ns=poll, fifo_bytes=0 if link.timer_ns else 4 * part[1],
        floor_ns=5 * NS_PER_US + int(part[0] * WAKE_MOST_NS + part[1] * poll),
    )  # fmt: skip


def messages(cell: Cell, seed: int, of: int, seconds: int = SECONDS) -> Iterator[Message]:
    """The messages of a run on machine `seed` of so many."""
    device, random = cell.device, Random(f"loss {cell.name} {seed}")
    model = _AdverseModel(
        _machine(cell, seed % of, of), 1.0, seed, baud=cell.link.baud, size_bytes=device.size_bytes, cell=cell,
        skew_ppm=SKEWS_PPM[seed % len(SKEWS_PPM)],
    )  # fmt: skip
    ends = [at for at, _ in device.rates_hz[1:]] + [float(seconds)]
    count = int(sum(rate * (end - at) for (at, rate), end in zip(device.rates_hz, ends, strict=True) if end > at))
    for number, a in enumerate(model.run(count)):
        if device.loss and random.random() < device.loss:
            continue
        if device.loss_burst_s is not None:
            every, for_ = device.loss_burst_s
            if (a.t_ns - model.begin_ns) / NS_PER_S % every < for_:
                continue
        yield Message(a.t_ns, _measurement(device, a, number), a.t_rx_ns, a.t_rx_ns if cell.link is CAN else None)


def _measurement(device: Device, a: Arrival, number: int) -> Measurement:
    ms = a.dev_ns // NS_PER_MS
    if device.says == "time":
        return Measurement(a.size_bytes, a.trailing_bytes, ms % (1 << 32))
    if device.says == "number":
        return Measurement(a.size_bytes, a.trailing_bytes, number % 256)
    age = {"stamp": ms % STAMP_MODULUS, "trigger": 0}.get(device.says)
    return Measurement(a.size_bytes, a.trailing_bytes, None, pps_age_ms=age)
