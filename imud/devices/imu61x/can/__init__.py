"""IMU61x on CAN. To read in order: codec, driver; the device takes no commands."""
