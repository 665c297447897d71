"""Checks of the daemon itself: configuration, the systemd unit, the socket, and what runs against what is on disk."""

import errno
import re
from collections.abc import Iterator
from typing import Final

import msgspec

from imud.cli.doctor.surroundings import DoctorFinding, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.contracts.status import DeviceState, DeviceStatus
from imud.model.errors import LinkDenied, reason_of
from imud.model.units import NS_PER_S, NS_PER_US
from imud.publishers.metrics.publisher import MetricsOptions, Scrapes
from imud.publishers.recorder.directory import RecorderOptions
from imud.publishers.shm import ShmOptions

ENABLED: Final = ("enabled", "enabled-runtime", "linked", "static", "alias")
EXIT_ADVICE: Final = {
    "78": "the configuration cannot be used: `imud check` says where, `systemctl start imud` afterwards",
    "75": "an output that is required could not start: does another imud run? `journalctl -u imud -n 20`",
    "2": "the command line of the unit is wrong: `systemctl cat imud`",
}
"""By exit status of `imud run` (docs/operate.md)."""
STALE_NS: Final = 1 * NS_PER_S
"""A file that is newer than the last reload by less may have been read by it: both times are rounded."""
RESTARTS: Final = 3
"""So many restarts by systemd since the service was started are no coincidence."""


def configuration(at: Surroundings) -> Findings:
    """Look for mistakes in the configuration file."""
    if at.config is not None:
        names = ", ".join(device.name for device in at.config.devices)
        if names:
            yield ok(f"{at.config_file} has no mistakes; devices: {names}")
        else:
            yield warning(f"{at.config_file} has no device", "add one: `imud probe` shows what is attached")
        for name in at.config.disabled:
            yield note(f"device {name} is disabled in {at.config_file}")
        return
    try:
        at.at(at.config_file).open("rb").close()
    except OSError as problem:
        if problem.errno in (errno.EACCES, errno.EPERM):
            yield not_checked(f"{at.config_file} may not be read by this user", "run `sudo imud doctor`")
            return
        if problem.errno == errno.ENOENT:
            yield error(at.config_problem, "`sudo imud setup` writes one for what is attached")
            return
    for line in at.config_problem.splitlines():
        yield error(line, f"correct it; `imud check {at.config_file}` opens no port")


def service(at: Surroundings) -> Findings:
    """Look at the state of imud.service."""
    if not at.unit:
        yield not_checked("systemctl cannot be asked: no systemd runs here, or it does not answer")
        return
    if not at.installed:
        seen = "systemd does not know imud.service; imud starts by hand only"
        yield warning(seen, "install the unit: README.md, `Install as a service`")
        return
    yield _enabled(at)
    state, result = at.unit_value("ActiveState"), at.unit_value("Result")
    if state in ("active", "reloading"):
        yield ok(f"imud.service is {state}")
    elif state == "activating":
        yield warning(
            f"imud.service is starting, or waits for its restart (result: {result or 'none'})",
            "look again in a minute; `journalctl -u imud -n 20`",
        )
    else:
        status = at.unit_value("ExecMainStatus")
        advice = EXIT_ADVICE.get(
            status if result == "exit-code" else "",
            "`sudo systemctl start imud`, then `journalctl -u imud -n 20` if it does not stay",
        )
        yield error(f"imud.service is {state or 'in no known state'} (result: {result or 'none'})", advice)
    restarts = at.unit_value("NRestarts")
    if restarts.isdecimal() and int(restarts) >= RESTARTS:
        yield warning(f"systemd restarted imud.service {restarts} times", "`journalctl -u imud -p warning` has why")
    if at.unit_value("NeedDaemonReload") == "yes":
        yield warning(
            "the unit file of imud.service changed on disk, systemd works with the one before",
            "`sudo systemctl daemon-reload`, then `sudo systemctl restart imud`",
        )


def _enabled(at: Surroundings) -> DoctorFinding:
    state = at.unit_value("UnitFileState")
    if state in ENABLED:
        return ok(f"imud.service is {state}: it starts at boot")
    if state == "masked":
        return error("imud.service is masked: it cannot be started", "`sudo systemctl unmask imud`")
    return warning(
        f"imud.service is {state or 'not enabled'}: it does not start at boot", "`sudo systemctl enable imud`"
    )


def socket(at: Surroundings) -> Findings:
    """Ask the daemon for its status."""
    if at.status is not None:
        yield ok(f"the daemon answers; devices: {', '.join(one.name for one in at.status) or 'none'}")
    elif isinstance(at.status_error, LinkDenied):
        yield not_checked(f"{at.status_error}", "run `sudo imud doctor`, or join the group and log in again")
    elif at.daemon_down:
        yield error(f"{at.status_error}", "`sudo systemctl start imud`, or give the daemon's --socket")
    else:
        yield error(
            f"the daemon does not answer as it should: {at.status_error}",
            "is it overloaded or of another version? `systemctl status imud`",
        )


def stale_configuration(at: Surroundings) -> Findings:
    """Compare the configuration file with what the daemon runs on."""
    if at.config is None:
        yield not_checked("there is no configuration that can be compared with what runs")
        return
    looked = False
    if at.status is not None:
        looked = True
        on_disk, running = {one.name for one in at.config.devices}, {one.name for one in at.status}
        if on_disk != running:
            yield warning(
                f"the daemon has the devices {_names(running)}, {at.config_file} has {_names(on_disk)}",
                "`sudo systemctl reload imud`, or name the daemon's file with --config",
            )
            return
    changed_us = at.unit_value("StateChangeTimestampMonotonic")
    if at.unit_value("ActiveState") == "active" and changed_us.isdecimal() and int(changed_us):
        looked = True
        loaded_ns = int(changed_us) * NS_PER_US + at.boot_utc_ns()
        if at.at(at.config_file).stat().st_mtime_ns > loaded_ns + STALE_NS:
            yield warning(f"{at.config_file} was written after the daemon read it last", "`sudo systemctl reload imud`")
            return
    if looked:
        yield ok(f"the daemon runs with what {at.config_file} has")
    else:
        yield not_checked("no daemon runs whose configuration could be compared")


