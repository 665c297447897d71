"""Checks of what the daemon receives: nothing, noise, echoes, damaged bytes, restarts of the device, edges of lines."""

from collections.abc import Iterator
from typing import Final

from imud.cli.doctor.finding import DoctorFinding, Findings, error, not_checked, note, ok, warning
from imud.cli.doctor.surroundings import Surroundings
from imud.contracts.status import DeviceState, DeviceStatus

HEARD_BYTES: Final = 200
"""Fewer bytes than a module sends in a second at its lowest rate are noise, or echoes of what imud sent."""
DAMAGED_SHARE: Final = 0.001
"""Share of bad frames above which a line is not in order; a good one has none in days."""
ANSWERED_AFTER_S: Final = 60.0
"""A device is asked who it is when it was found, and 5 and 35 s later; so long without an answer is no lost reply."""
RESETS: Final = 3
RESETS_PER_H: Final = 1.0
"""More restarts of a device per hour are no operator's."""
EDGES_AFTER_SAMPLES: Final = 100
"""So many samples without an edge on SOUT: it is not wired, or not switched on in the device."""
PPS_AFTER_S: Final = 10.0
S_PER_H: Final = 3600
DOWN: Final = "the daemon does not answer, so nothing is known of what it receives"
CONFIGURED_LINES: Final = ("sout", "sout_div", "data_ready", "alarm", "pps")


def heard(at: Surroundings) -> Findings:
    """Judge bytes and frames of devices on UARTs: none, noise of a wrong rate, echoes."""
    names = {one.name for one in at.devices("uart")}
    for one in _status(at, names):
        if isinstance(one, DoctorFinding):
            yield one
            return
        counts = one.ledger
        if one.state in (DeviceState.MISSING, DeviceState.FAILED, DeviceState.FINISHED):
            continue
        if counts["samples"]:
            yield from _damage(one)
            yield from _answers(at, one)
        elif counts["bytes_in"] == 0:
            yield error(
                f"{one.name}: nothing is heard on {one.link}: no power, or its TX is not wired to RX of this port",
                "is it powered? Are TX and RX swapped? TX of each end goes to RX of the other: exchange the two "
                "wires and look again. Is ground connected? Are the levels the same (TTL 3.3 V, RS-232 or RS-485)?",
            )
        elif one.kernel.framing or one.kernel.break_:
            yield error(
                f"{one.name}: {counts['bytes_in']} bytes, no valid frame; {one.kernel.framing} framing errors",
                "wrong rate: set `baud: auto`; if that is set, the levels are wrong or inverted",
            )
        elif counts["bytes_in"] < HEARD_BYTES:
            yield error(
                f"{one.name}: only {counts['bytes_in']} bytes came, no valid frame",
                "is it an echo of what imud sends (TX and RX joined, a half-duplex adapter)? Use an adapter "
                "without echo; else look at power and at TX of the module",
            )
        else:
            yield error(
                f"{one.name}: {counts['bytes_in']} bytes on {one.link}, but no {_missed(one)}",
                "wrong rate, driver or device: set `baud: auto` and `driver: auto`; `imud probe` tries all",
            )


def _missed(one: DeviceStatus) -> str:
    """What did not come. Noise of a wrong rate has lines that count as replies, so valid frames alone say nothing."""
    good = one.ledger["frames_good"]
    return f"sample in {good} frames" if good else "valid frame"


def _damage(one: DeviceStatus) -> Findings:
    counts, kernel = one.ledger, one.kernel
    bad = sum(counts[name] for name in ("frames_bad_crc", "frames_bad_length", "frames_bad_content"))
    if kernel.overrun:
        yield warning(
            f"{one.name}: the kernel lost bytes {kernel.overrun} times (overrun)",
            "less load on this machine, a lower rate, or an adapter with a larger buffer",
        )
    if bad > DAMAGED_SHARE * counts["frames_good"]:
        yield warning(
            f"{one.name}: {bad} damaged frames beside {counts['frames_good']} good ones; "
            f"{kernel.framing} framing and {kernel.parity} parity errors",
            "a shorter or shielded cable, a better ground, a lower rate; on RS-485 120 Ω at both ends",
        )
    elif not kernel.overrun:
        yield ok(f"{one.name}: {counts['frames_good']} good frames, {bad} damaged")


def _answers(at: Surroundings, one: DeviceStatus) -> Findings:
    """Judge a device whose samples come: one that never answered does not hear what imud sends."""
    asked = any(device.name == one.name and device.identify for device in (at.config.devices if at.config else ()))
    rate_hz = one.expected_rate_hz or one.rate_hz
    if not asked or one.identity.get("product") or one.ledger["frames_in_replies"]:
        return
    if one.state is DeviceState.RUNNING and one.ledger["samples"] > ANSWERED_AFTER_S * rate_hz > 0:
        yield warning(
            f"{one.name}: samples come, but no answer ever did: RX of the module is not wired to TX of this port",
            "wire TX of the adapter to RX of the module, with its level (3.3 V or RS-232); until then its settings "
            "cannot be changed. For a line of one direction: `identify: false`",
        )


