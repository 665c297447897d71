"""Replay of captures in place of a port."""
