"""HiPNUC modules over a UART: HI91, HI92, ASCII commands."""
