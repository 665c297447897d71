"""Rows of the fleet database with given values. The other required columns get default values."""

from datetime import UTC, datetime, timedelta
from typing import Any, Final

from imud.fleet.database.tables import FleetTable
from imud.model.units import NS_PER_S

START: Final = datetime(2026, 1, 1, 10, tzinfo=UTC)
DEFAULTS: Final[dict[str, object]] = {
    "site": "mill", "gateway": "gw-1", "boot": "00000000000000aa", "device": "bow", "stream": "statistics",
    "utc_set": True, "first": 1, "last": 1, "samples": 1, "t_ns": 0, "end_t_ns": 0, "t_err_ns": 500, "sync": "edge",
    "seq": 1, "t_rx_ns": 0, "number": 1, "kind": "up", "message": "device is up", "cause": "space", "online": True,
    "reason": "", "version": "0.1.0", "devices": ["bow"], "mqtt": "{}", "begin": 1, "newest": 0, "whole": 0,
    "thinned": 0, "dropped": 0, "dropped_by_cause": "{}", "missing": 0, "duplicates": 0, "gaps": [],
    "topic": "imud/mill/gw-1/state", "payload_bytes": 1, "payload": b"x",
}  # fmt: skip


def insert(cursor: Any, table: FleetTable, at_s: float = 0.0, **values: object) -> None:
    """Insert a row. `at_s`: its time after START, s."""
    time = START + timedelta(seconds=at_s)
    utc_ns = round(time.timestamp()) * NS_PER_S
    times = {"time": time, "utc_ns": utc_ns, "end_utc_ns": utc_ns, "stored_at": time, "updated_at": time}
    given = DEFAULTS | times | values
    needed = [one.name for one in table.columns if "NOT NULL" in one.type and "DEFAULT" not in one.type]
    row = {name: given[name] for name in dict.fromkeys((*needed, *values))}
    places = ", ".join(f"%({name})s" for name in row)
    cursor.execute(f"INSERT INTO {table.name} ({', '.join(row)}) VALUES ({places})", row)
