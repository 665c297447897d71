"""Model of arrival times with a known truth: the reference for the clock of imud.

A device with its own crystal samples at regular steps of its own time. Each frame crosses the wire; frames wait if the
wire is slower than the samples. An adapter can hold bytes until a latency timer fires or a USB packet is full. The
reader wakes up later and reads all waiting bytes at the same time:

    truth ──▶ wire (size × byte time) ──▶ adapter (FIFO timeout | latency timer) ──▶ wake-up ──▶ t_rx

Times are ns of CLOCK_MONOTONIC of the host. All random values follow from one seed.
"""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from random import Random

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US, uart_byte_ns


@dataclass(frozen=True, slots=True)
class Crystal:
    """Clock of the device relative to the clock of the host."""

    skew_ppm: float = 0.0  # rate error at the start relative to the host clock, 1e-6
    drift_ppm_s: float = 0.0  # change of the rate error per second, 1e-6 (temperature)
    drift_limit_ppm: float = 10.0  # Maximum change of the rate error, 1e-6. The drift reverses at this limit.
    start_ns: int = 5_000_000_123_456  # device time of the first sample, ns


@dataclass(frozen=True, slots=True)
class ArrivalProfile:
    """Delays between the wire of the device and the program that reads it. `Adapter` uses only the latency timer."""

    name: str  # name of the profile
    timer_ns: int = 0  # period of the latency timer, ns; 0 for no timer
    # Rate error of the timer relative to the host clock, 1e-6; 0 runs in lockstep with an exact device.
    timer_ppm: float = 0.0
    # Number of bytes after which the adapter sends a packet and restarts its timer (FT232: 62); 0: never.
    packet_bytes: int = 0
    poll_ns: int = 0  # maximum time until the bus polls the adapter, ns, uniform distribution
    # Number of byte times after which a receive FIFO reports bytes below its trigger level (16550: 4).
    fifo_bytes: float = 0.0
    floor_ns: int = 0  # minimum wake-up time, ns
    wake_ns: int = 0  # mean of the exponential part of the wake-up time, ns
    stall_share: float = 0.0  # share of reads with an additional delay
    stall_ns: int = 0  # mean of the additional delay, ns, exponential distribution

    @property
    def hold_ns(self) -> int:
        """Return the latency timer of the adapter, ns, as a link reports it."""
        return self.timer_ns


