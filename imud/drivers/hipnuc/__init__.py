"""HiPNUC devices on UART, Modbus, CANopen, J1939 and NMEA 2000."""
