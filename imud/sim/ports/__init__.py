"""Ports of simulated devices (a pseudo-terminal, a CAN interface, pins), with their timing and faults."""
