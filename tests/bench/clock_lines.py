"""Measures the time stamp errors with GPIO lines and UTC: `python -m tests.bench.clock_lines`."""

import argparse
from collections.abc import Iterator
from itertools import chain
from statistics import pstdev

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
from tests.bench.clock import BAUD_OF_RATE, CRYSTALS
from tests.bench.clock_figures import LineFigures
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
from tests.support.results import ProgramRun, Table, add_json, printed, rows_of

SETTLED_S = 20  # after this time, the clock uses the lines
FAULTS = {
    "1 % of edges lost": LineFaults(edge_loss=0.01), "5 % extra edges": LineFaults(extra=0.05),
    "10 % of pulses and of frames lost, loaded": LineFaults(pulse_loss=0.1, frame_loss=0.1, loaded=True),
}  # fmt: skip
Case = tuple[str, str, int, list[DatedSample]]  # source of the time, condition, rate in Hz, and the samples of the run


def model(profile: ArrivalProfile, rate_hz: int, crystal: Crystal) -> ArrivalModel:
    return ArrivalModel(profile, rate_hz, 1, crystal, BAUD_OF_RATE[rate_hz])


def sout_cases(rate_hz: int) -> Iterator[Case]:
    plain = CRYSTALS["+50 ppm"]
    runs = [
        (profile.name, profile, plain, LineFaults(loaded=profile is LOADED))
        for profile in (BARE_UART, USB_1MS, USB_16MS, USB_16MS_PACKET, LOADED)
    ]
    runs += [
        (f"usb-16ms, crystal {name}", USB_16MS, CRYSTALS[name], LineFaults()) for name in ("+5 %", "-5 %", "drift")
    ]
    runs += [(f"usb-16ms, {name}", USB_16MS, plain, faults) for name, faults in FAULTS.items()]
    for over, profile, crystal, faults in runs:
        yield "SOUT", over, rate_hz, run_sout(model(profile, rate_hz, crystal), 60, faults)
    # the device restarts in the middle of the run, with 1 s of silence
    m = model(USB_16MS, rate_hz, plain)
    reads = simulate_reads(restarted(m, 60 * rate_hz, NS_PER_S), 1, LineFaults())
    yield "SOUT", "usb-16ms, device restarts", rate_hz, with_sout(sout_clock(m), reads)


def other_cases() -> Iterator[Case]:
    for profile, rate_hz in ((BARE_UART, 100), (USB_16MS, 100), (USB_16MS_PACKET, 100), (USB_16MS_PACKET, 1)):
        for ppm in (0.0, 50.0):
            m, at = model(profile, rate_hz, Crystal(ppm)), f"{profile.name}, {ppm:.0f} ppm"
            yield "PPS", at, rate_hz, run_pps(m, 120)
            # 2^32 ms: the counter of UTC does not wrap in the run
            yield "UTC", at, rate_hz, run_utc(m, 120, turn_ms=1 << 32)[0]
    for rate_hz in (100, 1000):
        for name in ("0 ppm", "+5 %"):
            dated = run_triggers(model(BARE_UART, rate_hz, CRYSTALS[name]), 60, 0.99)[0]
            yield "SIN trigger", f"bare-uart, crystal {name}", rate_hz, dated


def table() -> Iterator[LineFigures]:
    for source, over, rate_hz, dated in chain(sout_cases(100), sout_cases(1000), other_cases()):
        settled = after(dated, SETTLED_S)
        settling = dated[: len(dated) - len(settled)]
        offs = [t.off_ns for t in settled]
        figures = (
            pstdev(offs), sum(offs) / len(offs), sorted(map(abs, offs))[int(len(offs) * 0.999)],
            sum(t.sample.t_err_ns for t in settled) / len(settled),
        )  # fmt: skip
        # share of samples that used the source of this case
        mine = sum(t.sample.sync.value not in ("arrival", "regression") for t in settled) / len(settled)
        shares = (share_honest(settled), share_honest(settling), mine)
        yield LineFigures(
            source, over, rate_hz, *(round(ns / 1000, 1) for ns in figures), *(round(share, 3) for share in shares)
        )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.clock_lines")
    add_json(parser)
    args, program_run, found = parser.parse_args(), ProgramRun(), []
    for one in table():
        found += rows_of([one])
        print(printed(found[-1]), flush=True)
    program_run.save(args.json, [Table("", found)])


if __name__ == "__main__":
    main()
