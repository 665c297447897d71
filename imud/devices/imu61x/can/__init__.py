"""IMU61x over CAN."""
