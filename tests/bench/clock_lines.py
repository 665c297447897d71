"""Measures the time stamp errors with GPIO lines and UTC for docs/measurements.md, and the time that SOUT adds."""

import sys
from collections.abc import Callable, Iterator, Sequence
from math import sqrt
from time import perf_counter_ns

from imud.contracts.lines import SoutTiming
from imud.model.sample import Measurement
from imud.model.units import NS_PER_S
from imud.sim.ports.arrival import (
    BARE_UART,
    LOADED,
    USB_1MS,
    USB_16MS,
    USB_16MS_PACKET,
    ArrivalModel,
    ArrivalProfile,
    Crystal,
)
from tests.bench.clock import BAUD_OF_RATE, CRYSTALS, TICK_NS, clock_for
from tests.bench.clock_figures import LINE_HEAD, LineFigures, keep
from tests.bench.line_model import LineFaults, restarted, simulate_reads
from tests.bench.line_runs import (
    DatedSample,
    after,
    run_pps,
    run_sout,
    run_triggers,
    run_utc,
    share_honest,
    sout_clock,
    with_sout,
)  # fmt: skip
from tests.bench.rows import Row, at_least, at_most

CHUNK = 500  # samples per measured chunk
SETTLED_S = 20  # after this time, the clock uses the lines
FAULTS = {
    "": LineFaults(), "1 % of edges lost": LineFaults(edge_loss=0.01), "5 % extra edges": LineFaults(extra=0.05),
    "10 % of pulses and of frames lost, loaded": LineFaults(pulse_loss=0.1, frame_loss=0.1, loaded=True),
}  # fmt: skip
Case = tuple[str, str, int, Callable[[], list[DatedSample]]]
"""Source of the time, condition, rate in Hz, and the function that runs the case."""


def model(profile: ArrivalProfile, rate_hz: int, crystal: Crystal, seed: int = 1) -> ArrivalModel:
    return ArrivalModel(profile, rate_hz, seed, crystal, BAUD_OF_RATE[rate_hz])


def sout_cases(rate_hz: int) -> Iterator[Case]:
    plain = CRYSTALS["+50 ppm"]

    def case(profile: ArrivalProfile, crystal: Crystal, faults: LineFaults) -> Callable[[], list[DatedSample]]:
        return lambda: run_sout(model(profile, rate_hz, crystal), 60, faults)

    for profile in (BARE_UART, USB_1MS, USB_16MS, USB_16MS_PACKET, LOADED):
        loaded = LineFaults(loaded=profile is LOADED)
        yield "SOUT", profile.name, rate_hz, case(profile, plain, loaded)
    for name in ("+5 %", "-5 %", "drift"):
        yield "SOUT", f"usb-16ms, crystal {name}", rate_hz, case(USB_16MS, CRYSTALS[name], LineFaults())
    for name, faults in FAULTS.items():
        if name:
            yield "SOUT", f"usb-16ms, {name}", rate_hz, case(USB_16MS, plain, faults)
    # the device restarts in the middle of the run, with 1 s of silence
    m = model(USB_16MS, rate_hz, plain)
    yield (
        "SOUT", "usb-16ms, device restarts", rate_hz,
        lambda: with_sout(sout_clock(m), simulate_reads(restarted(m, 60 * rate_hz, NS_PER_S), 1, LineFaults())),
    )  # fmt: skip


def other_cases() -> Iterator[Case]:
    for profile, rate_hz in ((BARE_UART, 100), (USB_16MS, 100), (USB_16MS_PACKET, 100), (USB_16MS_PACKET, 1)):
        for ppm in (0.0, 50.0):
            crystal = Crystal(ppm)
            at = f"{profile.name}, {ppm:.0f} ppm"

            def pps(
                profile: ArrivalProfile = profile, rate_hz: int = rate_hz, crystal: Crystal = crystal
            ) -> list[DatedSample]:
                return run_pps(model(profile, rate_hz, crystal), 120)

            def utc(
                profile: ArrivalProfile = profile, rate_hz: int = rate_hz, crystal: Crystal = crystal
            ) -> list[DatedSample]:
                # 2^32 ms: the counter of UTC does not wrap in the run
                return run_utc(model(profile, rate_hz, crystal), 120, turn_ms=1 << 32)[0]

            yield "PPS", at, rate_hz, pps
            yield "UTC", at, rate_hz, utc
    for rate_hz in (100, 1000):
        for name in ("0 ppm", "+5 %"):

            def trigger(rate_hz: int = rate_hz, name: str = name) -> list[DatedSample]:
                return run_triggers(model(BARE_UART, rate_hz, CRYSTALS[name]), 60, 0.99)[0]

            yield "SIN trigger", f"bare-uart, crystal {name}", rate_hz, trigger


