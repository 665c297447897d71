"""Checks of the daemon itself: configuration, the systemd unit, the socket, and what runs against what is on disk."""

import errno
from typing import Final

from imud.cli.doctor.finding import DoctorFinding, Findings, error, not_checked, note, ok, warning
from imud.cli.doctor.surroundings import Surroundings
from imud.errors import LinkDenied
from imud.units import NS_PER_S, NS_PER_US

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
