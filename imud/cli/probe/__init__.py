"""`imud probe`."""
