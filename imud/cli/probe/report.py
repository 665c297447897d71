"""Table: what `imud probe` says of one device, or of a port without one, and the columns of its output."""

import msgspec

HEAD = ("PORT", "DRIVER", "RATE", "PRODUCT", "SERIAL NUMBER", "")


class ProbeReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """What stands at one port, or is one of those on a bus."""

    port: str
    title: str = ""
    """What the adapter calls itself; the state of a bus."""
    driver: str = ""
    device: str = ""
    """Which one on a bus, for example `node 8`."""
    baud: int = 0
    """Rate of port or bus, bit/s."""
    identity: dict[str, str] = {}  # msgspec copies a mutable default
    problem: str = ""


def row(report: ProbeReport) -> tuple[object, ...]:
    """A report as a line of the table."""
    identity = report.identity
    return (
        report.port,
        f"{report.driver} {report.device}".strip() or "-",
        report.baud or "-",
        identity.get("product", "-"),
        identity.get("serial_number", "-"),
        report.problem or report.title,
    )
