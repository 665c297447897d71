"""Parts that the IMU61x protocols share: constants of the family; registers and the driver of SPI and I2C."""
