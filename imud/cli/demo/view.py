"""The live view of `imud demo`, drawn in place, and the account at its end."""

from collections import deque
from time import monotonic_ns
from typing import TextIO

from imud.sample import Sample
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US, RAD_PER_DEG

DRAW_NS = NS_PER_S // 10
LATENCIES_KEPT = 100_000
CLEAR_LINE = "\x1b[2K"
UP = "\x1b[{}A"


class View:
    """View of one device: counts samples and their latency, and draws the newest ten times a second."""

    def __init__(self, out: TextIO, *, live: bool) -> None:
        self.samples = 0
        self.missed = 0
        self._out = out
        self._live = live
        self._drawn_lines = 0
        self._due_ns = 0
        self._first_ns = 0
        self._last: Sample | None = None
        self._seqs: dict[str, int] = {}
        """Number of the newest sample of each device."""
        self._latencies_ns: deque[int] = deque(maxlen=LATENCIES_KEPT)

    def add(self, sample: Sample) -> None:
        """Count and draw one sample as it arrives."""
        now_ns = monotonic_ns()
        if self._last is None:
            self._first_ns = sample.t_ns
        self.missed += sample.seq - self._seqs.get(sample.device, sample.seq - 1) - 1
        self._seqs[sample.device] = sample.seq
        self.samples += 1
        self._last = sample
        self._latencies_ns.append(now_ns - sample.t_rx_ns)
        if self._live and now_ns >= self._due_ns:
            self._due_ns = now_ns + DRAW_NS
            self._draw(sample)

    def end(self) -> None:
        """Leave the last picture on the terminal."""
        self._drawn_lines = 0
        self._out.flush()

    def account(self) -> str:
        """Format rate, losses and latency as this client saw them."""
        if self._last is None:
            return "  client    no sample arrived"
        span_ns = self._last.t_ns - self._first_ns
        rate = (self.samples + self.missed - len(self._seqs)) * NS_PER_S / span_ns if span_ns else 0.0
        ordered = sorted(self._latencies_ns)
        at = {
            share: ordered[min(len(ordered) - 1, int(share * len(ordered)))] / NS_PER_US for share in (0.5, 0.99, 1.0)
        }
        return (
            f"  client    {self.samples} samples at {rate:.2f} Hz, {self.missed} missed; from the port to this client "
            f"p50 {at[0.5]:.0f} µs, p99 {at[0.99]:.0f} µs, max {at[1.0]:.0f} µs"
        )

    def _draw(self, sample: Sample) -> None:
        lines = picture(sample)
        up = UP.format(self._drawn_lines) if self._drawn_lines else ""
        self._out.write(up + "".join(f"{CLEAR_LINE}{line}\n" for line in lines))
        self._out.flush()
        self._drawn_lines = len(lines)


def picture(sample: Sample) -> list[str]:
    """Format the newest sample in everyday units."""
    degrees, rates = _in(sample.euler_rad, RAD_PER_DEG), _in(sample.gyro_rad_s, RAD_PER_DEG)
    return [
        f"{sample.device} #{sample.seq}   stamp by {sample.sync}, ±{sample.t_err_ns / NS_PER_MS:.3f} ms",
        f"  roll pitch yaw  {degrees} °",
        f"  gyro            {rates} °/s",
        f"  accel           {_in(sample.accel_m_s2, 1.0)} m/s²",
        f"  mag             {_in(sample.mag_t, 1e-6)} µT",
    ]


def _in(vector: tuple[float, float, float] | None, unit: float) -> str:
    return " ".join(f"{value / unit:9.3f}" for value in vector) if vector else "        -"
