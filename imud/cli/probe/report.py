"""Table: the columns of `imud probe`, one row per device or per port without one."""

import msgspec

HEAD = ("PORT", "DRIVER", "RATE", "PRODUCT", "SERIAL NUMBER", "")


class ProbeReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Result for one port, or for one device of a bus."""

    port: str
    title: str = ""
    """Product name of the adapter; the state of a bus."""
    driver: str = ""
    device: str = ""
    """Address on a bus, for example `node 8`."""
    baud: int = 0
    """Rate of port or bus, bit/s."""
    identity: dict[str, str] = {}  # msgspec copies a mutable default
    problem: str = ""


def row(report: ProbeReport) -> tuple[object, ...]:
    """Format a report as a row of the table."""
    identity = report.identity
    return (
        report.port,
        f"{report.driver} {report.device}".strip() or "-",
        report.baud or "-",
        identity.get("product", "-"),
        identity.get("serial_number", "-"),
        report.problem or report.title,
    )
