"""Contracts about the sensors themselves: what their documents state."""
