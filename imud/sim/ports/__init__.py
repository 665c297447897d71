"""Ports, buses and pins of simulated devices, their faults, and a model of arrival times."""
