"""Simulated devices, links and hosts with one fault each, and the true time of each sample (for `clock_table`).

A frame takes the same path as in `ArrivalModel`. Here, parts of the path misbehave. Arrival times cannot show the
constant part of a link's delay. This part is different in each installation. Each seed is therefore another
installation (`machine_of`) with its own crystals, FIFO, adapter timer and constant delay. The delay is within the
bounds that imud assumes (`LinkDelay`). Judge the time stamp error only over several installations: in a single
installation, the constant delay is one random value.
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

SECONDS: Final = 120  # duration of a cell
WakeLaw = Callable[[Random, float], float]
"""Function from a generator and the host time, ns, to the wake-up time of a read above the host's minimum, ns."""
STAMP_MODULUS: Final = 8192  # counter of HI92: 13 bits, ms


# --- machines -------------------------------------------------------------------------------------------------------

WAKE_LEAST_NS: Final = 5 * NS_PER_US
"""Minimum wake-up time of all hosts, ns: one interrupt and one switch to the waiting process."""
WAKE_MOST_NS: Final = 90 * NS_PER_US
"""Maximum of a host's minimum wake-up time above WAKE_LEAST_NS, ns: the bound that imud assumes (`LinkDelay`)."""
POLL_NS: Final = 60 * NS_PER_US
"""Maximum random wait for a USB poll, ns. Each host adds a constant wait of at most the same length. The sum of both is
a microframe of USB 2.0, 125 µs."""
FIFO_MOST_BYTES: Final = 4.0
"""Maximum number of byte times until a FIFO reports its bytes. A 16550 reports bytes below its trigger level after four
byte times. A port without a FIFO reports each byte immediately."""
CRYSTAL_PPM: Final = 50.0
"""Tolerance of the crystals of devices and adapters, ppm. With a larger error, the adapter timer beats faster with the
samples, and imud can see the timer more easily. The table of `clock` contains crystals with an error of 5 %."""


class Machine(NamedTuple):
    """Properties of an installation. `wake`, `poll` and `fifo` are shares of the bounds above, 0 to 1."""

    wake: float
    poll: float
    fifo: float
    timer_ppm: float
    skew_ppm: float

    def profile(self, link: "Link", name: str) -> ArrivalProfile:
        poll = POLL_NS if link.timer_ns else 0
        return ArrivalProfile(
            name, timer_ns=link.timer_ns, timer_ppm=self.timer_ppm, packet_bytes=link.packet_bytes, poll_ns=poll,
            # adapters with a latency timer have no UART FIFO delay: the timer is longer
            fifo_bytes=0 if link.timer_ns else FIFO_MOST_BYTES * self.fifo,
            floor_ns=WAKE_LEAST_NS + int(self.wake * WAKE_MOST_NS + self.poll * poll),
        )  # fmt: skip


NAMED: Final = tuple(
    Machine((i + 0.5) / 6, (2 * i % 6 + 0.5) / 6, (2 * i % 6 + 0.5) / 6, timer_ppm, skew_ppm)
    for i, (timer_ppm, skew_ppm) in enumerate(
        ((-30.0, 12.0), (14.0, -43.0), (3.0, 50.0), (-11.0, -7.0), (40.0, 28.0), (0.0, 0.0))
    )
)
"""Installations of the seeds 0 to 5: evenly distributed shares, and one adapter timer in lockstep with the device."""


def machine_of(seed: int) -> Machine:
    """Return the installation of a seed: one of `NAMED`, or random values with an even distribution."""
    if seed < len(NAMED):
        return NAMED[seed]
    # a seed always returns the same installation, also in another process
    random = Random(f"machine {seed}")
    tolerance = partial(random.uniform, -CRYSTAL_PPM, CRYSTAL_PPM)
    return Machine(random.random(), random.random(), random.random(), tolerance(), tolerance())


# --- links ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Link:
    name: str
    baud: int = 115_200
    """Baud rate, bit/s; 0 for a link without a wire time. On a CAN bus, the kernel time-stamps the first frame."""
    timer_ns: int = 0
    packet_bytes: int = 0
    told_hold_ns: int | None = None
    """Latency timer that the operating system reports, ns; None if it reports the true timer."""

    @property
    def hold_ns(self) -> int:
        return self.timer_ns if self.told_hold_ns is None else self.told_hold_ns


UART: Final = Link("uart")
USB_1: Final = Link("usb-1ms", timer_ns=NS_PER_MS)
USB_16: Final = Link("usb-16ms", timer_ns=16 * NS_PER_MS)
FT232: Final = Link("ft232-16ms", timer_ns=16 * NS_PER_MS, packet_bytes=62)  # sends a packet after 62 bytes
FRAMES: Final = Link("usb-frames", 0, timer_ns=NS_PER_MS)
"""A device with a USB interface of its own. The host polls it in USB frames of 1 ms, and no serial wire exists."""
CAN: Final = Link("can", 0)
LINKS: Final = (UART, USB_1, USB_16, FT232, FRAMES)


# --- hosts ----------------------------------------------------------------------------------------------------------


def _exponential(random: Random, _t_ns: float, mean_ns: float, stall_share: float, stall_ns: float) -> float:
    wait = random.expovariate(1 / mean_ns)
    return wait + random.expovariate(1 / stall_ns) if random.random() < stall_share else wait


def _pareto(random: Random, _t_ns: float) -> float:
    """Return a wait with a heavy tail: usually less than 50 µs, more than 5 ms in one of 1,000 reads."""
    # the exponent 1.3 has no finite variance; the maximum is 0.5 s
    return min(25 * NS_PER_US * (random.paretovariate(1.3) - 1), 0.5 * NS_PER_S)