def device_states(at: Surroundings) -> Findings:
    """Report each device that does not run, with the daemon's own reason."""
    if at.status is None:
        yield not_checked(
            "the daemon does not answer, so the states of its devices are not known",
            "start it; until then `imud probe` listens to what is attached",
        )
        return
    for one in at.status:
        if one.state in ("running", "finished"):
            yield (
                warning(f"{one.name}: {one.problem}", f"`imud status` has more of {one.name}")
                if one.problem
                else ok(f"{one.name} is {one.state}, {one.rate_hz:.1f} samples/s")
            )
        else:
            yield error(
                f"{one.name} is {one.state}: {one.problem or 'the daemon gives no reason'}",
                "see the findings on its port or bus; `imud status` has its counters",
            )


def _names(names: set[str]) -> str:
    return ", ".join(sorted(names)) or "none"


STALE_S: Final = 300.0
"""Prometheus scrapes every 15 s to 1 min; five times as long is no slow configuration."""
NEVER_S: Final = 300.0
"""The same for a daemon that was never scraped: Prometheus may be started after it, and reads its targets anew."""
CONFIGURED: Final = re.compile(r"^metrics:", re.MULTILINE)
"""The key of the metrics in the configuration; without it they are on, and nobody has asked for them."""
SHARED_MEMORY: Final = "/dev/shm"
"""Where RemoveIPC= of a unit removes what the service's user or group owns (systemd.exec(5))."""
EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""An address to listen on that is no address to connect to, and one that is."""


def shared_memory(at: Surroundings) -> Findings:
    """Look whether systemd removes files that the configuration wants to outlive a daemon that is killed."""
    folders = _in_shared_memory(at)
    if not folders or not at.installed:
        return
    for key, folder in folders:
        if at.unit_value("RemoveIPC") == "yes":
            yield warning(
                f"{key} is {folder}, and RemoveIPC= of imud.service removes what is there whenever the daemon ends",
                "`sudo systemctl edit imud`, add `[Service]` and `RemoveIPC=no`, restart imud (docs/operate.md)",
            )
        else:
            yield ok(f"{key}: what is in {folder} stays when the daemon is killed")


def _in_shared_memory(at: Surroundings) -> list[tuple[str, str]]:
    """Keys and folders of the configuration that lie in SHARED_MEMORY."""
    publishers = at.config.publishers if at.config is not None else {}
    shm, recorder = publishers.get("shm"), publishers.get("recorder")
    found = []
    if isinstance(shm, ShmOptions) and shm.enabled:
        found.append(("shm.directory", shm.directory))
    if isinstance(recorder, RecorderOptions) and recorder.flight.enabled:
        found.append(("recorder.flight.directory", recorder.flight.directory))
    return [(key, folder) for key, folder in found if f"{folder}/".startswith(f"{SHARED_MEMORY}/")]


def prometheus(at: Surroundings) -> Findings:
    """Ask the metrics endpoint how often it was scraped."""
    settings = at.config.publishers.get("metrics") if at.config is not None else None
    if not isinstance(settings, MetricsOptions):
        yield not_checked("the address of the metrics is not known without a configuration")
        return
    if not settings.enabled:
        yield note("metrics are switched off in the configuration: Prometheus sees nothing of imud")
        return
    if settings.port == 0:
        yield not_checked("the metrics have a port of the system's choice (`port: 0`)", "give them one; 9321 is usual")
        return
    if at.daemon_down:
        yield not_checked("no daemon runs, so there are no metrics")
        return
    place = f"{settings.address} port {settings.port}"
    try:
        text = at.fetch(EVERYWHERE.get(settings.address, settings.address), settings.port, "/scrapes")
        counted = msgspec.json.decode(text, type=Scrapes)
    except OSError as problem:
        yield error(
            f"metrics do not answer at {place}: {reason_of(problem)}",
            "`journalctl -u imud -p warning`: is the port taken? `sudo ss -ltnp`; a firewall?",
        )
        return
    except msgspec.DecodeError:
        yield error(
            f"another program than imud answers at {place}", "give the metrics another port in the configuration"
        )
        return
    if not counted.scrapes:
        missed = counted.age_s > NEVER_S and CONFIGURED.search(at.text(at.config_file) or "")
        yield (warning if missed else note)(
            f"nothing has scraped {place} since it was opened {_ago(counted.age_s)} ago",
            'where Prometheus should: `up{job="imud"}` there; from another machine `address: 0.0.0.0`; '
            "docs/monitoring.md. Where nothing is to: `metrics: {enabled: false}`",
        )
    elif counted.age_s > STALE_S:
        yield warning(
            f"nothing has scraped {place} for {counted.age_s / 60:.0f} minutes, {counted.scrapes} times before",
            'does Prometheus run, does it reach this machine? `up{job="imud"}` has its reason',
        )
    else:
        yield ok(f"metrics at {place}: scraped {counted.scrapes} times, last {counted.age_s:.0f} s ago")


def _ago(seconds: float) -> str:
    return f"{seconds / 60:.0f} minutes" if seconds >= 120 else f"{seconds:.0f} s"


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
