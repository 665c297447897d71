"""The end of `imud setup`: whether samples come from every device, at which rate, with which error of their time."""

from collections.abc import Callable, Collection, Sequence
from typing import Final

import msgspec

from imud.cli.output import shortened, table
from imud.contracts.status import DeviceState, DeviceStatus
from imud.errors import ImudError
from imud.units import NS_PER_MS

SAMPLES_HEAD: Final = ("DEVICE", "STATE", "RATE HZ", "PRODUCT", "CLOCK ERROR")
NAME_WIDTH: Final = 24
PRODUCT_WIDTH: Final = 20
LOOK_S: Final = 0.5
"""Time between two looks."""
SETTLE_S: Final = 4.0
"""Time for the rate, a mean over seconds, and for the answer of the device to what it is."""


def wait_for_samples(
    ask: Callable[[], list[DeviceStatus]],
    names: Collection[str],
    limit_s: float,
    now_s: Callable[[], float],
    sleep: Callable[[float], None],
) -> list[DeviceStatus]:
    """Wait until all devices of these names run, and SETTLE_S more; return their status, at `limit_s` whatever it is.

    Raises ImudError where the daemon does not answer until then.
    """
    end_s = now_s() + limit_s
    settled_s = end_s
    while True:
        try:
            found = [one for one in ask() if one.name in names]
            problem: Exception | None = None
        except (ImudError, TimeoutError, msgspec.ValidationError) as error:
            found, problem = [], error
        now = now_s()
        runs = len(found) == len(names) and all(_runs(one) for one in found)
        settled_s = min(settled_s, now + SETTLE_S) if runs else end_s
        if now >= min(end_s, settled_s):
            if problem is not None:
                raise ImudError(f"the daemon does not answer: {problem}; `sudo imud doctor` says more")
            return found
        sleep(LOOK_S)


def samples_table(found: Sequence[DeviceStatus]) -> str:
    """Format rate, product and error of each device."""
    return table(SAMPLES_HEAD, [_row(one) for one in found])


def reasons(found: Sequence[DeviceStatus], names: Sequence[str]) -> list[str]:
    """Say for each device of these names why it gives no samples; empty when all do."""
    known = {one.name: one for one in found}
    return [_reason(name, known.get(name)) for name in names if name not in known or not _runs(known[name])]


def _reason(name: str, one: DeviceStatus | None) -> str:
    return (
        f"{name}: the daemon does not have it: `systemctl status imud`"
        if one is None
        else (f"{name}: {one.problem or one.state}")
    )


def _runs(one: DeviceStatus) -> bool:
    return one.state is DeviceState.RUNNING


def _row(one: DeviceStatus) -> tuple[object, ...]:
    error = f"{one.clock.t_err_ns / NS_PER_MS:.3f} ms" if _runs(one) else "-"
    product = shortened(one.identity.get("product", "-"), PRODUCT_WIDTH)
    return shortened(one.name, NAME_WIDTH), one.state, one.rate_hz, product, error