def _log_normal(random: Random, t_ns: float) -> float:
    """Return a wait on a host with idle states and frequency scaling.

    Half of the reads wake the processor from an idle state. The host is busy for 2 s of every 7 s.
    """
    wait = random.lognormvariate(10.0, 0.9)  # median 22 µs
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
    slews: tuple[tuple[float, float], ...] = ()  # pairs of (start in s, rate error of CLOCK_MONOTONIC in ppm)
    steps: tuple[tuple[float, float], ...] = ()  # pairs of (time in s, forward step of CLOCK_REALTIME in s)
    suspend_s: tuple[float, float] | None = None
    """(start in s, duration in s) of a suspend. CLOCK_MONOTONIC and CLOCK_MONOTONIC_RAW stop. The device continues, and
    the host does not receive its frames."""
    stop_s: tuple[float, float] | None = None
    """(start in s, duration in s) of a stop of the virtual machine. The clocks of the host continue. Frames that do not
    fit into WAITING_BYTES during the stop are lost."""

    def stepped_ns(self, since_ns: int) -> int:
        # a suspend also moves CLOCK_REALTIME ahead of the stopped CLOCK_MONOTONIC
        steps = (*self.steps, self.suspend_s) if self.suspend_s else self.steps
        return sum(int(step_s * NS_PER_S) for at_s, step_s in steps if since_ns >= at_s * NS_PER_S)


WAITING_BYTES: Final = 256  # size of the receive buffer of an FT232, bytes


# --- devices --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Device:
    says: str = "time"
    """Time information in a frame. `time`: device time in ms (HI91). `stamp`: device time in ms modulo 8192 (HI92).
    `number`: 8-bit sample counter. `trigger`: only the information that a trigger occurred (HI92 in the mode MARK).
    `nothing`: no time."""
    rates_hz: Sequence[tuple[float, float]] = ((0.0, 100.0),)
    """Pairs of (start in s, rate in Hz). A change of the rate also shifts the sampling instant within the tick."""
    swing_ppm: float = 0.0  # amplitude of the rate error due to temperature, ppm, with the period `swing_s`
    swing_s: float = 200.0
    restarts_s: Sequence[float] = ()
    """Times of the device's restarts, s. After each, the device is silent for two seconds and its counter restarts."""
    ticks_before_wrap: int | None = None
    loss: float = 0.0  # share of frames that are lost individually
    loss_burst_s: tuple[float, float] | None = None
    """(period in s, duration in s) of bursts in which all frames are lost."""
    size_bytes: int = 82


class Message(NamedTuple):
    """A frame: the arguments of `SampleClock.sample`, and the true time of the measurement."""

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
    host: HostClocks | None = None  # changes of the host clocks; None for unchanged clocks

    @property
    def name(self) -> str:
        return f"{self.adversity}, {self.link.name}"

    def on(self, link: Link) -> "Cell":
        return replace(self, link=link)


@dataclass(slots=True)
class _AdverseModel(ArrivalModel):
    """Arrivals of a cell. `_truth` yields device time in whole ms."""

    cell: Cell = field(default_factory=lambda: Cell("", UART))
    skew_ppm: float = 0.0

    def _truth(self, count: int, random: Random) -> Iterator[tuple[float, float]]:
        device, begin_ns = self.cell.device, self.begin_ns + random.random() * 50 * NS_PER_MS
        t_ns, dev_ns = begin_ns, 5e12 + random.random() * NS_PER_MS
        # start the counter shortly before the 32-bit counter of ms wraps
        if device.ticks_before_wrap is not None:
            dev_ns += ((1 << 32) - device.ticks_before_wrap) * NS_PER_MS - 5e12
        rates, restarts, rate = list(device.rates_hz), list(device.restarts_s), 1.0
        suspend = self.cell.host.suspend_s if self.cell.host else None
        for _ in range(count):
            since_s = (t_ns - begin_ns) / NS_PER_S
            if rates and since_s >= rates[0][0]:
                rate = rates.pop(0)[1]
                if since_s:
                    # the device executes the rate command: 20 to 60 ms without samples
                    skipped_ns = random.uniform(20, 60) * NS_PER_MS
                    t_ns, dev_ns = t_ns + skipped_ns, dev_ns + skipped_ns
            if restarts and since_s >= restarts[0]:
                restarts.pop(0)
                # restart: 2 s of silence, device time continues near 0.4 s
                t_ns, dev_ns = t_ns + 2 * NS_PER_S, 4e8 + random.random() * NS_PER_MS
            if suspend and since_s >= suspend[0]:
                unheard_ns, suspend = suspend[1] * NS_PER_S, None
                # the device samples during the suspend; CLOCK_MONOTONIC does not advance
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
            # one read returns all frames that the adapter delivered before the wake-up
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
    # `_heard` applies the stop of a virtual machine before the losses
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
    # frames that fit into the receive buffer of the adapter
    room = WAITING_BYTES // cell.device.size_bytes
    for number, a in arrivals:
        if not stop_ns <= a.t_rx_ns < end_ns:
            yield number, a
        elif room:
            room -= 1
            # the host reads these frames together when the virtual machine continues
            yield number, replace(a, t_rx_ns=end_ns, trailing_bytes=room * a.size_bytes if cell.link.baud else 0)


def _measurement(device: Device, a: Arrival, number: int) -> Measurement:
    ms = a.dev_ns // NS_PER_MS
    if device.says == "time":
        return Measurement(a.size_bytes, a.trailing_bytes, ms % (1 << 32))
    if device.says == "number":
        return Measurement(a.size_bytes, a.trailing_bytes, number % 256)
    age = {"stamp": ms % STAMP_MODULUS, "trigger": 0}.get(device.says)
    return Measurement(a.size_bytes, a.trailing_bytes, None, pps_age_ms=age)
