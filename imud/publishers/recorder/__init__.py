"""Recorder: everything that devices deliver, into files of a bounded directory (docs/recording.md)."""
