"""Forsense IMU61x on UART, I2C, SPI and CAN."""
