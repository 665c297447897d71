"""Tables of the fleet database: creation and removal of old rows."""

from typing import Any

from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import TABLES


class Upkeep:
    """Creation and upkeep of the tables. Synchronization: one thread."""

    def __init__(self, settings: CollectorSettings) -> None:
        self._settings = settings

    def prepare(self, cursor: Any) -> None:
        """Create missing tables. Without a missing table, the user needs no right to create tables."""
        cursor.execute("SELECT pg_advisory_xact_lock(hashtextextended('imud tables', 0))")
        for table in TABLES:
            cursor.execute("SELECT to_regclass(%s)", (table.name,))
            if cursor.fetchone()[0] is None:
                for statement in table.statements():
                    cursor.execute(statement)

    def run(self, cursor: Any) -> None:
        """Do nothing yet."""
