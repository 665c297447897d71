"""IMU61x on a UART. To read in order: framing, codec, replies, commands, session, actions, driver."""
