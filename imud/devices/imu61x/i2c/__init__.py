"""IMU61x on I2C. To read in order: codec, session, settings, driver."""
