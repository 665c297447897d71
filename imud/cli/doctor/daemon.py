"""Checks of the daemon: configuration, systemd unit, socket, outputs, and the traffic of the devices."""

import errno
import re
from collections.abc import Iterator
from typing import Final

import msgspec

from imud.cli.doctor.surroundings import DoctorFinding, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.config.yaml import path_text
from imud.contracts.condition import DOCTOR, Condition
from imud.contracts.status import DeviceState, DeviceStatus
from imud.host.files import open_regular
from imud.model.errors import LinkDenied, reason_of
from imud.model.units import NS_PER_S, NS_PER_US
from imud.publishers.metrics.publisher import MetricsOptions, Scrapes
from imud.publishers.recorder.directory import RecorderOptions
from imud.publishers.shm import ShmOptions

ENABLED: Final = ("enabled", "enabled-runtime", "linked", "static", "alias")
# Advice by exit status of `imud run` (docs/operate.md)
EXIT_ADVICE: Final = {
    "78": "the configuration is invalid: find the error with `imud check`, then `systemctl start imud`",
    "75": "a required output could not start: does another imud run? `journalctl -u imud -n 20`",
    "2": "the command line in the unit is invalid: `systemctl cat imud`",
}
STALE_NS: Final = 1 * NS_PER_S  # Minimum age difference of file and reload for a warning, ns. Both times are rounded.
RESTARTS: Final = 3  # number of restarts by systemd that causes a warning


def configuration(at: Surroundings) -> Findings:
    """Check the configuration file."""
    if at.config is not None:
        names = ", ".join(device.name for device in at.config.devices)
        if names:
            yield ok(f"{at.config_file} is valid; devices: {names}")
        else:
            yield warning(
                f"{at.config_file} contains no device", "add a device; list the attached devices with `imud probe`"
            )
        advice = f"run `imud check {at.config_file}`, which names the line, and correct the file"
        for finding in at.host_findings(at.config):
            if finding.is_error:  # a warning is often about a file that this user may not read
                yield error(f"{at.config_file}: {path_text(finding.path)}: {finding.message}", advice)
        for name in at.config.disabled:
            yield note(f"device {name} is disabled in {at.config_file}")
        for problem in at.config.ignored:
            yield error(problem, "then restart imud: `sudo systemctl restart imud` (docs/drivers.md)")
        return
    try:
        open_regular(at.at(at.config_file)).close()
    except OSError as problem:
        # not an error: other users usually cannot read the file
        if problem.errno in (errno.EACCES, errno.EPERM):
            yield not_checked(f"this user cannot read {at.config_file}", "run `sudo imud doctor`")
            return
        if problem.errno == errno.ENOENT:
            yield error(at.config_problem, "write a configuration for the attached devices with `sudo imud setup`")
            return
    for line in at.config_problem.splitlines():
        yield error(line, f"correct the file, then run `imud check {at.config_file}`")


def service(at: Surroundings) -> Findings:
    """Check the state of imud.service."""
    if not at.unit:
        yield not_checked("systemctl does not reply: does this host use systemd?")
        return
    if not at.installed:
        seen = "systemd does not know imud.service; you can start imud only with `imud run`"
        yield warning(seen, "install the unit: README.md, `Install as a service`")
        return
    yield _enabled(at)
    state, result = at.unit_value("ActiveState"), at.unit_value("Result")
    if state in ("active", "reloading"):
        yield ok(f"imud.service is {state}")
    elif state == "activating":
        yield warning(
            f"imud.service is starting, or waits for a restart (result: {result or 'none'})",
            "run `imud doctor` again in a minute; `journalctl -u imud -n 20`",
        )
    else:
        status = at.unit_value("ExecMainStatus")
        advice = EXIT_ADVICE.get(
            status if result == "exit-code" else "",
            "`sudo systemctl start imud`; if imud stops again, `journalctl -u imud -n 20`",
        )
        yield error(f"imud.service is {state or 'in an unknown state'} (result: {result or 'none'})", advice)
    restarts = at.unit_value("NRestarts")
    if restarts.isdecimal() and int(restarts) >= RESTARTS:
        yield warning(
            f"systemd restarted imud.service {restarts} times", "find the reason: `journalctl -u imud -p warning`"
        )
    if at.unit_value("NeedDaemonReload") == "yes":
        yield warning(
            "the unit file of imud.service changed on disk, but systemd still uses the previous file",
            "`sudo systemctl daemon-reload`, then `sudo systemctl restart imud`",
        )


