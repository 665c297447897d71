"""Output `recorder`."""
