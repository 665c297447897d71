"""HiPNUC devices on RS-485 with Modbus RTU."""