def _enabled(at: Surroundings) -> DoctorFinding:
    state = at.unit_value("UnitFileState")
    if state in ENABLED:
        return ok(f"imud.service is {state}: systemd starts imud at boot")
    if state == "masked":
        return error("imud.service is masked: systemd cannot start imud", "`sudo systemctl unmask imud`")
    return warning(
        f"imud.service is {state or 'not enabled'}: systemd does not start imud at boot",
        "`sudo systemctl enable imud`",
    )


def socket(at: Surroundings) -> Findings:
    """Check that the daemon replies on its socket."""
    if at.status is not None:
        yield ok(f"the daemon replies; devices: {', '.join(one.name for one in at.status) or 'none'}")
    elif isinstance(at.status_error, LinkDenied):
        yield not_checked(f"{at.status_error}", "run `sudo imud doctor`, or join the group and log in again")
    elif at.daemon_down:
        yield error(f"{at.status_error}", "`sudo systemctl start imud`, or name the socket of the daemon with --socket")
    else:
        yield error(
            f"the reply of the daemon is invalid: {at.status_error}",
            "is the daemon overloaded, or another version? `systemctl status imud`",
        )


def c_kernel(at: Surroundings) -> Findings:
    """Check that the daemon uses the kernel in C."""
    if at.c_kernel is None:
        return  # the check `socket` reports a daemon that does not reply
    if at.c_kernel.active:
        yield ok("the daemon uses its C kernel")
    else:
        yield note(
            f"the daemon does not use its C kernel, so it needs more CPU time: {at.c_kernel.problem}",
            "if the CPU load is too high, install imud with a C compiler (docs/install.md)",
        )


def stale_configuration(at: Surroundings) -> Findings:
    """Compare the configuration file with the configuration of the running daemon."""
    if at.config is None:
        yield not_checked("cannot compare the running daemon with a configuration: the file is missing or invalid")
        return
    looked = False
    if at.status is not None:
        looked = True
        on_disk, running = {one.name for one in at.config.devices}, {one.name for one in at.status}
        if on_disk != running:
            yield warning(
                f"the daemon uses the devices {_names(running)}, {at.config_file} contains {_names(on_disk)}",
                "`sudo systemctl reload imud`, or name the file of the daemon with --config",
            )
            return
    changed_us = at.unit_value("StateChangeTimestampMonotonic")
    if at.unit_value("ActiveState") == "active" and changed_us.isdecimal() and int(changed_us):
        looked = True
        # systemd reports CLOCK_MONOTONIC, file times are UTC
        loaded_ns = int(changed_us) * NS_PER_US + at.boot_utc_ns()
        if at.at(at.config_file).stat().st_mtime_ns > loaded_ns + STALE_NS:
            yield warning(
                f"{at.config_file} changed after the last reload of the daemon", "`sudo systemctl reload imud`"
            )
            return
    if looked:
        yield ok(f"the daemon uses the configuration in {at.config_file}")
    else:
        yield not_checked("cannot compare the configuration: no daemon runs")


def device_states(at: Surroundings) -> Findings:
    """Report the condition of each device, with the reasons and next steps of the daemon."""
    if at.status is None:
        yield not_checked(
            "the device states are unknown, because the daemon does not reply",
            "start the daemon; without it, `imud probe` lists the attached devices",
        )
        return
    for one in at.status:
        for reason in one.reasons:
            words = f"{one.name}: {reason.message}"
            step = "see the findings about its port, bus and lines" if reason.next == DOCTOR else reason.next
            if one.has_problem:
                yield (error if one.word == Condition.MISSING else warning)(words, step)
            else:
                yield ok(words)


def _names(names: set[str]) -> str:
    return ", ".join(sorted(names)) or "none"


