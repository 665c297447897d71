"""Devices that send only on request: I2C, SPI, Modbus."""
