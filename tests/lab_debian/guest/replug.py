"""The USB adapter is unplugged and plugged in ten times: samples and product return, without wrong warnings."""

import time

from tests.lab_debian.guest.checks import Checks, Failed, expect, wait_until
from tests.lab_debian.guest.system import Host, device, journal, mark, wait_streaming

ROUNDS = 10
ROUNDS_SHORT = 2  # rounds with --short


def check(checks: Checks, host: Host) -> None:
    wait_streaming("usb")
    product = wait_until(lambda: (device("usb") or {})["identity"].get("product"), "the product before")
    taken: list[float] = []
    for number in range(1, ROUNDS + 1):
        with checks(f"unplugged and plugged, {number} of {ROUNDS}: samples, no wrong warning, the product"):
            taken.append(one_round(host, product))
            checks.figure(f"node to samples, round {number}", taken[-1], "s")
    if taken:
        checks.figure("node to samples, median", sorted(taken)[len(taken) // 2], "s")
        checks.figure("node to samples, maximum", max(taken), "s")


def one_round(host: Host, product: str) -> float:
    """Unplug, wait until the daemon reports it, plug in. Return the time from the node to the first new sample, s."""
    since = mark()
    host.unplug()
    wait_until(lambda: (device("usb") or {}).get("state") not in ("running", None), "the device in the state missing")
    node_s = host.plug()
    wait_streaming("usb")
    taken_s = time.monotonic() - node_s
    wait_until(lambda: (device("usb") or {})["identity"].get("product"), "the product after", limit_s=30)
    expect("product", (device("usb") or {})["identity"]["product"], product)
    said = journal(since)
    for word in ("cannot open", "usermod", "EPERM"):
        if word in said:
            raise Failed(f"expected no {word!r} in the log, got: {said}")
    return taken_s