STALE_S: Final = 300.0  # Maximum time since the last scrape, s. Prometheus usually scrapes every 15 s to 1 min.
NEVER_S: Final = 300.0  # Maximum time without a first scrape, s. Prometheus can start later than imud.
# Key of the metrics in the configuration. Without the key, metrics are enabled by default, but perhaps unused.
CONFIGURED: Final = re.compile(r"^metrics:", re.MULTILINE)
# Folder in which RemoveIPC= of a unit removes the files of the service's user or group (systemd.exec(5))
SHARED_MEMORY: Final = "/dev/shm"
EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # address to connect to, for wildcard addresses to listen on


def shared_memory(at: Surroundings) -> Findings:
    """Check that systemd does not remove files that must stay after the daemon is killed."""
    folders = _in_shared_memory(at)
    if not folders or not at.installed:
        return
    for key, folder in folders:
        if at.unit_value("RemoveIPC") == "yes":
            yield warning(
                f"{key} is {folder}, and RemoveIPC= of imud.service removes the files in this folder when the daemon "
                "stops",
                "`sudo systemctl edit imud`, add `[Service]` and `RemoveIPC=no`, restart imud (docs/operate.md)",
            )
        else:
            yield ok(f"{key}: files in {folder} stay after the daemon is killed")


def _in_shared_memory(at: Surroundings) -> list[tuple[str, str]]:
    """Return the keys of the configuration with folders in SHARED_MEMORY, and the folders."""
    publishers = at.config.publishers if at.config is not None else {}
    shm, recorder = publishers.get("shm"), publishers.get("recorder")
    found = []
    if isinstance(shm, ShmOptions) and shm.enabled:
        found.append(("shm.directory", shm.directory))
    if isinstance(recorder, RecorderOptions) and recorder.flight.enabled:
        found.append(("recorder.flight.directory", recorder.flight.directory))
    return [(key, folder) for key, folder in found if f"{folder}/".startswith(f"{SHARED_MEMORY}/")]


def prometheus(at: Surroundings) -> Findings:
    """Check that Prometheus scrapes the metrics."""
    settings = at.config.publishers.get("metrics") if at.config is not None else None
    if not isinstance(settings, MetricsOptions):
        yield not_checked("the address of the metrics is unknown, because there is no valid configuration")
        return
    if not settings.enabled:
        yield note("the configuration disables the metrics: Prometheus cannot monitor imud")
        return
    if settings.port == 0:
        yield not_checked("the port of the metrics is unknown (`port: 0`)", "configure a port; the default is 9321")
        return
    if at.daemon_down:
        yield not_checked("there are no metrics, because no daemon runs")
        return
    place = f"{settings.address} port {settings.port}"
    try:
        text = at.fetch(EVERYWHERE.get(settings.address, settings.address), settings.port, "/scrapes")
        counted = msgspec.json.decode(text, type=Scrapes)
    except OSError as problem:
        yield error(
            f"the metrics do not reply at {place}: {reason_of(problem)}",
            "does another program use the port? `sudo ss -ltnp`, `journalctl -u imud -p warning`; is there a firewall?",
        )
        return
    except msgspec.DecodeError:
        yield error(f"the program at {place} is not imud", "configure another port for the metrics")
        return
    if not counted.scrapes:
        # a warning only if the user configured the metrics
        missed = counted.age_s > NEVER_S and CONFIGURED.search(at.text(at.config_file) or "")
        yield (warning if missed else note)(
            f"no scrape of {place} since imud opened it {_ago(counted.age_s)} ago",
            'if you use Prometheus, check `up{job="imud"}`; to scrape from another host, set `address: 0.0.0.0` '
            "(docs/monitoring.md). If you do not use Prometheus, set `metrics: {enabled: false}`",
        )
    elif counted.age_s > STALE_S:
        yield warning(
            f"no scrape of {place} for {counted.age_s / 60:.0f} minutes, after {counted.scrapes} scrapes",
            'does Prometheus run, can it reach this host? Check `up{job="imud"}`',
        )
    else:
        yield ok(f"metrics at {place}: {counted.scrapes} scrapes, the last {counted.age_s:.0f} s ago")


def _ago(seconds: float) -> str:
    return f"{seconds / 60:.0f} minutes" if seconds >= 120 else f"{seconds:.0f} s"


