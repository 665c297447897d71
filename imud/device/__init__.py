"""One configured device: its link, samples, scripts, settings, calibrations and state."""
