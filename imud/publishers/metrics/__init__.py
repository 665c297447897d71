"""Output `metrics`."""