def sigma_ns(offs: Sequence[int]) -> float:
    mean = sum(offs) / len(offs)
    return sqrt(sum((off - mean) ** 2 for off in offs) / len(offs))


def table() -> Iterator[LineFigures]:
    for source, over, rate_hz, run in (*sout_cases(100), *sout_cases(1000), *other_cases()):
        dated = run()
        settled = after(dated, SETTLED_S)
        settling = dated[: len(dated) - len(settled)]
        offs = [t.off_ns for t in settled]
        figures = (
            sigma_ns(offs), sum(offs) / len(offs), sorted(map(abs, offs))[int(len(offs) * 0.999)],
            sum(t.sample.t_err_ns for t in settled) / len(settled),
        )  # fmt: skip
        # share of samples that used the source of this case
        mine = sum(t.sample.sync.value not in ("arrival", "regression") for t in settled) / len(settled)
        shares = (share_honest(settled), share_honest(settling), mine)
        yield LineFigures(
            source, over, rate_hz, *(round(ns / 1000, 1) for ns in figures), *(round(share, 3) for share in shares)
        )


def main() -> None:
    print(LINE_HEAD)
    found = []
    for one in table():
        found.append(one)
        print(one.row(), flush=True)
    if "--keep" in sys.argv:
        keep(lines=found)


def speed_ns(*, edges: bool, count: int = 20_000) -> float:
    """Return the mean time of one sample, ns, with or without the two edges of its pulse; best of all chunks."""
    v = (1.0, 2.0, 3.0)
    m = model(BARE_UART, 1000, CRYSTALS["+50 ppm"])
    clock = clock_for(m)
    best, begin, done = float("inf"), perf_counter_ns(), 0
    for read in simulate_reads(m.run(count), 1, LineFaults()):
        messages = [
            (
                Measurement(82, a.trailing_bytes, a.dev_ns // TICK_NS, v, v, v, (1.0, 0.0, 0.0, 0.0), v, 20.0, 1e5),
                a.t_rx_ns,
            )
            for a in read.arrivals
        ]
        if done == 0:
            spent = 0
        begin = perf_counter_ns()
        if edges:
            clock.add_edges("sout", read.edges)
        for message, t_rx_ns in messages:
            clock.sample(message, t_rx_ns, 0)
        spent += perf_counter_ns() - begin
        done += len(messages)
        # a chunk of 500 samples is short enough to miss interrupts of other programs
        if done >= CHUNK:
            best, done = min(best, spent / done), 0
    return best


def rows(*, quick: bool = False) -> Iterator[Row]:
    seconds = 10 if quick else 30
    plain, with_edges = speed_ns(edges=False), speed_ns(edges=True)
    yield at_most("clock: time that SOUT adds to one sample at 1 kHz", with_edges - plain, "ns", 4000)
    for profile, rate_hz in ((USB_16MS, 100), (LOADED, 1000)):
        dated = run_sout(
            model(profile, rate_hz, CRYSTALS["+50 ppm"]), seconds, LineFaults(edge_loss=0.01), SoutTiming(bias_us=0.0)
        )
        name = f"clock: with SOUT at {rate_hz} Hz, {profile.name}"
        yield at_most(f"{name}, sigma", sigma_ns([t.off_ns for t in after(dated, 5)]) / 1000, "us", 5)
        yield at_least(f"{name}, share within 2 t_err", share_honest(dated), "", 0.95)


if __name__ == "__main__":
    main()
