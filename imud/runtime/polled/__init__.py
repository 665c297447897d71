"""Devices that speak only when they are asked: I2C, SPI, Modbus."""
