"""IMU61x over SPI."""
