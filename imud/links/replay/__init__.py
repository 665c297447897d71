"""Captures instead of a port."""
