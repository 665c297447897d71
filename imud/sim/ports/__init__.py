"""What simulated devices stand behind (a pseudo-terminal, a CAN interface, pins), its timing and its faults."""
