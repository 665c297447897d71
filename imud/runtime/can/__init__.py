"""Devices on a CAN bus."""
