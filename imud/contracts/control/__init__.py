"""What can be done to a device: contracts of its calibrations."""
