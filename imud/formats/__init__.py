"""Formats of bytes and text that several parts share, without I/O."""
