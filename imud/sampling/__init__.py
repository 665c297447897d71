"""Time stamps: from the data of a device to time-stamped samples, without I/O."""
