"""IMU61x on SPI. To read in order: codec, session, driver."""
