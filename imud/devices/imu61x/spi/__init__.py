"""IMU61x on SPI. To read in order: words, bursts, codec, session, settings, driver."""
