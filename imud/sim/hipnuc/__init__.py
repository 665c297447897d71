"""Simulated HiPNUC devices."""
