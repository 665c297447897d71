"""Part of imud."""
