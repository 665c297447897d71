"""HiPNUC devices on UART, RS-232 and USB."""
