"""Samples in shared memory, one ring per device."""
