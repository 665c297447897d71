"""Measures the time stamp errors of held samples: `python -m tests.bench.clock_hold`.

The same simulated arrivals are read in three ways, at intervals of the latency:

- at once: each frame is read on arrival.
- one in time: imud reads one frame on arrival, then all held frames at intervals of the latency. The clock receives the
  hold. Every 50 ms, imud reads the next frame on arrival again. Behind a latency timer, it does so after each interval
  (`imud.device.stream_transport`).
- by timer: all frames are held. The clock interprets the hold as the latency timer of an adapter.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from imud.device.stream_transport import WATCH_NS
from imud.model.sample import Measurement, Sync
from imud.model.units import NS_PER_MS
from imud.sampling.clock import SampleClock
from imud.sim.ports.arrival import BARE_UART, LOADED, USB_1MS, USB_16MS, Arrival, ArrivalModel, ArrivalProfile, Crystal
from tests.bench.clock import BAUD_OF_RATE, CRYSTALS, TICK_MODULUS, TICK_NS, Accuracy, Point, accuracy
from tests.bench.rows import Row, at_most

PROFILES = (BARE_UART, USB_1MS, USB_16MS, LOADED)
HOLDS_MS = {1000: (10, 50), 200: (20, 50)}  # by rate, Hz
SECONDS = 150


class TimedRead(NamedTuple):
    arrival: Arrival
    t_rx_ns: int
    trailing_bytes: int
    waited_ns: int


def at_once(arrivals: Sequence[Arrival], _hold_ns: int, _byte_ns: int, _watch_ns: int) -> Iterator[TimedRead]:
    return (TimedRead(a, a.t_rx_ns, a.trailing_bytes, 0) for a in arrivals)


def one_in_time(arrivals: Sequence[Arrival], hold_ns: int, byte_ns: int, watch_ns: int) -> Iterator[TimedRead]:
    at = 0
    while at < len(arrivals):
        begun_ns = arrivals[at].t_rx_ns
        # this frame, and frames of the same read
        while at < len(arrivals) and arrivals[at].t_rx_ns == begun_ns:
            yield TimedRead(arrivals[at], begun_ns, arrivals[at].trailing_bytes, 0)
            at += 1
        end_ns = begun_ns + hold_ns
        while end_ns <= begun_ns + max(watch_ns, hold_ns):
            end = at
            while end < len(arrivals) and arrivals[end].t_rx_ns <= end_ns:
                end += 1
            yield from _together(arrivals, at, end, end_ns, byte_ns, hold_ns)
            if end == at:
                # no frame arrived during the interval: the next frame is read on arrival
                break
            at, end_ns = end, end_ns + hold_ns


def by_timer(arrivals: Sequence[Arrival], hold_ns: int, byte_ns: int, _watch_ns: int) -> Iterator[TimedRead]:
    at, end_ns = 0, arrivals[0].t_rx_ns
    while at < len(arrivals):
        end = at
        while end < len(arrivals) and arrivals[end].t_rx_ns <= end_ns:
            end += 1
        yield from _together(arrivals, at, end, end_ns, byte_ns, 0)
        at, end_ns = end, end_ns + hold_ns


def _together(
    arrivals: Sequence[Arrival], at: int, end: int, t_rx_ns: int, byte_ns: int, waited_ns: int
) -> Iterator[TimedRead]:
    """Yield the frames of one read. The received bytes of the next, incomplete frame are trailing bytes."""
    rest = 0
    if end < len(arrivals) and byte_ns:
        after = arrivals[end]
        whole_ns = after.t_rx_ns - after.trailing_bytes * byte_ns
        rest = min(max(after.size_bytes - (whole_ns - t_rx_ns) // byte_ns, 0), after.size_bytes - 1)
    for number in range(at, end):
        trailing = (end - 1 - number) * arrivals[number].size_bytes + rest
        yield TimedRead(arrivals[number], t_rx_ns, trailing, waited_ns)


Way = Callable[[Sequence[Arrival], int, int, int], Iterator[TimedRead]]
WAYS: dict[str, Way] = {"at once": at_once, "one in time": one_in_time, "by timer": by_timer}


def run(way: str, model: ArrivalModel, seconds: int, hold_ns: int) -> list[Point]:
    arrivals = list(model.run(int(model.rate_hz) * seconds))
    told_ns = model.profile.hold_ns + hold_ns * (way == "by timer")
    clock = SampleClock("bench", tick_ns=TICK_NS, tick_modulus=TICK_MODULUS, byte_ns=model.byte_ns, hold_ns=told_ns)
    watch_ns = 0 if model.profile.hold_ns else WATCH_NS
    points = []
    first = {True: at_once, False: WAYS[way]}
    # 5 s until the clock uses the fit
    settle = next(i for i, a in enumerate(arrivals) if a.t_ns - arrivals[0].t_ns > 5_000 * NS_PER_MS)
    begin = settle if way == "one in time" else 0  # nothing is held before the clock uses the fit
    for early, part in ((True, arrivals[:begin]), (False, arrivals[begin:])):
        for a, t_rx_ns, trailing_bytes, waited_ns in first[early](part, hold_ns, model.byte_ns, watch_ns):
            m = Measurement(a.size_bytes, trailing_bytes, a.dev_ns // TICK_NS % TICK_MODULUS)
            clock.waited_ns = waited_ns
            s = clock.sample(m, t_rx_ns, 0)
            points.append(Point(s.t_ns - a.t_ns, s.t_err_ns, s.sync is Sync.REGRESSION, a.t_ns))
    return points


def measure(way: str, profile: ArrivalProfile, rate_hz: int, crystal: Crystal, hold_ms: int) -> Accuracy:
    model = ArrivalModel(profile, rate_hz, 1, crystal, BAUD_OF_RATE[rate_hz])
    return accuracy(run(way, model, SECONDS, hold_ms * NS_PER_MS))


def rows(*, quick: bool = False) -> Iterator[Row]:
    for profile in PROFILES[:1] if quick else PROFILES:
        plain, held = (
            measure(way, profile, 1000, CRYSTALS["+50 ppm"], 10).sigma_ns for way in ("at once", "one in time")
        )
        yield at_most(f"clock: sigma with a hold of 10 ms / without a hold, {profile.name}", held / plain, "x", 1.5)


def main() -> None:
    print("| arrival | rate, Hz | latency, ms | way | σ, µs | rms, µs | mean t_err, µs | in 2 t_err | settling |")
    print("|---|---|---|---|---|---|---|---|---|")
    for profile in PROFILES:
        for rate_hz, holds_ms in HOLDS_MS.items():
            for hold_ms in holds_ms:
                for way in WAYS:
                    found = [measure(way, profile, rate_hz, CRYSTALS[name], hold_ms) for name in ("+50 ppm", "drift")]
                    figures = [
                        "–".join(f"{ns / 1000:.0f}" for ns in sorted(getattr(one, name) for one in found))
                        for name in ("sigma_ns", "rms_ns", "mean_t_err_ns")
                    ]
                    share, settling = min(a.share for a in found), min(a.share_settling for a in found)
                    print(
                        f"| {profile.name} | {rate_hz} | {hold_ms} | {way} | {' | '.join(figures)} "
                        f"| {share:.3f} | {settling:.3f} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
