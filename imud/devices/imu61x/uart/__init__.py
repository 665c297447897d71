"""IMU61x over a UART."""