PERFECT = ArrivalProfile("perfect")
# UART of the host, without a latency timer
BARE_UART = ArrivalProfile(
    "bare-uart", fifo_bytes=4, floor_ns=30 * NS_PER_US, wake_ns=30 * NS_PER_US, stall_share=0.005, stall_ns=NS_PER_MS
)
# USB adapter with a latency timer of 1 ms
USB_1MS = ArrivalProfile(
    "usb-1ms", timer_ns=NS_PER_MS, timer_ppm=-30, poll_ns=125 * NS_PER_US, floor_ns=30 * NS_PER_US,
    wake_ns=40 * NS_PER_US, stall_share=0.005, stall_ns=NS_PER_MS,
)  # fmt: skip
# USB adapter with a latency timer of 16 ms, the default of FTDI
USB_16MS = ArrivalProfile(
    "usb-16ms", timer_ns=16 * NS_PER_MS, timer_ppm=-30, poll_ns=125 * NS_PER_US, floor_ns=30 * NS_PER_US,
    wake_ns=40 * NS_PER_US, stall_share=0.005, stall_ns=NS_PER_MS,
)  # fmt: skip
USB_16MS_PACKET = ArrivalProfile(
    "usb-16ms-packet", timer_ns=16 * NS_PER_MS, timer_ppm=-30, packet_bytes=62, poll_ns=125 * NS_PER_US,
    floor_ns=30 * NS_PER_US, wake_ns=40 * NS_PER_US, stall_share=0.005, stall_ns=NS_PER_MS,
)  # fmt: skip
LOADED = ArrivalProfile(
    "loaded", fifo_bytes=4, floor_ns=40 * NS_PER_US, wake_ns=300 * NS_PER_US, stall_share=0.05, stall_ns=8 * NS_PER_MS
)
PROFILES = (PERFECT, BARE_UART, USB_1MS, USB_16MS, USB_16MS_PACKET, LOADED)  # all profiles, the best profile first


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame at the reader, with its true times."""

    t_ns: int  # truth: host time of the measurement, ns
    dev_ns: int  # Device time of the measurement without wrap, ns. The device sends `dev_ns // tick_ns % tick_modulus`.
    size_bytes: int
    trailing_bytes: int
    t_rx_ns: int


@dataclass(slots=True)
class ArrivalModel:
    """Arrivals of a device with `rate_hz` in its own time behind a profile."""

    profile: ArrivalProfile
    rate_hz: float
    seed: int
    crystal: Crystal = field(default_factory=Crystal)
    baud: int = 921_600  # baud rate, bit/s; 0: frames take no time on the wire
    size_bytes: int = 82  # Size of a frame, bytes. HI91: six bytes of head, 76 of payload (manual B §3).
    begin_ns: int = 1_000 * NS_PER_S

    @property
    def byte_ns(self) -> int:
        return uart_byte_ns(self.baud)

    def run(self, count: int) -> Iterator[Arrival]:
        """Yield the first `count` frames in order of arrival."""
        random = Random(f"{self.profile.name} {self.rate_hz} {self.seed}")
        truth = list(self._truth(count, random))
        begins = self._on_wire([t for t, _ in truth])
        handed = self._handed_over(begins, random)
        first = 0
        while first < count:
            t_rx_ns = int(handed[first] + self._wake(random))
            last = first
            while last + 1 < count and handed[last + 1] <= t_rx_ns:
                last += 1
            rest = self._begun_bytes(begins, last + 1, self._newest_hand_over(handed[last], t_rx_ns))
            for i in range(first, last + 1):
                trailing = (last - i) * self.size_bytes + rest
                yield Arrival(int(truth[i][0]), int(truth[i][1]), self.size_bytes, trailing, t_rx_ns)
            first = last + 1

    def _truth(self, count: int, random: Random) -> Iterator[tuple[float, float]]:
        """Yield the pairs (host time, device time) of the samples."""
        crystal, period_ns = self.crystal, NS_PER_S / self.rate_hz
        ppm, slope, limit = 0.0, crystal.drift_ppm_s, crystal.drift_limit_ppm
        t_ns = self.begin_ns + random.random() * 50 * NS_PER_MS
        for i in range(count):
            yield t_ns, crystal.start_ns + i * period_ns
            step_ns = period_ns / (1 + (crystal.skew_ppm + ppm) * 1e-6)
            t_ns += step_ns
            ppm += slope * step_ns / NS_PER_S
            if abs(ppm) > limit:
                slope = -abs(slope) if ppm > 0 else abs(slope)

    def _on_wire(self, truth: list[float]) -> list[float]:
        """Return the time at which the first byte of each frame leaves: immediately, or after the previous frame."""
        duration_ns = self.size_bytes * self.byte_ns
        begins: list[float] = []
        free_ns = 0.0
        for t_ns in truth:
            begins.append(max(t_ns, free_ns))
            free_ns = begins[-1] + duration_ns
        return begins

    def _handed_over(self, begins: list[float], random: Random) -> list[float]:
        """Return the time at which the adapter has delivered the last byte of each frame."""
        profile, duration_ns = self.profile, self.size_bytes * self.byte_ns
        if not profile.timer_ns:
            return [begin + duration_ns + profile.fifo_bytes * self.byte_ns for begin in begins]
        phase_ns = self.begin_ns - random.random() * profile.timer_ns
        if profile.packet_bytes:
            return self._packets(begins, phase_ns)
        step_ns = self._timer_step_ns()
        return [end - (end - phase_ns) % step_ns + step_ns for end in (begin + duration_ns for begin in begins)]

    def _packets(self, begins: list[float], timer_from_ns: float) -> list[float]:
        """Return the same times for an adapter that sends full packets and restarts its timer with each packet."""
        byte_ns, size, full, step_ns = self.byte_ns, self.size_bytes, self.profile.packet_bytes, self._timer_step_ns()
        handed = [0.0] * len(begins)
        sent = done = 0
        while done < len(begins):
            at = sent + full
            fill_ns = begins[(at - 1) // size] + ((at - 1) % size + 1) * byte_ns if at <= len(begins) * size else 1e99
            timer_from_ns = min(fill_ns, timer_from_ns + step_ns)
            sent = max(sent, at if timer_from_ns == fill_ns else self._bytes_by(begins, timer_from_ns))
            while done < len(begins) and (done + 1) * size <= sent:
                handed[done] = timer_from_ns
                done += 1
        return handed

    def _timer_step_ns(self) -> float:
        return self.profile.timer_ns / (1 + self.profile.timer_ppm * 1e-6)

    def _wake(self, random: Random) -> float:
        profile = self.profile
        wait_ns: float = profile.floor_ns
        if profile.poll_ns:
            wait_ns += random.random() * profile.poll_ns
        if profile.wake_ns:
            wait_ns += random.expovariate(1 / profile.wake_ns)
        if random.random() < profile.stall_share:
            wait_ns += random.expovariate(1 / profile.stall_ns)
        return wait_ns

    def _newest_hand_over(self, handed_ns: float, t_rx_ns: int) -> float:
        """Return the time of the newest byte in a read at `t_rx_ns` that contains bytes delivered at `handed_ns`."""
        profile = self.profile
        if not profile.timer_ns:
            return t_rx_ns - profile.fifo_bytes * self.byte_ns
        if profile.packet_bytes:
            return handed_ns
        step_ns = self._timer_step_ns()
        return handed_ns + (t_rx_ns - handed_ns) // step_ns * step_ns

    def _begun_bytes(self, begins: list[float], index: int, until_ns: float) -> int:
        """Return the number of bytes of frame `index` that arrived until `until_ns`, less than a complete frame."""
        if index >= len(begins) or not self.byte_ns:
            return 0
        return min(max(int((until_ns - begins[index]) / self.byte_ns), 0), self.size_bytes - 1)

    def _bytes_by(self, begins: list[float], until_ns: float) -> int:
        """Return the number of bytes of the whole stream that arrived until `until_ns`."""
        index = bisect_left(begins, until_ns)
        if index == 0:
            return 0
        if not self.byte_ns:
            return index * self.size_bytes
        part = min(int((until_ns - begins[index - 1]) / self.byte_ns), self.size_bytes)
        return (index - 1) * self.size_bytes + part
