"""Checks of what reads from the daemon by network: Prometheus.

The metrics endpoint counts how often it was asked; `/scrapes` gives that number without being counted itself.
"""

from typing import Final

import msgspec

from imud.cli.doctor.finding import Findings, error, not_checked, note, ok, warning
from imud.cli.doctor.surroundings import Surroundings
from imud.errors import reason_of
from imud.publishers.metrics.publisher import MetricsSettings, Scrapes

STALE_S: Final = 300.0
"""Prometheus scrapes every 15 s to 1 min; five times as long is no slow configuration."""
EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""An address to listen on that is no address to connect to, and one that is."""


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
        yield note(
            f"Prometheus has not scraped {place} since the daemon started",
            'where it should: `up{job="imud"}` in Prometheus; from another machine `address: 0.0.0.0`; docs/metrics.md',
        )
    elif counted.age_s > STALE_S:
        yield warning(
            f"nothing has scraped {place} for {counted.age_s / 60:.0f} minutes, {counted.scrapes} times before",
            'does Prometheus run, does it reach this machine? `up{job="imud"}` has its reason',
        )
    else:
        yield ok(f"metrics at {place}: scraped {counted.scrapes} times, last {counted.age_s:.0f} s ago")
