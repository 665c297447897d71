"""PostgreSQL database of a fleet: tables, rows, transactions, and removal of old rows."""
