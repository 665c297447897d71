"""What a clock meets: devices, links and hosts with a fault each, simulated with the truth known (for `clock_table`).

The way of a message is that of `ArrivalModel`; here its parts misbehave. What no arrival can show, the constant part of
a link's delay, differs from machine to machine: each seed is another machine (`machine_of`), within what imud allows
for (`LinkDelay`), with another crystal, FIFO and timer. A stated error can be judged over several machines only: on one
of them the constant part is whatever it is.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import ceil, pi, sin
from random import Random
from typing import Final, NamedTuple

from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sim.ports.arrival import Arrival, ArrivalModel, ArrivalProfile

SECONDS: Final = 120
WakeLaw = Callable[[Random, float], float]
"""Wake-up of a read at a host time, ns, above the machine's shortest."""
STAMP_MODULUS: Final = 8192


# --- machines -------------------------------------------------------------------------------------------------------

WAKE_LEAST_NS: Final = 5 * NS_PER_US
"""An interrupt and a switch to a process that waits: no host is faster."""
WAKE_MOST_NS: Final = 90 * NS_PER_US
"""Shortest wake-up of a machine, above that, at most: what imud takes as the bound (`LinkDelay`)."""
POLL_NS: Final = 60 * NS_PER_US
"""Wait for a USB poll that differs from read to read; as much again at most is the machine's own. Both together are a
microframe of USB 2.0, 125 µs."""
FIFO_MOST_BYTES: Final = 4.0
"""A 16550 reports what is below its trigger level after four characters; one without a FIFO at once."""
CRYSTAL_PPM: Final = 50.0
"""Tolerance of a usual crystal, of a device and of an adapter's timer. More makes it easier to see through a timer: it
beats with the samples sooner. Crystals that are 5 % off are in the table of `clock`."""


class Machine(NamedTuple):
    """What one installation has and another has otherwise. The shares are of the bounds above, from 0 to 1."""

    wake: float
    poll: float
    fifo: float
    timer_ppm: float
    skew_ppm: float

    def profile(self, link: "Link", name: str) -> ArrivalProfile:
        poll = POLL_NS if link.timer_ns else 0
        return ArrivalProfile(
            name, timer_ns=link.timer_ns, timer_ppm=self.timer_ppm, packet_bytes=link.packet_bytes, poll_ns=poll,
            fifo_bytes=0 if link.timer_ns else FIFO_MOST_BYTES * self.fifo,
            floor_ns=WAKE_LEAST_NS + int(self.wake * WAKE_MOST_NS + self.poll * poll),
        )  # fmt: skip


NAMED: Final = tuple(
    Machine((i + 0.5) / 6, (2 * i % 6 + 0.5) / 6, (2 * i % 6 + 0.5) / 6, timer_ppm, skew_ppm)
    for i, (timer_ppm, skew_ppm) in enumerate(
        ((-30.0, 12.0), (14.0, -43.0), (3.0, 50.0), (-11.0, -7.0), (40.0, 28.0), (0.0, 0.0))
    )
)
"""Machines of seeds 0 to 5: spread evenly, and one in lockstep. The figures of `clock_table.json` are of these."""


def machine_of(seed: int) -> Machine:
    """Return the machine of a seed: one of `NAMED`, or drawn evenly from all that a machine can be."""
    if seed < len(NAMED):
        return NAMED[seed]
    random = Random(f"machine {seed}")
    tolerance = partial(random.uniform, -CRYSTAL_PPM, CRYSTAL_PPM)
    return Machine(random.random(), random.random(), random.random(), tolerance(), tolerance())


# --- links ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Link:
    name: str
    baud: int = 115_200
    """0: a CAN bus, where the kernel stamps the first frame."""
    timer_ns: int = 0
    packet_bytes: int = 0
    told_hold_ns: int | None = None
    """What the system says of the timer; None: the truth."""

    @property
    def hold_ns(self) -> int:
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
    every_ns: int
    for_ns: int
    from_ns: int = 0

    def end_of(self, since_ns: float) -> float:
        at = (since_ns - self.from_ns) % self.every_ns
        return since_ns - at + self.for_ns if since_ns >= self.from_ns and at < self.for_ns else since_ns


