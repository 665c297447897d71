"""GPIO lines: SOUT, SOUT_DIV, SIN, PPS, ALARM, reset and data ready."""