# Number of bytes that a device sends in 1 s at its lowest rate. Fewer bytes are noise or echoes of imud's requests.
HEARD_BYTES: Final = 200
DAMAGED_SHARE: Final = 0.001  # Maximum share of damaged frames. A good link has no damaged frame in days.
# Time without a reply that causes a warning, s. imud requests the identity at detection, and 5 s and 35 s later.
ANSWERED_AFTER_S: Final = 60.0
# Number of samples without an edge on SOUT after which the pin is not connected, or disabled in the device
EDGES_AFTER_SAMPLES: Final = 100
PPS_AFTER_S: Final = 10.0
DOWN: Final = "the received data is unknown, because the daemon does not reply"


def heard(at: Surroundings) -> Findings:
    """Check the bytes and frames of devices on UARTs."""
    names = {one.name for one in at.devices("uart")}
    for one in _status(at, names):
        if isinstance(one, DoctorFinding):
            yield one
            return
        counts = one.ledger
        if one.state in (DeviceState.MISSING, DeviceState.FAILED, DeviceState.FINISHED):
            continue
        # with samples, wires and baud rate are correct
        if counts["samples"]:
            if one.unused:
                yield warning(f"{one.name}: imud does not use {one.unused}", "switch these frames off on the device")
            yield from _damage(one)
            yield from _answers(at, one)
        elif counts["bytes_in"] == 0:
            yield error(
                f"{one.name}: no byte arrives on {one.link}: the device has no power, or its TX is not connected to RX",
                "does the device have power? Are TX and RX swapped (connect TX of each side to RX of the other side)? "
                "Is ground connected? Do both sides use the same levels (TTL 3.3 V, RS-232 or RS-485)?",
            )
        # frames with a correct check value: the baud rate and the driver are right
        elif counts["frames_ignored"]:
            yield error(
                f"{one.name}: {one.unused or one.problem or 'valid frames of unknown types, but no sample'}",
                "select a frame type that imud decodes, in the settings of the device",
            )
        # framing errors are typical of a wrong baud rate
        elif one.kernel.framing or one.kernel.break_:
            yield error(
                f"{one.name}: {counts['bytes_in']} bytes, no valid frame; {one.kernel.framing} framing errors",
                "the baud rate is wrong: set `baud: auto`; if it is set, the signal levels are wrong or inverted",
            )
        elif counts["bytes_in"] < HEARD_BYTES:
            yield error(
                f"{one.name}: only {counts['bytes_in']} bytes arrived, no valid frame",
                "are they echoes of imud's requests (TX and RX connected, or a half-duplex adapter)? Use an adapter "
                "without echo; otherwise check the power and TX of the device",
            )
        else:
            yield error(
                f"{one.name}: {counts['bytes_in']} bytes on {one.link}, but no {_missed(one)}",
                "the baud rate, the driver or the device is wrong: set `baud: auto` and `driver: auto`; `imud probe` "
                "tries all drivers",
            )


def _missed(one: DeviceStatus) -> str:
    """Return the name of the missing data."""
    # noise of a wrong baud rate contains lines of text, which count as valid frames
    good = one.ledger["frames_good"]
    return f"sample in {good} frames" if good else "valid frame"


def _damage(one: DeviceStatus) -> Findings:
    counts, kernel = one.ledger, one.kernel
    bad = sum(counts[name] for name in ("frames_bad_crc", "frames_bad_length", "frames_bad_content"))
    if kernel.overrun:
        yield warning(
            f"{one.name}: the kernel lost bytes {kernel.overrun} times (overrun)",
            "reduce the load of this host or the rate, or use an adapter with a larger buffer",
        )
    if bad > DAMAGED_SHARE * counts["frames_good"]:
        yield warning(
            f"{one.name}: {bad} damaged and {counts['frames_good']} good frames; "
            f"{kernel.framing} framing and {kernel.parity} parity errors",
            "use a shorter or shielded cable, a better ground, a lower baud rate; on RS-485 120 Ω at both ends",
        )
    elif not kernel.overrun:
        yield ok(f"{one.name}: {counts['frames_good']} good frames, {bad} damaged")


