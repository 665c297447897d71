"""A simulated HiPNUC module on a UART: HI91, HI92, ASCII commands, pins."""
