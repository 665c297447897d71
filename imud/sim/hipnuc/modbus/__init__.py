"""A simulated HiPNUC module on RS-485, Modbus RTU."""
