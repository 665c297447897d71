"""IMU61x on a UART. To read in order: framing, codec, replies, commands, contact, session, following, calibrating,
settings, actions, calibrations, driver."""
