"""The clock for the samples of a driver."""

from collections.abc import Callable

from imud.contracts.driver import Driver
from imud.contracts.lines import DeviceLines
from imud.host.clock import UNSTEERED, SteadyTime
from imud.sampling.clock import SampleClock


def make_clock(
    name: str,
    lines: DeviceLines | None,
    driver: Driver,
    before: SampleClock | None,
    *,
    host: SteadyTime = UNSTEERED,
    byte_ns: int = 0,
    hold_ns: int = 0,
    on_unknown_gap: Callable[[], None] = lambda: None,
) -> SampleClock:
    """Return the clock for samples of `driver`. With `before`, continue its sequence numbers and time stamps."""
    clock = SampleClock(
        name,
        tick_ns=driver.tick_ns,
        tick_modulus=driver.tick_modulus,
        byte_ns=byte_ns,
        hold_ns=hold_ns,
        stamp_modulus=driver.stamp_modulus,
        bits=driver.time_bits,
        sout=lines.sout.timing if lines is not None and lines.sout is not None else None,
        sin=lines.sin.timing if lines is not None and lines.sin is not None else None,
        host=host,
        on_unknown_gap=on_unknown_gap,
    )
    if before is not None:
        clock.continue_from(before)
    return clock
