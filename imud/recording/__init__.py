"""Recordings: the input of a device, recorded and replayed."""
