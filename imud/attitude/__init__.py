"""Axes, angles, rotation, mounting and gravity, without I/O."""
