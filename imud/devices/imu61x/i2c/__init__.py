"""IMU61x over I2C."""