@dataclass(frozen=True, slots=True)
class HostClocks:
    name: str
    slews: tuple[tuple[float, float], ...] = ()
    """(from then on, CLOCK_MONOTONIC runs so many ppm fast)."""
    steps: tuple[tuple[float, float], ...] = ()
    """(then, CLOCK_REALTIME is set forward by so many seconds)."""
    suspend_s: tuple[float, float] | None = None
    """(then, for so long): CLOCK_MONOTONIC and CLOCK_MONOTONIC_RAW stand still, the device runs on unheard."""
    stop_s: tuple[float, float] | None = None
    """(then, for so long): the virtual machine does not run, and its clocks go on. What comes beyond WAITING_BYTES in
    that time is lost."""

    def stepped_ns(self, since_ns: int) -> int:
        steps = (*self.steps, self.suspend_s) if self.suspend_s else self.steps
        return sum(int(step_s * NS_PER_S) for at_s, step_s in steps if since_ns >= at_s * NS_PER_S)


WAITING_BYTES: Final = 256
"""Receive buffer of an FT232."""


# --- devices --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Device:
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
    adversity: str
    link: Link
    device: Device = field(default_factory=Device)
    wake: WakeLaw = QUIET
    stalls: Stalls | None = None
    host: HostClocks | None = None
    """None: its clocks are left alone."""

    @property
    def name(self) -> str:
        return f"{self.adversity}, {self.link.name}"

    def on(self, link: Link) -> "Cell":
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
        suspend = self.cell.host.suspend_s if self.cell.host else None
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
            if suspend and since_s >= suspend[0]:
                unheard_ns, suspend = suspend[1] * NS_PER_S, None
                samples = ceil(unheard_ns * rate / NS_PER_S)
                dev_ns += samples * NS_PER_S / rate
                t_ns += samples * NS_PER_S / rate / (1 + self.skew_ppm * 1e-6) - unheard_ns
            yield t_ns, dev_ns
            ppm = self.skew_ppm + device.swing_ppm * sin(2 * pi * since_s / device.swing_s)
            dev_ns += NS_PER_S / rate
            t_ns += NS_PER_S / rate / (1 + ppm * 1e-6)

    def _handed_over(self, begins: list[float], random: Random) -> list[float]:
        handed = ArrivalModel._handed_over(self, begins, random)
        stalls, begin_ns = self.cell.stalls, self.begin_ns
        return [stalls.end_of(t - begin_ns) + begin_ns for t in handed] if stalls else handed

    def run(self, count: int) -> Iterator[Arrival]:
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


def messages(cell: Cell, seed: int, seconds: int = SECONDS) -> Iterator[Message]:
    device, random, machine = cell.device, Random(f"loss {cell.name} {seed}"), machine_of(seed)
    model = _AdverseModel(
        machine.profile(cell.link, cell.name), 1.0, seed, baud=cell.link.baud, size_bytes=device.size_bytes, cell=cell,
        skew_ppm=machine.skew_ppm,
    )  # fmt: skip
    ends = [at for at, _ in device.rates_hz[1:]] + [float(seconds)]
    count = int(sum(rate * (end - at) for (at, rate), end in zip(device.rates_hz, ends, strict=True) if end > at))
    for number, a in _heard(enumerate(model.run(count)), cell, model.begin_ns):
        if device.loss and random.random() < device.loss:
            continue
        if device.loss_burst_s is not None:
            every, for_ = device.loss_burst_s
            if (a.t_ns - model.begin_ns) / NS_PER_S % every < for_:
                continue
        yield Message(a.t_ns, _measurement(device, a, number), a.t_rx_ns, a.t_rx_ns if cell.link is CAN else None)


def _heard(arrivals: Iterator[tuple[int, Arrival]], cell: Cell, begin_ns: int) -> Iterator[tuple[int, Arrival]]:
    if cell.host is None or cell.host.stop_s is None:
        yield from arrivals
        return
    at_s, for_s = cell.host.stop_s
    stop_ns = begin_ns + int(at_s * NS_PER_S)
    end_ns = stop_ns + int(for_s * NS_PER_S)
    room = WAITING_BYTES // cell.device.size_bytes
    for number, a in arrivals:
        if not stop_ns <= a.t_rx_ns < end_ns:
            yield number, a
        elif room:
            room -= 1
            yield number, replace(a, t_rx_ns=end_ns, trailing_bytes=room * a.size_bytes if cell.link.baud else 0)


def _measurement(device: Device, a: Arrival, number: int) -> Measurement:
    ms = a.dev_ns // NS_PER_MS
    if device.says == "time":
        return Measurement(a.size_bytes, a.trailing_bytes, ms % (1 << 32))
    if device.says == "number":
        return Measurement(a.size_bytes, a.trailing_bytes, number % 256)
    age = {"stamp": ms % STAMP_MODULUS, "trigger": 0}.get(device.says)
    return Measurement(a.size_bytes, a.trailing_bytes, None, pps_age_ms=age)