def half_duplex(at: Surroundings) -> Findings:
    """Judge requests on RS-485 lines: unanswered ones, echoes, strange bytes."""
    for one in _status(at, {one.name for one in at.devices("rs485")}):
        if isinstance(one, DoctorFinding):
            yield one
            return
        line = one.serial_line
        if line is None:
            continue
        polls = one.polling.polls if one.polling is not None else 0
        if one.state is not DeviceState.RUNNING and line.timeouts:
            heard = f"only imud's own {line.echoes} echoes" if line.echoes else "nothing"
            yield error(
                f"{one.name}: {line.timeouts} requests unanswered, {heard} heard on {one.link}",
                "power, A and B swapped, address, rate: `imud modbus scan` with the daemon stopped finds "
                "modules; does the adapter switch its direction by itself (`direction`)?",
            )
        elif line.strange_bytes > max(line.timeouts, 1) or line.timeouts * 100 > polls:
            yield warning(
                f"{one.name}: {line.timeouts} requests unanswered, {line.strange_bytes} strange bytes",
                "120 Ω at both ends, bias on one; each address once; a longer `reply_ms`",
            )
        else:
            yield ok(
                f"{one.name}: its line is in order" + ("; echoes are expected and left out" if line.echoes else "")
            )


def restarts(at: Surroundings) -> Findings:
    """Look for devices that restart by themselves."""
    for one in _status(at):
        if isinstance(one, DoctorFinding):
            yield one
            return
        if not one.ledger["samples"]:
            continue
        resets = one.clock.resets
        rate_hz = one.expected_rate_hz or one.rate_hz
        hours = one.ledger["samples"] / rate_hz / S_PER_H if rate_hz else 0.0
        if resets >= RESETS and resets > RESETS_PER_H * hours:
            yield warning(
                f"{one.name} began its clock anew {resets} times within {hours:.1f} h of samples",
                "brown-out? Measure its supply at the module while it runs: a thin cable, a weak USB port, "
                "a shared regulator; then look for commands that restart it",
            )
        elif resets:
            yield note(f"{one.name} began its clock anew {resets} times since the daemon started")
        else:
            yield ok(f"{one.name} has not restarted since the daemon started")


def lines(at: Surroundings) -> Findings:
    """Look for lines that are wired and give no edges."""
    wired = {one.name for one in at.config.devices if one.lines is not None} if at.config else set()
    for one in _status(at, wired):
        if isinstance(one, DoctorFinding):
            yield one
            return
        if one.lines is None:
            continue
        for name, problem in one.lines.problems.items():
            yield error(f"{one.name}: {name}: {problem}", "docs/lines.md; `gpioinfo` lists lines and who uses them")
        for name, edges in one.lines.edges.items():
            if name not in one.lines.problems:
                yield _edges(one, name, edges, one.lines.edges_lost.get(name, 0))


def _edges(one: DeviceStatus, name: str, edges: int, lost: int) -> DoctorFinding:
    samples = one.ledger["samples"]
    if lost:
        return warning(
            f"{one.name}: {name}: {lost} of {edges + lost} edges were lost in the kernel",
            "the machine is too busy, or the line is noisy: `bias: pull-down`, a shorter wire",
        )
    if edges:
        return ok(f"{one.name}: {name}: {edges} edges")
    if name == "alarm":
        return note(
            f"{one.name}: alarm: no edge so far",
            "normal while no limit was passed; test it: tilt the module beyond its limit",
        )
    rate_hz = one.expected_rate_hz or one.rate_hz
    enough = samples > (PPS_AFTER_S * rate_hz if name == "pps" else EDGES_AFTER_SAMPLES)
    if not enough:
        return not_checked(
            f"{one.name}: {name}: no edge yet, too few samples for a judgement", "look again in a minute"
        )
    if name == "pps":
        return warning(
            f"{one.name}: pps: no pulse in {samples} samples",
            "has the receiver a fix? Is it this line (`gpiomon`)? Is the level 3.3 V?",
        )
    return warning(
        f"{one.name}: {name}: no edge in {samples} samples",
        "is the line wired to this GPIO, and is the output switched on in the module (docs/lines.md)? "
        "Try `active_low`, `bias`",
    )


def _status(at: Surroundings, names: set[str] | None = None) -> Iterator[DeviceStatus | DoctorFinding]:
    """Status of each of these devices; one finding where the daemon does not answer. Without names, of all."""
    if names is not None and not names:
        return
    if at.status is None:
        yield not_checked(DOWN, "start the daemon and look again")
        return
    yield from (one for one in at.status if names is None or one.name in names)
