"""`imud demo`."""
