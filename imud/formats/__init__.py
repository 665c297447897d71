"""Byte formats that several parts share, without I/O."""