def _answers(at: Surroundings, one: DeviceStatus) -> Findings:
    """Check that a device with samples also replies to requests."""
    asked = any(device.name == one.name and device.identify for device in (at.config.devices if at.config else ()))
    rate_hz = one.expected_rate_hz or one.rate_hz
    # a reply of any kind shows that RX of the device works
    if not asked or one.identity.get("product") or one.ledger["frames_in_replies"]:
        return
    if one.state is DeviceState.RUNNING and one.ledger["samples"] > ANSWERED_AFTER_S * rate_hz > 0:
        yield warning(
            f"{one.name} sends samples, but never replied: RX of the device is not connected to TX of this port",
            "connect TX of the adapter to RX of the device, with the correct level (3.3 V or RS-232); without this "
            "wire, imud cannot change its settings. If the wire is not wanted: `identify: false`",
        )


def half_duplex(at: Surroundings) -> Findings:
    """Check the requests on RS-485 buses: missing replies, echoes, invalid bytes."""
    for one in _status(at, {one.name for one in at.devices("rs485")}):
        if isinstance(one, DoctorFinding):
            yield one
            return
        line = one.serial_line
        if line is None:
            continue
        polls = one.polling.polls if one.polling is not None else 0
        if one.state is not DeviceState.RUNNING and line.timeouts:
            heard = f"imud received only {line.echoes} echoes of its requests" if line.echoes else "no byte arrived"
            yield error(
                f"{one.name}: {line.timeouts} requests without a reply; {heard} on {one.link}",
                "check the power, A and B (swapped?), the address and the baud rate: stop the daemon, then run `imud "
                "modbus scan`. Does the adapter need `direction` to switch between send and receive?",
            )
        elif line.strange_bytes > max(line.timeouts, 1) or line.timeouts * 100 > polls:
            yield warning(
                f"{one.name}: {line.timeouts} requests without a reply, {line.strange_bytes} invalid bytes",
                "check: 120 Ω at both ends, bias at one end, each address used once; set a longer `reply_ms`",
            )
        else:
            yield ok(f"{one.name}: the RS-485 bus works" + ("; imud ignores the echoes" if line.echoes else ""))


def lines(at: Surroundings) -> Findings:
    """Check that configured GPIO lines have edges."""
    wired = {one.name for one in at.config.devices if one.lines is not None} if at.config else set()
    for one in _status(at, wired):
        if isinstance(one, DoctorFinding):
            yield one
            return
        if one.lines is None:
            continue
        for name, problem in one.lines.problems.items():
            yield error(f"{one.name}: {name}: {problem}", "docs/lines.md; `gpioinfo` lists the lines and their users")
        for name, edges in one.lines.edges.items():
            if name not in one.lines.problems:
                yield _edges(one, name, edges, one.lines.edges_lost.get(name, 0))


def _edges(one: DeviceStatus, name: str, edges: int, lost: int) -> DoctorFinding:
    samples = one.ledger["samples"]
    if lost:
        return warning(
            f"{one.name}: {name}: the kernel lost {lost} of {edges + lost} edges",
            "the host is too busy, or the line is noisy: set `bias: pull-down`, use a shorter wire",
        )
    if edges:
        return ok(f"{one.name}: {name}: {edges} edges")
    if name == "alarm":
        return note(
            f"{one.name}: alarm: no edge so far",
            "normal while the device is within its limits; to test the alarm, tilt the device beyond a limit",
        )
    rate_hz = one.expected_rate_hz or one.rate_hz
    enough = samples > (PPS_AFTER_S * rate_hz if name == "pps" else EDGES_AFTER_SAMPLES)
    if not enough:
        return not_checked(
            f"{one.name}: {name}: no edge yet, too few samples for a verdict", "run `imud doctor` again in a minute"
        )
    if name == "pps":
        return warning(
            f"{one.name}: pps: no pulse in {samples} samples",
            "does the receiver have a fix? Is this the correct line (`gpiomon`)? Is the level 3.3 V?",
        )
    return warning(
        f"{one.name}: {name}: no edge in {samples} samples",
        "is the wire connected to this GPIO line, is the output enabled in the device (docs/lines.md)? "
        "Try `active_low` and `bias`",
    )


def _status(at: Surroundings, names: set[str] | None = None) -> Iterator[DeviceStatus | DoctorFinding]:
    """Yield the status of these devices, or of all devices. If the daemon does not reply, yield one finding instead."""
    if names is not None and not names:
        return
    if at.status is None:
        yield not_checked(DOWN, "start the daemon, then run `imud doctor` again")
        return
    yield from (one for one in at.status if names is None or one.name in names)
