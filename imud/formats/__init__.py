"""Bytes without I/O that several parts share."""
