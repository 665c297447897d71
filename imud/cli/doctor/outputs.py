"""Checks of what reads from the daemon: files in shared memory that end with the service, Prometheus.

The metrics endpoint counts how often it was asked; `/scrapes` gives that number without being counted itself.
"""

import re
from typing import Final

import msgspec

from imud.cli.doctor.finding import Findings, error, not_checked, note, ok, warning
from imud.cli.doctor.surroundings import Surroundings
from imud.errors import reason_of
from imud.publishers.metrics.publisher import MetricsSettings, Scrapes
from imud.publishers.recorder.settings import RecorderSettings
from imud.publishers.shm.publisher import ShmSettings

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
    if isinstance(shm, ShmSettings) and shm.enabled:
        found.append(("shm.directory", shm.directory))
    if isinstance(recorder, RecorderSettings) and recorder.flight.enabled:
        found.append(("recorder.flight.directory", recorder.flight.directory))
    return [(key, folder) for key, folder in found if f"{folder}/".startswith(f"{SHARED_MEMORY}/")]


def prometheus(at: Surroundings) -> Findings:
    """Ask the metrics endpoint how often it was scraped."""
    settings = at.config.publishers.get("metrics") if at.config is not None else None
    if not isinstance(settings, MetricsSettings):
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
