"""`imud modbus`."""
