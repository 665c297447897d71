"""GPIO lines and what they mean: SOUT, SIN, PPS, ALARM, reset, data ready."""
