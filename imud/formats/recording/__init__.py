"""Recordings: what a daemon read, and when, in blocks that are each readable alone (docs/recording.md)."""
